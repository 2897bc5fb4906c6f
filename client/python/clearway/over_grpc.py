"""Maps over gRPC: `HOST:PORT`. Each stream has a connection of its own, with a small window, and acknowledges every map:
a stalled reader holds up nobody, and gets nothing old."""

from __future__ import annotations

import queue
import threading
from collections.abc import Iterator, Sequence

import grpc

from .errors import ClearwayError
from .map import BYTES_MAX, Map
from .stream import MapStream
from .v1 import map_pb2, service_pb2, service_pb2_grpc

_OPTIONS = [
    # A server that is gone without a word (a pulled cable) is noticed after two of these.
    ("grpc.keepalive_time_ms", 2000),
    ("grpc.keepalive_timeout_ms", 2000),
    ("grpc.http2.lookahead_bytes", 65_535),
    ("grpc.http2.bdp_probe", 0),
    ("grpc.max_receive_message_length", BYTES_MAX + 65_536),
    ("grpc.use_local_subchannel_pool", 1),
]
_ANSWER_S = 5.0


def _service(address: str) -> tuple[grpc.Channel, service_pb2_grpc.MapServiceStub]:
    channel = grpc.insecure_channel(address, options=_OPTIONS)
    try:
        grpc.channel_ready_future(channel).result(timeout=_ANSWER_S)
    except grpc.FutureTimeoutError:
        channel.close()
        raise ClearwayError("UNAVAILABLE", f"{address}: nobody answers within {_ANSWER_S:g} s") from None
    return channel, service_pb2_grpc.MapServiceStub(channel)


def _refused(address: str, error: grpc.RpcError) -> ClearwayError:
    return ClearwayError(error.code().name, f"{address}: {error.details()}")


def vehicles(address: str) -> list[service_pb2.Vehicle]:
    channel, service = _service(address)
    with channel:
        try:
            return list(service.ListVehicles(service_pb2.ListVehiclesRequest(), timeout=_ANSWER_S).vehicles)
        except grpc.RpcError as error:
            raise _refused(address, error) from None


def get(address: str, vehicle: str, layers: Sequence[str]) -> Map:
    channel, service = _service(address)
    with channel:
        try:
            request = service_pb2.GetMapRequest(vehicle=vehicle, layers=layers)
            return Map(service.GetMap(request, timeout=_ANSWER_S).map)
        except grpc.RpcError as error:
            raise _refused(address, error) from None


def watch(address: str, vehicle: str, layers: Sequence[str], max_in_flight: int) -> MapStream:
    channel, service = _service(address)
    requests: queue.SimpleQueue[service_pb2.WatchRequest | None] = queue.SimpleQueue()
    selection = service_pb2.Selection(vehicle=vehicle, layers=layers, max_in_flight=max_in_flight)
    requests.put(service_pb2.WatchRequest(selection=selection))

    def outgoing() -> Iterator[service_pb2.WatchRequest]:
        while (request := requests.get()) is not None:
            yield request

    updates = service.Watch(outgoing())
    stream = MapStream()

    def follow() -> None:
        try:
            for update in updates:
                header = map_pb2.Map.FromString(update.map).header
                stream.put(update.map, update.skipped)
                if max_in_flight:
                    requests.put(service_pb2.WatchRequest(acknowledged=header.sequence))
            stream.end(ClearwayError("ended", f"{address}: the server has ended the stream"))
        except grpc.RpcError as error:
            stream.end(_refused(address, error))
        except Exception as error:  # noqa: BLE001: whatever it is, the reader is told and does not wait for ever.
            stream.end(ClearwayError("protobuf", f"{address}: {error}"))

    def close() -> None:
        requests.put(None)
        updates.cancel()
        channel.close()

    stream.on_close(close)
    threading.Thread(target=follow, name="clearway watch", daemon=True).start()
    return stream
