"""Streams in asyncio: the same maps, no map lost to a cancelled wait, and an event loop that is never blocked."""

import asyncio
import os
import threading

import pytest

import clearway
from clearway.stream import LatestSlot
from clearway.v1 import map_pb2


def sample(sequence):
    header = map_pb2.Header(vehicle="alpha", boot_id=7, sequence=sequence, valid_until_ns=1 << 62)
    header.capture_start_ns = header.capture_end_ns = clearway.now_ns()
    return clearway.Map(map_pb2.Map(header=header).SerializeToString())


def stream():
    slot = LatestSlot()
    return slot, clearway.MapStream(slot, lambda: None)


def test_a_cancelled_wait_takes_no_map_and_leaves_nothing_behind():
    async def run():
        slot, maps = stream()
        for sequence in range(20):
            waiting = asyncio.ensure_future(anext(maps))
            await asyncio.sleep(0)
            waiting.cancel()
            with pytest.raises(asyncio.CancelledError):
                await waiting
            slot.store(sample(sequence), None)
            assert (m := await anext(maps)).sequence == sequence and m.skipped == 0
        assert slot._wakers == []

    asyncio.run(run())


def test_a_wait_ends_with_a_map_of_another_thread_with_a_stale_map_and_with_the_end_of_the_stream():
    async def run():
        slot, maps = stream()
        threading.Timer(0.0, slot.store, (sample(3), None)).start()
        assert (await maps.anext_or_stale()).sequence == 3
        threading.Timer(0.0, slot.end_replay).start()
        assert [m async for m in maps] == []
        threading.Timer(0.0, slot.close).start()
        with pytest.raises(clearway.ClearwayError, match="closed"):
            await maps.anext_or_stale()
        assert [m async for m in maps] == []
        slot, maps = stream()
        m = sample(4)
        m.header.valid_until_ns = m.header.capture_end_ns
        slot.store(m, None)
        assert (await anext(maps)).stale
        threading.Timer(0.0, slot.end, (clearway.ClearwayError("ended", "gone"),)).start()
        with pytest.raises(clearway.ClearwayError, match="gone"):
            await anext(maps)

    asyncio.run(run())


@pytest.mark.skipif(not os.environ.get("CLEARWAY"), reason="CLEARWAY names no command")
def test_two_streams_of_a_replay_in_lockstep_are_read_side_by_side_on_one_loop(clearway_replay):
    async def follow(drive, layer):
        async with drive.watch(layers=layer) as maps:
            return [m.sequence async for m in maps]

    async def run():
        drive = await asyncio.to_thread(clearway_replay, clearway.testing.TOWN, "--lockstep", "--wait-readers", "2")
        both = await asyncio.gather(*(follow(drive, layer) for layer in ("freespace", "terrain")))
        assert both == [list(range(10))] * 2

    asyncio.run(run())
