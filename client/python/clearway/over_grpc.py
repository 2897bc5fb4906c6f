"""Maps over gRPC: `HOST:PORT`. Each stream has its own connection with a small window and acknowledges every map, so a
stalled reader delays no other reader and receives no old maps."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence

import grpc

from .errors import ClearwayError, DecodeError
from .freshness import Clock
from .limits import MAP_BYTES_MAX
from .map import Map
from .stream import MapStream
from .tls import Tls
from .v1 import map_pb2, service_pb2, service_pb2_grpc

_OPTIONS = [
    # A server that disappears (a pulled cable) is noticed after two of these intervals.
    ("grpc.keepalive_time_ms", 2000),
    ("grpc.keepalive_timeout_ms", 2000),
    ("grpc.http2.lookahead_bytes", 65_535),
    ("grpc.http2.bdp_probe", 0),
    ("grpc.max_receive_message_length", MAP_BYTES_MAX + 65_536),
    ("grpc.use_local_subchannel_pool", 1),
    # Longest time to connect.
    ("grpc.min_reconnect_backoff_ms", 5000),
]
_TIMEOUT_S = 5.0


def _service(address: str, tls: Tls | None) -> tuple[grpc.Channel, service_pb2_grpc.MapServiceStub]:
    """The connection is made by the first call, which raises an error if no server answers or its certificate is
    rejected."""
    if tls is None:
        channel = grpc.insecure_channel(address, options=_OPTIONS)
    else:
        pem = tls.read()
        credentials = grpc.ssl_channel_credentials(pem["ca"], pem.get("key"), pem.get("cert"))
        channel = grpc.secure_channel(address, credentials, options=_OPTIONS)
    return channel, service_pb2_grpc.MapServiceStub(channel)


def _refused(address: str, error: grpc.RpcError) -> ClearwayError:
    return ClearwayError(error.code().name, f"{address}: {error.details()}")


def vehicles(address: str, tls: Tls | None) -> list[service_pb2.Vehicle]:
    channel, service = _service(address, tls)
    with channel:
        try:
            return list(service.ListVehicles(service_pb2.ListVehiclesRequest(), timeout=_TIMEOUT_S).vehicles)
        except grpc.RpcError as error:
            raise _refused(address, error) from None


def get(address: str, vehicle: str, layers: Sequence[str], tls: Tls | None) -> Map:
    channel, service = _service(address, tls)
    with channel:
        try:
            request = service_pb2.GetMapRequest(vehicle=vehicle, layers=layers)
            return Map(service.GetMap(request, timeout=_TIMEOUT_S).map).with_arrival()
        except grpc.RpcError as error:
            raise _refused(address, error) from None


def watch(
    address: str, selection: service_pb2.Selection, tls: Tls | None, *, replay_clock: bool = False
) -> MapStream:
    channel, service = _service(address, tls)
    requests: queue.SimpleQueue[service_pb2.WatchRequest | None] = queue.SimpleQueue()
    requests.put(service_pb2.WatchRequest(selection=selection))

    def outgoing() -> Iterator[service_pb2.WatchRequest]:
        while (request := requests.get()) is not None:
            yield request

    updates = service.Watch(outgoing())
    stream = MapStream(Clock(is_of_replay=replay_clock), has_one_server=True)

    def run() -> None:
        try:
            _receive_maps(stream, updates, requests.put, acknowledges=selection.max_in_flight > 0)
            stream.end(ClearwayError("ended", f"{address}: the server has ended the stream"))
        except grpc.RpcError as error:
            stream.end(_refused(address, error))
        except ClearwayError as error:
            stream.end(error)
        except Exception as error:  # noqa: BLE001: any error ends the stream.
            stream.end(ClearwayError("protobuf", f"{address}: {error}"))

    def close() -> None:
        requests.put(None)
        updates.cancel()
        channel.close()

    stream.on_close(close)
    threading.Thread(target=run, name="clearway watch", daemon=True).start()
    return stream


def _receive_maps(
    stream: MapStream,
    updates: Iterable[service_pb2.MapUpdate],
    request: Callable[[service_pb2.WatchRequest], None],
    *,
    acknowledges: bool,
) -> None:
    """Stores the map of every update and acknowledges it, in lockstep when it was handled. If a delta needs a map that
    is not here (an update was lost), it requests a keyframe. Maps not stored count as skipped, except those that the
    requested rate excluded."""
    base: Map | None = None
    is_requested, left_out = False, 0
    for update in updates:
        if update.replay_ended:
            stream.end_replay()
            continue
        left_out += update.left_out
        message = map_pb2.Map.FromString(update.map)
        answer = service_pb2.WatchRequest()
        if acknowledges:
            answer.acknowledged = message.header.sequence
        try:
            m = Map(update.map, base=base)
            # Maps of another run, or before a jump of a replay, were not skipped.
            is_next = base is not None and base.header.boot_id == m.header.boot_id
            between = m.sequence - base.sequence - 1 if is_next else 0
            stream.store(m, max(between - left_out, 0), left_out=left_out)
            base, is_requested, left_out = m, False, 0
        except DecodeError:
            if not any(layer.HasField("base_sequence") for layer in message.layers):
                raise
            # More deltas may be in flight; one request is enough for all of them.
            answer.request_keyframe, is_requested = not is_requested, True
        if update.lockstep and acknowledges and not answer.request_keyframe:
            stream.wait_until_handled()
        if answer.request_keyframe or acknowledges:
            request(answer)
