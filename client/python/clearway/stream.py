"""Maps from a background thread -> the newest map.

The thread stores the newest map in one slot. There is no queue, so a reader with a slow loop body never gets an old
map. A waiting reader is notified when its map becomes stale, also if no further map arrives.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from typing import NamedTuple

from .errors import ClearwayError
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


class MapStream:
    """An iterator over the newest map; it stops at the end of a replay, and has no end otherwise. Close it, or use it
    in a `with` statement."""

    def __init__(self, clock: Clock = Clock()) -> None:
        self._clock = clock
        self._changed = threading.Condition()
        self._newest: Map | None = None
        self._counters = _Counters()
        #: `_counters` at the map before; `None` before the first.
        self._seen: _Counters | None = None
        #: The last map returned, until it is reported as stale.
        self._fresh: Map | None = None
        self._ended: ClearwayError | None = None
        self._closed = False
        #: Replays that have reached their end, and those of them after which the iteration has stopped.
        self._replay_ends = self._replay_ends_seen = 0
        self._close: Callable[[], None] = lambda: None

    def __iter__(self) -> Iterator[Map]:
        return self

    def __next__(self) -> Map:
        """Waits for a map newer than the last one returned. Raises the reason if the stream has ended; stops when
        closed, and once after the last map of a replay: iterate again for the maps of a replay that is set back."""
        return self._next(report_stale=False)

    def next_or_stale(self) -> Map:
        """Waits for a map newer than the last one returned, or until that one is stale. A stale map is returned again,
        once, at most 20 ms late, also if no further map arrives; `m.stale` is then true. Raises the reason if the
        stream has ended, and `StopIteration` when closed."""
        return self._next(report_stale=True)

    def _next(self, *, report_stale: bool) -> Map:
        with self._changed:
            while not (self._closed or self._is_unseen() or self._ended or self.replay_ended):
                last = self._fresh if report_stale else None
                if last is not None and last.stale:
                    self._fresh = None
                    return last.copy_with()
                # On some platforms Ctrl-C does not interrupt a wait without limit.
                self._changed.wait(1.0 if last is None else min(POLL_INTERVAL_S, last.fresh_for_s()))
            if self._closed:
                raise StopIteration
            newest = self._newest
            if self.replay_ended and not self._is_unseen():
                self._replay_ends_seen = self._replay_ends
                raise StopIteration
            if newest is None or not self._is_unseen():
                assert self._ended is not None
                raise self._ended
            # The first map has skipped nothing: the reader was not subscribed before.
            counters, before = self._counters, self._seen or self._counters._replace(maps=self._counters.maps - 1)
            self._seen = counters
            last = newest.copy_with(
                counters.maps - before.maps - 1, counters.lost - before.lost, counters.left_out - before.left_out
            )
            self._fresh = None if last.stale else last
            return last

    @property
    def replay_ended(self) -> bool:
        """True from the end of a replay until the iteration has stopped for it."""
        return self._replay_ends > self._replay_ends_seen

    def newest(self) -> Map | None:
        """The newest map at this moment; `None` before the first. It does not wait and does not change the counts of
        the next map. The map may be stale."""
        with self._changed:
            return self._newest

    def close(self) -> None:
        """Ends the stream. A reader that waits for a map stops waiting."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._close()

    def __enter__(self) -> MapStream:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __del__(self) -> None:
        self._close()

    def store(self, m: Map, skipped: int, *, lost: int = 0, left_out: int = 0) -> None:
        """Stores a map as the newest. Between it and the one before there are `skipped` maps, of which the link lost
        `lost`, and `left_out` maps that the requested rate excluded. Ignores a map that is not newer than the newest of
        the same run of the server (a replayed one). For the background thread."""
        m.with_arrival(self._clock)
        with self._changed:
            newest = self._newest
            if newest is None or newest.header.boot_id != m.header.boot_id or newest.sequence < m.sequence:
                before = self._counters
                self._counters = _Counters(before.maps + 1 + skipped, before.lost + lost, before.left_out + left_out)
                self._newest = m
                self._changed.notify_all()

    def end(self, reason: ClearwayError) -> None:
        """Ends the stream with a reason. For the background thread."""
        with self._changed:
            self._ended = reason
            self._changed.notify_all()

    def end_replay(self) -> None:
        """Records that the replay has ended. For the background thread."""
        with self._changed:
            self._replay_ends += 1
            self._changed.notify_all()

    def on_close(self, close: Callable[[], None]) -> None:
        """Sets a function that is called when the stream is closed."""
        self._close = close

    def _is_unseen(self) -> bool:
        return self._newest is not None and self._seen != self._counters
