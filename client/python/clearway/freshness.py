"""How old a map is, by two clocks.

Age counts from the end of the capture, which only the wall clock can tell; but a wall clock can be set back. So a map is at
least as old as it was when it came, and the time since by a steady clock: no step of the wall clock makes a stale map fresh.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import NamedTuple

#: How often a stream that waits looks at its clocks: a map is told as stale at most this late.
LOOK_S = 0.02


def now_ns() -> int:
    """This machine's clock, ns since the Unix epoch."""
    return time.time_ns()


class Clock(NamedTuple):
    """Where the time comes from."""

    #: ns since the Unix epoch; may be stepped.
    wall_ns: Callable[[], int] = now_ns
    #: ns since some moment; never goes back.
    steady_ns: Callable[[], int] = time.monotonic_ns


class Arrival(NamedTuple):
    """When a map came to this process."""

    clock: Clock
    steady_ns: int
    #: By the wall clock, as it was then.
    age_ns: int

    @staticmethod
    def of(capture_end_ns: int, clock: Clock) -> Arrival:
        return Arrival(clock, clock.steady_ns(), max(clock.wall_ns() - capture_end_ns, 0))

    def age_ns_min(self) -> int:
        """What the map is old at least, whatever the wall clock says now."""
        return self.age_ns + self.clock.steady_ns() - self.steady_ns
