"""The two grids of a layer: points <-> cell indices.

In: points and cell indices (row by row) as numpy arrays. Points are in the ego frame: x forward, y left, metres.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class RadialGrid:
    """Rings and sectors; array shape (rows, columns). Row j spans (row_radius_m[j-1], row_radius_m[j]], column c the
    azimuths [c, c+1) * 2 pi / columns, counter-clockwise from the ego x axis, both about the centre."""

    row_radius_m: np.ndarray
    columns: int
    #: Position (x, y) of the centre: the sensor whose lasers define the rows.
    centre_m: tuple[float, float] = (0.0, 0.0)

    @property
    def shape(self) -> tuple[int, int]:
        return len(self.row_radius_m), self.columns

    def __str__(self) -> str:
        range_m = self.row_radius_m[-1]
        return f"{len(self.row_radius_m)} rings to {range_m:.1f} m of {self.columns} sectors"

    def corners(self) -> np.ndarray:
        """Corners of every cell, shape (rows + 1, columns + 1, 2)."""
        azimuth = np.arange(self.columns + 1) / self.columns * math.tau
        ray = np.stack([np.cos(azimuth), np.sin(azimuth)], axis=-1)
        return np.asarray(np.concatenate(([0.0], self.row_radius_m))[:, None, None] * ray + self.centre_m)

    def cells_at(self, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
        """Cell index of each point, -1 outside the grid."""
        x_m, y_m = np.asarray(x_m) - self.centre_m[0], np.asarray(y_m) - self.centre_m[1]
        with np.errstate(over="ignore"):
            row = np.searchsorted(self.row_radius_m, np.hypot(x_m, y_m), side="left")
        share = np.mod(np.arctan2(y_m, x_m) / math.tau, 1.0)
        column = np.minimum((share * self.columns).astype(np.int64), self.columns - 1)
        return np.where(row < len(self.row_radius_m), row * self.columns + column, -1)

    def nearest(self, cells: np.ndarray, x_m: float, y_m: float) -> np.ndarray:
        """The point of each of these cells (indices) that is nearest to a point, shape (n, 2)."""
        x_m, y_m = x_m - self.centre_m[0], y_m - self.centre_m[1]
        row, column = np.divmod(cells, self.columns)
        inner, outer = np.concatenate(([0.0], self.row_radius_m[:-1]))[row], self.row_radius_m[row]

        def along(share: np.ndarray) -> np.ndarray:
            ray = np.stack([np.cos(share * math.tau), np.sin(share * math.tau)], axis=-1)
            return np.asarray(np.clip(ray @ (x_m, y_m), inner, outer)[:, None] * ray)

        share = math.atan2(y_m, x_m) / math.tau % 1.0
        abreast = (column <= share * self.columns) & (share * self.columns <= column + 1)
        # For a point beside the column, the nearest point is on one of the column's two sides.
        first, last = along(column / self.columns), along((column + 1) / self.columns)
        is_first = np.hypot(*(first - (x_m, y_m)).T) <= np.hypot(*(last - (x_m, y_m)).T)
        beside = np.where(is_first[:, None], first, last)
        return np.where(abreast[:, None], along(np.full(len(cells), share)), beside) + self.centre_m

    def centres(self) -> np.ndarray:
        """Centre of every cell, shape (rows, columns, 2)."""
        return self.centres_of(np.arange(math.prod(self.shape))).reshape(*self.shape, 2)

    def centres_of(self, cells: np.ndarray) -> np.ndarray:
        """Centre of each of these cells (indices), shape (n, 2)."""
        row, column = np.divmod(cells, self.columns)
        range_m = 0.5 * (np.concatenate(([0.0], self.row_radius_m[:-1])) + self.row_radius_m)[row]
        azimuth = (column + 0.5) / self.columns * math.tau
        return np.asarray(range_m[:, None] * np.stack([np.cos(azimuth), np.sin(azimuth)], axis=-1) + self.centre_m)


@dataclass(frozen=True)
class CartesianGrid:
    """Squares; array shape (height, width), indexed [iy, ix]. Cell (ix, iy) spans [origin + i * cell_m, origin + (i+1)
    * cell_m).

    The spans are along the grid's axes, which start at the origin of the ego frame; seen from them, the ego frame has
    the heading `yaw_rad`.
    """

    origin_x_m: float
    origin_y_m: float
    width: int
    height: int
    cell_m: float
    yaw_rad: float = 0.0
    #: Number of cell (0, 0) in the endless grid that map.proto defines.
    first_ix: int = 0
    first_iy: int = 0

    @property
    def shape(self) -> tuple[int, int]:
        return self.height, self.width

    def __str__(self) -> str:
        return f"{self.width} x {self.height} cells of {self.cell_m:.3g} m"

    def corners(self) -> np.ndarray:
        """Corners of every cell in the ego frame, shape (height + 1, width + 1, 2)."""
        iy, ix = np.mgrid[: self.height + 1, : self.width + 1]
        return self._placed(ix, iy)

    def cells_at(self, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
        """Cell index of each point, -1 outside the grid."""
        cos, sin = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        with np.errstate(over="ignore", invalid="ignore"):
            ix = np.floor((x_m * cos - y_m * sin - self.origin_x_m) / self.cell_m)
            iy = np.floor((x_m * sin + y_m * cos - self.origin_y_m) / self.cell_m)
            # Compared before they are integers, which far places have not.
            inside = (ix >= 0) & (ix < self.width) & (iy >= 0) & (iy < self.height)
            return np.where(inside, iy * self.width + ix, -1).astype(np.int64)

    def nearest(self, cells: np.ndarray, x_m: float, y_m: float) -> np.ndarray:
        """The point of each of these cells (indices) that is nearest to a point, shape (n, 2)."""
        iy, ix = np.divmod(cells, self.width)
        cos, sin = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        left, bottom = self.origin_x_m + ix * self.cell_m, self.origin_y_m + iy * self.cell_m
        x = np.clip(x_m * cos - y_m * sin, left, left + self.cell_m)
        y = np.clip(x_m * sin + y_m * cos, bottom, bottom + self.cell_m)
        return np.stack([x * cos + y * sin, y * cos - x * sin], axis=-1)

    def centres(self) -> np.ndarray:
        """Centre of every cell in the ego frame, shape (height, width, 2)."""
        return self.centres_of(np.arange(self.width * self.height)).reshape(self.height, self.width, 2)

    def centres_of(self, cells: np.ndarray) -> np.ndarray:
        """Centre of each of these cells (indices) in the ego frame, shape (n, 2)."""
        iy, ix = np.divmod(cells, self.width)
        return self._placed(ix + 0.5, iy + 0.5)

    def _placed(self, ix: np.ndarray, iy: np.ndarray) -> np.ndarray:
        """Points of the ego frame, from numbers of cells along the grid's axes."""
        x, y = self.origin_x_m + ix * self.cell_m, self.origin_y_m + iy * self.cell_m
        cos, sin = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        return np.stack([x * cos + y * sin, y * cos - x * sin], axis=-1)


Grid = RadialGrid | CartesianGrid
