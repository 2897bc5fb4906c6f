"""Maps, as fast as they come, to the newest map, as fast as it is asked for.

A background thread fills one slot; a reader whose loop body is slow, or that only looks now and then, never gets an old
map from a queue, because there is none.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator

from .errors import ClearwayError
from .map import Map


class MapStream:
    """An endless iterator over the newest map. Close it, or use it in a `with` statement."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._newest: bytes | None = None
        #: Maps since the start of the stream, those that were skipped included.
        self._made = 0
        #: `_made` at the previous look; `None` before the first.
        self._seen: int | None = None
        self._ended: ClearwayError | None = None
        self._closed = False
        self._close: Callable[[], None] = lambda: None

    def __iter__(self) -> Iterator[Map]:
        return self

    def __next__(self) -> Map:
        """Waits for a map newer than the one given last. Raises why there will be no more; ends when closed."""
        with self._changed:
            # A wait without limit would not let Ctrl-C through on every platform.
            while not (self._closed or self._ended or (self._newest is not None and self._made != self._seen)):
                self._changed.wait(1.0)
            if self._closed:
                raise StopIteration
            if self._newest is None or self._made == self._seen:
                assert self._ended is not None
                raise self._ended
            # The first look has missed nothing: the reader was not there before.
            skipped = 0 if self._seen is None else self._made - self._seen - 1
            self._seen = self._made
            encoded = self._newest
        return Map(encoded, skipped)

    def newest(self) -> Map | None:
        """The newest map at this moment, without waiting and without counting as a look; it may be stale."""
        with self._changed:
            encoded = self._newest
        return None if encoded is None else Map(encoded)

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

    def put(self, encoded: bytes, skipped: int) -> None:
        """Makes a map the newest; `skipped` maps lie between it and the one before. For the background thread."""
        with self._changed:
            self._made += 1 + skipped
            self._newest = encoded
            self._changed.notify_all()

    def end(self, reason: ClearwayError) -> None:
        """There will be no more maps. For the background thread."""
        with self._changed:
            self._ended = reason
            self._changed.notify_all()

    def on_close(self, close: Callable[[], None]) -> None:
        """What else ends with the stream."""
        self._close = close
