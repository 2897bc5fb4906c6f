"""One layer of a map: numpy arrays and look-ups in the ego frame.

Frames follow REP-103: x forward, y left, metres, the origin on the ground under the vehicle. Class 0 is unknown in
every layer and is never free.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import IntEnum
from itertools import accumulate
from typing import Any, NamedTuple

import numpy as np

from . import codec
from .errors import ClearwayError, DecodeError
from .grid import CartesianGrid, Grid, RadialGrid
from .limits import MAP_PARTS_MAX, RGB_MAX, SAFE_POINT_STEPS_MAX
from .questions import BLOCKS, FREE, LOW, Along, Answer, Asked, Obstacle
from .shapes import Arc, Outline, finite
from .v1 import map_pb2


@dataclass(frozen=True)
class Channel:
    """One value per cell of a layer."""

    name: str
    #: Unit of `values`: `id` for ids; empty for classes and plain numbers.
    unit: str
    #: Factor from `raw` to `values`.
    scale: float
    #: Raw value of an unknown cell.
    unknown: int
    #: Raw values, in the shape of the grid; read-only.
    raw: np.ndarray

    @property
    def values(self) -> np.ndarray:
        """Values in `unit`; NaN for unknown cells."""
        return np.where(self.raw == self.unknown, np.nan, self.raw * np.float64(self.scale))

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self.raw.flags.writeable = False


class Meaning(IntEnum):
    """What a class means to a planner; `ClassMeaning` of map.proto defines each of them."""

    UNKNOWN = map_pb2.CLASS_MEANING_UNKNOWN
    FREE = map_pb2.CLASS_MEANING_FREE
    INFERRED = map_pb2.CLASS_MEANING_INFERRED
    OCCUPIED = map_pb2.CLASS_MEANING_OCCUPIED
    HIDDEN = map_pb2.CLASS_MEANING_HIDDEN
    NOT_REACHED = map_pb2.CLASS_MEANING_NOT_REACHED
    LOW = map_pb2.CLASS_MEANING_LOW


class LegendEntry(NamedTuple):
    """One class of a layer."""

    #: Name, such as `drivable`; `unknown` for class 0.
    name: str
    #: What a planner may conclude about a cell of this class.
    meaning: Meaning
    #: Colour in which viewers draw the class: 0xRRGGBB.
    rgb: int


class SafePoint(NamedTuple):
    """A point on the medial axis of the free space: as far as possible from the obstacles on both sides. Ego frame,
    metres."""

    x_m: float
    y_m: float
    #: Distance to the nearest cell that is not free, in metres.
    radius_m: float
    #: Indices of earlier points that the vehicle can drive to straight from here.
    links: tuple[int, ...]


class Layer:
    """One grid of a map, with one or more values per cell."""

    def __init__(self, message: map_pb2.Layer, base: Layer | None = None) -> None:
        self.name: str = message.name
        self.grid: Grid = _grid(message)
        #: Cell (row, column) of a delta has the base cell (row, column) + shift.
        self._shift = _shift(message.name, base.grid, self.grid) if base else (0, 0)
        #: The classes, by value of the channel `class`; class 0 is `unknown`.
        self.legend_entries: tuple[LegendEntry, ...] = _legend(message, base)
        #: Names of the classes.
        self.legend: tuple[str, ...] = tuple(entry.name for entry in self.legend_entries)
        self.channels: dict[str, Channel] = {}
        for channel in message.channels:
            if channel.name in self.channels:
                raise DecodeError("twice", f"channel {channel.name!r} occurs twice; names are unique")
            self.channels[channel.name] = self._channel(channel, base)
        #: Planes z = ax + by + c in the ego frame, by segment id, shape (n, 3).
        self.planes = np.array([(p.a, p.b, p.c) for p in message.planes], dtype=np.float64).reshape(-1, 3)
        #: Metrics of the whole layer by name, such as `drivable_share`.
        self.metrics: dict[str, float] = dict(message.metrics)
        #: Safe points, the vehicle's position first.
        self.points: tuple[SafePoint, ...] = tuple(self._points(message.safe_points))
        self._check_classes()

    @property
    def classes(self) -> np.ndarray:
        """Class of each cell, in the shape of the grid: an index of `legend` and `legend_entries`. 0 is unknown, and
        never free."""
        return self._class_channel().raw

    @property
    def free(self) -> np.ndarray:
        """True for each cell whose class means free, in the shape of the grid."""
        return self._means(Meaning.FREE)

    @property
    def obstacles(self) -> np.ndarray:
        """True for each cell whose class means occupied, in the shape of the grid."""
        return self._means(Meaning.OCCUPIED)

    def _cell_at(self, x_m: float, y_m: float) -> int:
        return int(self.grid.cells_at(np.array(finite("x_m", x_m)), np.array(finite("y_m", y_m))))

    def class_at(self, x_m: float, y_m: float) -> str:
        """Name of the class at a point (ego frame, metres); "unknown" outside the grid. A coordinate that is not finite
        raises a `ClearwayError`, as in `meaning_at` and `value_at`."""
        cell = self._cell_at(x_m, y_m)
        return "unknown" if cell < 0 else self.legend[int(self.classes.flat[cell])]

    def meaning_at(self, x_m: float, y_m: float) -> Meaning:
        """Meaning of the class at a point (ego frame, metres); `Meaning.UNKNOWN` outside the grid."""
        cell = self._cell_at(x_m, y_m)
        return Meaning.UNKNOWN if cell < 0 else self.legend_entries[int(self.classes.flat[cell])].meaning

    def value_at(self, channel: str, x_m: float, y_m: float) -> float:
        """Value of a channel at a point (ego frame, metres), in the channel's unit; NaN if nothing is known of the
        cell."""
        cell = self._cell_at(x_m, y_m)
        return math.nan if cell < 0 else float(self.channels[channel].values.flat[cell])

    def is_free(self, polygon: Sequence[tuple[float, float]]) -> bool:
        """True if every cell that a polygon (corners x, y in metres, ego frame) touches, its border included, has a
        class that means free. A corner that is not finite, or edges that cross, raise a `ClearwayError`."""
        return self.answer(polygon).verdict == "free"

    def answer(self, polygon: Sequence[tuple[float, float]]) -> Answer:
        """Whether a vehicle may drive on a polygon, only if it clears low things, or not, and the cell nearest to the
        ego origin that forbids it."""
        return self._asked.answer(polygon)

    def along(self, path: Arc | Sequence[tuple[float, float]], outline: Outline) -> Along:
        """What a vehicle of this outline meets on a path (an arc, or places x, y in metres between which it drives
        straight), judged at poses at most 0.1 m apart."""
        return self._asked.along(path, outline)

    def nearest_obstacle(self, x_m: float = 0.0, y_m: float = 0.0, own: Outline | None = None) -> Obstacle | None:
        """The obstacle of the layer that is nearest to a point (ego frame, metres); `None` if the layer has none. An
        obstacle can also stand in an unknown cell. Cells whose centre lies within `own`, the outline of the vehicle
        itself, do not count, nor do low things."""
        return self._asked.nearest(self._of_classes(Meaning.OCCUPIED), x_m, y_m, own)

    def nearest_low(self, x_m: float = 0.0, y_m: float = 0.0, own: Outline | None = None) -> Obstacle | None:
        """The low thing that is nearest to a point, as `nearest_obstacle`."""
        return self._asked.nearest(self._of_classes(Meaning.LOW), x_m, y_m, own)

    def clearance(self, most_m: float = 10.0, passes_low: bool = False) -> np.ndarray:
        """For each cell the distance in metres from its centre to the nearest point of a cell that is not free, at most
        `most_m`, in the shape of the grid; 0 in such a cell. What lies outside the grid is not free, nor are low
        things, unless `passes_low` is true: for a vehicle that clears them."""
        return self._asked.clearance(most_m, passes_low)

    def plot(self, axes: Any = None) -> Any:
        """Draws the classes in the colours of the legend, forward up, on axes of matplotlib (default: the present
        ones), and returns these axes."""
        from .plot import plot

        return plot(self, axes)

    def __repr__(self) -> str:
        counts = np.bincount(self.classes.ravel()).tolist() if "class" in self.channels else []
        shares = [f"{name} {count / sum(counts):.0%}" for name, count in zip(self.legend, counts) if count]
        return f"<Layer {self.name}, {self.grid}: {', '.join(shares) or 'no classes'}; {', '.join(self.channels)}>"

    @property
    def _asked(self) -> Asked:
        kinds = {Meaning.FREE: FREE, Meaning.LOW: LOW}
        by_class = [kinds.get(entry.meaning, BLOCKS) for entry in self.legend_entries]
        why = self.channels["why"].raw if "why" in self.channels else None
        return Asked(self.grid, self.classes, self.legend, by_class, why)

    def _of_classes(self, meaning: Meaning) -> np.ndarray:
        return np.array([entry.meaning == meaning for entry in self.legend_entries])

    def _channel(self, message: map_pb2.Channel, base: Layer | None) -> Channel:
        rows, columns = self.grid.shape
        if message.cell_count != rows * columns:
            text = f"channel {message.name!r} has {message.cell_count} cells; the grid has {rows * columns}"
            raise DecodeError("cell_count", text)
        make_base = None
        if message.by_class:
            if message.encoding != map_pb2.ENCODING_CHANGES or "class" not in self.channels:
                needed = "the encoding of changes and a channel 'class' before it are needed"
                text = f"layer {self.name!r}: channel {message.name!r} refers to the class of each cell; {needed}"
                raise DecodeError("by_class", text)
            classes = self.channels["class"].raw
            make_base = lambda dtype: codec.by_class(message, classes, len(self.legend), dtype)  # noqa: E731
        elif base is not None:
            make_base = lambda dtype: self._before(message, base, dtype)  # noqa: E731
        raw = codec.decode(message, columns, make_base)
        raw.flags.writeable = False
        return Channel(message.name, message.unit, message.scale, message.unknown, raw)

    def _before(self, message: map_pb2.Channel, base: Layer, dtype: np.dtype) -> np.ndarray:
        before = base.channels.get(message.name)
        if before is None or before.raw.dtype != dtype:
            raise DecodeError("base_shape", f"layer {self.name!r}: the base has no such channel {message.name!r}")
        return codec.shifted(before.raw, self.grid.shape, self._shift, message.unknown)

    def _points(self, packed: map_pb2.SafePoints) -> Iterator[SafePoint]:
        """Unpacks at most `MAP_PARTS_MAX` safe points."""
        count, step = len(packed.x), packed.step_m
        if len(packed.y) != count or len(packed.radius_cm) != count or count > MAP_PARTS_MAX:
            found = f"{count} values of x, {len(packed.y)} of y, {len(packed.radius_cm)} of the radius"
            raise DecodeError("safe_point", f"safe points: {found}; equal numbers up to {MAP_PARTS_MAX} are needed")
        if count and not (math.isfinite(step) and step > 0):
            raise DecodeError("safe_point", f"safe points: a step of {step} m; a finite length over 0 is needed")
        links = self._links(packed, count)
        for index, sums in enumerate(zip(*map(accumulate, (packed.x, packed.y, packed.radius_cm)))):
            if max(map(abs, sums)) > SAFE_POINT_STEPS_MAX or sums[2] < 0:
                allowed = f"up to {SAFE_POINT_STEPS_MAX} in size and a radius of 0 or more are allowed"
                raise DecodeError("safe_point", f"safe point {index}: x, y in steps and radius in cm {sums}; {allowed}")
            yield SafePoint(sums[0] * step, sums[1] * step, sums[2] / 100, tuple(links[index]))

    @staticmethod
    def _links(packed: map_pb2.SafePoints, count: int) -> list[list[int]]:
        starts = list(accumulate(packed.starts))
        if 0 in packed.starts or starts and starts[-1] >= count or len(packed.link_from) != len(packed.link_back):
            found = f"lines of safe points that start at {starts}, and {len(packed.link_from)} links"
            allowed = f"rising numbers under {count}, and as many ends ({len(packed.link_back)}) as links are needed"
            raise DecodeError("safe_point", f"{found}; {allowed}")
        links: list[list[int]] = [[] for _ in range(count)]
        before = (-1, -1)
        for start, back in zip(accumulate(packed.link_from), packed.link_back):
            link = (start, start - back)
            if start >= count or back < 2 or back > start or link <= before:
                allowed = f"links in rising order, each to an earlier one of the {count} safe points, are allowed"
                raise DecodeError("safe_point", f"a link from safe point {link[0]} to {link[1]}; {allowed}")
            links[start].append(link[1])
            before = link
        for index in set(range(1, count)).difference(starts):
            links[index].append(index - 1)
        return links

    def _check_classes(self) -> None:
        channel = self.channels.get("class")
        if channel is None:
            return
        if not self.legend or self.legend[0] != "unknown":
            raise DecodeError("legend", f"legend {self.legend}: class 0 is 'unknown' in every legend")
        if channel.raw.size and (channel.raw.min() < 0 or channel.raw.max() >= len(self.legend)):
            raise DecodeError("class", f"class {channel.raw.max()} has no name among {self.legend}")

    def _class_channel(self) -> Channel:
        if "class" not in self.channels:
            raise ClearwayError("class", f"layer {self.name!r} has no classes; its channels: {list(self.channels)}")
        return self.channels["class"]

    def _means(self, meaning: Meaning) -> np.ndarray:
        return np.asarray(self._of_classes(meaning)[self.classes])


def _grid(message: map_pb2.Layer) -> Grid:
    kind = message.WhichOneof("geometry")
    if kind == "radial":
        radii = np.array(message.radial.row_radius_m, dtype=np.float64)
        ascending = np.isfinite(radii).all() and (np.diff(radii, prepend=0.0) > 0).all()
        centre = (message.radial.centre_x_m, message.radial.centre_y_m)
        if message.radial.columns and len(radii) and ascending and all(map(math.isfinite, centre)):
            return RadialGrid(radii, message.radial.columns, centre)
    elif kind == "cartesian":
        grid = message.cartesian
        finite = all(map(math.isfinite, (grid.origin_x_m, grid.origin_y_m, grid.cell_m, grid.yaw_rad)))
        if grid.width and grid.height and finite and grid.cell_m > 0:
            origin = (grid.origin_x_m, grid.origin_y_m)
            first = (grid.first_ix, grid.first_iy)
            return CartesianGrid(*origin, grid.width, grid.height, grid.cell_m, grid.yaw_rad, *first)
    geometry = getattr(message, kind) if kind else "none"
    raise DecodeError("geometry", f"layer {message.name!r}, geometry: {geometry}")


def _shift(layer: str, before: Grid, now: Grid) -> tuple[int, int]:
    """(rows, columns) from the cells of a grid to the cells of its base layer at the same places."""
    if isinstance(before, CartesianGrid) and isinstance(now, CartesianGrid) and before.cell_m == now.cell_m:
        return now.first_iy - before.first_iy, now.first_ix - before.first_ix
    if isinstance(before, RadialGrid) and isinstance(now, RadialGrid):
        same = (before.columns, before.centre_m) == (now.columns, now.centre_m)
        if same and np.array_equal(before.row_radius_m, now.row_radius_m):
            return 0, 0
    raise DecodeError("base_shape", f"layer {layer!r} is a delta to a grid that is not comparable")


def _legend(message: map_pb2.Layer, base: Layer | None) -> tuple[LegendEntry, ...]:
    """Reads the legend of a layer; a delta without one has the legend of its base layer. A meaning that this version does not
    know becomes `Meaning.UNKNOWN`, so that a planner does not enter cells of that class."""
    names, meanings, colours = len(message.legend), len(message.legend_meanings), len(message.legend_rgb)
    if base is not None and not names | meanings | colours:
        return base.legend_entries
    if not names == meanings == colours:
        found = f"{names} names, {meanings} meanings, {colours} colours"
        text = f"layer {message.name!r}: {found}; equal numbers are needed"
        raise DecodeError("legend", text)
    if names and message.legend_meanings[0] != map_pb2.CLASS_MEANING_UNKNOWN:
        text = f"layer {message.name!r}: class 0 has the meaning {message.legend_meanings[0]}; 0 (unknown) is needed"
        raise DecodeError("legend", text)
    if names and max(message.legend_rgb) > RGB_MAX:
        text = f"layer {message.name!r}: a colour {max(message.legend_rgb):#x}; at most {RGB_MAX:#x} is allowed"
        raise DecodeError("legend", text)
    known = {int(meaning) for meaning in Meaning}
    understood = (Meaning(meaning if meaning in known else 0) for meaning in message.legend_meanings)
    return tuple(map(LegendEntry, message.legend, understood, message.legend_rgb))
