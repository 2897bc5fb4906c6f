"""A second session of a reader that knows several routers, to another router than its first session, while the first
brings no maps. client/src/zenoh/standby.rs has the reasons."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import zenoh

#: As in client/src/zenoh/standby.rs.
_SILENT_PERIODS, _SILENT_MIN_S, _SILENT_MAX_S = 1.6, 0.16, 0.3
_BACK_AFTER, _VAIN_AFTER_S, _AGAIN_AFTER_S, _RETRY_S = 10, 5.0, 30.0, 0.2
#: As in client/src/zenoh/subscription.rs.
_PERIOD_S, _PERIOD_MAX_S, _SMOOTHING = 0.1, 1.0, 5


class Arrivals:
    """The maps that a session has brought. For several threads."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self.count = 0
        #: When the last map came, or the session began.
        self._at = time.monotonic()
        #: Time between two maps, smoothed.
        self._period_s = _PERIOD_S
        self.ended = False

    def add(self) -> None:
        with self._changed:
            now = time.monotonic()
            if self.count > 0:
                self._period_s += (min(now - self._at, _PERIOD_MAX_S) - self._period_s) / _SMOOTHING
            self.count, self._at = self.count + 1, now
            self._changed.notify_all()

    def end(self) -> None:
        with self._changed:
            self.ended = True
            self._changed.notify_all()

    def quiet_s(self) -> float:
        """Time since the last map, or since the begin."""
        return time.monotonic() - self._at

    def wait_silent(self) -> None:
        """Waits until no map has come for longer than maps are apart, or the end."""
        with self._changed:
            while not self.ended and (left := self._allowed_s() - self.quiet_s()) > 0:
                self._changed.wait(left)

    def _allowed_s(self) -> float:
        if self.count == 0:
            return _SILENT_MAX_S
        return min(max(self._period_s * _SILENT_PERIODS, _SILENT_MIN_S), _SILENT_MAX_S)

    def wait_for(self, count: int, timeout_s: float) -> bool:
        """Waits until so many maps have come, or the end; returns false after the time-out."""
        with self._changed:
            return self._changed.wait_for(lambda: self.ended or self.count >= count, timeout_s)


class Standby:
    """Reads through another router while the first session brings no maps, in a thread of its own."""

    def __init__(
        self,
        first: zenoh.Session,
        arrivals: Arrivals,
        endpoints: Sequence[str],
        connect: Callable[[str], zenoh.Session],
        subscribe: Callable[[zenoh.Session, Arrivals], list[threading.Thread]],
    ) -> None:
        """`connect` opens a session to an endpoint; `subscribe` begins to read through a session, counts its maps, and
        returns the threads that do so until the session is closed."""
        self._first, self._arrivals, self._endpoints = first, arrivals, endpoints
        self._connect, self._subscribe = connect, subscribe
        self.thread = threading.Thread(target=self._cover, name="clearway standby", daemon=True)
        self.thread.start()

    def _cover(self) -> None:
        arrivals = self._arrivals
        while True:
            arrivals.wait_silent()
            if arrivals.ended:
                return
            try:
                # Without a router the first session looks for another one itself.
                covered = not _routers(self._first) or self._cover_once()
            except Exception:  # noqa: BLE001: no other router, or the first session is being closed.
                covered = False
            # What was in vain is tried again later, unless the first has maps again.
            arrivals.wait_for(arrivals.count + 1, _RETRY_S if covered else _AGAIN_AFTER_S)

    def _cover_once(self) -> bool:
        """Reads through another router until the first session has maps again. Returns false if none came there
        either."""
        session = self._second()
        if session is None:
            return False
        back, second, threads = self._arrivals.count + _BACK_AFTER, Arrivals(), []
        try:
            threads = self._subscribe(session, second)
            while (left := _VAIN_AFTER_S - second.quiet_s()) > 0:
                if self._arrivals.wait_for(back, left):
                    return True
            return False
        finally:
            session.close()
            for thread in threads:
                thread.join()

    def _second(self) -> zenoh.Session | None:
        """A session at a router that is not that of the first."""
        own = _routers(self._first)
        for endpoint in self._endpoints:
            if self._arrivals.ended:
                return None
            try:
                session = self._connect(endpoint)
            except Exception:  # noqa: BLE001: this router does not answer.
                continue
            if _routers(session) - own:
                return session
            session.close()
        return None


def _routers(session: zenoh.Session) -> set[str]:
    return {str(router) for router in session.info.routers_zid()}
