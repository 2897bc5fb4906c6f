"""Maps over zenoh: `zenoh:tcp/HOST:PORT`. Keys `clearway/<vehicle>/map/<layer>`, liveliness `clearway/<vehicle>`.

Each layer travels on its own key; a map is given once all layers asked for have come with one sequence. Who comes late, or
comes back after a cut, has the current map of the publisher's cache. Nothing lost is recovered: an old map is worth nothing.
Only where the last map got lost nothing newer follows that could show it: the publisher's heartbeat tells that there is one,
and it is asked for. zenoh keeps one sample a key for this process, the newest: a queue would hand out old maps.
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

_ANSWER_S = 5.0
#: Holes between two looks at them; of more, in a process that halted meanwhile, the first are not told as lost, but as skipped.
_MISSES_KEPT = 1024
#: What every session of ours has; those of the Rust client, and why, are in client/src/zenoh.rs.
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
        # Without this it shows no certificate.
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
        replies = session.liveliness().get("clearway/*", timeout=_ANSWER_S)
        return sorted({str(reply.ok.key_expr).removeprefix("clearway/") for reply in replies if reply.ok})


def _newest(session: zenoh.Session, key: str) -> bytes | None:
    for reply in session.get(key, timeout=_ANSWER_S):
        if reply.ok:
            return reply.ok.payload.to_bytes()
    return None


def get(endpoint: str, vehicle: str, layers: Sequence[str], tls: Tls | None) -> Map:
    gathered = _Gathered(layers)
    with _session(endpoint, tls) as session:
        # A new map can come between two queries; the second round then finds one sequence.
        for _ in range(10):
            for layer in layers:
                key = f"clearway/{vehicle}/map/{layer}"
                part = _newest(session, key)
                if part is None:
                    raise ClearwayError("NOT_FOUND", f"{endpoint}: nobody serves {key}")
                if whole := gathered.take(part):
                    return Map(whole[0]).arrived()
    raise ClearwayError("zenoh", f"{endpoint}: no ten queries found the layers {', '.join(layers)} of one map")


def watch(endpoint: str, vehicle: str, layers: Sequence[str], tls: Tls | None) -> MapStream:
    session = _session(endpoint, tls)
    stream = MapStream()
    into = _Into(stream, layers)
    threads: list[threading.Thread] = []

    def close() -> None:
        atexit.unregister(close)
        session.close()
        for thread in threads:
            thread.join(_ANSWER_S)

    # A thread that comes back from zenoh while Python ends would abort the process.
    atexit.register(close)
    stream.on_close(close)
    try:
        for layer in into.layers:
            threads += _Tap(session, f"clearway/{vehicle}/map/{layer}", layer, into).threads
    except Exception as error:
        close()
        raise ClearwayError("zenoh", f"subscribe to the layers of {vehicle!r}: {error}") from None
    return stream


class _Tap:
    """One layer's key: samples as zenoh gives them -> the newest part of a map, with what was missed on the way."""

    def __init__(self, session: zenoh.Session, key: str, layer: str, into: _Into) -> None:
        import zenoh
        from zenoh import ext

        self._session, self._key, self._layer, self._into = session, key, layer, into
        #: The publisher's number of the sample that came last, or that was asked for last.
        self._number: int | None = None
        history = ext.HistoryConfig(max_samples=1, detect_late_publishers=True)
        ring = zenoh.handlers.RingChannel
        self._samples = ext.declare_advanced_subscriber(session, key, ring(1), history=history)
        self._misses = self._samples.sample_miss_listener(ring(_MISSES_KEPT))
        self._heartbeats = session.declare_subscriber(f"{key}/@adv/pub/**", ring(1))
        # Not zenoh's own threads for callbacks: a process that leaves its stream open could not end for them.
        name = f"clearway watch {layer}"
        self.threads = [threading.Thread(target=run, name=name, daemon=True) for run in (self._listen, self._hear)]
        for thread in self.threads:
            thread.start()

    def _listen(self) -> None:
        import zenoh

        for sample in self._samples:
            # Told before the sample behind the hole.
            while (miss := self._misses.try_recv()) is not None:
                self._into.missed(self._layer, miss.nb)
            if sample.kind != zenoh.SampleKind.PUT:
                continue
            if sample.source_info is not None:
                self._number = sample.source_info.source_sn
            self._into.take(sample.payload.to_bytes())

    def _hear(self) -> None:
        import zenoh
        from zenoh import ext

        for heartbeat in self._heartbeats:
            try:
                told = int(ext.z_deserialize(ext.UInt32, heartbeat.payload))
                part = _newest(self._session, self._key) if told != self._number else None
            except (ext.ZDeserializeError, zenoh.ZError):
                # No heartbeat, or the session is being closed.
                continue
            self._number = told
            if part is not None:
                self._into.take(part)


class _Into:
    """Parts of maps, from a thread for each layer -> a stream."""

    def __init__(self, stream: MapStream, layers: Sequence[str]) -> None:
        self._stream, self._gathered, self._one_at_a_time = stream, _Gathered(layers), threading.Lock()
        self.layers = list(dict.fromkeys(layers))
        #: Of each layer, since the map given last.
        self._missed = dict.fromkeys(self.layers, 0)

    def missed(self, layer: str, count: int) -> None:
        with self._one_at_a_time:
            self._missed[layer] += count

    def take(self, part: bytes) -> None:
        try:
            with self._one_at_a_time:
                if whole := self._gathered.take(part):
                    m, skipped = Map(whole[0]), whole[1]
                    # A missed one that was asked for is there, and none of the skipped ones.
                    self._stream.put(m, skipped, lost=min(skipped, max(self._missed.values())))
                    self._missed = dict.fromkeys(self.layers, 0)
        except ClearwayError as error:
            self._stream.end(error)
        except Exception as error:  # noqa: BLE001: whatever it is, the reader is told and does not wait for ever.
            self._stream.end(ClearwayError("protobuf", f"a map of {', '.join(self.layers)}: {error}"))


class _Gathered:
    """Layers on their way to one map."""

    def __init__(self, layers: Sequence[str]) -> None:
        self._wanted = list(dict.fromkeys(layers))
        self._of: tuple[int, int] | None = None
        self._parts: dict[str, bytes] = {}
        self._given: tuple[int, int] | None = None

    def take(self, part: bytes) -> tuple[bytes, int] | None:
        """Takes one layer; gives the whole map and the number of maps skipped once it is there."""
        message = map_pb2.Map.FromString(part)
        of = (message.header.boot_id, message.header.sequence)
        if self._of is not None and self._of[0] == of[0] and of[1] < self._of[1]:
            return None
        if of != self._of:
            self._of, self._parts = of, {}
        self._parts.update({layer.name: part for layer in message.layers})
        if of == self._given or not all(layer in self._parts for layer in self._wanted):
            return None
        same_boot = self._given is not None and self._given[0] == of[0]
        skipped = of[1] - self._given[1] - 1 if same_boot and self._given else 0
        self._given = of
        return self._whole(), skipped

    def _whole(self) -> bytes:
        first, *rest = (self._parts[layer] for layer in self._wanted)
        # Protobuf messages concatenate: header and first layer, then the other layers.
        return first + b"".join(_without_header(part) for part in rest)


def _without_header(part: bytes) -> bytes:
    message = map_pb2.Map.FromString(part)
    message.ClearField("header")
    return message.SerializeToString()
