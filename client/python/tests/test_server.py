"""Against a running server, whose addresses are in CLEARWAY_GRPC, CLEARWAY_ZENOH and CLEARWAY_RECORDING."""

import json
import os
import re
import subprocess
import sys
import threading
from pathlib import Path

import pytest

import clearway

GRPC, ZENOH, RECORDING = (os.environ.get(f"CLEARWAY_{name}", "") for name in ("GRPC", "ZENOH", "RECORDING"))
pytestmark = pytest.mark.skipif(not GRPC, reason="CLEARWAY_GRPC names no server")
EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
SUBSCRIPTIONS = json.loads((Path(__file__).resolve().parents[2] / "golden" / "subscriptions.json").read_text())
TRANSPORTS = [{"address": GRPC}, {"address": f"zenoh:{ZENOH}", "vehicle": "car"}]


@pytest.mark.parametrize("transport", TRANSPORTS, ids=["grpc", "zenoh"])
def test_the_newest_map_has_numpy_arrays(transport):
    with clearway.watch(**transport, layers=["drivability", "terrain"]) as maps:
        # The first revolution of a sensor is partial; a busy machine loses packets of others.
        m = next(m for m in maps if m.header.sensors[0].state == "ok")
    assert list(m.layers) == ["drivability", "terrain"] and m.vehicle == "car"
    layer = m["drivability"]
    assert layer.classes.shape == layer.grid.shape and layer.classes.dtype == "uint8"
    assert layer.free.any() and layer.class_at(10.0, 0.0) == "drivable"
    assert layer.is_free([(9, -1), (12, -1), (12, 1), (9, 1)])
    assert m["terrain"].class_at(10.0, 0.0).startswith("flat")
    assert m.header.sensors[0].returns > 1000
    with pytest.raises(ValueError, match="read-only"):
        layer.classes[0, 0] = 1


@pytest.mark.parametrize("row", SUBSCRIPTIONS, ids=lambda row: str(row["options"]))
def test_every_option_is_served_or_refused_as_the_golden_table_says(row):
    with clearway.watch(GRPC, **row["options"]) as maps:
        if row["refused"] is None:
            assert next(maps).vehicle == "car"
            return
        with pytest.raises(clearway.ClearwayError, match=re.escape(row["refused"]["says"])) as refused:
            next(maps)
    assert refused.value.reason == row["refused"]["code"]


@pytest.mark.parametrize("transport", TRANSPORTS, ids=["grpc", "zenoh"])
def test_get_and_watch_return_equal_maps(transport):
    one = clearway.get(**transport, layers=["drivability"])
    with clearway.watch(**transport, layers=["drivability"]) as maps:
        other = next(maps)
    assert one.sequence <= other.sequence
    if one.sequence == other.sequence:
        assert (one["drivability"].classes == other["drivability"].classes).all()


@pytest.mark.parametrize("address", [GRPC, f"zenoh:{ZENOH}"], ids=["grpc", "zenoh"])
def test_a_plan_comes_with_the_maps_after_it(address):
    from clearway.v1 import Stub, service_pb2

    selection = service_pb2.Selection(vehicle="car", layers=["drivability"], plans=True)
    with clearway.over_grpc.channel(GRPC) as channel, clearway.PlanSender(address, planner="pytest") as plans:
        updates = Stub(channel, "MapService").Watch(iter([service_pb2.WatchRequest(selection=selection)]))
        m = clearway.get(GRPC, layers=["drivability"])
        text = f"blocked, {address}"
        plans.send(m, [(0, 0), (5, 0.5)], footprint=[(1, 1), (-1, 1), (-1, -1)], goal=(9, 0), text=text)
        plan = next(update.plan for update in updates if update.plan.text == text)
        updates.cancel()
    assert (list(plan.x), plan.goal.x, plan.planner, plan.map_sequence) == ([0, 5], 9, "pytest", m.sequence)


def test_a_plan_that_cannot_be_drawn_is_refused_with_its_value():
    m = clearway.get(GRPC, layers=["drivability"])
    before = clearway.status(GRPC).observations_refused["plan"]
    with clearway.PlanSender(GRPC) as plans:
        for path, said in [([], "path of 0 points"), ([(0, 0), (1, float("nan"))], "NaN"), ([(0, 0)] * 4097, "4097")]:
            with pytest.raises(clearway.ClearwayError, match=said) as raised:
                plans.send(m, path)
            assert raised.value.reason == "INVALID_ARGUMENT"
        with pytest.raises(clearway.ClearwayError, match=r"path of shape \(3,\)"):
            plans.send(m, [1.0, 2.0, 3.0])
    assert clearway.status(GRPC).observations_refused["plan"] == before + 3


@pytest.mark.parametrize("transport", TRANSPORTS, ids=["grpc", "zenoh"])
def test_a_slow_loop_body_gets_the_newest_map_and_the_skipped_count(transport):
    with clearway.watch(**transport, layers=["drivability"]) as maps:
        first = maps.next_or_stale()
        while maps.newest().sequence < first.sequence + 3:
            pass
        newest = maps.newest().sequence
        second = next(maps)
    assert second.sequence >= newest
    assert second.sequence - first.sequence == second.skipped + 1


def test_deltas_of_a_region_at_a_rate_have_the_cells_of_whole_maps():
    wanted = dict(layers=["drivability", "terrain"], region=(0, 20, -8, 8))
    few_maps = clearway.watch(GRPC, **wanted, deltas=True, max_rate_hz=5)
    with few_maps as few, clearway.watch(GRPC, **wanted) as all_of_them:
        got, whole = [], {}
        # A busy machine skips maps of both streams: until one map has come on both.
        while len(got) < 3 or not any(m.sequence in whole for m in got[1:]):
            got.append(next(few))
            whole.update((m.sequence, m) for m in (next(all_of_them) for _ in range(3)))
            assert len(got) < 300
    assert all(m.left_out for m in got[1:])
    assert got[0]["terrain"].grid.width < 100
    for m in got:
        for layer in (layer for name, layer in m.layers.items() if m.sequence in whole):
            assert (layer.classes == whole[m.sequence][layer.name].classes).all()


@pytest.mark.parametrize("wrong", [{"max_rate_hz": 0.0}, {"max_rate_hz": float("nan")}, {"region": (500, 600, 0, 1)}])
def test_an_impossible_selection_is_refused(wrong):
    with pytest.raises(clearway.ClearwayError, match=next(iter(wrong))):
        next(clearway.watch(GRPC, **wrong))


def test_without_layers_every_layer_is_sent():
    with clearway.watch(GRPC) as maps:
        assert {"drivability", "terrain"} <= set(next(maps).layers)


def test_both_transports_list_the_vehicles():
    assert clearway.vehicles(GRPC) == ["car"] == clearway.vehicles(f"zenoh:{ZENOH}")


@pytest.mark.parametrize("wrong, known", [({"vehicle": "bus"}, "car"), ({"layers": ["dirt"]}, "drivability")])
def test_an_unknown_vehicle_or_layer_is_refused_with_the_known_ones(wrong, known):
    with pytest.raises(clearway.ClearwayError, match=known):
        clearway.get(GRPC, **wrong)
    with pytest.raises(clearway.ClearwayError, match=known):
        next(clearway.watch(GRPC, **wrong))


def test_a_closed_stream_ends_its_loop():
    seen = []
    maps = clearway.watch(GRPC, layers=["drivability"])
    for m in maps:
        seen.append(m.sequence)
        if len(seen) == 2:
            maps.close()
    assert len(seen) == 2


@pytest.mark.parametrize("transport", TRANSPORTS, ids=["grpc", "zenoh"])
def test_streams_that_are_dropped_end(transport):
    def drop():
        for _ in clearway.watch(**transport, layers=["drivability"]):
            break

    drop()
    threads = set(threading.enumerate())
    for _ in range(5):
        drop()
    for thread in set(threading.enumerate()) - threads:
        thread.join(60)
        assert not thread.is_alive(), thread


@pytest.mark.parametrize("transport", TRANSPORTS, ids=["grpc", "zenoh"])
def test_the_name_of_a_layer_is_one_layer(transport):
    assert list(clearway.get(**transport, layers="drivability").layers) == ["drivability"]


def test_a_proxy_of_the_environment_is_not_used_for_a_vehicle(monkeypatch):
    for name in ["http_proxy", "https_proxy", "grpc_proxy"]:
        monkeypatch.setenv(name, "http://127.0.0.1:9")
    assert clearway.vehicles(GRPC) == clearway.vehicles(f"http://{GRPC}") == ["car"]


@pytest.mark.parametrize("address", [f"https://{GRPC}", f"tcp://{GRPC}"])
def test_an_address_of_another_kind_is_refused_with_what_is_needed(address):
    with pytest.raises(clearway.ClearwayError, match="tls|HOST:PORT"):
        clearway.vehicles(address)


def test_a_test_without_the_fixture_imports_nothing_of_the_client():
    program = "import sys, clearway_pytest; sys.exit('clearway' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program]).returncode == 0


def test_a_program_may_end_without_closing_its_stream():
    program = f"import clearway; maps = clearway.watch({GRPC!r}); next(maps)"
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    assert (run.returncode, run.stderr) == (0, "")


def test_an_address_without_a_server_is_reported():
    with pytest.raises(clearway.ClearwayError, match="127.0.0.1:9: .*[Cc]onnect"):
        clearway.vehicles("127.0.0.1:9")


@pytest.mark.parametrize("example", ["follow.py", "footprint.py"])
def test_the_examples_run(example):
    run = subprocess.Popen([sys.executable, "-u", EXAMPLES / example, GRPC], stdout=subprocess.PIPE, text=True)
    try:
        assert run.stdout is not None and run.stdout.readline().startswith("map ")
    finally:
        run.kill()
        run.wait()


def test_a_recording_has_its_maps_in_order():
    sequences = [m.sequence for m in clearway.read(RECORDING, "drivability")]
    assert sequences and sequences == list(range(sequences[0], sequences[0] + len(sequences)))
    assert clearway.read(RECORDING, "drivability").__next__()["drivability"].free.any()
    with pytest.raises(clearway.ClearwayError, match="/car/map/drivability"):
        next(clearway.read(RECORDING, "dirt"))


def test_a_recording_that_was_cut_is_refused_with_what_helps(tmp_path):
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(Path(RECORDING).read_bytes()[:-1000])
    with pytest.raises(clearway.ClearwayError, match="clearway repair"):
        next(clearway.read(cut, "drivability"))
