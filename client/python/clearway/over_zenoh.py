"""Maps over zenoh: `zenoh:tcp/HOST:PORT`. Keys `clearway/<vehicle>/map/<layer>`, the end of a replay on
`clearway/<vehicle>/replay`, liveliness `clearway/<vehicle>`.

Each layer has its own key; a map is complete when all selected layers with one sequence number have arrived. The
publisher's cache gives the current map to a new subscriber, and again after a lost connection is restored. Lost maps
are not recovered: an old map has no use. Only if the last map is lost, no newer sample follows that shows the loss;
then the publisher's heartbeat states its number, and it is queried. A thread per key checks and decodes each sample;
what does not belong on the key is counted and passed over.
"""

from __future__ import annotations

import json
import os
import threading
import time
from collections.abc import Iterator, Sequence
from os import PathLike
from typing import TYPE_CHECKING, Any

from .errors import ClearwayError, forked
from .map import LayerCollector, Map
from .signature import PublicKey
from .stream import LatestSlot, MapStream
from .tls import Tls
from .v1 import map_pb2

if TYPE_CHECKING:
    import zenoh
    import zenoh.ext

_TIMEOUT_S, _EXAMPLE = 5.0, "zenoh:tcp/localhost:7447"
#: Time until the next attempt to open a session; longest time for an endpoint to answer, in ms, in the first attempt
#: and in the attempts after it.
_OPEN_RETRY_S, _OPEN_TIMEOUT_MS = 0.2, (500, 2000)
#: Most gaps kept between two samples. If there are more (the process was suspended), the first count as skipped and not
#: as lost.
_MISSES_KEPT = 1024
#: Samples kept per key between zenoh and the thread that reads them: that many false ones hide no true one.
_SAMPLES_KEPT = 64
#: Longest wait for the last map of a replay that has ended.
_LAST_MAP_S = 1.0
#: Settings of every session; client/src/zenoh.rs has the reasons.
_SETTINGS = {
    "listen/endpoints": [],
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "connect/exit_on_failure": False,
    "connect/retry": {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 2},
    "transport/link/tx/lease": 2000,
    "transport/link/rx/max_message_size": 16777216,
    "transport/link/tcp": {"so_rcvbuf": 262144},
}
#: The process that has opened the first session.
_process: int | None = None
#: Names of certificates in a session's configuration.
_CERTIFICATES = {"ca": "root_ca_certificate", "cert": "connect_certificate", "key": "connect_private_key"}


def _session(endpoint: str, tls: Tls | None, waiting: LatestSlot | None = None) -> zenoh.Session:
    """A session at the first of several endpoints `A,B` that answers, or at all of `A+B`. With the slot of a stream it
    waits for a router that is not there, until the stream is closed."""
    try:
        import zenoh
    except ImportError:
        raise ClearwayError("zenoh", "zenoh is not installed: pip install 'clearway[zenoh]'") from None
    _check_not_forked()
    encrypted: dict[str, Any] = {"so_rcvbuf": 262144}
    endpoints = endpoint.split("+" if "+" in endpoint else ",")
    if not all("/" in one for one in endpoints):
        raise ClearwayError("address", f"zenoh:{endpoint}: zenoh:PROTOCOL/HOST:PORT is allowed, such as {_EXAMPLE}")
    if tls is not None:
        if not all(one.startswith("tls/") for one in endpoints):
            raise ClearwayError("certificate", f"zenoh:{endpoint}: certificates are for zenoh:tls/HOST:PORT")
        files = {_CERTIFICATES[name]: path for name, path in tls.files().items()}
        # Without this setting the client presents no certificate.
        encrypted |= files | {"enable_mtls": tls.cert is not None}
    mode, timeout_ms = ("peer", -1) if "+" in endpoint else ("client", 0)
    of_endpoint = {"mode": mode, "connect/timeout_ms": timeout_ms, "connect/endpoints": endpoints}
    config = zenoh.Config()
    for key, value in (_SETTINGS | of_endpoint | {"transport/link/tls": encrypted}).items():
        config.insert_json5(key, json.dumps(value))
    until, (first_ms, longest_ms) = time.monotonic() + _TIMEOUT_S, _OPEN_TIMEOUT_MS
    open_timeout_ms = first_ms if mode == "client" else longest_ms
    while True:
        config.insert_json5("transport/unicast/open_timeout", str(open_timeout_ms))
        try:
            return zenoh.open(config)
        except Exception as error:
            # The text of zenoh names a line of its sources.
            is_away, reason = "Unable to connect" in str(error), str(error).split(" at /")[0]
            if is_away:
                reason = "no zenoh router or server accepts a connection"
            if is_away and waiting is not None and not waiting.closed:
                waiting.set_reasons([f"{endpoint}: {reason}"])
            elif waiting is not None or time.monotonic() >= until:
                raise ClearwayError("zenoh", f"{endpoint}: {reason}") from None
        time.sleep(_OPEN_RETRY_S)
        open_timeout_ms = min(2 * open_timeout_ms, longest_ms)


def _check_not_forked() -> None:
    """Raises an error in a process that was forked from one with a session: zenoh has no threads there."""
    global _process
    _process = _process or os.getpid()
    if _process != os.getpid():
        raise forked("zenoh")


def vehicles(endpoint: str, tls: Tls | None) -> list[str]:
    with _session(endpoint, tls) as session:
        return _published(session, "clearway/*", 1)


def _published(session: zenoh.Session, keys: str, place: int) -> list[str]:
    """Sorted names at a place of the keys that are published now and fit `keys`."""
    replies = session.liveliness().get(keys, timeout=_TIMEOUT_S)
    return sorted({str(reply.ok.key_expr).split("/")[place] for reply in replies if reply.ok})


def _tell_absence(session: zenoh.Session, vehicle: str, layers: Sequence[str], slot: LatestSlot) -> None:
    """Tells the slot once a second, until it has a map, which vehicle or layer no server publishes."""
    import zenoh

    while slot.newest() is None and not slot.wait_closed(1.0):
        try:
            what, names = f"the vehicle {vehicle!r}", _published(session, "clearway/*", 1)
            absent = vehicle not in names
            if not absent:
                names = _published(session, f"clearway/{vehicle}/map/*/@adv/pub/**", 3)
                what = f"of {vehicle} the layers {', '.join(layer for layer in layers if layer not in names)}"
                absent = not set(layers) <= set(names)
        except zenoh.ZError:
            # The session is being closed.
            return
        if slot.newest() is None:
            text = f"no server publishes {what} now; published: {', '.join(names) or 'none'}"
            slot.set_reasons([text] if absent else [])


def put(session: zenoh.Session, key: str, payload: bytes) -> None:
    """Puts a message; with roles the server looks up the certificate of the session that its source info names."""
    import zenoh

    with session.declare_publisher(key, congestion_control=zenoh.CongestionControl.DROP) as publisher:
        publisher.put(payload, source_info=zenoh.SourceInfo(source_id=publisher.id, source_sn=0))


def _replies(session: zenoh.Session, key: str) -> Iterator[zenoh.Sample]:
    """Every reply of every peer: zenoh would otherwise select one, perhaps from a peer that is no server."""
    import zenoh

    every, none = zenoh.QueryTarget.ALL, zenoh.ConsolidationMode.NONE
    for reply in session.get(key, timeout=_TIMEOUT_S, target=every, consolidation=none):
        if reply.ok:
            yield reply.ok


class _Unfit(Exception):
    """A sample that is no map of its key. The text is the name of a field of `PassedOver`."""


class _LayerKey:
    """The key of one layer of one vehicle, and the server that publishes it."""

    def __init__(self, vehicle: str, layer: str, signed_by: PublicKey | None) -> None:
        self.key, self._vehicle, self.layer = f"clearway/{vehicle}/map/{layer}", vehicle, layer
        self._signed_by = signed_by

    def part(self, sample: zenoh.Sample) -> tuple[bytes, map_pb2.Map]:
        """The encoded map of a sample and its message. Raises `_Unfit` if it does not belong on this key."""
        # A sample on `clearway/**` reaches this subscription too.
        if str(sample.key_expr) != self.key:
            raise _Unfit("misplaced")
        part = sample.payload.to_bytes()
        if self._signed_by is not None:
            signature = b"" if sample.attachment is None else sample.attachment.to_bytes()
            if not self._signed_by.verifies(self.key, part, signature):
                raise _Unfit("unsigned")
        try:
            m = Map(part)
            names = list(m.layers)
        except Exception:  # noqa: BLE001: whatever is wrong with it, it is no map.
            raise _Unfit("undecodable") from None
        if m.vehicle != self._vehicle or any(name != self.layer for name in names):
            raise _Unfit("misplaced")
        return part, map_pb2.Map.FromString(part)


def get(
    endpoint: str, vehicle: str, layers: Sequence[str], tls: Tls | None, signed_by: str | PathLike[str] | None
) -> Map:
    collector, server = LayerCollector(layers), None if signed_by is None else PublicKey(signed_by)
    keys, whole, unfit = [_LayerKey(vehicle, layer, server) for layer in layers], [], 0
    with _session(endpoint, tls) as session:
        # A new map can come between two queries; the second round then finds one sequence.
        for _ in range(10):
            for key in keys:
                is_served = False
                for sample in _replies(session, key.key):
                    is_served = True
                    try:
                        whole += [Map(encoded).with_arrival() for encoded in collector.add(*key.part(sample))]
                    except _Unfit:
                        unfit += 1
                if not is_served:
                    raise ClearwayError("NOT_FOUND", f"{endpoint}: no server serves {key.key}")
            if whole:
                return max(whole, key=lambda m: (not m.stale, m.header.capture_end_ns))
    found = f"ten queries did not find the layers {', '.join(layers)} of one map; {unfit} answers were no map of theirs"
    raise ClearwayError("zenoh", f"{endpoint}: {found}")


def watch(
    endpoint: str,
    vehicle: str,
    layers: Sequence[str],
    tls: Tls | None,
    signed_by: str | PathLike[str] | None,
    reconnect: bool,
) -> MapStream:
    server, slot = None if signed_by is None else PublicKey(signed_by), LatestSlot()
    sessions: list[zenoh.Session] = []
    threads: list[threading.Thread] = []

    def open_() -> None:
        sessions.append(_session(endpoint, tls, slot if reconnect else None))
        writer = _StreamWriter(slot, layers)
        try:
            for layer in writer.layers:
                threads.extend(_LayerSubscription(sessions[0], _LayerKey(vehicle, layer, server), writer).threads)
            threads.append(_ReplaySubscription(sessions[0], f"clearway/{vehicle}/replay", slot).thread)
            told = (sessions[0], vehicle, writer.layers, slot)
            threads.append(threading.Thread(target=_tell_absence, args=told, name="clearway watch names", daemon=True))
            threads[-1].start()
        except Exception as error:
            raise ClearwayError("zenoh", f"subscribe to the layers of {vehicle!r}: {error}") from None

    def open_when_there() -> None:
        try:
            open_()
        except ClearwayError as error:
            slot.end(error)

    opening = threading.Thread(target=open_when_there, name="clearway watch", daemon=True)

    def close() -> None:
        # The garbage collector may call this from one of the threads.
        for thread in [opening] if reconnect else []:
            if thread is not threading.current_thread():
                thread.join(_TIMEOUT_S)
        for session in sessions:
            session.close()  # type: ignore[no-untyped-call]
        for thread in threads:
            if thread is not threading.current_thread():
                thread.join(_TIMEOUT_S)

    if reconnect:
        opening.start()
    else:
        try:
            open_()
        except ClearwayError:
            close()
            raise
    # The stream closes before Python shuts down: a thread that returned from zenoh later would abort the process.
    return MapStream(slot, close)


class _LayerSubscription:
    """Samples of one layer's key -> the newest part of a map, with the number of missed samples."""

    def __init__(self, session: zenoh.Session, layer: _LayerKey, writer: _StreamWriter) -> None:
        import zenoh
        from zenoh import ext

        self._session, self._layer, self._writer = session, layer, writer
        #: The publisher's number of the sample that was received or queried last.
        self._number: int | None = None
        history = ext.HistoryConfig(max_samples=1, detect_late_publishers=True)
        ring = zenoh.handlers.RingChannel
        self._samples = ext.declare_advanced_subscriber(session, layer.key, ring(_SAMPLES_KEPT), history=history)
        self._misses = self._samples.sample_miss_listener(ring(_MISSES_KEPT))
        self._heartbeats = session.declare_subscriber(f"{layer.key}/@adv/pub/**", ring(1))
        # Own threads instead of zenoh's callback threads: those would keep a process alive that leaves its stream open.
        name = f"clearway watch {layer.layer}"
        loops = (self._read_samples, self._read_heartbeats)
        self.threads = [threading.Thread(target=loop, name=name, daemon=True) for loop in loops]
        for thread in self.threads:
            thread.start()

    def _read_samples(self) -> None:
        import zenoh

        for sample in self._samples:
            try:
                # zenoh reports a gap before the sample after it.
                while (miss := self._misses.try_recv()) is not None:
                    self._writer.add_missed(self._layer.layer, miss.nb)
            except zenoh.ZError:
                # The session is closed, with samples left.
                return
            if sample.kind == zenoh.SampleKind.PUT and self._writer.add(self._layer, sample):
                if sample.source_info is not None:
                    self._number = sample.source_info.source_sn

    def _read_heartbeats(self) -> None:
        import zenoh
        from zenoh import ext

        for heartbeat in self._heartbeats:
            try:
                newest = int(ext.z_deserialize(ext.UInt32, heartbeat.payload))
                samples = list(_replies(self._session, self._layer.key)) if newest != self._number else []
            except (ext.ZDeserializeError, zenoh.ZError):
                # Not a heartbeat, or the session is being closed.
                continue
            self._number = newest
            for sample in samples:
                self._writer.add(self._layer, sample)


class _ReplaySubscription:
    """The key of a vehicle's replay -> its end, after its last map."""

    def __init__(self, session: zenoh.Session, key: str, slot: LatestSlot) -> None:
        import zenoh

        self._session, self._key, self._slot, self._told = session, key, slot, False
        self._ends = session.declare_subscriber(key, zenoh.handlers.RingChannel(_SAMPLES_KEPT))
        self.thread = threading.Thread(target=self._read, name="clearway watch replay", daemon=True)
        self.thread.start()

    def _read(self) -> None:
        import zenoh

        try:
            # The replay may have ended before.
            for sample in _replies(self._session, self._key):
                self._tell(sample)
        except zenoh.ZError:
            # The session is being closed.
            return
        for sample in self._ends:
            self._tell(sample)

    def _tell(self, sample: zenoh.Sample) -> None:
        try:
            document = json.loads(sample.payload.to_bytes())
            ended, error = bool(document["ended"]), document.get("error")
            last = (document.get("boot_id"), document.get("sequence", 0))
        except (ValueError, KeyError, TypeError, AttributeError):
            # No message of a server.
            return
        was_told, self._told = self._told, ended
        if error is not None:
            self._slot.end(ClearwayError("UNAVAILABLE", str(error)))
        elif ended and not was_told:
            # Other threads store the maps. A map that the link lost does not come.
            until = time.monotonic() + _LAST_MAP_S
            while not self._has(*last) and time.monotonic() < until:
                time.sleep(0.005)
            self._slot.end_replay()

    def _has(self, boot_id: int | None, sequence: int) -> bool:
        newest = self._slot.newest()
        if boot_id is None or newest is None:
            return boot_id is None
        return newest.header.boot_id == boot_id and newest.sequence >= sequence


class _StreamWriter:
    """Parts of maps from one thread per layer -> a stream."""

    def __init__(self, slot: LatestSlot, layers: Sequence[str]) -> None:
        self._slot, self._collector, self._lock = slot, LayerCollector(layers), threading.Lock()
        self.layers = list(dict.fromkeys(layers))
        #: Samples missed of each layer since the last complete map.
        self._missed = dict.fromkeys(self.layers, 0)

    def add_missed(self, layer: str, count: int) -> None:
        with self._lock:
            self._missed[layer] += count

    def add(self, layer: _LayerKey, sample: zenoh.Sample) -> bool:
        """Adds the part of a map; counts it as passed over if it does not belong on its key. Returns whether it
        does."""
        try:
            part = layer.part(sample)
        except _Unfit as unfit:
            self._slot.pass_over(str(unfit))
            return False
        with self._lock:
            for whole in self._collector.add(*part):
                # A missed map that was queried has arrived, so it is not a skipped one.
                if self._slot.store(Map(whole), None, lost=max(self._missed.values())):
                    self._missed = dict.fromkeys(self.layers, 0)
        return True
