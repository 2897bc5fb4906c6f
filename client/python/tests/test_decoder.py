"""The decoder against the golden vectors in proto/golden, which every client language reads."""

import json
import math
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import clearway
from clearway import codec, limits
from clearway.grid import CartesianGrid, RadialGrid
from clearway.map import Map
from clearway.v1 import map_pb2

GOLDEN = Path(__file__).resolve().parents[3] / "proto" / "golden"


def golden(name: str):
    return json.loads((GOLDEN / name).read_text())


def channel(vector) -> map_pb2.Channel:
    fields = {key: vector[key] for key in ("cell_type", "encoding", "cell_count", "crc32")}
    return map_pb2.Channel(payload=bytes.fromhex(vector["payload_hex"]), **fields)


def test_the_limits_are_those_of_every_client_language():
    for name, value in golden("limits.json").items():
        assert getattr(limits, name.upper()) == value, name


@pytest.mark.parametrize("group", [b"", b"\x1b\x1c"], ids=["alone", "behind a group"])
@pytest.mark.parametrize("tag", ["layers", "channels", "planes", "sensors"])
def test_a_map_of_too_many_parts_is_refused_before_they_are_made(tag, group):
    parts = {"layers": (b"", 2), "sensors": (b"\x0a", 10), "channels": (b"\x12", 5), "planes": (b"\x12", 6)}
    of, number = parts[tag]

    def encoded(count):
        content = bytes([number << 3 | 2, 0]) * count
        length = bytes([len(content) & 127 | 128, len(content) >> 7 & 127 | 128, len(content) >> 14])
        return group + (of + length + content if of else content)

    assert limits.count_parts(encoded(limits.MAP_PARTS_MAX - 1)) == limits.MAP_PARTS_MAX - (not of)
    with pytest.raises(clearway.DecodeError) as refused:
        Map(encoded(limits.MAP_PARTS_MAX + 1))
    assert refused.value.reason == "too_many_parts"


@pytest.mark.parametrize("vector", golden("channels.json"), ids=lambda vector: vector["name"])
def test_a_channel_has_the_cells_that_were_encoded(vector):
    expected = [value for value, length in vector["cells_value_length"] for _ in range(length)]
    assert codec.decode(channel(vector), vector["columns"]).ravel().tolist() == expected


@pytest.mark.parametrize("vector", golden("bad_channels.json"), ids=lambda vector: vector["name"])
def test_a_bad_channel_is_refused_without_allocating_its_claim(vector):
    message = channel(vector)
    tracemalloc.start()
    with pytest.raises(clearway.DecodeError) as error:
        codec.decode(message, vector["columns"])
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert error.value.reason == vector["error"]
    # At most the accepted number of cells is allocated.
    cells = 4 * limits.CHANNEL_CELLS_MAX if message.cell_count <= limits.CHANNEL_CELLS_MAX else 0
    assert peak <= 64 * len(message.payload) + (64 << 10) + cells


@pytest.mark.parametrize("count", [1 << 28, (1 << 32) - 1, limits.CHANNEL_CELLS_MAX])
def test_20_bytes_that_claim_many_cells_allocate_no_more_than_they_are_worth(count):
    for payload in [b"", b"\xff", b"\xff" * 20, b"\0" * 20, b"\0\0\0\x80", b"\x55" * 19]:
        message = map_pb2.Channel(cell_type=3, encoding=map_pb2.ENCODING_ROWS, cell_count=count, payload=payload)
        tracemalloc.start()
        with pytest.raises(clearway.DecodeError):
            codec.decode(message, 2048)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak <= 64 << 10, (count, payload)


@pytest.mark.parametrize("vector", golden("bad_maps.json"), ids=lambda vector: vector["name"])
def test_a_bad_map_is_refused_by_name(vector):
    with pytest.raises(clearway.DecodeError) as error:
        clearway.Map(bytes.fromhex(vector["map_hex"])).layers
    assert error.value.reason == vector["error"]


def test_the_golden_map_with_class_tables_equals_the_one_without():
    tables, plain = (clearway.Map((GOLDEN / f"{name}.bin").read_bytes()) for name in ("by_class", "by_class_plain"))
    channels = tables["occupancy"].channels
    assert list(channels) == ["class", "hits", "unit_height", "difference"]
    for name, channel in channels.items():
        np.testing.assert_array_equal(channel.raw, plain["occupancy"].channels[name].raw)


def test_the_golden_delta_on_its_base_gives_the_golden_whole_map():
    base, delta, whole = ((GOLDEN / f"delta{name}.bin").read_bytes() for name in ("_base", "", "_whole"))
    decoded, expected = clearway.Map(delta, base=clearway.Map(base)), clearway.Map(whole)
    assert list(decoded.layers) == list(expected.layers) and decoded.header == expected.header
    for name, layer in expected.layers.items():
        for channel, values in layer.channels.items():
            assert np.array_equal(decoded[name].channels[channel].raw, values.raw), (name, channel)
        assert decoded[name].metrics == layer.metrics and decoded[name].legend == layer.legend
    grid, whole_grid = decoded["occupancy"].grid, expected["occupancy"].grid
    assert (grid.first_ix, grid.first_iy) == (whole_grid.first_ix, whole_grid.first_iy) != (0, 0)


@pytest.mark.parametrize("vector", golden("bad_deltas.json"), ids=lambda vector: vector["name"])
def test_a_delta_on_a_wrong_base_is_refused_by_name(vector):
    base = vector["base_hex"] and clearway.Map(bytes.fromhex(vector["base_hex"]))
    with pytest.raises(clearway.DecodeError) as error:
        clearway.Map(bytes.fromhex(vector["map_hex"]), base=base)
    assert error.value.reason == vector["error"]


def test_the_golden_map_decodes_as_in_every_client_language():
    golden_map = golden("map.json")
    m = clearway.Map((GOLDEN / "map.bin").read_bytes())
    assert (m.vehicle, m.sequence) == (golden_map["vehicle"], golden_map["sequence"])
    assert m.header.valid_until_ns == golden_map["valid_until_ns"]
    assert list(m.layers) == [layer["name"] for layer in golden_map["layers"]]
    for expected in golden_map["layers"]:
        layer = m[expected["name"]]
        assert list(layer.grid.shape) == expected["shape"] and list(layer.legend) == expected["legend"]
        assert layer.metrics == expected["metrics"]
        assert [f"CLASS_MEANING_{entry.meaning.name}" for entry in layer.legend_entries] == expected["legend_meanings"]
        assert [entry.rgb for entry in layer.legend_entries] == expected["legend_rgb"]
        for values in expected["channels"]:
            cells = [value for value, length in values["cells_value_length"] for _ in range(length)]
            assert layer.channels[values["name"]].raw.ravel().tolist() == cells
        assert [(p.x_m, p.y_m, p.radius_m, list(p.links)) for p in layer.points] == [
            (p["x_m"], p["y_m"], p["radius_m"], p["links"]) for p in expected["points"]
        ]
    for at in golden_map["classes_of_drivability"]:
        assert m["drivability"].class_at(at["x_m"], at["y_m"]) == at["class"]
        assert f"CLASS_MEANING_{m['drivability'].meaning_at(at['x_m'], at['y_m']).name}" == at["meaning"]


def test_a_map_is_stale_after_its_validity_or_if_its_age_is_unknown():
    m = clearway.Map((GOLDEN / "map.bin").read_bytes())
    end, until = m.header.capture_end_ns, m.header.valid_until_ns
    valid = until - end
    times = (end, until, until + 1, end - valid, end - valid - 1)
    assert [m.is_stale(at) for at in times] == [False, False, True, False, True]
    assert m.age_ms(end + 5_000_000) == 5.0


def test_a_footprint_is_free_only_if_every_cell_of_it_is_free():
    layer = clearway.Map((GOLDEN / "map.bin").read_bytes())["drivability"]
    centres = layer.grid.centres()
    assert [layer.class_at(x, y) for x, y in centres.reshape(-1, 2)] == [layer.legend[c] for c in layer.classes.ravel()]
    free, other = np.argwhere(layer.free)[0], np.argwhere(~layer.free)[0]

    def square(cell, half=0.05):
        x, y = centres[tuple(cell)]
        return [(x - half, y - half), (x + half, y - half), (x + half, y + half), (x - half, y + half)]

    assert layer.is_free(square(free)) and not layer.is_free(square(other))
    assert not layer.is_free(square(free, half=100.0)), "outside the grid nothing is known"
    with pytest.raises(clearway.ClearwayError, match="corner 1, y is nan"):
        layer.is_free([(0, 0), (1, float("nan")), (2, 2)])


@pytest.mark.parametrize("yaw_rad", [None, 0.0, 0.7], ids=["radial", "square", "turned"])
def test_the_nearest_obstacle_is_not_farther_than_any_point_of_one(yaw_rad):
    layer = clearway.Map((GOLDEN / "map.bin").read_bytes())["drivability"]
    radial = RadialGrid(np.array([0.6, 1.3, 2.5]), 8, (0.3, -0.4))
    layer.grid = radial if yaw_rad is None else CartesianGrid(-1.4, -1.7, 6, 6, 0.5, yaw_rad)
    looks = np.stack(np.meshgrid(*2 * [np.arange(-3.5, 3.5, 0.02)]), axis=-1).reshape(-1, 2)
    cells = layer.grid.cells_at(looks[:, 0], looks[:, 1])
    random = np.random.default_rng(7)
    for x_m, y_m in [(0.0, 0.0), *random.uniform(-3, 3, (30, 2))]:
        raw = np.where(random.random(layer.grid.shape) < 0.1, layer.legend.index("obstacle"), 0).astype(np.uint8)
        raw.flat[-1] = layer.legend.index("obstacle")
        layer.channels["class"] = replace(layer.channels["class"], raw=raw)
        nearest = layer.nearest_obstacle(x_m, y_m)
        assert nearest is not None
        places = looks[(cells >= 0) & layer.obstacles.ravel()[cells]]
        seen = np.hypot(places[:, 0] - x_m, places[:, 1] - y_m).min()
        assert seen - 0.04 < nearest.distance_m <= seen + 1e-9, (x_m, y_m)
        assert math.isclose(math.hypot(nearest.x_m - x_m, nearest.y_m - y_m), nearest.distance_m, abs_tol=1e-9)
    layer.channels["class"] = replace(layer.channels["class"], raw=np.zeros(layer.grid.shape, np.uint8))
    assert layer.nearest_obstacle() is None


def test_a_footprint_includes_cells_narrower_than_a_step():
    layer = clearway.Map((GOLDEN / "map.bin").read_bytes())["drivability"]
    layer.grid = RadialGrid(np.arange(1.0, 6.0), 360)
    raw = np.full(layer.grid.shape, layer.legend.index("drivable"), np.uint8)
    layer.channels["class"] = replace(layer.channels["class"], raw=raw)
    x, y = np.moveaxis(layer.grid.centres(), -1, 0)
    footprint = [(1, -1), (4, -1), (4, 1), (1, 1)]
    assert layer.is_free(footprint)
    for cell in np.argwhere((1 < x) & (x < 4) & (abs(y) < 1)):
        raw[tuple(cell)] = 0
        assert not layer.is_free(footprint), f"cell {cell} is unknown"
        raw[tuple(cell)] = layer.legend.index("drivable")
