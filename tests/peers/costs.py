#!/usr/bin/env python3
"""Measures and plots what Clearway costs against lasers, cells, readers and vehicles.

    python3 tests/peers/costs.py [lasers cells readers vehicles] [--rounds 3] [--seconds 8] [--out target/costs]

| quantity | cost | bench |
|---|---|---|
| lasers | processor time of one thread for a map, five sensor models in a simulated town | `costs` |
| cells | the same, its encoding and its bytes, each layer of an HDL-64E with finer and finer cells | `costs` |
| readers | processor time of the server, and age of the maps: readers of `drivability` over gRPC | `stream` |
| vehicles | the same: HDL-64Es, each with a reader of `drivability` and `speed` over gRPC | `vehicles` |

A round takes every setting of a quantity once, so that all of them meet the same load; of the first two quantities it
takes ten revolutions. Servers, and what sends and reads, are processes of their own on the same machine.

Writes to --out: costs.csv, a line for each measurement, and costs.png, a dot for each and a line through the medians.
Prints the medians. A quantity that is not named keeps its lines of an earlier costs.csv.
The packages are installed into an environment below --venv, which is made at the first run.
"""

import argparse
import csv
import json
import statistics
import subprocess
import tempfile
from pathlib import Path

import environment

PACKAGES = ["matplotlib"]
# Numbers of readers and of vehicles.
READERS = [1, 10, 100, 300, 1000]
VEHICLES = [1, 2, 4, 8, 12, 16]
# Revolutions of a round in which one thread makes maps.
REVOLUTIONS = 10
# The columns of costs.csv: what was measured, against what, and the results.
NAMES = ["quantity", "series", "setting", "round"]
AGAINST = ["lasers", "points", "cells", "readers", "vehicles"]
RESULTS = ["map_ms", "encode_ms", "bytes", "server_cores", "age_ms_p50", "age_ms_p99", "maps_per_s"]
# Greatest ages that Clearway aims at: of 1,000 readers, of 16 vehicles.
AGE_MS_P99_TARGETS = {"readers": 20, "vehicles": 50}
# The parts of the picture: quantity, what the cost is measured against and how it is written, results and how they
# are written, scales of both axes.
MAP, SERVER = "processor time of a map, ms", "processor time of the server, s/s"
AGE, AGES = "age of the maps, ms", {"age_ms_p50": "median", "age_ms_p99": "99th percentile"}
PANELS = [
    ("lasers", "lasers", "lasers of the sensor", ["map_ms"], MAP, ("linear", "linear")),
    ("lasers", "points", "points of a map", ["map_ms"], MAP, ("linear", "linear")),
    ("cells", "cells", "cells of the layer", ["map_ms"], MAP, ("linear", "linear")),
    ("cells", "cells", "cells of the layer", ["encode_ms"], "processor time of encoding, ms", ("linear", "linear")),
    ("cells", "cells", "cells of the layer", ["bytes"], "bytes of a message", ("log", "log")),
    ("readers", "readers", "gRPC readers", ["server_cores"], SERVER, ("linear", "linear")),
    ("readers", "readers", "gRPC readers", [*AGES], AGE, ("log", "linear")),
    ("vehicles", "vehicles", "vehicles", ["server_cores"], SERVER, ("linear", "linear")),
    ("vehicles", "vehicles", "vehicles", [*AGES], AGE, ("linear", "log")),
]


def measure(programs, quantity, rounds, seconds):
    """Measures a quantity; returns lines of costs.csv."""
    def output(name, *arguments):
        command = [programs[name], *map(str, arguments)]
        return subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout

    if quantity in ["lasers", "cells"]:
        return list(csv.DictReader(output("costs", quantity, "--rounds", rounds * REVOLUTIONS).splitlines()))
    if quantity == "readers":
        bench, options, numbers = "stream", ["--carriers", "grpc"], READERS
    else:
        bench, options, numbers = "vehicles", [], VEHICLES
    in_turn = ",".join(map(str, rounds * numbers))
    report = json.loads(output(bench, f"--{quantity}", in_turn, "--seconds", seconds, "--json", *options))
    return [served(quantity, index // len(numbers), row) for index, row in enumerate(report["rows"])]


def served(quantity, number, row):
    """A line of costs.csv from a row of the bench `stream` or `vehicles`."""
    age_ms_p50, age_ms_p99 = (row["age_ms"] or [None, None])[:2]
    line = {"quantity": quantity, "series": quantity, "setting": row[quantity], "round": number}
    line |= {quantity: row[quantity], "age_ms_p50": age_ms_p50, "age_ms_p99": age_ms_p99}
    return line | {name: row[name] for name in ["server_cores", "maps_per_s"]}


def medians(lines):
    """The medians of all rounds, by quantity, series and setting."""
    groups = {}
    for line in lines:
        groups.setdefault((line["quantity"], line["series"], line["setting"]), []).append(line)
    def median(group, name):
        return statistics.median(float(line[name]) for line in group)

    present = {key: [name for name in AGAINST + RESULTS if group[0][name]] for key, group in groups.items()}
    return {key: {name: median(group, name) for name in present[key]} for key, group in groups.items()}


def draw(lines, file):
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot, ticker

    figure, grid = pyplot.subplots(3, 3, figsize=(18, 15), layout="constrained")
    thousands = ticker.FuncFormatter(lambda value, _: f"{value / 1e3:g}k" if value >= 1e3 else f"{value:g}")
    for axes, (quantity, against, x_label, results, y_label, scales) in zip(grid.flat, PANELS):
        draw_results(axes, [line for line in lines if line["quantity"] == quantity], against, results)
        if y_label == AGE:
            axes.axhline(AGE_MS_P99_TARGETS[quantity], color="black", linestyle=":", label="target, 99th percentile")
        axes.set(title=f"{y_label.split(',')[0]} against {x_label}", xlabel=x_label, ylabel=y_label)
        axes.set(xscale=scales[0], yscale=scales[1])
        for axis in [axes.xaxis, axes.yaxis]:
            axis.set_major_formatter(thousands)
        axes.legend()
    figure.savefig(file, dpi=100)


def draw_results(axes, lines, against, results):
    """For each series and result, a dot for each measurement and a line through the medians."""
    through = {}
    for (_, series, _), values in medians(lines).items():
        through.setdefault(series, []).append(values)
    for series, values in through.items():
        values.sort(key=lambda median: median[against])
        dots = [line for line in lines if line["series"] == series]
        for result in results:
            label = AGES.get(result, series)
            (path,) = axes.plot([v[against] for v in values], [v[result] for v in values], label=label)
            xs, ys = ([float(line[name]) for line in dots] for name in [against, result])
            axes.plot(xs, ys, ".", color=path.get_color(), alpha=0.4, markersize=5)


def show(lines):
    for (quantity, series, setting), values in medians(lines).items():
        named = ", ".join(f"{name} {value:,.4g}" for name, value in values.items())
        print(f"{quantity}: {series}, {setting}: {named}")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    quantities = ["lasers", "cells", "readers", "vehicles"]
    parser.add_argument("quantities", nargs="*", help=f"{', '.join(quantities)}; all by default")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--seconds", type=int, default=8, help="seconds of a measurement of readers or vehicles")
    parser.add_argument("--out", type=Path, default=environment.REPOSITORY / "target/costs")
    parser.add_argument("--venv", type=Path, default=Path(tempfile.gettempdir()) / "clearway-costs")
    options = parser.parse_args()
    chosen = options.quantities or quantities
    if not set(chosen) <= set(quantities):
        parser.error(f"quantities are {', '.join(quantities)}")
    environment.enter(options.venv, PACKAGES)

    benches = [f"--bench={name}" for name in ["costs", "stream", "vehicles"]]
    programs = environment.build("bench", "--no-run", "-p", "clearway-tests", *benches)
    options.out.mkdir(parents=True, exist_ok=True)
    table = options.out / "costs.csv"
    earlier = list(csv.DictReader(table.open())) if table.exists() else []
    lines = [line for line in earlier if line["quantity"] not in chosen]
    for quantity in chosen:
        lines += measure(programs, quantity, options.rounds, options.seconds)
    columns = NAMES + AGAINST + RESULTS
    environment.write_csv(table, columns, [[line.get(name) for name in columns] for line in lines])
    lines = list(csv.DictReader(table.open()))
    draw(lines, options.out / "costs.png")
    show(lines)
    print(f"\n{table}, costs.png")


if __name__ == "__main__":
    main()
