"""Maps of a Clearway server as numpy arrays.

    for m in clearway.watch("localhost:50051", layers=["drivability"]):
        print(m.sequence, m.age_ms(), m["drivability"].classes.shape)

An address is `HOST:PORT` for gRPC, or `zenoh:ENDPOINT` (`zenoh:tcp/localhost:7447`, with certificates
`zenoh:tls/localhost:7447`) for zenoh.
"""

from __future__ import annotations

from collections.abc import Sequence

from . import over_grpc, over_zenoh
from .errors import ClearwayError, DecodeError
from .map import FREE, OBSTACLES, CartesianGrid, Channel, Layer, Map, Obstacle, RadialGrid, SafePoint, now_ns
from .recording import read
from .stream import MapStream
from .tls import Tls
from .v1 import map_pb2, service_pb2

__all__ = [
    "FREE", "OBSTACLES", "CartesianGrid", "Channel", "ClearwayError", "DecodeError", "Layer", "Map", "MapStream",
    "Obstacle", "RadialGrid", "SafePoint", "Tls", "get", "now_ns", "read", "vehicles", "watch",
]  # fmt: skip


def watch(
    address: str,
    vehicle: str = "",
    layers: Sequence[str] = (),
    max_in_flight: int = 2,
    max_rate_hz: float | None = None,
    region: Sequence[float] | None = None,
    deltas: bool = False,
    tls: Tls | None = None,
) -> MapStream:
    """Streams the newest map, beginning with the one there is.

    `vehicle` may be left out over gRPC where the server has one; no `layers` means all of them, and over zenoh they must
    be named. With `tls` the connection is encrypted. The rest is gRPC's: `max_in_flight` maps are on their way without an acknowledgement, at most `max_rate_hz` come
    a second, of each layer the `region` (x_from_m, x_to_m, y_from_m, y_to_m) in the ego frame, and with `deltas` as what has
    changed since the map before: less on the link, the same maps. Errors of the server (an unknown vehicle or layer: the
    message lists the known ones) are raised by the first look.
    """
    if endpoint := _zenoh(address, vehicle, layers):
        if max_rate_hz is not None or region is not None or deltas:
            raise ClearwayError("selection", f"{address}: max_rate_hz, region and deltas are for gRPC, HOST:PORT")
        return over_zenoh.watch(endpoint, vehicle, layers, tls)
    selection = service_pb2.Selection(vehicle=vehicle, layers=layers, max_in_flight=max_in_flight, deltas=deltas)
    if max_rate_hz is not None:
        selection.max_rate_hz = max_rate_hz
    if region is not None:
        x_from_m, x_to_m, y_from_m, y_to_m = region
        selection.region.CopyFrom(map_pb2.Region(x_from_m=x_from_m, x_to_m=x_to_m, y_from_m=y_from_m, y_to_m=y_to_m))
    return over_grpc.watch(address, selection, tls)


def get(address: str, vehicle: str = "", layers: Sequence[str] = (), tls: Tls | None = None) -> Map:
    """The newest map at this moment; it may be stale."""
    if endpoint := _zenoh(address, vehicle, layers):
        return over_zenoh.get(endpoint, vehicle, layers, tls)
    return over_grpc.get(address, vehicle, layers, tls)


def vehicles(address: str, tls: Tls | None = None) -> list[str]:
    """Names of the vehicles that are served now, in order."""
    if address.startswith("zenoh:"):
        return over_zenoh.vehicles(address.removeprefix("zenoh:"), tls)
    return sorted(vehicle.name for vehicle in over_grpc.vehicles(address, tls))


def _zenoh(address: str, vehicle: str, layers: Sequence[str]) -> str | None:
    if not address.startswith("zenoh:"):
        return None
    if not vehicle or not layers:
        raise ClearwayError("selection", f"{address}: over zenoh vehicle and layers are named, such as layers=['terrain']")
    return address.removeprefix("zenoh:")
