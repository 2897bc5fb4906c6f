"""Situations in which a map is older than it seems (see the Rust client's stream.rs), with clocks that the tests
set."""

import json
from pathlib import Path

import pytest

import clearway
from clearway.freshness import POLL_INTERVAL_S, Clock
from clearway.stream import LatestSlot, MapStream
from clearway.v1 import map_pb2

MS = 1_000_000
START_NS = 1_700_000_000_000_000_000
VALID_MS = 300
STALENESS = json.loads((Path(__file__).resolve().parents[2] / "golden" / "staleness.json").read_text())


class TestBed:
    """A stream and the clocks of the planner's machine."""

    __test__ = False

    def __init__(self, *, has_one_server=False):
        self.wall_ns, self.steady_ns = START_NS, 0
        clock = Clock(lambda: self.wall_ns, lambda: self.steady_ns)
        self.slot = LatestSlot(clock, has_one_server=has_one_server)
        self.stream = MapStream(self.slot, lambda: None)

    def pass_(self, ns):
        self.wall_ns += ns
        self.steady_ns += ns

    def store_aged(self, boot_id, sequence, age_ns):
        self.store(boot_id, sequence, self.wall_ns - age_ns)

    def store(self, boot_id, sequence, end_ns):
        header = map_pb2.Header(vehicle="alpha", boot_id=boot_id, sequence=sequence, capture_start_ns=end_ns,
                                capture_end_ns=end_ns, valid_until_ns=end_ns + VALID_MS * MS)  # fmt: skip
        self.slot.store(clearway.Map(map_pb2.Map(header=header).SerializeToString()), 0)

    def next(self):
        m = self.stream.next_or_stale()
        return m.stale, m.sequence, m.age_ns()

    def is_silent(self):
        """True if there is no newer map and the newest was reported as stale."""
        return not self.slot._is_unseen() and self.slot._fresh is None

    def check_becomes_stale(self, sequence):
        self.pass_(260 * MS)
        assert not self.stream.newest().stale, "the map may be used in its last nanosecond"
        self.pass_(1)
        assert self.next() == (True, sequence, VALID_MS * MS + 1)
        assert self.is_silent()


def test_a_wait_with_a_timeout_returns_the_newest_map_again():
    bed = TestBed()
    assert bed.stream.next_or_stale(timeout=0) is None
    bed.store_aged(1, 7, 40 * MS)
    assert bed.next()[:2] == (False, 7)
    assert (again := bed.stream.next_or_stale(timeout=0)).sequence == 7 and not again.stale
    bed.check_becomes_stale(7)
    for _ in range(2):
        assert (again := bed.stream.next_or_stale(timeout=0.01)).sequence == 7 and again.stale


def test_a_map_is_reported_as_stale_after_the_link_is_cut():
    bed = TestBed()
    bed.store_aged(7, 0, 40 * MS)
    assert bed.next() == (False, 0, 40 * MS)
    bed.check_becomes_stale(0)
    bed.store_aged(7, 20, 40 * MS)
    assert bed.next() == (False, 20, 40 * MS)


def test_a_jump_of_a_replay_is_followed_at_once_where_the_server_is_known():
    for has_one_server in (True, False):
        bed = TestBed(has_one_server=has_one_server)
        bed.store_aged(7, 20, 40 * MS)
        assert bed.next() == (False, 20, 40 * MS)
        bed.store_aged(8, 3, 30 * MS)
        assert bed.stream.newest().sequence == (3 if has_one_server else 20)
        assert bed.stream.passed_over.other_run == (0 if has_one_server else 1)


def test_the_last_map_of_a_stopped_server_becomes_stale():
    bed = TestBed()
    bed.store_aged(7, 0, 40 * MS)
    assert bed.next() == (False, 0, 40 * MS)
    bed.slot.end(clearway.ClearwayError("UNAVAILABLE", "alpha:1"))
    with pytest.raises(clearway.ClearwayError, match="alpha:1"):
        bed.stream.next_or_stale()
    bed.pass_(261 * MS)
    assert bed.stream.newest().stale


def test_a_growing_delay_is_reported_at_the_first_map_that_is_too_old():
    bed = TestBed()
    for sequence in range(320):
        bed.pass_(100 * MS)
        bed.store_aged(7, sequence, sequence * MS)
        assert bed.next() == (sequence > VALID_MS, sequence, sequence * MS)


def test_a_replayed_map_is_neither_newest_nor_fresh():
    bed = TestBed()
    bed.store_aged(7, 5, 40 * MS)
    assert bed.next() == (False, 5, 40 * MS)
    bed.pass_(1200 * MS)
    bed.store(7, 5, START_NS - 40 * MS)
    bed.store(7, 4, START_NS - 140 * MS)
    assert bed.next() == (True, 5, 1240 * MS)
    assert bed.is_silent()
    bed.store(7, 6, START_NS - 40 * MS)
    assert bed.next() == (True, 6, 1240 * MS)


def test_the_first_map_of_a_restarted_server_is_the_newest():
    bed = TestBed()
    bed.store_aged(7, 900, 40 * MS)
    assert bed.next() == (False, 900, 40 * MS)
    bed.check_becomes_stale(900)
    bed.store_aged(8, 0, 40 * MS)
    assert bed.next() == (False, 0, 40 * MS)


@pytest.mark.parametrize("step_ms", [-3_600_000, -200, -50])
def test_a_step_of_the_wall_clock_makes_no_stale_map_fresh(step_ms):
    bed = TestBed()
    bed.store_aged(7, 0, 40 * MS)
    assert bed.next() == (False, 0, 40 * MS)
    bed.wall_ns += step_ms * MS
    if step_ms < -VALID_MS:
        assert bed.next()[0], "the age is not known by a clock this far behind"
    else:
        bed.check_becomes_stale(0)
    stale = bed.stream.newest()
    bed.pass_(400 * MS)
    for further in (0, step_ms, 10 * step_ms):
        at_ns = bed.wall_ns + further * MS
        assert stale.is_stale(at_ns) and stale.age_ns(at_ns) >= 440 * MS


@pytest.mark.parametrize("case", STALENESS)
def test_a_stale_map_says_why_in_the_words_of_every_client(case):
    bed = TestBed()
    bed.store_aged(7, 0, case["age_on_arrival_ms"] * MS)
    bed.pass_(case["since_arrival_ms"] * MS)
    newest = bed.stream.newest()
    assert (newest.stale, newest.stale_because) == (case["stale_because"] is not None, case["stale_because"])


def test_a_stream_polls_its_clocks_often_enough_for_the_promised_50_ms():
    assert 2 * POLL_INTERVAL_S <= 0.05
