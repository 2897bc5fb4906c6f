"""The six ways a map can be older than it looks (see the Rust client's stream.rs), with clocks that the tests set."""

import pytest

import clearway
from clearway.freshness import LOOK_S, Clock
from clearway.stream import MapStream
from clearway.v1 import map_pb2

MS = 1_000_000
START_NS = 1_700_000_000_000_000_000
VALID_MS = 300


class House:
    """A planner's machine and the server it reads from."""

    def __init__(self):
        self.wall_ns, self.steady_ns = START_NS, 0
        self.stream = MapStream(Clock(lambda: self.wall_ns, lambda: self.steady_ns))

    def pass_(self, ns):
        self.wall_ns += ns
        self.steady_ns += ns

    def comes(self, boot_id, sequence, age_ns):
        self.came(boot_id, sequence, self.wall_ns - age_ns)

    def came(self, boot_id, sequence, end_ns):
        header = map_pb2.Header(vehicle="alpha", boot_id=boot_id, sequence=sequence, capture_start_ns=end_ns,
                                capture_end_ns=end_ns, valid_until_ns=end_ns + VALID_MS * MS)  # fmt: skip
        self.stream.put(clearway.Map(map_pb2.Map(header=header).SerializeToString()), 0)

    def says(self):
        m = self.stream.next_or_stale()
        return m.stale, m.sequence, m.age_ns()

    def has_told(self):
        """Nothing new is there, and what there is was told as stale."""
        return not self.stream._is_unseen() and self.stream._fresh is None

    def goes_stale(self, sequence):
        self.pass_(260 * MS)
        assert not self.stream.newest().stale, "in its last nanosecond it may be used"
        self.pass_(1)
        assert self.says() == (True, sequence, VALID_MS * MS + 1)
        assert self.has_told()


def test_a_cut_link_leaves_a_map_that_is_told_as_stale_though_nothing_comes():
    house = House()
    house.comes(7, 0, 40 * MS)
    assert house.says() == (False, 0, 40 * MS)
    house.goes_stale(0)
    house.comes(7, 20, 40 * MS)
    assert house.says() == (False, 20, 40 * MS)


def test_a_stopped_server_is_named_and_its_last_map_grows_stale_all_the_same():
    house = House()
    house.comes(7, 0, 40 * MS)
    assert house.says() == (False, 0, 40 * MS)
    house.stream.end(clearway.ClearwayError("UNAVAILABLE", "alpha:1"))
    with pytest.raises(clearway.ClearwayError, match="alpha:1"):
        house.stream.next_or_stale()
    house.pass_(261 * MS)
    assert house.stream.newest().stale


def test_a_delay_that_grows_by_a_millisecond_a_map_is_told_at_the_first_map_that_is_too_old():
    house = House()
    for turn in range(320):
        house.pass_(100 * MS)
        house.comes(7, turn, turn * MS)
        assert house.says() == (turn > VALID_MS, turn, turn * MS)


def test_an_old_map_that_is_replayed_is_neither_the_newest_nor_fresh():
    house = House()
    house.comes(7, 5, 40 * MS)
    assert house.says() == (False, 5, 40 * MS)
    house.pass_(1200 * MS)
    house.came(7, 5, START_NS - 40 * MS)
    house.came(7, 4, START_NS - 140 * MS)
    assert house.says() == (True, 5, 1240 * MS)
    assert house.has_told()
    house.came(7, 6, START_NS - 40 * MS)
    assert house.says() == (True, 6, 1240 * MS)


def test_a_restarted_server_is_another_boot_whose_first_map_is_the_newest():
    house = House()
    house.comes(7, 900, 40 * MS)
    assert house.says() == (False, 900, 40 * MS)
    house.goes_stale(900)
    house.comes(8, 0, 40 * MS)
    assert house.says() == (False, 0, 40 * MS)


@pytest.mark.parametrize("step_ms", [-3_600_000, -200, -50])
def test_a_step_of_the_wall_clock_makes_no_stale_map_fresh(step_ms):
    house = House()
    house.comes(7, 0, 40 * MS)
    assert house.says() == (False, 0, 40 * MS)
    house.wall_ns += step_ms * MS
    if step_ms < -VALID_MS:
        assert house.says()[0], "a clock this far behind cannot tell the age"
    else:
        house.goes_stale(0)
    stale = house.stream.newest()
    house.pass_(400 * MS)
    for further in (0, step_ms, 10 * step_ms):
        at_ns = house.wall_ns + further * MS
        assert stale.is_stale(at_ns) and stale.age_ns(at_ns) >= 440 * MS


def test_a_stream_looks_at_its_clocks_often_enough_for_what_planners_are_promised():
    assert 2 * LOOK_S <= 0.05
