"""Questions of a planner: the answers of `client/golden/questions.json`, as of the Rust client."""

import json
from pathlib import Path

import numpy as np
import pytest

import clearway

GOLDEN = json.loads((Path(__file__).resolve().parents[2] / "golden" / "questions.json").read_text())
#: Greatest difference of numbers in two clients, in metres.
SAME_M = 1e-9


def outline(values):
    return None if values is None else clearway.Outline(*map(float, values))


def points(values):
    return [(float(x), float(y)) for x, y in values]


def met(found):
    return None if found is None else [found[0], list(found[1])]


def ask(layer, question):
    """The answer in the form of the file, or the reason of the error."""
    own, point = outline(question.get("own")), question.get("point", ())
    try:
        match question["ask"]:
            case "answer":
                verdict, blocker = layer.answer(points(question["polygon"]))
                return [verdict, blocker and list(blocker)]
            case "along":
                arc = question.get("arc")
                path = clearway.Arc(*map(float, arc)) if arc else points(question["places"])
                length_m, low, blocked = layer.along(path, outline(question["outline"]))
                return [length_m, met(low), met(blocked)]
            case "clearance":
                return layer.clearance(question["most_m"], question["passes_low"]).ravel().tolist()
            case kind:
                nearest = getattr(layer, kind)(*map(float, point), own=own)
                return nearest and list(nearest)
    except clearway.ClearwayError as error:
        return {"error": error.reason}


def is_same(one, other):
    if isinstance(one, list) and isinstance(other, list):
        return len(one) == len(other) and all(map(is_same, one, other))
    if isinstance(one, float | int) and isinstance(other, float | int):
        return abs(one - other) <= SAME_M
    return one == other


def test_the_golden_questions_have_the_golden_answers():
    m = clearway.Map(bytes.fromhex(GOLDEN["map"]))
    assert len(GOLDEN["questions"]) >= 1000
    for question in GOLDEN["questions"]:
        found = ask(m[question["layer"]], question)
        assert is_same(found, question["answer"]), f"{question}: {found}"


def test_an_error_names_the_value_and_what_is_needed():
    layer = clearway.Map(bytes.fromhex(GOLDEN["map"]))["squares"]
    with pytest.raises(clearway.ClearwayError, match="corner 1, y is nan; a finite number is needed"):
        layer.is_free([(0, 0), (1, float("nan")), (1, 1)])
    with pytest.raises(clearway.ClearwayError, match=r"edges 0 and 2 of the polygon cross near \(0.500, 0.500\) m"):
        layer.is_free([(0, 0), (1, 1), (1, 0), (0, 1)])
    for ask in (layer.class_at, layer.meaning_at, lambda x, y: layer.value_at("class", x, y)):
        with pytest.raises(clearway.ClearwayError, match="y_m is nan; a finite number is needed"):
            ask(1.0, float("nan"))


def test_the_clearance_is_the_distance_to_the_nearest_cell_that_is_not_free():
    layer = clearway.Map(bytes.fromhex(GOLDEN["map"]))["turned"]
    clearance, centres = layer.clearance(), layer.grid.centres()
    for iy, ix in [(3, 4), (12, 20), (20, 9)]:
        x, y = centres[iy, ix]
        places = layer.grid.nearest(np.flatnonzero(~layer.free), x, y)
        nearest = np.hypot(places[:, 0] - x, places[:, 1] - y).min()
        border = (min(ix, layer.grid.width - 1 - ix, iy, layer.grid.height - 1 - iy) + 0.5) * layer.grid.cell_m
        assert clearance[iy, ix] == pytest.approx(0.0 if not layer.free[iy, ix] else min(nearest, border))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("far_m", [1e18, 1e155, 1e308])
@pytest.mark.parametrize("name", ["turned", "squares", "rings"])
def test_places_as_far_as_numbers_reach_are_answered_and_never_free(name, far_m):
    layer = clearway.Map(bytes.fromhex(GOLDEN["map"]))[name]
    assert layer.answer([(far_m, far_m), (far_m, 0.0), (0.0, far_m)]).verdict == "blocked"
    assert layer.answer([(-far_m, -far_m), (far_m, 0.0), (0.0, far_m)]).verdict == "blocked"
    assert layer.class_at(far_m, -far_m) == "unknown"
    assert layer.along(clearway.Arc(0.0, 5.0), clearway.Outline(far_m, far_m, far_m)).blocked is not None
    if name != "rings":
        assert (layer.clearance(far_m) == layer.clearance(1e6)).all()
