"""Maps, as fast as they come, to the newest map, as fast as it is asked for.

A background thread fills one slot; a reader whose loop body is slow, or that only looks now and then, never gets an old
map from a queue, because there is none. And a reader that waits is told when the map it has becomes stale, also where nothing
comes any more.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from typing import NamedTuple

from .errors import ClearwayError
from .freshness import LOOK_S, Clock
from .map import Map


class _Made(NamedTuple):
    """Maps since the start of the stream."""

    #: Those given and those skipped.
    maps: int = 0
    #: Of the skipped ones, those that the link lost.
    lost: int = 0
    #: Those left out at the reader's wish.
    left_out: int = 0


class MapStream:
    """An endless iterator over the newest map. Close it, or use it in a `with` statement."""

    def __init__(self, clock: Clock = Clock()) -> None:
        self._clock = clock
        self._changed = threading.Condition()
        self._newest: Map | None = None
        self._made = _Made()
        #: `_made` at the previous look; `None` before the first.
        self._seen: _Made | None = None
        #: The map given last, until it is told as stale.
        self._fresh: Map | None = None
        self._ended: ClearwayError | None = None
        self._closed = False
        self._close: Callable[[], None] = lambda: None

    def __iter__(self) -> Iterator[Map]:
        return self

    def __next__(self) -> Map:
        """Waits for a map newer than the one given last. Raises why there will be no more; ends when closed."""
        return self._next(tell_stale=False)

    def next_or_stale(self) -> Map:
        """Waits for a map newer than the one given last, or until that one is stale: then it is given again, once, at most
        20 ms late, whether or not anything comes. Ask the map: `m.stale`. Raises why there will be no more, and
        `StopIteration` when closed."""
        return self._next(tell_stale=True)

    def _next(self, *, tell_stale: bool) -> Map:
        with self._changed:
            while not (self._closed or self._is_unseen() or self._ended):
                given = self._fresh if tell_stale else None
                if given is not None and given.stale:
                    self._fresh = None
                    return given.again()
                # A wait without limit would not let Ctrl-C through on every platform.
                self._changed.wait(1.0 if given is None else min(LOOK_S, given.fresh_for_s()))
            if self._closed:
                raise StopIteration
            newest = self._newest
            if newest is None or not self._is_unseen():
                assert self._ended is not None
                raise self._ended
            # The first look has missed nothing: the reader was not there before.
            made, before = self._made, self._seen or self._made._replace(maps=self._made.maps - 1)
            self._seen = made
            given = newest.again(made.maps - before.maps - 1, made.lost - before.lost, made.left_out - before.left_out)
            self._fresh = None if given.stale else given
            return given

    def newest(self) -> Map | None:
        """The newest map at this moment, without waiting and without counting as a look; it may be stale."""
        with self._changed:
            return self._newest

    def close(self) -> None:
        """Ends the stream; whoever waits for a map stops waiting."""
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

    def put(self, m: Map, skipped: int, *, lost: int = 0, left_out: int = 0) -> None:
        """Makes a map the newest; between it and the one before lie `skipped` maps, `lost` of them by the link, and `left_out`
        ones that the reader did not want. One that is no newer than the newest of the same run of the server (a replayed one)
        is passed over. For the background thread."""
        m.arrived(self._clock)
        with self._changed:
            newest = self._newest
            if newest is None or newest.header.boot_id != m.header.boot_id or newest.sequence < m.sequence:
                made = self._made
                self._made = _Made(made.maps + 1 + skipped, made.lost + lost, made.left_out + left_out)
                self._newest = m
                self._changed.notify_all()

    def end(self, reason: ClearwayError) -> None:
        """There will be no more maps. For the background thread."""
        with self._changed:
            self._ended = reason
            self._changed.notify_all()

    def on_close(self, close: Callable[[], None]) -> None:
        """What else ends with the stream."""
        self._close = close

    def _is_unseen(self) -> bool:
        return self._newest is not None and self._seen != self._made
