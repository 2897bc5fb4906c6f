"""Age of a map by two clocks.

The age starts at the end of the capture, which is a stamp of the wall clock; but a wall clock can be set back. So a map
is at least as old as its age on arrival plus the time since then by a steady clock. No step of the wall clock makes a
stale map fresh.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import NamedTuple

#: Interval at which a waiting stream reads its clocks, in seconds: it reports a stale map at most this late.
POLL_INTERVAL_S = 0.02


def now_ns() -> int:
    """Present time of this machine's wall clock, ns since the Unix epoch."""
    return time.time_ns()


class Clock(NamedTuple):
    """The clocks of a stream."""

    #: Wall clock, ns since the Unix epoch; it can be set forward and back.
    wall_ns: Callable[[], int] = now_ns
    #: Steady clock, ns since an arbitrary moment; it never goes back.
    steady_ns: Callable[[], int] = time.monotonic_ns
    #: True: the wall clock is the replay's, which stood at the end of the making of each map when it came.
    is_of_replay: bool = False


class Arrival(NamedTuple):
    """Arrival of a map at this process."""

    clock: Clock
    steady_ns: int
    #: Age of the map on arrival, by the wall clock.
    age_ns: int

    @staticmethod
    def of(capture_end_ns: int, completed_ns: int, clock: Clock) -> Arrival:
        if clock.is_of_replay:
            steady, came_ns = clock.steady_ns, clock.steady_ns()
            clock = clock._replace(wall_ns=lambda: completed_ns + steady() - came_ns)
        return Arrival(clock, clock.steady_ns(), max(clock.wall_ns() - capture_end_ns, 0))

    def age_ns_min(self) -> int:
        """Least age of the map in ns; it does not depend on the present wall clock."""
        return self.age_ns + self.since_ns()

    def since_ns(self) -> int:
        """Time since the arrival in ns, by the steady clock."""
        return self.clock.steady_ns() - self.steady_ns
