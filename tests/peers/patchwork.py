#!/usr/bin/env python3
"""Patchwork++ beside Clearway's maps, on the very same scans and variations.

    python3 tests/peers/patchwork.py target/release/clearway FOLDER [--variations all] [options of evaluate]

FOLDER may also be sim:random. Runs `clearway evaluate` with these arguments, which writes each scan and its truth to a
folder. Runs PyPI's pypatchworkpp on these files, and prints for each variation or type of world precision, recall and
F1 of the ground points by both protocols of `clearway evaluate`, of Patchwork++ and of Clearway's estimate of the
ground and its maps, and the times.
The packages are installed into an environment below --venv, which is made at the first run.
"""

import argparse
import json
import os
import statistics
import subprocess
import tempfile
from pathlib import Path

import environment

PACKAGES = ["pypatchworkpp==1.4.1", "numpy"]
# Number of times that Patchwork++ processes each scan; the time is the median.
RUNS = 9
PROTOCOLS = ["vegetation_excluded", "low_vegetation_ground"]


class Counts:
    """True positives, false positives and false negatives of ground points."""

    def __init__(self):
        self.right = self.wrong = self.missed = 0

    def add(self, called, scored):
        """`called`: whether each point is called ground. `scored`: 0 not scored, 1 ground, 2 not ground."""
        self.right += int((called & (scored == 1)).sum())
        self.wrong += int((called & (scored == 2)).sum())
        self.missed += int((~called & (scored == 1)).sum())

    def shares(self):
        precision = self.right / max(1, self.right + self.wrong)
        recall = self.right / max(1, self.right + self.missed)
        f1 = 2 * precision * recall / max(1e-9, precision + recall)
        return {"precision": precision, "recall": recall, "f1": f1}


def segment(points, height_m):
    """Whether Patchwork++ calls each point ground, and its time in milliseconds."""
    import numpy
    import pypatchworkpp

    times_ms = []
    for _ in range(RUNS):
        parameters = pypatchworkpp.Parameters()
        parameters.sensor_height = height_m
        # Patchwork++ adapts its thresholds from scan to scan. Each scan is judged by itself, as Clearway's are.
        segmenter = pypatchworkpp.patchworkpp(parameters)
        segmenter.estimateGround(points)
        times_ms.append(segmenter.getTimeTaken() / 1e3)
    called = numpy.zeros(len(points), dtype=bool)
    called[segmenter.getGroundIndices()] = True
    return called, statistics.median(times_ms)


def judge(folder):
    """Counts by protocol and times of Patchwork++ on all written scans, by path and row of the report."""
    import numpy

    rows = {}
    for file in sorted(folder.glob("*/*.bin")):
        described = json.loads(file.with_suffix(".json").read_text())
        points = numpy.fromfile(file, dtype=numpy.float32).reshape(-1, 4)
        truth = numpy.fromfile(file.with_suffix(".truth"), dtype=numpy.uint8).reshape(-1, 2)
        called, time_ms = segment(points, described["extrinsics"]["z_m"])
        for row in described["rows"]:
            counts, times_ms = rows.setdefault((described["path"], row), ([Counts(), Counts()], []))
            times_ms.append(time_ms)
            for protocol, count in enumerate(counts):
                count.add(called, truth[:, protocol])
    return rows


def words(shares):
    return " / ".join(f"{100 * (shares[key] or 0):6.2f}" for key in ["precision", "recall", "f1"])


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clearway", help="the program clearway")
    parser.add_argument("arguments", nargs=argparse.REMAINDER, help="arguments of clearway evaluate")
    parser.add_argument("--venv", type=Path, default=Path(tempfile.gettempdir()) / "clearway-patchwork")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    environment.enter(options.venv, PACKAGES)
    # Patchwork++ writes to the standard output, which belongs to the tables.
    tables = os.fdopen(os.dup(1), "w")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)

    with tempfile.TemporaryDirectory() as written:
        command = [options.clearway, "evaluate", "--json", "--write-scans", written, *options.arguments]
        report = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)
        patchwork = judge(Path(written))
    rows = {}
    for source in report["sources"]:
        for row in source["rows"]:
            counts, times_ms = patchwork.get((source["path"], row["name"]), (None, None))
            if counts is None:
                continue
            shares = dict(zip(PROTOCOLS, [count.shares() for count in counts]))
            name = row["name"] if len(report["sources"]) == 1 else f"{source['path']}: {row['name']}"
            rows[name] = {
                "final_only": row["final_only"],
                "patchwork++": {"ground_points": shares, "ms_p50": statistics.median(times_ms)},
                "clearway": {map["layer"]: {"ground_points": map["ground_points"]} for map in row["maps"]},
                "clearway_all_maps_ms_p50": row["step_ms_p50"],
            }
    if options.json:
        print(json.dumps(rows, indent=2), file=tables)
        return
    def show(line):
        print(line, file=tables)

    show("Ground points, %: precision / recall / F1, vegetation excluded; then low vegetation as ground.")
    for name, row in rows.items():
        show(f"{name}{'*' if row['final_only'] else ''}")
        own = [(layer, values["ground_points"]) for layer, values in row["clearway"].items()]
        for method, points in [("Patchwork++", row["patchwork++"]["ground_points"]), *own]:
            show(f"  {method:<18} {words(points[PROTOCOLS[0]])}    {words(points[PROTOCOLS[1]])}")
        times = row["patchwork++"]["ms_p50"], row["clearway_all_maps_ms_p50"]
        own_ms = "-" if times[1] is None else f"{times[1]:.1f}"
        show(f"  milliseconds a scan: Patchwork++ {times[0]:.1f}, all maps of Clearway {own_ms}")
    show("* for final tables only: no parameter is tuned on these frames")


if __name__ == "__main__":
    main()
