"""Maps of a Clearway server as numpy arrays.

    for m in clearway.watch("localhost:50051", layers=["freespace"]):
        print(m.sequence, m.age_ms(), m["freespace"].classes.shape)

An address is `HOST:PORT` for gRPC, or `zenoh:ENDPOINT` (`zenoh:tcp/localhost:7447`, with certificates
`zenoh:tls/localhost:7447`) for zenoh.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from os import PathLike

from . import over_grpc, over_zenoh
from .costmap import OccupancyGrid
from .errors import ClearwayError, DecodeError, ReplayEnded
from .freshness import now_ns
from .grid import CartesianGrid, RadialGrid
from .ingest import Ingester, PlanSender, Refusal
from .layer import Channel, Layer, LegendEntry, Meaning, SafePoint
from .map import Map
from .questions import Along, Answer, Blocker, Obstacle
from .recorder import Recorder
from .recording import read, read_all
from .shapes import Arc, Outline
from .stream import MapStream, PassedOver
from .tls import Tls
from .v1 import map_pb2, service_pb2

__all__ = [
    "Along", "Answer", "Arc", "Blocker", "CartesianGrid", "Channel", "ClearwayError", "DecodeError", "Ingester",
    "Layer", "LegendEntry", "Map", "MapStream", "Meaning", "Obstacle", "OccupancyGrid", "Outline", "PassedOver",
    "PlanSender", "RadialGrid", "Recorder", "Refusal", "ReplayEnded", "SafePoint", "Tls", "get", "now_ns", "read",
    "read_all", "status", "vehicles", "watch",
]  # fmt: skip


def watch(
    address: str,
    vehicle: str = "",
    layers: str | Sequence[str] = (),
    max_in_flight: int = 2,
    max_rate_hz: float | None = None,
    region: Sequence[float] | None = None,
    deltas: bool = False,
    tls: Tls | None = None,
    signed_by: str | PathLike[str] | None = None,
    replay_clock: bool = False,
    reconnect: bool = False,
) -> MapStream:
    """Streams the newest map, starting with the present one.

    `vehicle` may be empty over gRPC if the server has a single vehicle. `layers` are names, or one name; without them
    every layer is sent; over zenoh vehicle and layers must be named. With `tls` the connection is encrypted. The other
    arguments are for gRPC: at most `max_in_flight` maps are sent without an acknowledgement, and at most `max_rate_hz`
    maps per second. Each layer is cut to the `region` (x_from_m, x_to_m, y_from_m, y_to_m) in the ego frame. With
    `deltas`, layers are sent as changes from the map before: fewer bytes, the same maps. With `replay_clock`, a map is
    as old as it was when it was made, plus the time since it came: for a replay that keeps the recorded stamps. With
    `reconnect`, the stream waits for a server that is not there, at the start and later, with pauses of 0.1 to 5 s;
    `MapStream.reasons` and the log "clearway" say so. Errors of the server are raised by the first `next`; for an
    unknown vehicle or layer the message lists the known ones. Over zenoh, which always reconnects later, `reconnect`
    waits for a router at the start, and `MapStream.reasons` names what no server publishes; with `signed_by`, the
    PEM file of a server's public key, only maps that this server has signed are believed; `MapStream.passed_over`
    counts the others.
    """
    _check_signed_by(address, signed_by)
    layers = _names(layers)
    if endpoint := _zenoh(address, vehicle, layers):
        if max_rate_hz is not None or region is not None or deltas or replay_clock:
            text = "max_rate_hz, region, deltas and replay_clock are for gRPC, HOST:PORT"
            raise ClearwayError("selection", f"{address}: {text}")
        return over_zenoh.watch(endpoint, vehicle, layers, tls, signed_by, reconnect)
    selection = service_pb2.Selection(vehicle=vehicle, layers=layers, max_in_flight=max_in_flight, deltas=deltas)
    if max_rate_hz is not None:
        selection.max_rate_hz = max_rate_hz
    if region is not None:
        x_from_m, x_to_m, y_from_m, y_to_m = region
        selection.region.CopyFrom(map_pb2.Region(x_from_m=x_from_m, x_to_m=x_to_m, y_from_m=y_from_m, y_to_m=y_to_m))
    return over_grpc.watch(address, selection, tls, replay_clock=replay_clock, reconnect=reconnect)


def get(
    address: str,
    vehicle: str = "",
    layers: str | Sequence[str] = (),
    tls: Tls | None = None,
    signed_by: str | PathLike[str] | None = None,
) -> Map:
    """Returns the newest map; it may be stale. `signed_by` as in `watch`."""
    _check_signed_by(address, signed_by)
    layers = _names(layers)
    if endpoint := _zenoh(address, vehicle, layers):
        return over_zenoh.get(endpoint, vehicle, layers, tls, signed_by)
    return over_grpc.get(address, vehicle, layers, tls)


def vehicles(address: str, tls: Tls | None = None) -> list[str]:
    """Returns the sorted names of the vehicles that are served now."""
    if address.startswith("zenoh:"):
        return over_zenoh.vehicles(address.removeprefix("zenoh:"), tls)
    return sorted(vehicle.name for vehicle in over_grpc.vehicles(address, tls))


def status(address: str, vehicle: str = "", tls: Tls | None = None) -> service_pb2.Vehicle:
    """Returns the state of a vehicle, over gRPC: the message `Vehicle` of service.proto, in which each field is
    described. `state` is "ok", "warn" or "error", and `reasons` say why. `vehicle` may be empty if there is one."""
    found = over_grpc.vehicles(address, tls)
    fit = [one for one in found if vehicle in ("", one.name)]
    if len(fit) != 1:
        known = ", ".join(one.name for one in found) or "none"
        raise ClearwayError("vehicle", f"{address}: {len(fit)} vehicles fit {vehicle!r}; the server has {known}")
    return fit[0]


def _names(layers: str | Sequence[str]) -> Sequence[str]:
    """Names of layers. One name is not the sequence of its letters."""
    return [layers] if isinstance(layers, str) else layers


def _check_signed_by(address: str, signed_by: str | PathLike[str] | None) -> None:
    if signed_by is not None and not address.startswith("zenoh:"):
        raise ClearwayError("selection", f"{address}: signed_by is for zenoh:ENDPOINT; over gRPC use tls")


def _zenoh(address: str, vehicle: str, layers: Sequence[str]) -> str | None:
    if not address.startswith("zenoh:"):
        return None
    if not vehicle or not layers:
        raise ClearwayError("selection", f"{address}: over zenoh vehicle and layers must be named, such as ['terrain']")
    for what, name in [("vehicle", vehicle), *(("layer", layer) for layer in layers)]:
        # Another name is no part of a key, or stands for several.
        if not re.fullmatch("[a-z0-9_-]{1,64}", name):
            text = f"{what} {name!r}: 1 to 64 of the characters a-z, 0-9, - and _ are allowed"
            raise ClearwayError("selection", f"{address}: {text}")
    return address.removeprefix("zenoh:")
