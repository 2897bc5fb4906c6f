"""A layer -> square cells along the axes of a frame, as Nav2 and RViz need them.

The frame is the world's if the map has a pose, else the vehicle's. The cells lie at whole multiples of their edge and
are never rotated, because Nav2's StaticLayer ignores the orientation of a grid. Each has the worst of the layer's cell
at its middle and of the layer's cells whose middles lie in it, so that no obstacle is lost and unknown never becomes
free; an obstacle moves by half the diagonal of a cell at most. The server's ROS 2 topics are made in the same way.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from .errors import ClearwayError
from .grid import CartesianGrid
from .limits import CHANNEL_CELLS_MAX
from .v1 import map_pb2

if TYPE_CHECKING:
    from .layer import Layer

#: Edge of the cells to which radial layers are resampled, in metres: as other layers have them. Most such cells from
#: the vehicle to the edge; larger grids get larger cells.
_CELL_M, _CELLS_MAX = 0.25, 1000
#: Most cells from the frame's origin, whose numbers are exact, and most cells: a turned square has twice its own.
_EDGES_MAX, _AREA_MAX = 1 << 40, 4 * CHANNEL_CELLS_MAX
#: From the best to the worst: free cells have the occupancies 0 to 50, and then:
_UNKNOWN, _OCCUPIED = 99, 100
_NARROW = 50


@dataclass(frozen=True)
class OccupancyGrid:
    """The fields of nav_msgs/OccupancyGrid. Cell (ix, iy) is `data[iy, ix]`."""

    #: Time of the end of the capture: `header.stamp`.
    stamp_ns: int
    #: True if the axes are the world frame's, which your poses define; false if they are the vehicle's: the frame that
    #: `header.frame_id` must name.
    is_in_world: bool
    #: Edge of a cell in metres.
    resolution: float
    width: int
    height: int
    #: Position (x, y, z) of the corner of cell (0, 0); the orientation is the identity.
    origin: tuple[float, float, float]
    #: Shape (height, width): 0 free to 100 not to be entered, -1 unknown. `data.ravel()` is the field of the message.
    data: npt.NDArray[np.int8]


def occupancy_grid(header: map_pb2.Header, layer: Layer, clear_m: float) -> OccupancyGrid:
    """`Map.to_occupancy_grid`."""
    worst = _worst(layer)
    if clear_m > 0:
        graded = np.rint(_NARROW * (1 - layer.clearance(clear_m) / clear_m))
        worst = np.where(worst == 0, graded.astype(np.int8), worst)
    (x_m, y_m), edge_m, cells = _aligned(header, layer, worst)
    data = np.where(cells == _UNKNOWN, -1, cells).astype(np.int8)
    z_m = header.map_from_ego.z
    is_in_world = header.HasField("map_from_ego")
    height, width = data.shape
    return OccupancyGrid(header.capture_end_ns, is_in_world, edge_m, width, height, (x_m, y_m, z_m), data)


def costmap(header: map_pb2.Header, layer: Layer, inscribed_m: float) -> npt.NDArray[np.uint8]:
    """`Map.to_costmap`."""
    worst = _worst(layer)
    if inscribed_m > 0:
        worst = np.where((worst == 0) & (layer.clearance(inscribed_m) < inscribed_m), np.int8(1), worst)
    cells = _aligned(header, layer, worst)[2]
    values = np.zeros(_OCCUPIED + 1, np.uint8)
    values[[1, _UNKNOWN, _OCCUPIED]] = 253, 255, 254
    return values[cells]


def _worst(layer: Layer) -> npt.NDArray[np.int8]:
    """For each cell 0 (free), `_UNKNOWN` or `_OCCUPIED`."""
    by_meaning: dict[int, int] = {
        map_pb2.CLASS_MEANING_FREE: 0, map_pb2.CLASS_MEANING_OCCUPIED: _OCCUPIED,
        map_pb2.CLASS_MEANING_LOW: _OCCUPIED, map_pb2.CLASS_MEANING_NOT_REACHED: _OCCUPIED,
    }  # fmt: skip
    of_class = [by_meaning.get(entry.meaning, _UNKNOWN) for entry in layer.legend_entries]
    return np.asarray(np.array(of_class, np.int8)[layer.classes])


def _aligned(
    header: map_pb2.Header, layer: Layer, worst: npt.NDArray[np.int8]
) -> tuple[tuple[float, float], float, npt.NDArray[np.int8]]:
    """Corner, edge and cells along the axes of the frame, from a value for each cell of the layer."""
    grid, (x_m, y_m, heading) = layer.grid, _pose(header)
    cos, sin = math.cos(heading), math.sin(heading)
    corners, middles = grid.corners().reshape(-1, 2), grid.centres().reshape(-1, 2)
    if isinstance(grid, CartesianGrid):
        edge_m = grid.cell_m
    else:
        edge_m = max(_CELL_M, float(np.abs(corners).max()) / _CELLS_MAX)

    def in_edges(points: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Points of the ego frame, in the frame."""
        x, y = points.T
        return np.stack([x_m + cos * x - sin * y, y_m + sin * x + cos * y], axis=-1) / edge_m

    placed = in_edges(corners)
    first, end = np.floor(placed.min(axis=0)), np.ceil(placed.max(axis=0))
    if not (np.abs(placed).max() <= _EDGES_MAX and (end - first).prod() <= _AREA_MAX):
        text = f"layer {layer.name!r}, its vehicle at ({x_m}, {y_m}) m: the corners lie at {first} to {end} cells"
        raise ClearwayError("extent", f"{text} of {edge_m} m; up to {_EDGES_MAX} and {_AREA_MAX} cells are allowed")
    width, height = (end - first).astype(int).tolist()
    iy, ix = np.mgrid[:height, :width]
    x, y = (first[0] + ix + 0.5) * edge_m - x_m, (first[1] + iy + 0.5) * edge_m - y_m
    at_middle = grid.cells_at(cos * x + sin * y, cos * y - sin * x)
    cells = np.where(at_middle < 0, np.int8(_UNKNOWN), worst.ravel()[at_middle])
    column, row = (in_edges(middles) - first).astype(int).T
    np.maximum.at(cells, (row.clip(0, height - 1), column.clip(0, width - 1)), worst.ravel())
    return (float(first[0] * edge_m), float(first[1] * edge_m)), edge_m, cells


def _pose(header: map_pb2.Header) -> tuple[float, float, float]:
    """Position and heading of the ego frame in the world frame; the origin if no pose is known."""
    if not header.HasField("map_from_ego"):
        return 0.0, 0.0, 0.0
    pose = header.map_from_ego
    forward_x = 1 - 2 * (pose.qy * pose.qy + pose.qz * pose.qz)
    return pose.x, pose.y, math.atan2(2 * (pose.qx * pose.qy + pose.qw * pose.qz), forward_x)
