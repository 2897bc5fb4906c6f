"""One decoded map: its layers, its age and whether it is stale.

In: an encoded `clearway.v1.Map` from any transport.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
from google.protobuf.message import DecodeError as ProtobufError

from .costmap import OccupancyGrid, costmap, occupancy_grid
from .errors import ClearwayError, DecodeError
from .freshness import Arrival, Clock, now_ns
from .layer import Layer
from .limits import MAP_BYTES_MAX, MAP_CELLS_MAX, MAP_PARTS_MAX, WIRE_VERSION, count_parts
from .v1 import map_pb2

#: Longest time after its capture for which a map is believed to be valid (the Rust client's view.rs).
_VALID_NS_MAX = 60_000_000_000
#: Most maps that still miss layers. Ours: layers of one map arrive together.
_MAPS_BEGUN_MAX = 16


class Map:
    """A map, decoded and checked. `map["freespace"]` is a layer."""

    def __init__(self, encoded: bytes, skipped: int = 0, base: Map | None = None) -> None:
        """`base`: the base map of layers that are deltas; whole layers do not need it."""
        if len(encoded) > MAP_BYTES_MAX:
            raise DecodeError("too_long", f"map of {len(encoded)} bytes; at most {MAP_BYTES_MAX} are allowed")
        if count_parts(encoded) > MAP_PARTS_MAX:
            raise DecodeError("too_many_parts", f"over {MAP_PARTS_MAX} layers, channels, planes, sensors and names")
        try:
            message = map_pb2.Map.FromString(encoded)
        except ProtobufError as fault:
            raise DecodeError("protobuf", f"not an encoded clearway.v1.Map: {fault}") from None
        _check_header(message)
        #: The header as on the wire: stamps, pose, speed and sensors.
        self.header: map_pb2.Header = message.header
        #: Number of maps made since the one before that this reader did not get, because it or its link was slow.
        self.skipped = skipped
        #: Number of the skipped maps that the link lost (zenoh drops maps on a congested or cut link). 0 over gRPC,
        #: where the server skips maps instead.
        self.lost = 0
        #: Number of maps made since the one before that `max_rate_hz` excluded.
        self.left_out = 0
        #: Arrival at this process; `None` if the map did not come from a server.
        self._arrival: Arrival | None = None
        self._message = message
        #: Names of the layers.
        self._names = [layer.name for layer in message.layers]
        self._bases: dict[str, Layer] = {}
        deltas = [layer for layer in message.layers if layer.HasField("base_sequence")]
        if deltas:
            self._bases = {layer.name: _base(message, layer, base) for layer in deltas}
            # Decoded now, so that no map keeps a chain of earlier maps in memory.
            self.layers
            self._bases = {}

    def with_arrival(self, clock: Clock = Clock()) -> Map:
        """Sets the arrival of the map to now."""
        self._arrival = Arrival.of(self.header.capture_end_ns, self.header.completed_ns, clock)
        return self

    def copy_with(self, skipped: int = 0, lost: int = 0, left_out: int = 0) -> Map:
        """A copy of the map with other counts."""
        other = Map.__new__(Map)
        vars(other).update(vars(self))
        other.skipped, other.lost, other.left_out = skipped, lost, left_out
        return other

    @property
    def vehicle(self) -> str:
        """Name of the vehicle."""
        return self.header.vehicle

    @property
    def sequence(self) -> int:
        """Number of the map: 0, 1, 2 and so on, without gaps, within one run of the server (`header.boot_id`)."""
        return self.header.sequence

    @property
    def pose(self) -> tuple[float, float, float] | None:
        """Where the vehicle is in its locally fixed frame: x, y (m) and the heading (rad, counterclockwise from x), from
        `header.map_from_ego`. `None` if it is not known."""
        if not self.header.HasField("map_from_ego"):
            return None
        of = self.header.map_from_ego
        heading = math.atan2(2 * (of.qw * of.qz + of.qx * of.qy), 1 - 2 * (of.qy**2 + of.qz**2))
        return of.x, of.y, heading

    @cached_property
    def layers(self) -> dict[str, Layer]:
        """Layers by name, in the order of the server's configuration. They are decoded at the first access."""
        cells = sum(channel.cell_count for layer in self._message.layers for channel in layer.channels)
        if cells > MAP_CELLS_MAX:
            text = f"the channels claim {cells} cells; at most {MAP_CELLS_MAX} are allowed"
            raise DecodeError("too_many_cells", text)
        layers: dict[str, Layer] = {}
        for message in self._message.layers:
            if message.name in layers:
                raise DecodeError("twice", f"layer {message.name!r} occurs twice; names are unique")
            layers[message.name] = Layer(message, self._bases.get(message.name))
        return layers

    def __getitem__(self, name: str) -> Layer:
        if name not in self.layers:
            raise ClearwayError("layer", f"no layer {name!r}; this map has {', '.join(self.layers) or 'none'}")
        return self.layers[name]

    def age_ns(self, at_ns: int | None = None) -> int:
        """Age of the map in ns at a time (default: now), measured from the end of the capture. If the map came from a
        server, it is at least the age on arrival plus the time since, so that no step of the clock makes the map
        younger. Else it is negative before the capture."""
        by_wall_ns = (self._now_ns() if at_ns is None else at_ns) - self.header.capture_end_ns
        return by_wall_ns if self._arrival is None else max(by_wall_ns, self._arrival.age_ns_min())

    def age_ms(self, at_ns: int | None = None) -> float:
        """Age of the map in milliseconds (`age_ns`)."""
        return self.age_ns(at_ns) * 1e-6

    @property
    def stale(self) -> bool:
        """True if the map must not be used any more."""
        return self.is_stale(self._now_ns())

    def is_stale(self, at_ns: int) -> bool:
        """True if the map must not be used at a time: its validity has passed, or its capture is so far in the future
        of that time that its age cannot be known."""
        return self.staleness(at_ns) is not None

    @property
    def stale_because(self) -> str | None:
        """Why the map must not be used any more, in a sentence; `None` if it may be used."""
        return self.staleness(self._now_ns())

    def staleness(self, at_ns: int) -> str | None:
        """Why the map must not be used at a time, in a sentence; `None` if it may be used. `Staleness` of the
        Rust client gives the same sentences (`client/golden/staleness.json`)."""
        valid_ns = self._valid_ns()
        ahead_ns = self.header.capture_end_ns - at_ns
        if ahead_ns > valid_ns:
            return f"it was captured {ahead_ns * 1e-6:.0f} ms in the future: its stamps are ahead of the reader's clock"
        came_ns = 0 if self._arrival is None else self._arrival.age_ns
        if came_ns > valid_ns:
            causes = "maps are delayed, its stamps are behind the reader's clock"
            causes += ", or a recording is replayed without --as-live"
            return f"it was {came_ns * 1e-6:.0f} ms old when it arrived: {causes}"
        return "no newer map has arrived" if self.age_ns(at_ns) > valid_ns else None

    def fresh_for_s(self) -> float:
        """Time from now until the map is stale, in seconds; 0 if it is stale."""
        return 0.0 if self.stale else (self._valid_ns() - self.age_ns() + 1) * 1e-9

    def ahead_ns(self) -> int:
        """Time by which the end of the capture lies in the future of this machine's clock, in ns."""
        return self.header.capture_end_ns - self._now_ns()

    def since_arrival_ns(self) -> int:
        """Time since the map arrived at this process, in ns; 0 if it did not come from a server."""
        return 0 if self._arrival is None else self._arrival.since_ns()

    def _valid_ns(self) -> int:
        return min(self.header.valid_until_ns - self.header.capture_end_ns, _VALID_NS_MAX)

    def _now_ns(self) -> int:
        return now_ns() if self._arrival is None else self._arrival.clock.wall_ns()

    def to_occupancy_grid(self, layer: str = "freespace", clear_m: float = 0.0) -> OccupancyGrid:
        """A layer with the fields of nav_msgs/OccupancyGrid, as `OccupancyGrid` describes. With `clear_m`, free cells
        rise from 0 to 50 as their clearance falls from `clear_m` metres to 0: the server's own topics have 2.0. Nothing
        shows there that the map is stale: see `stale` first."""
        return occupancy_grid(self.header, self[layer], clear_m)

    def to_costmap(self, layer: str = "freespace", inscribed_m: float = 0.0) -> npt.NDArray[np.uint8]:
        """The cells of `to_occupancy_grid` with the values of Nav2's costmaps, shape (height, width): 254 not to be
        entered, 255 unknown, 253 free but with less clearance than `inscribed_m` metres, 0 free."""
        return costmap(self.header, self[layer], inscribed_m)

    def __getstate__(self) -> dict[str, Any]:
        """Layers are pickled as they are decoded, and the age in place of the clocks, which are this process's own."""
        age = None if self._arrival is None else (self.age_ns(), self._arrival.clock.is_of_replay)
        replaced: dict[str, Any] = {"header": self.header.SerializeToString(), "_message": None, "_bases": {}, "_arrival": age}
        return vars(self) | {"layers": self.layers} | replaced

    def __setstate__(self, state: dict[str, Any]) -> None:
        """The map arrives now. It is at least as old as it was when it was pickled."""
        vars(self).update(state)
        self.header = map_pb2.Header.FromString(state["header"])
        if state["_arrival"] is not None:
            age_ns, is_of_replay = state["_arrival"]
            end_ns = self.header.capture_end_ns
            arrival = Arrival.of(end_ns, end_ns + age_ns, Clock(is_of_replay=is_of_replay))
            self._arrival = arrival._replace(age_ns=max(arrival.age_ns, age_ns))

    def __repr__(self) -> str:
        age = "" if self._arrival is None else f", {self.age_ms():.0f} ms old{', STALE' if self.stale else ''}"
        return f"<Map {self.sequence} of {self.vehicle}{age}: {', '.join(self._names)}>"


def _base(message: map_pb2.Map, layer: map_pb2.Layer, base: Map | None) -> Layer:
    """The base layer of a delta."""
    if base is None:
        raise DecodeError("no_base", f"layer {layer.name!r} is a delta to that of map {layer.base_sequence}")
    given = (base.vehicle, base.header.boot_id, base.sequence)
    needed = (message.header.vehicle, message.header.boot_id, layer.base_sequence)
    if needed != given:
        raise DecodeError("other_base", f"layer {layer.name!r} is a delta to map {needed}; given was {given}")
    if layer.name not in base.layers:
        raise DecodeError("no_base", f"layer {layer.name!r} is a delta, and its base map does not have this layer")
    return base.layers[layer.name]


def _check_header(message: map_pb2.Map) -> None:
    header = message.header
    if header.wire_version > WIRE_VERSION:
        text = f"wire of version {header.wire_version}; this reader knows versions up to {WIRE_VERSION}"
        raise DecodeError("version", text)
    if not message.HasField("header") or header.capture_start_ns > header.capture_end_ns:
        raise DecodeError("header", "the header is absent, or its capture starts after its end")
    if header.HasField("map_from_ego"):
        pose = header.map_from_ego
        norm = math.hypot(pose.qx, pose.qy, pose.qz, pose.qw)
        if not all(map(math.isfinite, (pose.x, pose.y, pose.z))) or not abs(norm - 1) <= 1e-3:
            raise DecodeError("header", f"map_from_ego {pose}: finite metres and a unit quaternion are needed")


class LayerCollector:
    """Encoded maps of one layer each -> whole maps."""

    def __init__(self, layers: Sequence[str]) -> None:
        self._layers = list(dict.fromkeys(layers))
        #: Parts of the maps that began last, by run and sequence: a false part does not replace a true one.
        self._parts: dict[tuple[int, int], dict[str, bytes]] = {}

    def add(self, part: bytes, message: map_pb2.Map) -> list[bytes]:
        """Adds one layer. Returns the whole map when it is complete, else nothing."""
        id_ = (message.header.boot_id, message.header.sequence)
        parts = self._parts.pop(id_, {})
        parts.update({layer.name: part for layer in message.layers})
        if all(layer in parts for layer in self._layers):
            return [self._whole(parts)]
        self._parts[id_] = parts
        while len(self._parts) > _MAPS_BEGUN_MAX:
            del self._parts[next(iter(self._parts))]
        return []

    def _whole(self, parts: dict[str, bytes]) -> bytes:
        first, *rest = (parts[layer] for layer in self._layers)
        # Protobuf messages concatenate: header and first layer, then the other layers.
        return first + b"".join(_without_header(part) for part in rest)


def _without_header(part: bytes) -> bytes:
    message = map_pb2.Map.FromString(part)
    message.ClearField("header")
    return message.SerializeToString()
