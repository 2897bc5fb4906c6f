"""Maps over zenoh: `zenoh:tcp/HOST:PORT`. Keys `clearway/<vehicle>/map/<layer>`, liveliness `clearway/<vehicle>`.

Each layer has its own key; a map is complete when all selected layers with one sequence number have arrived. The
publisher's cache gives the current map to a new subscriber, and again after a lost connection is restored. Lost maps
are not recovered: an old map has no use. Only if the last map is lost, no newer sample follows that shows the loss;
then the publisher's heartbeat states its number, and it is queried. zenoh keeps one sample per key for this process,
the newest: a queue would deliver old maps.
"""

from __future__ import annotations

import atexit
import json
import threading
from collections.abc import Sequence
from typing import TYPE_CHECKING

from .errors import ClearwayError
from .map import Map
from .stream import MapStream
from .tls import Tls
from .v1 import map_pb2

if TYPE_CHECKING:
    import zenoh
    import zenoh.ext

_TIMEOUT_S = 5.0
#: Most gaps kept between two samples. If there are more (the process was suspended), the first count as skipped and not
#: as lost.
_MISSES_KEPT = 1024
#: Settings of every session; client/src/zenoh.rs has the reasons.
_SETTINGS = {
    "mode": "client",
    "listen/endpoints": [],
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "connect/timeout_ms": 5000,
    "connect/retry": {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 2},
    "transport/unicast/open_timeout": 2000,
    "transport/link/tx/lease": 2000,
    "transport/link/rx/max_message_size": 16777216,
    "transport/link/tcp": {"so_rcvbuf": 262144},
}
#: Names of certificates in a session's configuration.
_CERTIFICATES = {"ca": "root_ca_certificate", "cert": "connect_certificate", "key": "connect_private_key"}


def _session(endpoint: str, tls: Tls | None) -> zenoh.Session:
    try:
        import zenoh
    except ImportError:
        raise ClearwayError("zenoh", "zenoh is not installed: pip install 'clearway[zenoh]'") from None
    encrypted = {"so_rcvbuf": 262144}
    if tls is not None:
        if not endpoint.startswith("tls/"):
            raise ClearwayError("certificate", f"zenoh:{endpoint}: certificates are for zenoh:tls/HOST:PORT")
        files = {_CERTIFICATES[name]: path for name, path in tls.files().items()}
        # Without this setting the client presents no certificate.
        encrypted |= files | {"enable_mtls": tls.cert is not None}
    config = zenoh.Config()
    for key, value in (_SETTINGS | {"connect/endpoints": [endpoint], "transport/link/tls": encrypted}).items():
        config.insert_json5(key, json.dumps(value))
    try:
        return zenoh.open(config)
    except Exception as error:
        raise ClearwayError("zenoh", f"connect to {endpoint}: {error}") from None


def vehicles(endpoint: str, tls: Tls | None) -> list[str]:
    with _session(endpoint, tls) as session:
        replies = session.liveliness().get("clearway/*", timeout=_TIMEOUT_S)
        return sorted({str(reply.ok.key_expr).removeprefix("clearway/") for reply in replies if reply.ok})


def _newest(session: zenoh.Session, key: str) -> bytes | None:
    for reply in session.get(key, timeout=_TIMEOUT_S):
        if reply.ok:
            return reply.ok.payload.to_bytes()
    return None


def get(endpoint: str, vehicle: str, layers: Sequence[str], tls: Tls | None) -> Map:
    collector = _LayerCollector(layers)
    with _session(endpoint, tls) as session:
        # A new map can come between two queries; the second round then finds one sequence.
        for _ in range(10):
            for layer in layers:
                key = f"clearway/{vehicle}/map/{layer}"
                part = _newest(session, key)
                if part is None:
                    raise ClearwayError("NOT_FOUND", f"{endpoint}: no server serves {key}")
                if whole := collector.add(part):
                    return Map(whole[0]).with_arrival()
    raise ClearwayError("zenoh", f"{endpoint}: ten queries did not find the layers {', '.join(layers)} of one map")


def watch(endpoint: str, vehicle: str, layers: Sequence[str], tls: Tls | None) -> MapStream:
    session = _session(endpoint, tls)
    stream = MapStream()
    writer = _StreamWriter(stream, layers)
    threads: list[threading.Thread] = []

    def close() -> None:
        atexit.unregister(close)
        session.close()
        for thread in threads:
            thread.join(_TIMEOUT_S)

    # A thread that returns from zenoh while Python shuts down would abort the process.
    atexit.register(close)
    stream.on_close(close)
    try:
        for layer in writer.layers:
            threads += _LayerSubscription(session, f"clearway/{vehicle}/map/{layer}", layer, writer).threads
    except Exception as error:
        close()
        raise ClearwayError("zenoh", f"subscribe to the layers of {vehicle!r}: {error}") from None
    return stream


class _LayerSubscription:
    """Samples of one layer's key -> the newest part of a map, with the number of missed samples."""

    def __init__(self, session: zenoh.Session, key: str, layer: str, writer: _StreamWriter) -> None:
        import zenoh
        from zenoh import ext

        self._session, self._key, self._layer, self._writer = session, key, layer, writer
        #: The publisher's number of the sample that was received or queried last.
        self._number: int | None = None
        history = ext.HistoryConfig(max_samples=1, detect_late_publishers=True)
        ring = zenoh.handlers.RingChannel
        self._samples = ext.declare_advanced_subscriber(session, key, ring(1), history=history)
        self._misses = self._samples.sample_miss_listener(ring(_MISSES_KEPT))
        self._heartbeats = session.declare_subscriber(f"{key}/@adv/pub/**", ring(1))
        # Own threads instead of zenoh's callback threads: those would keep a process alive that leaves its stream open.
        name = f"clearway watch {layer}"
        loops = (self._read_samples, self._read_heartbeats)
        self.threads = [threading.Thread(target=loop, name=name, daemon=True) for loop in loops]
        for thread in self.threads:
            thread.start()

    def _read_samples(self) -> None:
        import zenoh

        for sample in self._samples:
            # zenoh reports a gap before the sample after it.
            while (miss := self._misses.try_recv()) is not None:
                self._writer.add_missed(self._layer, miss.nb)
            if sample.kind != zenoh.SampleKind.PUT:
                continue
            if sample.source_info is not None:
                self._number = sample.source_info.source_sn
            self._writer.add(sample.payload.to_bytes())

    def _read_heartbeats(self) -> None:
        import zenoh
        from zenoh import ext

        for heartbeat in self._heartbeats:
            try:
                newest = int(ext.z_deserialize(ext.UInt32, heartbeat.payload))
                part = _newest(self._session, self._key) if newest != self._number else None
            except (ext.ZDeserializeError, zenoh.ZError):
                # Not a heartbeat, or the session is being closed.
                continue
            self._number = newest
            if part is not None:
                self._writer.add(part)


class _StreamWriter:
    """Parts of maps from one thread per layer -> a stream."""

    def __init__(self, stream: MapStream, layers: Sequence[str]) -> None:
        self._stream, self._collector, self._lock = stream, _LayerCollector(layers), threading.Lock()
        self.layers = list(dict.fromkeys(layers))
        #: Samples missed of each layer since the last complete map.
        self._missed = dict.fromkeys(self.layers, 0)

    def add_missed(self, layer: str, count: int) -> None:
        with self._lock:
            self._missed[layer] += count

    def add(self, part: bytes) -> None:
        try:
            with self._lock:
                if whole := self._collector.add(part):
                    m, skipped = Map(whole[0]), whole[1]
                    # A missed map that was queried has arrived, so it is not a skipped one.
                    self._stream.store(m, skipped, lost=min(skipped, max(self._missed.values())))
                    self._missed = dict.fromkeys(self.layers, 0)
        except ClearwayError as error:
            self._stream.end(error)
        except Exception as error:  # noqa: BLE001: any error ends the stream.
            self._stream.end(ClearwayError("protobuf", f"a map of {', '.join(self.layers)}: {error}"))


class _LayerCollector:
    """Collects the layers of one map."""

    def __init__(self, layers: Sequence[str]) -> None:
        self._layers = list(dict.fromkeys(layers))
        self._id: tuple[int, int] | None = None
        self._parts: dict[str, bytes] = {}
        self._last: tuple[int, int] | None = None

    def add(self, part: bytes) -> tuple[bytes, int] | None:
        """Adds one layer. Returns the whole map and the number of skipped maps when the map is complete, else
        `None`."""
        message = map_pb2.Map.FromString(part)
        id_ = (message.header.boot_id, message.header.sequence)
        if self._id is not None and self._id[0] == id_[0] and id_[1] < self._id[1]:
            return None
        if id_ != self._id:
            self._id, self._parts = id_, {}
        self._parts.update({layer.name: part for layer in message.layers})
        if id_ == self._last or not all(layer in self._parts for layer in self._layers):
            return None
        same_boot = self._last is not None and self._last[0] == id_[0]
        skipped = id_[1] - self._last[1] - 1 if same_boot and self._last else 0
        self._last = id_
        return self._whole(), skipped

    def _whole(self) -> bytes:
        first, *rest = (self._parts[layer] for layer in self._layers)
        # Protobuf messages concatenate: header and first layer, then the other layers.
        return first + b"".join(_without_header(part) for part in rest)


def _without_header(part: bytes) -> bytes:
    message = map_pb2.Map.FromString(part)
    message.ClearField("header")
    return message.SerializeToString()
