"""Maps over gRPC: `HOST:PORT`. Each stream has a connection of its own, with a small window, and acknowledges every map:
a stalled reader holds up nobody, and gets nothing old."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence

import grpc

from .errors import ClearwayError, DecodeError
from .map import BYTES_MAX, Map
from .stream import MapStream
from .tls import Tls
from .v1 import map_pb2, service_pb2, service_pb2_grpc

_OPTIONS = [
    # A server that is gone without a word (a pulled cable) is noticed after two of these.
    ("grpc.keepalive_time_ms", 2000),
    ("grpc.keepalive_timeout_ms", 2000),
    ("grpc.http2.lookahead_bytes", 65_535),
    ("grpc.http2.bdp_probe", 0),
    ("grpc.max_receive_message_length", BYTES_MAX + 65_536),
    ("grpc.use_local_subchannel_pool", 1),
    # How long it is tried to connect.
    ("grpc.min_reconnect_backoff_ms", 5000),
]
_ANSWER_S = 5.0


def _service(address: str, tls: Tls | None) -> tuple[grpc.Channel, service_pb2_grpc.MapServiceStub]:
    """Connects with the first call, which tells of a server that is not there, or not believed."""
    if tls is None:
        channel = grpc.insecure_channel(address, options=_OPTIONS)
    else:
        pem = tls.read()
        shown = grpc.ssl_channel_credentials(pem["ca"], pem.get("key"), pem.get("cert"))
        channel = grpc.secure_channel(address, shown, options=_OPTIONS)
    return channel, service_pb2_grpc.MapServiceStub(channel)


def _refused(address: str, error: grpc.RpcError) -> ClearwayError:
    return ClearwayError(error.code().name, f"{address}: {error.details()}")


def vehicles(address: str, tls: Tls | None) -> list[service_pb2.Vehicle]:
    channel, service = _service(address, tls)
    with channel:
        try:
            return list(service.ListVehicles(service_pb2.ListVehiclesRequest(), timeout=_ANSWER_S).vehicles)
        except grpc.RpcError as error:
            raise _refused(address, error) from None


def get(address: str, vehicle: str, layers: Sequence[str], tls: Tls | None) -> Map:
    channel, service = _service(address, tls)
    with channel:
        try:
            request = service_pb2.GetMapRequest(vehicle=vehicle, layers=layers)
            return Map(service.GetMap(request, timeout=_ANSWER_S).map).arrived()
        except grpc.RpcError as error:
            raise _refused(address, error) from None


def watch(address: str, selection: service_pb2.Selection, tls: Tls | None) -> MapStream:
    channel, service = _service(address, tls)
    requests: queue.SimpleQueue[service_pb2.WatchRequest | None] = queue.SimpleQueue()
    requests.put(service_pb2.WatchRequest(selection=selection))

    def outgoing() -> Iterator[service_pb2.WatchRequest]:
        while (request := requests.get()) is not None:
            yield request

    updates = service.Watch(outgoing())
    stream = MapStream()

    def follow() -> None:
        try:
            _follow(stream, updates, requests.put, acknowledges=selection.max_in_flight > 0)
            stream.end(ClearwayError("ended", f"{address}: the server has ended the stream"))
        except grpc.RpcError as error:
            stream.end(_refused(address, error))
        except ClearwayError as error:
            stream.end(error)
        except Exception as error:  # noqa: BLE001: whatever it is, the reader is told and does not wait for ever.
            stream.end(ClearwayError("protobuf", f"{address}: {error}"))

    def close() -> None:
        requests.put(None)
        updates.cancel()
        channel.close()

    stream.on_close(close)
    threading.Thread(target=follow, name="clearway watch", daemon=True).start()
    return stream


def _follow(
    stream: MapStream,
    updates: Iterable[service_pb2.MapUpdate],
    request: Callable[[service_pb2.WatchRequest], None],
    *,
    acknowledges: bool,
) -> None:
    """Takes every update and acknowledges it. A delta against a map that is not here (an update was lost) is not shown: a
    whole map is asked for. All that was not shown counts as skipped, but for what the reader did not want."""
    base: Map | None = None
    asked, left_out = False, 0
    for update in updates:
        left_out += update.left_out
        message = map_pb2.Map.FromString(update.map)
        answer = service_pb2.WatchRequest()
        if acknowledges:
            answer.acknowledged = message.header.sequence
        try:
            m = Map(update.map, base=base)
            between = 0 if base is None else m.sequence - base.sequence - 1
            stream.put(m, max(between - left_out, 0), left_out=left_out)
            base, asked, left_out = m, False, 0
        except DecodeError:
            if not any(layer.HasField("base_sequence") for layer in message.layers):
                raise
            # More deltas may be on the way already; one question is enough for them all.
            answer.request_keyframe, asked = not asked, True
        if answer.request_keyframe or acknowledges:
            request(answer)
