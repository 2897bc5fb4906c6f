"""Maps over zenoh: `zenoh:tcp/HOST:PORT`. Keys `clearway/<vehicle>/map/<layer>`, liveliness `clearway/<vehicle>`.

Each layer travels on its own key; a map is given once all layers asked for have come with one sequence.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import TYPE_CHECKING

from .errors import ClearwayError
from .map import Map
from .stream import MapStream
from .v1 import map_pb2

if TYPE_CHECKING:
    import zenoh

_ANSWER_S = 5.0


def _session(endpoint: str) -> zenoh.Session:
    try:
        import zenoh
    except ImportError:
        raise ClearwayError("zenoh", "zenoh is not installed: pip install 'clearway[zenoh]'") from None
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    config.insert_json5("connect/timeout_ms", str(int(_ANSWER_S * 1000)))
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("scouting/gossip/enabled", "false")
    # A session that loses its router has maps again a second after it, and notices within 2 s.
    config.insert_json5("connect/retry", "{ period_init_ms: 100, period_max_ms: 1000, period_increase_factor: 2 }")
    config.insert_json5("transport/link/tx/lease", "2000")
    try:
        return zenoh.open(config)
    except Exception as error:
        raise ClearwayError("zenoh", f"connect to {endpoint}: {error}") from None


def vehicles(endpoint: str) -> list[str]:
    with _session(endpoint) as session:
        replies = session.liveliness().get("clearway/*", timeout=_ANSWER_S)
        return sorted({str(reply.ok.key_expr).removeprefix("clearway/") for reply in replies if reply.ok})


def _newest(session: zenoh.Session, vehicle: str, layer: str) -> bytes | None:
    key = f"clearway/{vehicle}/map/{layer}"
    for reply in session.get(key, timeout=_ANSWER_S):
        if reply.ok:
            return reply.ok.payload.to_bytes()
    return None


def get(endpoint: str, vehicle: str, layers: Sequence[str]) -> Map:
    gathered = _Gathered(layers)
    with _session(endpoint) as session:
        # A new map can come between two queries; the second round then finds one sequence.
        for _ in range(10):
            for layer in layers:
                part = _newest(session, vehicle, layer)
                if part is None:
                    raise ClearwayError("NOT_FOUND", f"{endpoint}: nobody serves clearway/{vehicle}/map/{layer}")
                if whole := gathered.take(part):
                    return Map(whole[0]).arrived()
    raise ClearwayError("zenoh", f"{endpoint}: no ten queries found the layers {', '.join(layers)} of one map")


def watch(endpoint: str, vehicle: str, layers: Sequence[str]) -> MapStream:
    session = _session(endpoint)
    stream, gathered = MapStream(), _Gathered(layers)

    def take(sample: zenoh.Sample) -> None:
        try:
            if whole := gathered.take(sample.payload.to_bytes()):
                stream.put(Map(whole[0]), whole[1])
        except ClearwayError as error:
            stream.end(error)
        except Exception as error:  # noqa: BLE001: whatever it is, the reader is told and does not wait for ever.
            stream.end(ClearwayError("protobuf", f"{sample.key_expr}: {error}"))

    subscribers = [session.declare_subscriber(f"clearway/{vehicle}/map/{layer}", take) for layer in layers]
    for layer in layers:
        part = _newest(session, vehicle, layer)
        if part is not None and (whole := gathered.take(part)):
            stream.put(Map(whole[0]), whole[1])

    def close() -> None:
        for subscriber in subscribers:
            subscriber.undeclare()
        subscribers.clear()
        session.close()

    stream.on_close(close)
    return stream


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
