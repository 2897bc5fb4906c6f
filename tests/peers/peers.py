#!/usr/bin/env python3
"""Times Clearway's stages and other programs in turn, on the same scans and the same packets.

    python3 tests/peers/peers.py [SCAN.bin ...] [--rounds 30] [--out target/peers]

SCAN.bin is a scan in KITTI's format; by default the three of Patchwork++ in $CLEARWAY_DATA, else ../shared/data. The
last scan is a revolution of a simulated HDL-64E, for which there are stages from packets too. In each round every
program runs once, in an order that is drawn again, so that all of them meet the same load. A program's first rounds are
not counted.

Writes to --out: times.csv (scan, points, program, round, milliseconds), ratios.csv (scan, points, program, median of
the milliseconds, median of the ratios to Patchwork++ in the same round) and ratios.png, points.png. Prints the ratios.

| program | what it does with a scan |
|---|---|
| patchwork++ | ground points (PyPI pypatchworkpp) |
| linefit | ground points (PyPI linefit) |
| travel | ground points (PyPI travel-seg) |
| velodyne-decoder | packets of a simulated revolution of an HDL-64E -> points (PyPI velodyne-decoder) |
| clearway STAGE | see tests/benches/stages.rs; `all` is decode + maps + encode |
| clearway LAYER, its share | the layer alone, with a sixth of `shared`, which a map of six layers does once |

The packages are installed into an environment below --venv, which is made at the first run.
"""

import argparse
import os
import random
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import environment
from environment import REPOSITORY

PACKAGES = [
    "pypatchworkpp==1.4.1",
    "linefit==1.1.0",
    "travel-seg==1.1.0",
    "velodyne-decoder==3.1.0",
    "numpy",
    "matplotlib",
]
# Rounds before the first that counts: buffers get their sizes.
WARM_UP = 6
# Shares of the points of a scan, for the plot of cost against points.
SHARES = [1.0, 0.5, 0.25, 0.125]
# The ratios to Patchwork++ that Clearway aims at, greatest allowed.
SHARE = ", its share"
# Stages from packets are of the simulated town.
TOWN = "simulated town"
TARGETS = {
    "freespace_of_packets": 0.3,
    "maps_of_packets": 0.6,
    "all": 0.45,
    "freespace": 0.3,
    f"drivability{SHARE}": 0.08,
    f"terrain{SHARE}": 0.2,
    "occupancy_six_units": 0.1,
}
# How much faster than velodyne-decoder Clearway aims to decode.
DECODE_TARGET = 5


def build():
    """The built bench `stages` and the command `clearway`."""
    small = ["--no-default-features", "-p"]
    stages = environment.build("bench", "--no-run", *small, "clearway-tests", "--bench", "stages")
    command = environment.build("build", "--release", *small, "clearway", "-F", "tools")
    return stages["stages"], command["clearway"]


class Clearway:
    """The bench `stages` on one scan."""

    def __init__(self, bench, scan, height_m):
        command = [bench, scan, "--height", str(height_m), "--ask"]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self.stages = self.process.stdout.readline().split()

    def milliseconds(self, stage):
        print(stage, file=self.process.stdin, flush=True)
        return int(self.process.stdout.readline()) / 1e6

    def close(self):
        self.process.stdin.close()
        self.process.wait()


def timed(work):
    """Milliseconds of processor time of this thread."""
    start = time.thread_time()
    work()
    return (time.thread_time() - start) * 1e3


def peers(points, height_m, packets):
    """For each peer, by name: a function that runs it once and returns its milliseconds."""
    import linefit
    import numpy
    import pypatchworkpp
    import travel_seg
    import velodyne_decoder

    def patchwork():
        parameters = pypatchworkpp.Parameters()
        parameters.sensor_height = height_m
        segmenter = pypatchworkpp.patchworkpp(parameters)
        return timed(lambda: segmenter.estimateGround(points))

    xyz = numpy.ascontiguousarray(points[:, :3])
    line_fit = linefit.ground_seg()
    travel = travel_seg.TravelGroundSeg()
    calibration = velodyne_decoder.get_bundled_calibration("HDL-64E_S2.1-sztaki.yml")
    model = velodyne_decoder.Model.HDL64E_S2
    decoder = velodyne_decoder.ScanDecoder(velodyne_decoder.Config(model=model, calibration=calibration))
    stamped = [velodyne_decoder.VelodynePacket(1e9 + 288e-6 * number, packet) for number, packet in enumerate(packets)]
    revolution = velodyne_decoder.PacketVector(stamped)

    return {
        "patchwork++": patchwork,
        "linefit": lambda: timed(lambda: line_fit.run(xyz)),
        "travel": lambda: timed(lambda: travel.estimate_ground(points)),
        "velodyne-decoder": lambda: timed(lambda: decoder.decode(revolution)),
    }


def simulated_packets(clearway):
    """The packets of one simulated revolution of an HDL-64E."""
    with tempfile.TemporaryDirectory() as folder:
        capture = Path(folder) / "town.pcap"
        command = [clearway, "simulate", "town", "--seconds", "0.1", "--out", capture]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        data = capture.read_bytes()
    packets, at = [], 24
    while at < len(data):
        length = int.from_bytes(data[at + 8 : at + 12], "little")
        frame = data[at + 16 : at + 16 + length]
        at += 16 + length
        # Ethernet, IPv4 and UDP headers take 42 bytes; telemetry is shorter than a packet.
        if len(frame) == 42 + 1206:
            packets.append(frame[42:])
    return packets


def measure(bench, packets, name, points, height_m, rounds, rows):
    """Runs every program once a round; appends rows of times.csv."""
    order = random.Random(name)
    with tempfile.TemporaryDirectory() as folder:
        scan = Path(folder) / "scan.bin"
        points.tofile(scan)
        own = Clearway(bench, scan, height_m)
        programs = peers(points, height_m, packets)
        stages = [stage for stage in own.stages if name == TOWN or not stage.endswith("_of_packets")]
        programs |= {f"clearway {stage}": lambda stage=stage: own.milliseconds(stage) for stage in stages}
        for number in range(WARM_UP + rounds):
            for program in order.sample(sorted(programs), len(programs)):
                milliseconds = programs[program]()
                if number >= WARM_UP:
                    rows.append((name, len(points), program, number - WARM_UP, milliseconds))
        own.close()


def simulated_scan(bench):
    """The points of one revolution of the simulated HDL-64E."""
    import numpy

    with tempfile.TemporaryDirectory() as folder:
        scan = Path(folder) / "scan.bin"
        subprocess.run([bench, "--write", scan], check=True)
        return numpy.fromfile(scan, dtype=numpy.float32).reshape(-1, 4)


def summarise(rows):
    """Rows of ratios.csv: scan, points, program, median milliseconds, median ratio to Patchwork++ of the same round."""
    times = {}
    for scan, points, program, number, milliseconds in rows:
        times.setdefault((scan, points), {}).setdefault(number, {})[program] = milliseconds
    summary = []
    for (scan, points), by_round in times.items():
        for programs in by_round.values():
            programs["clearway all"] = sum(programs[f"clearway {stage}"] for stage in ["decode", "maps", "encode"])
            programs |= shares(programs)
        for program in sorted(next(iter(by_round.values()))):
            median_ms = statistics.median(programs[program] for programs in by_round.values())
            ratio = statistics.median(programs[program] / programs["patchwork++"] for programs in by_round.values())
            summary.append((scan, points, program, median_ms, ratio))
    return summary


def shares(programs):
    """Milliseconds of the layers with a target, each with its share of what a map does once for six layers."""
    common = programs["clearway shared"]
    layers = [target.removesuffix(SHARE) for target in TARGETS if target.endswith(SHARE)]
    return {f"clearway {layer}{SHARE}": programs[f"clearway {layer}"] - common * 5 / 6 for layer in layers}


def draw(summary, out):
    """ratios.png: each program on the whole scans. points.png: cost against the number of points."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    most = {scan: max(points for other, points, *_ in summary if other == scan) for scan, *_ in summary}
    whole = {}
    for scan, points, program, _, ratio in summary:
        if points == most[scan]:
            whole.setdefault(program, []).append(ratio)
    ranked = sorted(whole.items(), key=lambda item: statistics.median(item[1]))
    figure, axes = pyplot.subplots(figsize=(9, 6), layout="constrained")
    colours = ["tab:blue" if name.startswith("clearway") else "tab:gray" for name, _ in ranked]
    axes.barh([name for name, _ in ranked], [statistics.median(ratios) for _, ratios in ranked], color=colours)
    for name, ratios in ranked:
        target = TARGETS.get(name.removeprefix("clearway "))
        if target:
            axes.plot(target, name, "k|", markersize=14)
    axes.set_xscale("log")
    axes.set_xlabel("time of one scan / time of Patchwork++ (bar: a target)")
    figure.savefig(out / "ratios.png", dpi=120)

    figure, axes = pyplot.subplots(figsize=(9, 6), layout="constrained")
    first = summary[0][0]
    for program in ["patchwork++", "linefit", "travel", "clearway all", "clearway drivability", "clearway terrain"]:
        line = sorted((points, ms) for scan, points, name, ms, _ in summary if (scan, name) == (first, program))
        axes.plot([points / 1e3 for points, _ in line], [ms for _, ms in line], marker="o", label=program)
    axes.set_xlabel("thousand points")
    axes.set_ylabel("milliseconds")
    axes.legend()
    figure.savefig(out / "points.png", dpi=120)


def show(summary):
    most = {scan: max(points for other, points, *_ in summary if other == scan) for scan, *_ in summary}
    for scan in most:
        rows = [row[2:] for row in summary if row[:2] == (scan, most[scan])]
        print(f"\n{scan}, {most[scan]} points: program, median ms, ratio to Patchwork++, target")
        for program, ms, ratio in sorted(rows, key=lambda row: row[2]):
            target = TARGETS.get(program.removeprefix("clearway "))
            print(f"  {program:<28} {ms:8.2f} {ratio:8.3f} {'' if target is None else f'<= {target}'}")
        by_name = {program: ms for program, ms, _ in rows}
        faster = by_name["velodyne-decoder"] / by_name["clearway decode"]
        print(f"  decode is {faster:.1f} times as fast as velodyne-decoder (target {DECODE_TARGET})")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    data = Path(os.environ.get("CLEARWAY_DATA", REPOSITORY.parent / "shared/data"))
    scans = sorted(data.glob("kitti/patchwork-plusplus/*.bin"))
    parser.add_argument("scans", nargs="*", type=Path, default=scans)
    parser.add_argument("--height", type=float, default=1.73, help="height of the sensor over the ground, metres")
    parser.add_argument("--rounds", type=int, default=30)
    parser.add_argument("--out", type=Path, default=REPOSITORY / "target/peers")
    parser.add_argument("--venv", type=Path, default=Path(tempfile.gettempdir()) / "clearway-peers")
    options = parser.parse_args()
    if not options.scans:
        parser.error("no scans: name some, or set CLEARWAY_DATA")
    environment.enter(options.venv, PACKAGES)
    import numpy

    bench, clearway = build()
    packets = simulated_packets(clearway)
    # Peers write to the standard output, which belongs to the table.
    table = os.dup(1)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    rows = []
    for index, file in enumerate(options.scans):
        points = numpy.fromfile(file, dtype=numpy.float32).reshape(-1, 4)
        for share in SHARES if index == 0 else SHARES[:1]:
            chosen = numpy.sort(numpy.random.default_rng(1).permutation(len(points))[: int(share * len(points))])
            measure(bench, packets, file.name, points[chosen], options.height, options.rounds, rows)
    measure(bench, packets, TOWN, simulated_scan(bench), 1.9, options.rounds, rows)
    sys.stdout.flush()
    os.dup2(table, 1)
    options.out.mkdir(parents=True, exist_ok=True)
    summary = summarise(rows)
    environment.write_csv(options.out / "times.csv", ["scan", "points", "program", "round", "milliseconds"], rows)
    environment.write_csv(options.out / "ratios.csv", ["scan", "points", "program", "median_ms", "ratio"], summary)
    draw(summary, options.out)
    show(summary)
    print(f"\n{options.out}/times.csv, ratios.csv, ratios.png, points.png")


if __name__ == "__main__":
    main()
