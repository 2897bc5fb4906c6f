"""What a map becomes elsewhere: a grid for ROS 2, a costmap, a drawing, a pickle, a line of text."""

import math
import pickle
import subprocess
import sys
import zlib

import numpy as np
import pytest

import clearway
from clearway.freshness import Clock
from clearway.v1 import map_pb2

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
