"""Maps over gRPC: `HOST:PORT`. Each stream has its own connection with a small window and acknowledges every map, so a
stalled reader delays no other reader and receives no old maps."""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import grpc

from .errors import ClearwayError, DecodeError
from .freshness import Clock
from .limits import MAP_BYTES_MAX
from .map import Map
from .stream import LatestSlot, MapStream
from .tls import Tls
from .v1 import Stub, map_pb2, service_pb2

_OPTIONS = [
    # A server that disappears (a pulled cable) is noticed after two of these intervals.
    ("grpc.keepalive_time_ms", 2000),
    ("grpc.keepalive_timeout_ms", 2000),
    ("grpc.http2.lookahead_bytes", 65_535),
    ("grpc.http2.bdp_probe", 0),
    ("grpc.max_receive_message_length", MAP_BYTES_MAX + 65_536),
    ("grpc.use_local_subchannel_pool", 1),
    # A vehicle is reached directly: a proxy of the environment is for the web.
    ("grpc.enable_http_proxy", 0),
    # Longest time to connect; pauses between two attempts of a stream that is opened again.
    ("grpc.min_reconnect_backoff_ms", 5000),
    ("grpc.initial_reconnect_backoff_ms", 100),
    ("grpc.max_reconnect_backoff_ms", 5000),
]
_TIMEOUT_S = 5.0
#: Shortest and longest pause before a stream is opened again, and the reasons for which it is not: another attempt
#: would end in the same way. An unknown vehicle is one too, before the first map.
_PAUSE_S = (0.1, 5.0)
_LASTING = {"INVALID_ARGUMENT", "PERMISSION_DENIED", "UNAUTHENTICATED", "FAILED_PRECONDITION", "UNIMPLEMENTED"}
_log = logging.getLogger("clearway")


def channel(address: str, tls: Tls | None = None) -> grpc.Channel:
    """A channel to `HOST:PORT`, also written `http://HOST:PORT`, with certificates `https://HOST:PORT`. The connection
    is made by the first call, which raises an error if no server answers or its certificate is rejected."""
    target = _target(address, "http://" if tls is None else "https://")
    if tls is None:
        return grpc.insecure_channel(target, options=_OPTIONS)
    pem = tls.read()
    credentials = grpc.ssl_channel_credentials(pem["ca"], pem.get("key"), pem.get("cert"))
    return grpc.secure_channel(target, credentials, options=_OPTIONS)


def _target(address: str, scheme: str) -> str:
    """Host and port of an address; the Rust client reads the same (`client/golden/addresses.json`)."""
    target = address.removeprefix(scheme).rstrip("/")
    host, has_port, port = target.rpartition(":")
    if target.startswith("https://"):
        wrong = "https needs certificates"
    elif "://" in target:
        wrong = f"another scheme than {scheme}"
    elif "/" in target:
        wrong = "a path, or an endpoint of zenoh"
    elif not has_port:
        wrong = "no port"
    elif not host:
        wrong = "no host"
    elif not (port.isascii() and port.isdecimal() and int(port) < 65536):
        wrong = "the port is no number up to 65535"
    else:
        return target
    allowed = "HOST:PORT or http://HOST:PORT is allowed, such as localhost:50051, https://HOST:PORT with certificates"
    raise ClearwayError("address", f"server address {address!r}: {wrong}; {allowed}, or zenoh:ENDPOINT")


def refused(address: str, error: grpc.RpcError) -> ClearwayError:
    return ClearwayError(error.code().name, f"{address}: {error.details()}")


def _led_to(error: grpc.RpcError) -> str | None:
    """Address of the server to which this one leads: it serves the vehicle that this one does not."""
    metadata: Any = error.trailing_metadata() or ()
    return next((value for key, value in metadata if key == "clearway-served-at"), None)


def vehicles(address: str, tls: Tls | None) -> list[service_pb2.Vehicle]:
    with channel(address, tls) as opened:
        service = Stub(opened, "MapService")
        try:
            return list(service.ListVehicles(service_pb2.ListVehiclesRequest(), timeout=_TIMEOUT_S).vehicles)
        except grpc.RpcError as error:
            raise refused(address, error) from None


def get(address: str, vehicle: str, layers: Sequence[str], tls: Tls | None) -> Map:
    request = service_pb2.GetMapRequest(vehicle=vehicle, layers=layers)
    try:
        return _get(address, request, tls)
    except grpc.RpcError as error:
        server = _led_to(error)
        if server is None:
            raise refused(address, error) from None
    try:
        return _get(server, request, tls)
    except grpc.RpcError as error:
        raise refused(server, error) from None


def _get(address: str, request: service_pb2.GetMapRequest, tls: Tls | None) -> Map:
    with channel(address, tls) as opened:
        service = Stub(opened, "MapService")
        return Map(service.GetMap(request, timeout=_TIMEOUT_S).map).with_arrival()


class _Watch:
    """One open stream of maps, on a connection of its own. It waits for a server if it `waits`, with the pauses of
    gRPC between two attempts."""

    def __init__(self, address: str, selection: service_pb2.Selection, tls: Tls | None, *, waits: bool) -> None:
        self.address, self.channel = address, channel(address, tls)
        self.requests: queue.SimpleQueue[service_pb2.WatchRequest | None] = queue.SimpleQueue()
        self.requests.put(service_pb2.WatchRequest(selection=selection))
        service = Stub(self.channel, "MapService")
        self.updates = service.Watch(iter(self.requests.get, None), wait_for_ready=waits)

    def close(self) -> None:
        self.requests.put(None)
        self.updates.cancel()
        self.channel.close()


def watch(
    address: str,
    selection: service_pb2.Selection,
    tls: Tls | None,
    *,
    replay_clock: bool = False,
    reconnect: bool = False,
) -> MapStream:
    selection.states = True
    slot = LatestSlot(Clock(is_of_replay=replay_clock), has_one_server=True)
    opened = [_Watch(address, selection, tls, waits=False)]

    def run() -> None:
        is_led, pause_s = False, _PAUSE_S[0]
        while True:
            of, newest = opened[-1], slot.newest()
            try:
                _receive_maps(slot, of.updates, of.requests.put, acknowledges=selection.max_in_flight > 0)
                ended = ClearwayError("ended", f"{of.address}: the server has ended the stream")
            except grpc.RpcError as error:
                ended, server = refused(of.address, error), None if is_led else _led_to(error)
                if server is not None:
                    is_led = True
                    of.close()
                    opened[-1] = _Watch(server, selection, tls, waits=False)
                    continue
            except ClearwayError as error:
                slot.end(error)
                return
            except Exception as error:  # noqa: BLE001: any error ends the stream.
                slot.end(ClearwayError("protobuf", f"{of.address}: {error}"))
                return
            is_unknown = ended.reason == "NOT_FOUND" and slot.newest() is None
            if not reconnect or ended.reason in _LASTING or is_unknown or slot.closed:
                slot.end(ended)
                return
            _log.warning("%s; the stream of maps is opened again", ended)
            slot.set_reasons([str(ended)])
            of.close()
            pause_s = min(2 * pause_s, _PAUSE_S[1]) if slot.newest() is newest else _PAUSE_S[0]
            time.sleep(pause_s)
            opened[-1] = _Watch(of.address, selection, tls, waits=True)
            if slot.closed:
                opened[-1].close()

    threading.Thread(target=run, name="clearway watch", daemon=True).start()
    return MapStream(slot, lambda: opened[-1].close())


def _receive_maps(
    slot: LatestSlot,
    updates: Iterable[service_pb2.MapUpdate],
    request: Callable[[service_pb2.WatchRequest], None],
    *,
    acknowledges: bool,
) -> None:
    """Stores the map of every update and acknowledges it, in lockstep when it was handled. If a delta needs a map that
    is not here (an update was lost), it requests a keyframe. Maps not stored count as skipped, except those that the
    requested rate excluded."""
    # The newest map of the stream before, if this stream is opened again.
    base = slot.newest()
    is_requested, left_out = False, 0
    for update in updates:
        if update.replay_ended:
            slot.end_replay()
            continue
        if update.HasField("vehicle"):
            slot.set_reasons(update.vehicle.reasons)
            continue
        left_out += update.left_out
        message = map_pb2.Map.FromString(update.map)
        answer = service_pb2.WatchRequest()
        if acknowledges:
            answer.acknowledged = message.header.sequence
        try:
            m = Map(update.map, base=base)
            # Maps of another run, or before a jump of a replay, were not skipped.
            between = 0
            if base is not None and base.header.boot_id == m.header.boot_id:
                between = m.sequence - base.sequence - 1
            slot.store(m, max(between - left_out, 0), left_out=left_out)
            base, is_requested, left_out = m, False, 0
        except DecodeError:
            if not any(layer.HasField("base_sequence") for layer in message.layers):
                raise
            # More deltas may be in flight; one request is enough for all of them.
            answer.request_keyframe, is_requested = not is_requested, True
        if update.lockstep and acknowledges and not answer.request_keyframe:
            slot.wait_until_handled()
        if answer.request_keyframe or acknowledges:
            request(answer)
