"""Public objects pickle, copy and go to other processes, and compute the same numbers there, to the last bit."""

import copy
import pickle
import re
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from public_objects import CONTROLLERS, OBJECTS, circle, fitted, numbers, planar

import orthocas as oc
from orthocas.errors import InvalidValueError
from orthocas.tools.checks import Array

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def objects() -> dict[str, Any]:
    return {name: build() for name, build in OBJECTS.items()}


@pytest.fixture(scope="module")
def expected(objects: dict[str, Any]) -> dict[str, list[Array]]:
    """Computed before anything travels: an object must not leave behind only what it has not used yet."""
    return {name: numbers(thing) for name, thing in objects.items()}


def require_same(found: list[Array], expected: list[Array]) -> None:
    assert len(found) == len(expected) > 0
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.slow
@pytest.mark.parametrize("name", OBJECTS)
def test_pickles_are_equal(objects: dict[str, Any], expected: dict[str, list[Array]], name: str) -> None:
    for protocol in (2, pickle.DEFAULT_PROTOCOL, pickle.HIGHEST_PROTOCOL):
        require_same(numbers(pickle.loads(pickle.dumps(objects[name], protocol))), expected[name])


@pytest.mark.slow
@pytest.mark.parametrize("name", OBJECTS)
def test_copies_are_equal(objects: dict[str, Any], expected: dict[str, list[Array]], name: str) -> None:
    for other in (copy.deepcopy(objects[name]), copy.copy(objects[name])):
        assert type(other) is type(objects[name])
        require_same(numbers(other), expected[name])


@pytest.mark.slow
def test_another_process_computes_the_same(objects: dict[str, Any], expected: dict[str, list[Array]]) -> None:
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        for name, found in zip(objects, pool.map(numbers, objects.values()), strict=True):
            require_same(found, expected[name])
        back = pool.submit(oc.fit, planar(), oc.Linear()).result()
    require_same(numbers(back.chart), expected["linear chart"])


@pytest.mark.slow
@pytest.mark.parametrize("library", ["cloudpickle", "joblib"])
def test_other_ways_to_travel(expected: dict[str, list[Array]], objects: dict[str, Any], library: str) -> None:
    module = pytest.importorskip(library)
    if library == "cloudpickle":
        results = {name: numbers(pickle.loads(module.dumps(thing))) for name, thing in objects.items()}
    else:
        found = module.Parallel(n_jobs=2)(module.delayed(numbers)(thing) for thing in objects.values())
        results = dict(zip(objects, found, strict=True))
    for name, result in results.items():
        require_same(result, expected[name])


@pytest.mark.parametrize("travel", [copy.deepcopy, lambda thing: pickle.loads(pickle.dumps(thing))])
def test_parts_that_are_one_stay_one(travel: Any) -> None:
    problem, law, grown = travel(planar()), travel(CONTROLLERS["PD+"]()), travel(circle())
    assert problem.task.robot is problem.robot
    assert law.chart.problem is law.problem
    assert law.problem.task.robot is law.problem.robot
    assert grown.coordinates.problem is grown.problem is grown.coordinates.leaf.problem
    assert oc.Problem(problem.robot, problem.task, problem.metric, problem.domain).m == 1


def test_what_was_built_on_the_way_stays_behind() -> None:
    """A pickle is as large after use as before: no graph, no buffer and no family of functions is in it."""
    chart = oc.Chart(planar(), fitted().chart.coordinates)
    fresh = len(pickle.dumps(pickle.loads(pickle.dumps(chart))))
    numbers(chart)
    assert len(pickle.dumps(chart)) == fresh
    assert b"product_basis" not in pickle.dumps(chart)


def test_notes_stay_read_only() -> None:
    for chart in (copy.deepcopy(fitted().chart), pickle.loads(pickle.dumps(circle()))):
        assert dict(chart.notes)
        with pytest.raises(TypeError):
            chart.notes["solver"] = "another"


def test_objects_that_travel_keep_built_values_apart() -> None:
    """`functools.cached_property` would put them into pickles; it is left to what never leaves its process."""
    stays = re.compile(r"/(parametrisations|fitting|reproduce)/")
    sources = [path for path in (ROOT / "orthocas").rglob("*.py") if not stays.search(path.as_posix())]
    assert len(sources) > 50
    users = [path.name for path in sources if re.search(r"from functools import .*cached_property", path.read_text())]
    assert users == []


@pytest.mark.parametrize("name", ["problem", "task", "custom metric"])
def test_pickles_that_this_casadi_cannot_read_get_one_line(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """CasADi's text begins with the version of its format; its own error has several lines of C++."""
    content = pickle.dumps(OBJECTS[name]())
    monkeypatch.setattr("casadi.CasadiMeta.version", lambda: "3.0.1")
    older = pickle.dumps(pickle.loads(content))
    monkeypatch.undo()

    def refuse(text: str) -> ca.Function:
        raise RuntimeError("Error in DeserializingStream at\n.../casadi/core/serializing_stream.cpp:157:\nmismatch")

    monkeypatch.setattr("casadi.Function.deserialize", refuse)
    with pytest.raises(InvalidValueError, match=r"^pickle is from CasADi 3.0.1, expected one of CasADi [^\n]*$"):
        pickle.loads(older)
