"""What a map becomes elsewhere: a grid for ROS 2, a costmap, a drawing, a pickle, a line of text, a view in Rerun."""

import collections
import math
import pickle
import runpy
import subprocess
import sys
import zlib
from pathlib import Path
from unittest import mock

import numpy as np
import pytest

import clearway
from clearway.freshness import Clock
from clearway.v1 import journal_pb2, map_pb2

try:
    # The package has 170 MB; the weekly run of .ci/run installs it.
    from rerun.chunk import RrdReader
except ImportError:
    RrdReader = None

MEANINGS = [map_pb2.ClassMeaning.Value(f"CLASS_MEANING_{name}") for name in ("UNKNOWN", "FREE", "OCCUPIED")]
CELL_M = 0.5


def layer(name="freespace", rows=40, columns=40, radial=False):
    """Free, with an obstacle in about each twentieth cell and an unknown corner."""
    cells = (np.random.default_rng(5).integers(0, 20, (rows, columns)) == 0) + np.uint8(1)
    cells[:5, :5] = 0
    channel = map_pb2.Channel(name="class", cell_type=1, encoding=1, cell_count=cells.size, scale=1.0)
    channel.payload, channel.crc32 = cells.tobytes(), zlib.crc32(cells.tobytes())
    made = map_pb2.Layer(name=name, legend=["unknown", "free", "wall"], channels=[channel])
    made.legend_meanings.extend(MEANINGS)
    made.legend_rgb.extend([0x808080, 0x00FF00, 0xFF0000])
    if radial:
        made.radial.row_radius_m.extend(np.arange(1, rows + 1) * 0.3)
        made.radial.columns = columns
    else:
        made.cartesian.MergeFrom(map_pb2.CartesianGrid(width=columns, height=rows, cell_m=CELL_M))
        made.cartesian.origin_x_m = made.cartesian.origin_y_m = -0.5 * CELL_M * rows + 0.1
    return made


def sample(*layers, heading=None):
    end_ns = clearway.now_ns()
    header = map_pb2.Header(vehicle="car", sequence=12, capture_end_ns=end_ns, valid_until_ns=end_ns + 300_000_000)
    if heading is not None:
        half = heading / 2
        header.map_from_ego.MergeFrom(map_pb2.Pose(x=123.4, y=-7.7, z=2.0, qz=math.sin(half), qw=math.cos(half)))
    return clearway.Map(map_pb2.Map(header=header, layers=layers).SerializeToString())


@pytest.mark.parametrize("heading", [None, 0.0, 0.4, math.pi / 2, -2.5])
@pytest.mark.parametrize("radial", [False, True])
def test_an_occupancy_grid_has_every_obstacle_in_its_place_and_no_unknown_cell_is_free(heading, radial):
    m = sample(layer(radial=radial), heading=heading)
    of, grid = m["freespace"], m.to_occupancy_grid()
    assert grid.data.shape == (grid.height, grid.width) and grid.data.dtype == np.int8
    assert set(np.unique(grid.data)) == {-1, 0, 100} and grid.is_in_world == (heading is not None)
    assert grid.origin[2] == (0.0 if heading is None else 2.0) and grid.resolution == (0.25 if radial else CELL_M)
    assert np.allclose(np.remainder(np.array(grid.origin[:2]) / grid.resolution + 0.5, 1.0), 0.5)
    turn = heading or 0.0
    at = np.array([0.0, 0.0]) if heading is None else np.array([123.4, -7.7])
    x, y = of.grid.centres().reshape(-1, 2).T
    assert m.pose is None if heading is None else np.allclose(m.pose, (123.4, -7.7, heading))
    placed = np.stack([x * math.cos(turn) - y * math.sin(turn), x * math.sin(turn) + y * math.cos(turn)], axis=-1) + at
    ix, iy = np.floor((placed - grid.origin[:2]) / grid.resolution).astype(int).T
    here = grid.data[iy, ix]
    assert (here[of.obstacles.ravel()] == 100).all() and (here[(of.classes == 0).ravel()] != 0).all()
    # Most free cells stay free.
    assert (here[of.free.ravel()] == 0).mean() > (0.5 if radial else 0.75)


def test_free_cells_are_graded_by_clearance_and_a_costmap_has_the_values_of_nav2():
    m = sample(layer())
    graded, plain = m.to_occupancy_grid(clear_m=2.0).data, m.to_occupancy_grid().data
    is_free = plain == 0
    assert (graded[~is_free] == plain[~is_free]).all()
    assert 0 <= graded[is_free].min() and 40 < graded[is_free].max() <= 50
    costs = m.to_costmap()
    assert costs.dtype == np.uint8 and costs.shape == plain.shape
    assert (costs == np.select([plain == 100, plain == -1], [254, 255], 0)).all()
    inscribed = m.to_costmap(inscribed_m=0.6)
    assert ((inscribed == 253) | (inscribed == costs)).all()
    assert 0.1 < (inscribed[is_free] == 253).mean() < 1.0


@pytest.mark.parametrize("radial", [False, True])
def test_a_layer_is_drawn_with_the_colours_of_its_legend_forward_up(radial):
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("agg")
    axes = sample(layer(radial=radial), heading=0.0)["freespace"].plot()
    assert [patch.get_facecolor()[:3] for patch in axes.get_legend().get_patches()][2] == (1.0, 0.0, 0.0)
    assert [text.get_text() for text in axes.get_legend().get_texts()] == ["unknown", "free", "wall"]
    assert axes.get_xlim()[0] > axes.get_xlim()[1] and axes.get_ylim()[0] < axes.get_ylim()[1]
    axes.figure.canvas.draw()
    matplotlib.pyplot.close()


@pytest.mark.parametrize("is_of_replay", [False, True])
def test_a_map_is_pickled_with_its_layers_and_its_age(is_of_replay):
    m = sample(layer(), layer("terrain", radial=True), heading=0.3)
    if is_of_replay:
        # Stamps of a day ago.
        for name in ("capture_start_ns", "capture_end_ns", "completed_ns", "valid_until_ns"):
            setattr(m.header, name, getattr(m.header, name) - 86_400_000_000_000)
        m.header.completed_ns = m.header.capture_end_ns
    m.with_arrival(Clock(is_of_replay=is_of_replay))
    other = pickle.loads(pickle.dumps(m.copy_with(skipped=3)))
    assert (other.sequence, other.skipped, other.header) == (12, 3, m.header) and not other.stale
    assert (other["freespace"].classes == m["freespace"].classes).all()
    assert other["terrain"].legend_entries == m["terrain"].legend_entries
    assert other.to_costmap().tolist() == m.to_costmap().tolist()
    with pytest.raises(ValueError, match="read-only"):
        other["freespace"].classes[0, 0] = 1
    age_ns = m.age_ns()
    assert pickle.loads(pickle.dumps(m)).age_ns() >= age_ns
    m._arrival = m._arrival._replace(age_ns=1_000_000_000)
    assert pickle.loads(pickle.dumps(m)).stale and m.stale


def test_maps_and_layers_say_in_a_line_what_they_are():
    m = sample(layer(), layer("terrain", radial=True))
    assert repr(m) == "<Map 12 of car: freespace, terrain>"
    assert repr(m.with_arrival()).startswith("<Map 12 of car, ") and " ms old: freespace" in repr(m)
    text = repr(m["freespace"])
    assert text.startswith("<Layer freespace, 40 x 40 cells of 0.5 m: unknown 2%, free 9") and text.endswith("; class>")
    assert "40 rings to 12.0 m of 40 sectors" in repr(m["terrain"])


def test_neither_the_plugin_of_pytest_nor_the_package_imports_more_than_it_needs():
    program = "import clearway_pytest, sys; assert 'clearway' not in sys.modules; import clearway; " \
        "assert not {'matplotlib', 'zenoh', 'mcap'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", program], check=True)


@pytest.fixture
def recording(tmp_path):
    """Two maps of two layers, the second one late, and a plan behind the first."""
    mcap = pytest.importorskip("mcap.writer")
    writer = mcap.Writer(str(tmp_path / "drive.mcap"))
    writer.start()
    names = ("journal", "map/freespace", "map/terrain")
    topics = {name: writer.register_channel(f"/car/{name}", "protobuf", 0) for name in names}

    def add(name, message):
        writer.add_message(topics[name], 0, message.SerializeToString(), 0)

    for sequence, seconds in ((12, 12), (13, 15)):
        for name in ("freespace", "terrain"):
            m = sample(layer(name, radial=name == "terrain"), heading=0.3)
            stamp_ns = seconds * 1_000_000_000
            m.header.sequence, m.header.capture_end_ns = sequence, stamp_ns
            m.header.completed_ns, m.header.valid_until_ns = stamp_ns + 5_000_000, stamp_ns + 300_000_000
            add(f"map/{name}", m._message)
        add("journal", journal_pb2.Event(datagram=b"packet"))
        if sequence == 12:
            car = [2, 1, -1, 1, -1, -1, 2, -1]
            plan = journal_pb2.Plan(stamp_ns=stamp_ns, x=[0, 5, 5], y=[0, 5, 5], footprint_m=car, text="blocked")
            plan.frame = journal_pb2.PLAN_FRAME_EGO
            add("journal", journal_pb2.Event(plan=plan))
    writer.finish()
    return tmp_path / "drive.mcap"


def test_a_recording_gives_its_maps_with_all_layers_and_its_plans_in_order(recording):
    read = list(clearway.read_all(recording))
    assert [type(of).__name__ for of in read] == ["Map", "Plan", "Map"] and read[1].text == "blocked"
    assert [(m.sequence, list(m.layers)) for m in read[::2]] == [(n, ["freespace", "terrain"]) for n in (12, 13)]
    assert len(list(clearway.read_all(recording, "car"))) == 3
    with pytest.raises(clearway.ClearwayError, match="no maps of vehicle 'bus'; the recording has /car/map/freespace"):
        next(clearway.read_all(recording, "bus"))


def test_a_grid_too_far_away_for_numbers_of_cells_is_refused_with_its_place():
    m = sample(layer(), heading=0.4)
    m.header.map_from_ego.x = 1e18
    with pytest.raises(clearway.ClearwayError, match=r"its vehicle at \(1e\+18, -7.7\) m") as refused:
        m.to_occupancy_grid()
    assert refused.value.reason == "extent"


def test_a_recording_that_is_damaged_anywhere_is_an_error_that_names_it(recording):
    sound, random = recording.read_bytes(), np.random.default_rng(7)
    truth = [str(m.layers) if isinstance(m, clearway.Map) else m for m in clearway.read_all(recording)]
    for at in random.integers(0, len(sound), 200):
        damaged = bytearray(sound)
        damaged[at] ^= 1 << int(random.integers(8))
        recording.write_bytes(damaged)
        try:
            found = [str(m.layers) if isinstance(m, clearway.Map) else m for m in clearway.read_all(recording)]
            assert found == truth, at
        except clearway.ClearwayError as error:
            assert str(recording) in str(error), at
    for path in (recording.parent, recording.parent / "none.mcap"):
        with pytest.raises(clearway.ClearwayError, match=str(path)):
            next(clearway.read(path, "freespace"))


#: What the example logs of the recording above. The plan is cleared after 2 s.
IN_RERUN = {
    "world/car": 2, "world/car/freespace": 2, "world/car/terrain": 2, "legend/freespace": 1, "legend/terrain": 1,
    "world/plan": 2, "world/plan/footprint": 1, "log": 1, "age_ms": 2, "state": 3,
}  # fmt: skip
EXAMPLE = Path(__file__).resolve().parents[1] / "examples" / "rerun_maps.py"


def test_the_example_for_rerun_logs_layers_plans_ages_and_states_of_a_recording(recording, monkeypatch):
    rerun = mock.MagicMock()
    modules = {"rerun": rerun, "rerun.blueprint": rerun.blueprint}
    monkeypatch.setattr(sys, "argv", [str(EXAMPLE), str(recording), "--save", "drive.rrd"])
    with mock.patch.dict(sys.modules, modules):
        runpy.run_path(str(EXAMPLE), run_name="__main__")
    assert rerun.save.call_args.args == ("drive.rrd",) and not rerun.spawn.called
    assert collections.Counter(call.args[0] for call in rerun.log.call_args_list) == IN_RERUN
    states = [call.kwargs["state"] for call in rerun.StateChange.call_args_list]
    assert states == ["fresh", "no newer map has arrived", "fresh"]
    assert [call.args for call in rerun.Scalars.call_args_list] == [(5.0,), (5.0,)]
    of = next(clearway.read(recording, "freespace"))["freespace"]
    rgb = np.array([(entry.rgb >> 16, entry.rgb >> 8 & 255, entry.rgb & 255) for entry in of.legend_entries], np.uint8)
    image = rerun.GridMap.call_args.kwargs
    assert image["data"] == rgb[of.classes][::-1].tobytes() and image["cell_size"] == CELL_M
    assert image["translation"] == pytest.approx((-9.9, -9.9, 0))
    rings = rerun.Mesh3D.call_args.kwargs
    assert rings["vertex_positions"].shape == (4 * 1600, 3) and rings["triangle_indices"].max() == 4 * 1600 - 1
    turns = [call.kwargs["radians"] for call in rerun.RotationAxisAngle.call_args_list]
    assert math.pi / 4 in turns, "the footprint lies along the path"


if RrdReader is not None:

    def test_rerun_reads_what_the_example_saves(recording, tmp_path):
        saved = tmp_path / "drive.rrd"
        subprocess.run([sys.executable, EXAMPLE, recording, "--save", saved], check=True)
        reader, rows = RrdReader(str(saved)), collections.Counter()
        for chunk in reader.stream().to_chunks():
            rows[chunk.entity_path.lstrip("/")] += chunk.num_rows
        del rows["__properties"]
        assert rows == IN_RERUN
        assert len(reader.blueprints()) == 1
