"""Maps from a background thread -> the newest map.

The thread stores the newest map in one slot. There is no queue, so a reader with a slow loop body never gets an old
map. A waiting reader is notified when its map becomes stale, also if no further map arrives.
"""

from __future__ import annotations

import asyncio
import math
import os
import threading
import time
import weakref
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from typing import NamedTuple, cast, overload

from .errors import ClearwayError, ReplayEnded, forked
from .freshness import POLL_INTERVAL_S, Clock
from .map import Map


class _Counters(NamedTuple):
    """Numbers of maps since the start of the stream."""

    #: Maps stored and maps skipped.
    maps: int = 0
    #: Skipped maps that the link lost.
    lost: int = 0
    #: Maps that the requested rate excluded.
    left_out: int = 0


class PassedOver(NamedTuple):
    """Numbers of received maps that a stream passed over since its start, by reason. A peer of a zenoh network without
    access control can put anything on the key of a map."""

    #: Messages that are no valid map.
    undecodable: int = 0
    #: Maps of another vehicle or layer than their key names, and messages on a key with wildcards.
    misplaced: int = 0
    #: Maps without a signature of the expected publisher (`signed_by`).
    unsigned: int = 0
    #: Maps of another run of the server while the present run sends fresh ones.
    other_run: int = 0
    #: Maps that are not newer than the newest (repeated ones).
    not_newer: int = 0


#: As in the Rust client's stream.rs, which has the reasons.
_RUN_HOLD_NS = 1_000_000_000
_AHEAD_NS_MAX = 1_000_000_000
_SKIPPED_MAX_PER_MS, _SKIPPED_MAX = 1, 1000
_AFTER_END_S = 2.0


class _Closed(ClearwayError):
    """The reader has closed the stream."""

    def __init__(self) -> None:
        super().__init__("closed", "the stream is closed")


class MapStream:
    """An iterator over the newest map; it stops at the end of a replay, and has no end otherwise. Close it, or use it
    in a `with` statement; a stream that is dropped, or open at the end of the process, is closed."""

    def __init__(self, slot: LatestSlot, close: Callable[[], None]) -> None:
        self._slot = slot
        process = os.getpid()

        def end() -> None:
            # A process that was forked from this one has no thread to end.
            if os.getpid() == process:
                slot.close()
                close()

        #: Called once: when the stream is closed or dropped, or the process ends.
        self._close = weakref.finalize(self, end)

    def __iter__(self) -> Iterator[Map]:
        return self

    def __next__(self) -> Map:
        """Waits for a map newer than the last one returned, which counts as handled: a replay in lockstep goes on then.
        Raises the reason if the stream has ended; stops when closed, and after the last map of a replay. Iterate again
        for the maps of a replay that is set back: it waits 2 s for them, and then stops again."""
        try:
            return cast(Map, self._slot.next(report_stale=False))
        except (ReplayEnded, _Closed):
            raise StopIteration from None

    @overload
    def next_or_stale(self, timeout: None = None) -> Map: ...
    @overload
    def next_or_stale(self, timeout: float) -> Map | None: ...
    def next_or_stale(self, timeout: float | None = None) -> Map | None:
        """Waits for a map newer than the last one returned, or until that one is stale. A stale map is returned again,
        once, at most 20 ms late, also if no further map arrives; `m.stale` is then true. With `timeout`, in seconds, a
        wait that takes longer returns the newest map again, stale or not, and `None` before the first. Raises the
        reason if the stream has ended: `ReplayEnded` at the end of a replay, as an iteration stops there,
        `ClearwayError` of reason "closed" when closed."""
        return self._slot.next(report_stale=True, timeout=timeout)

    def __aiter__(self) -> MapStream:
        return self

    async def __anext__(self) -> Map:
        """As `__next__`, without blocking the event loop. A wait that is cancelled takes no map."""
        try:
            return await self._slot.next_async(report_stale=False)
        except (ReplayEnded, _Closed):
            raise StopAsyncIteration from None

    async def anext_or_stale(self) -> Map:
        """As `next_or_stale` without a timeout, without blocking the event loop: `asyncio.wait_for` has one."""
        return await self._slot.next_async(report_stale=True)

    def newest(self) -> Map | None:
        """The newest map at this moment; `None` before the first. It does not wait and does not change the counts of
        the next map. The map may be stale."""
        return self._slot.newest()

    def close(self) -> None:
        """Ends the stream. A reader that waits for a map stops waiting."""
        self._close()

    def __enter__(self) -> MapStream:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    async def __aenter__(self) -> MapStream:
        return self

    async def __aexit__(self, *_: object) -> None:
        await asyncio.to_thread(self.close)

    @property
    def passed_over(self) -> PassedOver:
        """Numbers of received maps that were passed over since the start of the stream, by reason."""
        return self._slot.passed_over()

    @property
    def reasons(self) -> list[str]:
        """Why no map comes, worst first: the reasons of the vehicle's state on the server, or why there is no
        connection (`reconnect` of `clearway.watch`). Empty while maps come and in the first second without one. Over
        zenoh they name the router that does not answer, or the vehicle or layer that no server publishes."""
        return self._slot.reasons()


class LatestSlot:
    """The slot between a background thread, which stores maps, and a `MapStream`, which reads the newest. A thread has
    no reference to the stream, so that a stream ends when its reader drops it."""

    def __init__(self, clock: Clock = Clock(), *, has_one_server: bool = False) -> None:
        self._clock, self._process = clock, os.getpid()
        #: True if all maps come from one server that is known: another run is then a jump of its replay.
        self._has_one_server = has_one_server
        self._changed = threading.Condition()
        #: Functions that wake the coroutines that wait.
        self._wakers: list[Callable[[], None]] = []
        self._newest: Map | None = None
        self._counters = _Counters()
        self._passed_over = PassedOver()
        self._reasons: list[str] = []
        #: `_counters` at the map before; `None` before the first.
        self._seen: _Counters | None = None
        #: `_seen` when the reader asked for the next map: it has handled all maps until then.
        self._handled: _Counters | None = None
        #: The last map returned, until it is reported as stale.
        self._fresh: Map | None = None
        self._ended: ClearwayError | None = None
        self._closed = False
        #: Number of replays that have ended, and number of them after which the iteration has stopped.
        self._replay_ends = self._replay_ends_seen = 0
        #: True if no map has come since a replay has ended.
        self._at_end = False

    def newest(self) -> Map | None:
        """The newest map at this moment."""
        with self._changed:
            return self._newest

    def passed_over(self) -> PassedOver:
        """Numbers of received maps that were passed over."""
        with self._changed:
            return self._passed_over

    def reasons(self) -> list[str]:
        """Why no map comes."""
        with self._changed:
            return list(self._reasons)

    def set_reasons(self, reasons: Iterable[str]) -> None:
        """Sets why no map comes, until one is stored. For the background thread."""
        with self._changed:
            self._reasons = list(reasons)

    @property
    def closed(self) -> bool:
        """True if the stream was closed."""
        return self._closed

    def wait_closed(self, timeout_s: float) -> bool:
        """Waits until the stream is closed, no longer than `timeout_s`; returns whether it is."""
        with self._changed:
            return self._changed.wait_for(lambda: self._closed, timeout_s)

    def close(self) -> None:
        """Ends every wait for a map."""
        with self._changed:
            self._closed = True
            self._notify()

    def next(self, *, report_stale: bool, timeout: float | None = None) -> Map | None:
        """Waits as `MapStream.next_or_stale` does, or as `MapStream.__next__`. For the reader."""
        self._check_not_forked()
        with self._changed:
            until, end = self._ask(), time.monotonic() + (math.inf if timeout is None else timeout)
            while (found := self._found(until, report_stale)) is None:
                left = end - time.monotonic()
                if left <= 0:
                    return None if self._newest is None else self._newest.copy_with()
                self._changed.wait(min(self._pause_s(report_stale), left))
            return found

    async def next_async(self, *, report_stale: bool) -> Map:
        """As `next`, in a coroutine."""
        loop, changed = asyncio.get_running_loop(), asyncio.Event()

        def wake() -> None:
            # The loop may be closed with a coroutine that still waits.
            with suppress(RuntimeError):
                loop.call_soon_threadsafe(changed.set)

        self._check_not_forked()
        with self._changed:
            until = self._ask()
            self._wakers.append(wake)
        try:
            while True:
                changed.clear()
                with self._changed:
                    if (found := self._found(until, report_stale)) is not None:
                        return found
                    timer = loop.call_later(self._pause_s(report_stale), changed.set)
                try:
                    await changed.wait()
                finally:
                    timer.cancel()
        finally:
            with self._changed:
                self._wakers.remove(wake)

    def _check_not_forked(self) -> None:
        if os.getpid() != self._process:
            raise forked("the stream")

    def _ask(self) -> float:
        """The reader asks for the next map: it has handled the last. Returns until when it waits after a replay."""
        self._handled = self._seen
        self._notify()
        return time.monotonic() + _AFTER_END_S

    def _pause_s(self, report_stale: bool) -> float:
        """Longest time until the next look. On some platforms Ctrl-C does not interrupt a wait without limit."""
        last = self._fresh if report_stale else None
        return 1.0 if last is None else min(POLL_INTERVAL_S, last.fresh_for_s())

    def _found(self, until: float, report_stale: bool) -> Map | None:
        """What the reader waits for; `None` if it must wait."""
        if self._closed:
            raise _Closed
        newest = self._newest
        if newest is None or not self._is_unseen():
            if self.replay_ended:
                self._replay_ends_seen = self._replay_ends
                raise ReplayEnded
            if self._ended:
                raise self._ended
            if self._at_end and time.monotonic() >= until:
                raise ReplayEnded
            last = self._fresh if report_stale else None
            if last is None or not last.stale:
                return None
            self._fresh = None
            return last.copy_with()
        # The first map has skipped nothing: the reader was not subscribed before.
        counters, before = self._counters, self._seen or self._counters._replace(maps=self._counters.maps - 1)
        self._seen = counters
        last = newest.copy_with(
            counters.maps - before.maps - 1, counters.lost - before.lost, counters.left_out - before.left_out
        )
        self._fresh = None if last.stale else last
        return last

    def _notify(self) -> None:
        """Wakes every wait. The lock is held."""
        self._changed.notify_all()
        for wake in self._wakers:
            wake()

    @property
    def replay_ended(self) -> bool:
        """True from the end of a replay until the iteration has stopped for it."""
        return self._replay_ends > self._replay_ends_seen

    def _is_unseen(self) -> bool:
        return self._newest is not None and self._seen != self._counters

    def store(self, m: Map, skipped: int | None, *, lost: int = 0, left_out: int = 0) -> bool:
        """Stores a map as the newest, or counts it as passed over. Between it and the map before there are `skipped`
        maps (`None`: as many as the sequence skips), at most `lost` of them lost by the link, and `left_out` maps that
        the requested rate excluded. Returns whether it is stored. For the background thread."""
        m.with_arrival(self._clock)
        with self._changed:
            newest = self._newest
            is_jump = self._has_one_server and newest is not None and newest.header.boot_id != m.header.boot_id
            if newest is not None and not is_jump and (reason := _refuse(newest, m)):
                self._count(reason)
                return False
            if skipped is None:
                skipped = 0 if self._newest is None else _skipped(self._newest, m)
                lost = min(lost, skipped)
            before = self._counters
            self._counters = _Counters(before.maps + 1 + skipped, before.lost + lost, before.left_out + left_out)
            self._newest, self._at_end, self._reasons = m, False, []
            self._notify()
            return True

    def pass_over(self, reason: str) -> None:
        """Counts a message that is not stored, by the name of a field of `PassedOver`. For the background thread."""
        with self._changed:
            self._count(reason)

    def _count(self, reason: str) -> None:
        self._passed_over = self._passed_over._replace(**{reason: getattr(self._passed_over, reason) + 1})

    def end(self, reason: ClearwayError) -> None:
        """Ends the stream with a reason. For the background thread."""
        with self._changed:
            self._ended = reason
            self._notify()

    def wait_until_handled(self) -> None:
        """Waits until the reader has handled the newest map: until it asks for the next. For the background thread."""
        with self._changed:
            newest = self._counters
            while not self._closed and (self._handled is None or self._handled.maps < newest.maps):
                self._changed.wait(1.0)

    def end_replay(self) -> None:
        """Records that the replay has ended. For the background thread."""
        with self._changed:
            self._replay_ends += 1
            self._at_end = True
            self._notify()


def _refuse(newest: Map, m: Map) -> str | None:
    """Why a map does not replace the newest; `None` if it does. `refuse` of the Rust client's stream.rs."""
    is_ahead = newest.ahead_ns() > _AHEAD_NS_MAX
    if newest.header.boot_id != m.header.boot_id:
        holds = not newest.stale and not is_ahead and newest.since_arrival_ns() < _RUN_HOLD_NS
        return "other_run" if holds else None
    is_later = m.header.capture_end_ns > newest.header.capture_end_ns
    resynchronises = not m.stale and (is_later or is_ahead or newest.stale)
    return None if m.sequence > newest.sequence or resynchronises else "not_newer"


def _skipped(newest: Map, m: Map) -> int:
    """Number of maps between two of one run; 0 if the sequence goes back, or jumps farther than the stamps explain."""
    if newest.header.boot_id != m.header.boot_id:
        return 0
    skipped = max(m.sequence - newest.sequence - 1, 0)
    between_ms = max(m.header.capture_end_ns - newest.header.capture_end_ns, 0) // 1_000_000
    return skipped if skipped <= _SKIPPED_MAX + _SKIPPED_MAX_PER_MS * between_ms else 0
