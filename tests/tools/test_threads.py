"""Eight threads that share one chart, law or robot get the numbers that one thread gets, to the last bit."""

import copy
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from programs import needs_c
from public_objects import (
    fitted,
    impedance,
    numbers,
    planar,
    points_of,
    steps,
)
from series import SERIES, Call

import orthocas as oc
from orthocas import solvers
from orthocas.codegen import CompiledLibrary, Supervisor, compile_shared
from orthocas.simulation import MuJoCoPlant, simulate
from orthocas.tools.blas_graph import NumpyGraph
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array

THREADS = 8


@pytest.fixture(autouse=True)
def hurried() -> Iterator[None]:
    """Threads take turns five hundred times as often as usual."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-5)
    yield
    sys.setswitchinterval(before)


def in_threads(call: Call, count: int) -> list[Any]:
    with ThreadPoolExecutor(THREADS) as pool:
        return list(pool.map(call, range(count)))


@pytest.mark.slow
@pytest.mark.parametrize("name", SERIES)
def test_threads_share(name: str) -> None:
    build, count = SERIES[name]
    calls = build()
    expected = [calls[k % len(calls)](k) for k in range(12 * len(calls))]  # after that they repeat
    shared = build()  # its functions are not built yet: that happens in the threads
    for k, found in enumerate(in_threads(lambda k: shared[k % len(shared)](k), count)):
        np.testing.assert_array_equal(found, expected[k % len(expected)], err_msg=f"call {k}")


@pytest.mark.slow
def test_threads_share_the_ranges_of_a_chart() -> None:
    chart = copy.deepcopy(fitted().chart)
    q = points_of(chart)
    expected = [fitted().chart.xi_range(point).high for point in q[:2]]
    for k, found in enumerate(in_threads(lambda k: chart.xi_range(q[k % 2]).high, 2 * THREADS)):
        np.testing.assert_array_equal(found, expected[k % 2])


@pytest.mark.slow
def test_simulations_share_a_law() -> None:
    start = planar().domain.centre
    expected = numbers(simulate(impedance(), steps(), start, step=0.05, control_rate=None))
    sampled = numbers(simulate(impedance(), steps(), start, control_rate=100.0))
    law, reference = copy.deepcopy(impedance()), copy.deepcopy(steps())
    runs = in_threads(lambda k: simulate(law, reference, start, step=0.05, control_rate=[None, 100.0][k % 2]), 16)
    for k, run in enumerate(runs):
        for found, wanted in zip(numbers(run), sampled if k % 2 else expected, strict=True):
            np.testing.assert_array_equal(found, wanted)


@pytest.mark.slow
@needs_c
def test_supervised_arms_in_mujoco_share_a_library(tmp_path: Path) -> None:
    """Library, law and robot are shared; every run has its own state and plant."""
    law = impedance()
    generated = oc.generate_c(law.chart, tmp_path, law, "arm")
    library = CompiledLibrary(compile_shared(generated, tmp_path), "arm", law.problem.n)
    start = law.problem.domain.centre

    def arm(k: int) -> Array:
        q = start + 0.02 * (k % 4)
        supervisor, plant = Supervisor(library, law), MuJoCoPlant(law.problem.robot)
        supervisor.start(q)
        plant.reset(q)
        reference = np.concatenate([law.chart.phi(start), np.zeros(2 * len(law.labels))])
        path = []
        for _ in range(100):
            command, _ = supervisor.step(plant.q, plant.dq, reference)
            plant.step(command, 1e-3)
            path.append(np.concatenate([plant.q, command]))
        return np.array(path)

    alone = [arm(k) for k in range(4)]
    assert np.abs(alone[1] - alone[0]).max() > 1e-3
    for k, found in enumerate(in_threads(arm, 16)):
        np.testing.assert_array_equal(found, alone[k % 4])


def test_graphs_with_nodes_in_python_keep_memory_apart() -> None:
    x = ca.MX.sym("x", 20, 30)
    weights = ca.DM(np.random.default_rng(0).normal(size=(25, 20)))
    graph = NumpyGraph("graph", [x], [ca.tanh(weights @ x)])
    points = np.random.default_rng(1).normal(size=(8, 30, 20))
    expected = [graph(part)[0] for part in points]
    for k, (found,) in enumerate(in_threads(lambda k: graph(points[k % 8]), 800)):
        np.testing.assert_array_equal(found, expected[k % 8])


def test_a_value_is_built_once() -> None:
    """Threads that come while it is being built wait for the first one; errors are not kept."""
    gate, built = threading.Barrier(THREADS), []

    class Thing:
        @cached_property
        def value(self) -> object:
            built.append(threading.get_ident())
            if len(built) == 1:
                raise RuntimeError("not yet")
            time.sleep(0.05)  # so that the others come meanwhile
            return object()

    thing = Thing()
    with pytest.raises(RuntimeError, match="not yet"):
        _ = thing.value

    def look(k: int) -> object:
        gate.wait(60)
        return thing.value

    assert len({id(value) for value in in_threads(look, THREADS)}) == 1
    assert len(built) == 2


@pytest.mark.slow
def test_fits_in_threads_are_those_of_one_thread() -> None:
    """Also by solvers that build integrators and programs of CasADi, while simulations build theirs."""
    families = [oc.Polynomial(2), oc.MLP((4,)), oc.Polynomial(1), oc.Polynomial(1)]
    minimisers = [None, None, solvers.GradientFlow(max_iterations=3), solvers.Ipopt(max_iterations=5)]

    def theta(k: int) -> Array:
        if k % 5 == 4:
            return numbers(simulate(impedance(), steps(), planar().domain.centre, control_rate=50.0))[0]
        chart = oc.fit(planar(), families[k % 5], minimisers[k % 5], samples=100).chart
        return np.asarray(chart.coordinates.theta)  # type: ignore[attr-defined]

    expected = [theta(k) for k in range(5)]
    for k, found in enumerate(in_threads(theta, 10)):
        np.testing.assert_array_equal(found, expected[k % 5])
