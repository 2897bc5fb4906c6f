#!/usr/bin/env python3
"""A log of Argoverse 2 -> scans and labels that `clearway evaluate` reads.

    clearway evaluate OUT --extrinsics $(python3 tests/peers/argoverse.py LOG OUT)

Writes NAME.pcd and NAME.label of each sweep to the folder OUT, and prints the mount of the sensor. The two VLP-32C
stand on top of one another, so they are one sensor of 64 rings, in a level frame at their middle. The truth is the
log's map
of the ground: a point within 0.15 m of the published ground-height raster is ground (road inside a drivable area, else
other-ground), a point 0.3 m or more above it is an object, and others have no label.
The packages are installed into an environment below --venv, which is made at the first run.
"""

import argparse
import json
import tempfile
from pathlib import Path

import environment

PACKAGES = ["pyarrow==23.0.0", "numpy"]
# Greatest distance of a ground point from the raster, and least height of an obstacle over it, in metres. Ours, because
# the raster has cells of 0.3 m and three quarters of the points within 10 m are within 0.03 m of it.
GROUND_OFF_M, OBSTACLE_M = 0.15, 0.3
# Height of the rear axle, the origin of Argoverse's frame, over the ground, in metres: the median of the ground points
# within 8 m in the sample log is 0.33 to 0.34 m below it.
AXLE_M = 0.33
# Middle of the two sensors in Argoverse's frame, in metres, from the published calibration of its cars.
SENSOR_M = [1.35, 0.0, 1.60]
# SemanticKITTI's classes.
UNLABELED, ROAD, OTHER_GROUND, OTHER_OBJECT = 0, 40, 49, 99


class GroundMap:
    """Heights of the ground and drivable areas, in the city's frame."""

    def __init__(self, folder):
        import numpy

        self.heights_m = numpy.load(next(folder.glob("*_ground_height_surface_*.npy"))).astype(float)
        placed = json.loads(next(folder.glob("*_img_Sim2_city.json")).read_text())
        assert placed["R"] == [1.0, 0.0, 0.0, 1.0], "a raster without a rotation is needed"
        self.shift_m, self.scale = numpy.array(placed["t"]), placed["s"]
        archive = json.loads(next(folder.glob("log_map_archive_*.json")).read_text())
        outlines = [area["area_boundary"] for area in archive["drivable_areas"].values()]
        self.outlines = [numpy.array([[point["x"], point["y"]] for point in outline]) for outline in outlines]

    def height_m(self, places):
        """Height of the ground at each place; NaN where the raster has none."""
        import numpy

        columns, rows = numpy.rint((places + self.shift_m) * self.scale).astype(int).T
        inside = (columns >= 0) & (rows >= 0) & (columns < self.heights_m.shape[1]) & (rows < self.heights_m.shape[0])
        heights = numpy.full(len(places), numpy.nan)
        heights[inside] = self.heights_m[rows[inside], columns[inside]]
        return heights

    def is_drivable(self, places):
        """Whether each place is in a drivable area: a line to the right crosses an outline an odd number of times."""
        import numpy

        drivable = numpy.zeros(len(places), dtype=bool)
        x, y = places.T
        for outline in self.outlines:
            inside = numpy.zeros(len(places), dtype=bool)
            for (ax, ay), (bx, by) in zip(outline, numpy.roll(outline, -1, axis=0)):
                if ay != by:
                    inside ^= ((ay > y) != (by > y)) & (x < (bx - ax) * (y - ay) / (by - ay) + ax)
            drivable |= inside
        return drivable


def rotation(qw, qx, qy, qz):
    import numpy

    return numpy.array([
        [1 - 2 * (qy * qy + qz * qz), 2 * (qx * qy - qz * qw), 2 * (qx * qz + qy * qw)],
        [2 * (qx * qy + qz * qw), 1 - 2 * (qx * qx + qz * qz), 2 * (qy * qz - qx * qw)],
        [2 * (qx * qz - qy * qw), 2 * (qy * qz + qx * qw), 1 - 2 * (qx * qx + qy * qy)],
    ])


def ranks(points, lasers):
    """Rank of the laser of each point, by the median elevation of its points, 0 the lowest."""
    import numpy

    elevations = numpy.arctan2(points[:, 2], numpy.hypot(points[:, 0], points[:, 1]))
    seen = numpy.unique(lasers)
    order = sorted(seen, key=lambda laser: (numpy.median(elevations[lasers == laser]), laser))
    rank = numpy.zeros(256, dtype=numpy.uint16)
    rank[order] = numpy.arange(len(order))
    return rank[lasers]


def labels(places, ground):
    """SemanticKITTI's class of each point; `places` are in the city's frame."""
    import numpy

    over_m = places[:, 2] - ground.height_m(places[:, :2])
    is_ground = numpy.abs(over_m) <= GROUND_OFF_M
    label = numpy.full(len(places), UNLABELED, dtype="<u4")
    label[over_m > OBSTACLE_M] = OTHER_OBJECT
    label[is_ground] = OTHER_GROUND
    label[is_ground & ground.is_drivable(places[:, :2])] = ROAD
    return label


def write_pcd(file, points, intensity, rings):
    import numpy

    kind = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("ring", "<u2")]
    cloud = numpy.empty(len(points), dtype=kind)
    cloud["x"], cloud["y"], cloud["z"] = points.T
    cloud["intensity"], cloud["ring"] = intensity, rings
    header = (
        "VERSION 0.7\nFIELDS x y z intensity ring\nSIZE 4 4 4 4 2\nTYPE F F F F U\nCOUNT 1 1 1 1 1\n"
        f"WIDTH {len(cloud)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(cloud)}\nDATA binary\n"
    )
    file.write_bytes(header.encode() + cloud.tobytes())


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("log", type=Path, help="a folder with city_SE3_egovehicle.feather, map/ and sensors/lidar/")
    parser.add_argument("out", type=Path, help="folder of the scans and labels")
    parser.add_argument("--venv", type=Path, default=Path(tempfile.gettempdir()) / "clearway-argoverse")
    options = parser.parse_args()
    environment.enter(options.venv, PACKAGES)
    import numpy
    from pyarrow import feather

    def columns(file, *names):
        table = feather.read_table(file)
        return [table.column(name).to_numpy() for name in names]

    poses = columns(options.log / "city_SE3_egovehicle.feather", "timestamp_ns", "qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")
    ground = GroundMap(options.log / "map")
    options.out.mkdir(parents=True, exist_ok=True)
    for file in sorted((options.log / "sensors/lidar").glob("*.feather")):
        x, y, z, intensity, lasers = columns(file, "x", "y", "z", "intensity", "laser_number")
        points = numpy.stack([x, y, z], axis=1).astype(numpy.float32)
        pose = numpy.flatnonzero(poses[0] == int(file.stem))[0]
        qw, qx, qy, qz, *position = [column[pose] for column in poses[1:]]
        places = points.astype(float) @ rotation(qw, qx, qy, qz).T + position
        points -= numpy.array(SENSOR_M, dtype=numpy.float32)
        write_pcd(options.out / f"{file.stem}.pcd", points, intensity / 255, ranks(points, lasers))
        labels(places, ground).tofile(options.out / f"{file.stem}.label")
    print(f"{SENSOR_M[0]},{SENSOR_M[1]},{SENSOR_M[2] + AXLE_M:.2f},0,0,0")


if __name__ == "__main__":
    main()
