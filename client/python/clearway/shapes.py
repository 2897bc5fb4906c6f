"""The shapes that questions are about: polygons of ground, outlines of vehicles, paths.

In: values in the ego frame (x forward, y left, metres, radians). Out: checked corners and poses. A value that is not
finite, or a polygon that crosses itself, raises a `ClearwayError` with that value, and is never answered. The Rust
client has the same kinds of errors (`reason`) and the same poses.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from .errors import ClearwayError

#: Most corners of a polygon and places of a path, longest path, greatest distance between two judged poses, and
#: greatest way of the farthest corner by turning between them.
_CORNERS_MAX = 1_000
_PATH_M_MAX = 1_000.0
_STEP_M = 0.1

Point = tuple[float, float]


@dataclass(frozen=True)
class Outline:
    """Outline of a vehicle about its reference point, in metres."""

    #: Distance from the reference point to the front.
    front_m: float
    #: Distance from the reference point to the rear.
    rear_m: float
    width_m: float

    def at(self, place: Point, heading_rad: float) -> list[Point]:
        """The corners of the vehicle with its reference point at a place, counter-clockwise from the front right."""
        (x, y), sin, cos = place, math.sin(heading_rad), math.cos(heading_rad)
        left = self.width_m / 2.0
        corners = [(self.front_m, -left), (self.front_m, left), (-self.rear_m, left), (-self.rear_m, -left)]
        return [(x + ahead * cos - side * sin, y + ahead * sin + side * cos) for ahead, side in corners]

    def reach_m(self) -> float:
        """Distance of the farthest corner from the reference point, in metres."""
        return math.hypot(max(self.front_m, self.rear_m), self.width_m / 2.0)

    def check(self) -> None:
        for name in ("front_m", "rear_m", "width_m"):
            length(name, getattr(self, name))


@dataclass(frozen=True)
class Arc:
    """A path of constant curvature from the ego origin, straight ahead at its beginning."""

    #: Curvature in 1/m, positive to the left; 0 is a straight line.
    curvature_per_m: float
    #: Length in metres; negative if the vehicle drives backwards.
    length_m: float


class Pose(NamedTuple):
    """One pose of a path."""

    #: Distance along the path from its beginning, in metres.
    along_m: float
    place: Point
    heading_rad: float


def corners_of(polygon: Sequence[Point]) -> list[Point]:
    """The corners of a polygon, checked; a last corner that repeats the first is left out."""
    corners = _places("polygon", polygon, "corner", 3)
    _check_crossings(corners)
    return corners


def poses_of(path: Arc | Sequence[Point], outline: Outline) -> list[Pose]:
    """Poses of a vehicle, each at most 0.1 m from the one before and turned by so little that its farthest corner moves
    at most as far by that; with both ends. At a place between two stretches the vehicle turns the shorter way, to the
    left if both are equal."""
    reach_m = outline.reach_m()
    return _arc_poses(path, reach_m) if isinstance(path, Arc) else _straight_poses(path, reach_m)


def finite(what: str, value: float) -> float:
    if not math.isfinite(value):
        raise ClearwayError("not_finite", f"{what} is {value}; a finite number is needed")
    return float(value)


def length(what: str, value: float) -> float:
    if finite(what, value) < 0:
        raise ClearwayError("length", f"{what} is {value} m; 0 or more m is allowed")
    return float(value)


def _straight_poses(given: Sequence[Point], reach_m: float) -> list[Pose]:
    places = _places("path", given, "place", 2)
    poses: list[Pose] = []
    before_m = 0.0
    for (ax, ay), (bx, by) in zip(places, places[1:]):
        dx, dy = bx - ax, by - ay
        stretch_m, heading_rad = math.hypot(dx, dy), math.atan2(dy, dx)
        _path_length("the path", before_m + stretch_m)
        if poses:
            along_m, place, before_rad = poses[-1]
            turn_rad = _shorter_turn(before_rad, heading_rad)
            steps = _steps(_turn_m(turn_rad, reach_m))
            poses += [Pose(along_m, place, before_rad + step / steps * turn_rad) for step in range(1, steps)]
        steps = _steps(stretch_m)
        for share in (step / steps for step in range(steps + 1)):
            poses.append(Pose(before_m + share * stretch_m, (ax + share * dx, ay + share * dy), heading_rad))
        before_m += stretch_m
    return poses


def _arc_poses(arc: Arc, reach_m: float) -> list[Pose]:
    curvature, whole_m = finite("curvature_per_m", arc.curvature_per_m), finite("length_m", arc.length_m)
    _path_length("the path", abs(whole_m))
    steps = _steps(max(abs(whole_m), _turn_m(curvature * whole_m, reach_m)))
    poses = []
    for step in range(steps + 1):
        along_m = step / steps * whole_m
        heading_rad = curvature * along_m
        half = heading_rad / 2.0
        chord_m = along_m if abs(half) < 1e-9 else along_m * math.sin(half) / half
        place = (chord_m * math.cos(half), chord_m * math.sin(half))
        poses.append(Pose(abs(along_m), place, math.fmod(heading_rad, math.tau)))
    return poses


def _steps(way_m: float) -> int:
    """Steps of at most 0.1 m on a way."""
    return max(1, math.ceil(way_m / _STEP_M))


def _shorter_turn(from_rad: float, to_rad: float) -> float:
    """The turn from one heading to another, in radians, positive to the left."""
    turn_rad = to_rad - from_rad
    if turn_rad > math.pi:
        return turn_rad - math.tau
    return turn_rad + math.tau if turn_rad <= -math.pi else turn_rad


def _turn_m(turn_rad: float, reach_m: float) -> float:
    """The way of the farthest corner by a turn, in metres."""
    way_m = abs(turn_rad) * reach_m
    _path_length("the turn of the farthest corner", way_m)
    return way_m


def _path_length(what: str, value: float) -> None:
    """Checks the length of a way. A length that is not a number is too long."""
    if not value <= _PATH_M_MAX:
        raise ClearwayError("length", f"{what} is {value} m; 0 to 1000 m is allowed")


def _places(what: str, given: Sequence[Point], one: str, least: int) -> list[Point]:
    """The places without those that repeat the place before."""
    places: list[Point] = []
    for index, place in enumerate(given):
        if len(place) != 2:
            raise ClearwayError("places", f"{one} {index} is {place!r}; x and y in metres are needed")
        x, y = (finite(f"{one} {index}, {axis}", value) for axis, value in zip("xy", place))
        if not places or places[-1] != (x, y):
            places.append((x, y))
    if what == "polygon" and len(places) > 1 and places[0] == places[-1]:
        places.pop()
    if not least <= len(places) <= _CORNERS_MAX:
        text = f"{what} has {len(places)} different places; {least} to {_CORNERS_MAX} are needed"
        raise ClearwayError("places", text)
    return places


def _check_crossings(corners: list[Point]) -> None:
    """Refuses a polygon with two edges that cross. Edges that only touch one another are allowed."""
    edges = list(zip(corners, corners[1:] + corners[:1]))

    def side(edge: tuple[Point, Point], p: Point) -> float:
        (ax, ay), (bx, by) = edge
        return (bx - ax) * (p[1] - ay) - (by - ay) * (p[0] - ax)

    def parted(a: float, b: float) -> bool:
        return (a > 0.0 and b < 0.0) or (a < 0.0 and b > 0.0)

    for first, one in enumerate(edges):
        for second in range(first + 1, len(edges)):
            other = edges[second]
            start, end = side(one, other[0]), side(one, other[1])
            if parted(start, end) and parted(side(other, one[0]), side(other, one[1])):
                share = start / (start - end)
                x, y = (a + share * (b - a) for a, b in zip(*other))
                text = f"edges {first} and {second} of the polygon cross near ({x:.3f}, {y:.3f}) m"
                raise ClearwayError("crossing", f"{text}; a polygon that does not cross itself is needed")
