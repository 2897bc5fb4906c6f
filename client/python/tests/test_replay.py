"""The replay that planners are tested with is controlled, ends with a named error, and says how its server ended."""

import math
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import clearway

pytestmark = pytest.mark.skipif(not os.environ.get("CLEARWAY"), reason="CLEARWAY names no command")


def test_a_replay_is_paused_stepped_and_sought(clearway_replay):
    drive = clearway_replay()
    with drive.watch(layers=["drivability"]) as maps:
        next(maps)
        paused = drive.pause()
        assert (paused.phase, drive.state()) == ("paused", paused)
        stepped = drive.step(2)
        assert (stepped.phase, stepped.maps["car"]) == ("paused", paused.maps["car"] + 2)
        sought = drive.seek(0.3)
        assert (sought.phase, round(sought.position_s, 6)) == ("paused", 0.3)
        at = next(m for m in maps if m.sequence == sought.maps["car"] - 1)
        assert drive.step().maps["car"] == at.sequence + 2
        # The map at the position may come twice: once from the step, and once more from the seek.
        assert next(m for m in maps if m.sequence > at.sequence).sequence == at.sequence + 1
        assert (drive.speed(2.0).speed, drive.speed(math.inf).speed) == (2.0, math.inf)
        assert drive.lockstep().lockstep and not drive.lockstep(False).lockstep
        assert drive.play().phase == "playing"
        *_, last = maps
        assert last.sequence == drive.state().maps["car"] - 1
        assert drive.state().phase == "ended"
        # Asked again, the stream says that it is at the end, and does not wait for ever.
        with pytest.raises(clearway.ReplayEnded):
            while maps.next_or_stale().stale:
                pass
        assert next(maps, None) is None
    for wrong, allowed in [
        (lambda: drive.seek(99.0), "plays 0.000 s to"), (lambda: drive.seek(1e300), "seek 1e[+]300 s"),
        (lambda: drive.seek(math.nan), "seek nan s"), (lambda: drive.step(-1), "step -1 maps"),
        (lambda: drive.speed(0.0), "0.1 to 1000"),
    ]:  # fmt: skip
        with pytest.raises(clearway.ClearwayError, match=allowed):
            wrong()


def test_the_end_of_a_replay_has_a_name_and_an_exit_code(clearway_replay):
    drive = clearway_replay(clearway.testing.TOWN, "--exit-at-end", "--lockstep")
    seen = []
    with drive.watch(layers=["drivability"]) as maps:
        with pytest.raises(clearway.ReplayEnded, match="the replay has ended") as ended:
            while True:
                seen.append(maps.next_or_stale().sequence)
    assert sorted(set(seen)) == list(range(10)) and ended.value.reason == "replay_ended"
    with pytest.raises(clearway.ClearwayError, match="closed"):
        maps.next_or_stale()
    assert (drive.wait(), drive.exit_code) == (0, 0)


def test_the_log_and_the_exit_code_of_a_server_outlive_it(clearway_replay):
    drive = clearway_replay()
    assert drive.exit_code is None and drive.zenoh.startswith("zenoh:tcp/127.0.0.1:")
    with pytest.raises(clearway.ClearwayError, match="has not ended"):
        drive.wait(0.0)
    drive.close()
    assert drive.exit_code == -signal.SIGKILL and "gRPC" in drive.log


def test_a_reader_over_zenoh_gets_the_maps_too(clearway_replay):
    drive = clearway_replay()
    with clearway.watch(drive.zenoh, vehicle="car", layers=["drivability"]) as maps:
        assert next(maps)["drivability"].classes.any()
        *_, last = maps
        assert last.sequence == 9
    with clearway.watch(drive.zenoh, vehicle="car", layers=["drivability"]) as late:
        assert [m.sequence for m in late] in ([], [9])
        with pytest.raises(clearway.ReplayEnded):
            while late.next_or_stale():
                pass


def test_a_reader_over_zenoh_learns_why_a_replay_in_lockstep_has_failed(clearway_replay):
    drive = clearway_replay(clearway.testing.TOWN, "--lockstep=0.5")
    with clearway.watch(drive.zenoh, vehicle="car", layers=["drivability"]) as maps:
        with pytest.raises(clearway.ClearwayError, match="map 0 of vehicle car was not acknowledged within 0.5 s"):
            while next(maps):
                pass


def test_the_server_ends_with_the_process_that_started_it_also_if_that_is_killed():
    program = (
        "import os, clearway.testing; drive = clearway.testing.Replay(); "
        "print(drive._folder.name, flush=True); os.kill(os.getpid(), 9)"
    )
    killed = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert killed.returncode == -signal.SIGKILL, killed
    # The server removes its ready file at its end.
    ready, until = Path(killed.stdout.strip(), "ready.json"), time.monotonic() + 60
    while ready.exists():
        assert time.monotonic() < until, "the server runs on"
    shutil.rmtree(ready.parent)
