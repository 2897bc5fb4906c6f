"""Questions of a planner to one layer: whether an area or a path is free, what blocks it, what is nearest, and how far
the next cell is that is not free.

In: a grid with classes, and a polygon, a path or a point in the ego frame (x forward, y left, metres). Out: answers
from the meanings in the layer's legend. They consider every cell that an area touches, its border included. Only the
meaning free is free; ground outside the grid is not free. A low thing, which some vehicles clear, has an answer of its
own. The Rust client gives the same answers (`client/golden/questions.json`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from .errors import ClearwayError
from .grid import CartesianGrid, Grid, RadialGrid
from .shapes import Arc, Outline, Point, Pose, corners_of, finite, length, poses_of

#: Distance in metres below which a point touches a cell: far more than the rounding errors of a point on a map.
_TOUCH_M = 1e-9
#: Places far outside of a map may overflow: what is no number is never free.
_overflows = np.errstate(over="ignore", invalid="ignore")
#: One number for all stretches of a line, or one for each.
Numbers = float | np.ndarray
#: What a class is to a vehicle that drives onto it.
FREE, LOW, BLOCKS = 0, 1, 2
#: Names of the values of the channel `why` of the layer `freespace`.
_REASONS = ("not seen", "seen", "bridged", "remembered", "step", "obstacle", "overhang", "ditch", "too narrow")


class Blocker(NamedTuple):
    """A cell that is not free."""

    #: Centre of the cell, in metres; of a place outside the grid, that place.
    x_m: float
    y_m: float
    #: Name of its class; `unknown` outside the grid.
    name: str
    #: Why the cell has its class, if the map says it; `outside of the map` outside the grid.
    why: str | None


class Answer(NamedTuple):
    """What a vehicle may do on an area."""

    #: `free`: drive there. `low`: drive there if it clears low things. `blocked`: not drive there.
    verdict: str
    #: The cell nearest to the ego origin that forbids it; `None` if the area is free.
    blocker: Blocker | None


class Along(NamedTuple):
    """What a vehicle meets on a path."""

    #: Length of the path, in metres.
    length_m: float
    #: The first low thing and the distance along the path at which the vehicle touches it, in metres; `None` behind
    #: the first cell that blocks.
    low: tuple[float, Blocker] | None
    #: The first cell that blocks and the distance along the path at which the vehicle touches it, in metres.
    blocked: tuple[float, Blocker] | None


class Obstacle(NamedTuple):
    """The nearest point of a cell that contains an obstacle. Ego frame, metres."""

    x_m: float
    y_m: float
    #: Distance from the given point, in metres; 0 if the point lies in such a cell. No obstacle of the layer is nearer.
    #: The obstacle itself can be farther away by up to the size of the cell, because a map does not state where in a
    #: cell it stands.
    distance_m: float
    #: Name of the cell's class.
    name: str


class Asked:
    """One layer as questions see it."""

    def __init__(
        self, grid: Grid, classes: np.ndarray, names: Sequence[str], kinds: Sequence[int], why: np.ndarray | None
    ) -> None:
        """`kinds`: FREE, LOW or BLOCKS for each class. `why`: the raw values of the channel `why`, if there is one."""
        self._grid, self._classes, self._names, self._why = grid, classes.ravel(), names, why
        self._kinds = np.array([*kinds], dtype=np.int64)

    @_overflows
    def answer(self, polygon: Sequence[Point]) -> Answer:
        return self._answer(corners_of(polygon), (0.0, 0.0))

    @_overflows
    def along(self, path: Arc | Sequence[Point], outline: Outline) -> Along:
        outline.check()
        poses = poses_of(path, outline)
        low: tuple[float, Blocker] | None = None
        for pose, is_free in zip(poses, self._surely_free(poses, outline)):
            if is_free:
                continue
            answer = self._answer(outline.at(pose.place, pose.heading_rad), pose.place)
            if answer.blocker is None:
                continue
            if answer.verdict == "blocked":
                return Along(poses[-1].along_m, low, (pose.along_m, answer.blocker))
            low = low or (pose.along_m, answer.blocker)
        return Along(poses[-1].along_m, low, None)

    @_overflows
    def nearest(self, wanted: np.ndarray, x_m: float, y_m: float, own: Outline | None) -> Obstacle | None:
        """The nearest point of a cell of a wanted class; cells with their centre within `own` do not count."""
        x_m, y_m = finite("x_m", x_m), finite("y_m", y_m)
        cells = np.flatnonzero(wanted[self._classes])
        if own is not None:
            own.check()
            x, y = self._grid.centres_of(cells).T
            cells = cells[~((x >= -own.rear_m) & (x <= own.front_m) & (abs(y) <= own.width_m / 2.0))]
        if not len(cells):
            return None
        places = self._grid.nearest(cells, x_m, y_m)
        distances = np.hypot(places[:, 0] - x_m, places[:, 1] - y_m)
        nearest = int(distances.argmin())
        name = self._names[self._classes[cells[nearest]]]
        x_m, y_m = places[nearest].tolist()
        return Obstacle(x_m, y_m, float(distances[nearest]), name)

    def clearance(self, most_m: float, passes_low: bool) -> np.ndarray:
        most_m = length("most_m", most_m)
        if not isinstance(self._grid, CartesianGrid):
            raise ClearwayError("no_squares", "the layer has a radial grid; the clearance is computed on square cells alone")
        height, width = self._grid.shape
        kinds = self._kinds[self._classes].reshape(height, width)
        free = (kinds == FREE) | (passes_low & (kinds == LOW))
        reach = math.ceil(min(most_m / self._grid.cell_m + 0.5, height + width))
        down = _halves(_steps_down(free, reach))
        squared: np.ndarray = down.copy()
        for by in range(1, min(reach, width) + 1):
            away = _halves(np.int64(by))
            if away >= squared.max():
                break
            for here, there in ((np.s_[:, by:], np.s_[:, :-by]), (np.s_[:, :-by], np.s_[:, by:])):
                np.minimum(squared[here], down[there] + away, out=squared[here])
            # Outside the grid nothing is free.
            for border in (squared[:, :by], squared[:, width - by :]):
                np.minimum(border, away, out=border)
        return np.minimum(np.sqrt(squared.astype(np.float64)) * (self._grid.cell_m / 2.0), most_m)

    def _surely_free(self, poses: Sequence[Pose], outline: Outline) -> np.ndarray:
        """By pose: true if every cell of a few upright boxes is free which together cover the outline there. That
        is found for all poses at once; a pose for which it is false may be free too."""
        grid = self._grid
        if not isinstance(grid, CartesianGrid):
            return np.zeros(len(poses), dtype=bool)
        length_m = outline.front_m + outline.rear_m
        parts = max(1, math.ceil(min(8.0, length_m / max(outline.width_m, 0.1))))
        x = np.linspace(-outline.rear_m, outline.front_m, parts + 1)[:, None]
        y = np.array([-outline.width_m / 2.0, outline.width_m / 2.0])
        heading = np.array([pose.heading_rad for pose in poses])[:, None, None]
        place = np.array([pose.place for pose in poses])
        ego_x = place[:, 0, None, None] + x * np.cos(heading) - y * np.sin(heading)
        ego_y = place[:, 1, None, None] + x * np.sin(heading) + y * np.cos(heading)
        sin, cos = math.sin(grid.yaw_rad), math.cos(grid.yaw_rad)
        u = (ego_x * cos - ego_y * sin - grid.origin_x_m) / grid.cell_m
        v = (ego_x * sin + ego_y * cos - grid.origin_y_m) / grid.cell_m
        slack = 10.0 * _TOUCH_M / grid.cell_m
        # Each part lies between two of the lines across the outline.
        first = [np.minimum(of.min(axis=2)[:, :-1], of.min(axis=2)[:, 1:]) for of in (u, v)]
        last = [np.maximum(of.max(axis=2)[:, :-1], of.max(axis=2)[:, 1:]) for of in (u, v)]
        left, low = (np.floor(of - slack) for of in first)
        right, high = (np.floor(of + slack) + 1.0 for of in last)
        # False if one is not a number. A place far outside has no cell number.
        is_inside = (left >= 0) & (low >= 0) & (right <= grid.width) & (high <= grid.height)
        if not is_inside.any():
            return np.zeros(len(poses), dtype=bool)
        left, low, right, high = (np.where(is_inside, of, 0.0).astype(np.int64) for of in (left, low, right, high))
        row, column = low[is_inside].min(), left[is_inside].min()
        near = self._classes.reshape(grid.shape)[row : high[is_inside].max(), column : right[is_inside].max()]
        # For each corner of the cells near the path: how many that are not free lie in the rows and columns before it.
        before = np.pad((self._kinds != FREE)[near].cumsum(0).cumsum(1), ((1, 0), (1, 0)))
        low, high = (np.where(is_inside, of - row, 0) for of in (low, high))
        left, right = (np.where(is_inside, of - column, 0) for of in (left, right))
        others = before[high, right] - before[low, right] - before[high, left] + before[low, left]
        are_free: np.ndarray = (is_inside & (others == 0)).all(axis=1)
        return are_free

    def _answer(self, corners: list[Point], start: Point) -> Answer:
        cells, outside = touched(self._grid, corners)
        kinds = self._kinds[self._classes[cells]]
        blocking = cells[kinds == BLOCKS]
        if len(blocking):
            return Answer("blocked", self._blocker(blocking, start))
        if outside is not None:
            return Answer("blocked", Blocker(*outside, "unknown", "outside of the map"))
        low = cells[kinds == LOW]
        return Answer("low", self._blocker(low, start)) if len(low) else Answer("free", None)

    def _blocker(self, cells: np.ndarray, start: Point) -> Blocker:
        centres = self._grid.centres_of(cells)
        # To a micrometre, so that equal distances are equal in every client. The cells are ascending.
        micrometres = np.floor(np.hypot(centres[:, 0] - start[0], centres[:, 1] - start[1]) * 1e6 + 0.5)
        first = int(micrometres.argmin())
        cell = int(cells[first])
        x_m, y_m = centres[first].tolist()
        return Blocker(x_m, y_m, self._names[self._classes[cell]], self._reason(cell))

    def _reason(self, cell: int) -> str | None:
        if self._why is None:
            return None
        raw = int(self._why.flat[cell])
        return _REASONS[raw] if 0 <= raw < len(_REASONS) else f"reason {raw}"


def touched(grid: Grid, corners: list[Point]) -> tuple[np.ndarray, Point | None]:
    """The cells that a simple polygon touches, ascending, and its first corner outside the grid or on the grid's
    border; `None` if it lies inside. A cell is touched by an edge, or lies wholly inside; then the line through its
    centre crosses the polygon there."""
    far = next((corner for corner in corners if not all(map(math.isfinite, corner))), None)
    if far is not None:
        return np.empty(0, np.int64), far
    if isinstance(grid, CartesianGrid):
        cells, is_outside = _touched_squares(grid, np.array(corners))
    else:
        cells, is_outside = _touched_sectors(grid, np.array(corners) - grid.centre_m)
    outside = next((corner for corner in corners if _leaves(grid, corner)), corners[0]) if is_outside else None
    return cells, outside


def _leaves(grid: Grid, corner: Point) -> bool:
    x = corner[0] + 2 * _TOUCH_M * np.array([0.0, 1.0, -1.0, 0.0, 0.0])
    y = corner[1] + 2 * _TOUCH_M * np.array([0.0, 0.0, 0.0, 1.0, -1.0])
    return bool((grid.cells_at(x, y) < 0).any())


class _Spans:
    """Touched stretches of lines: in each line the cells from one to another."""

    def __init__(self, lines: int, cells: int) -> None:
        self._cells, self.is_outside = cells, False
        self._borders = np.zeros((lines, cells + 1), dtype=np.int64)

    def add(self, lines: np.ndarray, first: np.ndarray, last: np.ndarray) -> None:
        self.is_outside |= bool((first < 0).any() or (last >= self._cells).any())
        first, last = _limited(first, self._cells), _limited(last + 1, self._cells)
        np.add.at(self._borders, (lines, first), 1)
        np.add.at(self._borders, (lines, np.maximum(first, last)), -1)

    def mask(self) -> np.ndarray:
        """True for each cell of each line that is touched."""
        return self._borders.cumsum(axis=1)[:, :-1] > 0

    def add_pairs(
        self, lines: np.ndarray, places: np.ndarray, to_cell: Callable[[np.ndarray], np.ndarray]
    ) -> None:
        """Adds the stretch from the first to the second of each pair of a line's places in their order."""
        order = np.lexsort((places, lines))
        lines, places = lines[order], places[order]
        self.add(lines[::2], to_cell(places[::2]), to_cell(places[1::2]))


def _touched_squares(grid: CartesianGrid, corners: np.ndarray) -> tuple[np.ndarray, bool]:
    sin, cos = math.sin(grid.yaw_rad), math.cos(grid.yaw_rad)
    x, y = corners[:, 0], corners[:, 1]
    u = (x * cos - y * sin - grid.origin_x_m) / grid.cell_m
    v = (x * sin + y * cos - grid.origin_y_m) / grid.cell_m
    slack = _TOUCH_M / grid.cell_m
    first, last = np.floor(np.fmin.reduce(v) - slack), np.floor(np.fmax.reduce(v) + slack)
    start, end = _limited(np.array([first, last + 1]), grid.height).tolist()
    rows, spans = np.arange(start, end), _Spans(max(end - start, 0), grid.width)
    crossings: list[tuple[np.ndarray, np.ndarray]] = []
    for a, b in zip(np.stack([u, v], axis=-1), np.roll(np.stack([u, v], axis=-1), -1, axis=0)):
        starts, ends, kept = _clip(*_repeated(a, b, len(rows)), 0.0, 1.0, rows - slack)
        starts, ends, also = _clip(starts, ends, 0.0, -1.0, -(rows + 1.0 + slack))
        kept &= also
        low, high = np.minimum(starts[kept, 0], ends[kept, 0]), np.maximum(starts[kept, 0], ends[kept, 0])
        spans.add(rows[kept] - start, np.floor(low - slack), np.floor(high + slack))
        crossed = rows[(a[1] > rows + 0.5) != (b[1] > rows + 0.5)]
        if len(crossed):
            crossings.append((crossed - start, a[0] + (crossed + 0.5 - a[1]) / (b[1] - a[1]) * (b[0] - a[0])))
    if crossings:
        lines, places = map(np.concatenate, zip(*crossings))
        spans.add_pairs(lines, places, np.floor)
    cells = start * grid.width + np.flatnonzero(spans.mask())
    return cells, spans.is_outside or bool(first < 0 or last >= grid.height)


def _limited(cells: np.ndarray, most: int) -> np.ndarray:
    """Numbers of cells from numbers that may be anything: 0 for what is negative or no number, at most `most`."""
    return np.asarray(np.nan_to_num(np.clip(cells, 0, most)).astype(np.int64))


def _touched_sectors(grid: RadialGrid, corners: np.ndarray) -> tuple[np.ndarray, bool]:
    columns = np.arange(grid.columns)
    sin, cos = (f(np.arange(grid.columns + 1) / grid.columns * math.tau) for f in (np.sin, np.cos))
    middle_sin, middle_cos = (f((columns + 0.5) / grid.columns * math.tau) for f in (np.sin, np.cos))

    def row(range_m: np.ndarray) -> np.ndarray:
        return np.searchsorted(grid.row_radius_m, range_m, side="left")

    spans = _Spans(grid.columns, len(grid.row_radius_m))
    crossings: list[tuple[np.ndarray, np.ndarray]] = []
    for a, b in zip(corners, np.roll(corners, -1, axis=0)):
        starts, ends = _repeated(a, b, grid.columns)
        kept = np.ones(grid.columns, dtype=bool)
        if grid.columns > 1:
            starts, ends, kept = _clip(starts, ends, -sin[:-1], cos[:-1], -_TOUCH_M)
            starts, ends, also = _clip(starts, ends, sin[1:], -cos[1:], -_TOUCH_M)
            kept &= also
        starts, ends = starts[kept], ends[kept]
        nearest = _nearest_to_origin(starts, ends)
        farthest = np.maximum(np.hypot(*starts.T), np.hypot(*ends.T))
        spans.add(columns[kept], row(np.hypot(*nearest.T) - _TOUCH_M), row(farthest + _TOUCH_M))
        start, end = (middle_cos * p[1] - middle_sin * p[0] for p in (a, b))
        crossed = np.flatnonzero((start > 0.0) != (end > 0.0))
        share = start[crossed] / (start[crossed] - end[crossed])
        x, y = a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1])
        range_m = x * middle_cos[crossed] + y * middle_sin[crossed]
        crossings.append((crossed[range_m > 0.0], range_m[range_m > 0.0]))
    lines, ranges = map(np.concatenate, zip(*crossings))
    # An odd number of borders lies ahead of a centre inside the polygon.
    inside = columns[np.bincount(lines, minlength=grid.columns) % 2 == 1]
    spans.add_pairs(np.concatenate([lines, inside]), np.concatenate([ranges, np.zeros(len(inside))]), row)
    return np.flatnonzero(spans.mask().T), spans.is_outside


def _repeated(a: np.ndarray, b: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    return np.tile(a, (count, 1)), np.tile(b, (count, 1))


def _clip(
    a: np.ndarray, b: np.ndarray, nx: Numbers, ny: Numbers, offset: Numbers
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The parts of stretches where n . p >= offset, and which of them there are."""
    # A border that is not finite belongs to a stretch that is left out.
    with np.errstate(divide="ignore", invalid="ignore"):
        start, end = (nx * p[:, 0] + ny * p[:, 1] - offset for p in (a, b))
        border = a + (start / (start - end))[:, None] * (b - a)
    is_in, is_out = start >= 0.0, end >= 0.0
    return np.where(is_in[:, None], a, border), np.where(is_out[:, None], b, border), is_in | is_out


def _nearest_to_origin(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    d = b - a
    squared = (d * d).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.where(squared > 0.0, np.clip(-(a * d).sum(axis=1) / squared, 0.0, 1.0), 0.0)
    nearest: np.ndarray = a + share[:, None] * d
    return nearest


def _halves(steps: Any) -> Any:
    """Square of the half cells between a cell's centre and the nearest edge of the cell `steps` further on."""
    halves = np.maximum(2 * steps - 1, 0)
    return halves * halves


def _steps_down(free: np.ndarray, reach: int) -> np.ndarray:
    """For each cell the number of cells up or down its column to the nearest cell that is not free, at most `reach`.
    Outside the grid nothing is free."""
    steps = np.where(free, reach, 0).astype(np.int64)
    for rows in (range(len(steps)), reversed(range(len(steps)))):
        before = np.zeros(steps.shape[1], dtype=np.int64)
        for row in rows:
            before = steps[row] = np.minimum(steps[row], before + 1)
    return steps
