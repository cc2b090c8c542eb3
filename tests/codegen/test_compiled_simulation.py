"""Closed loops in compiled C agree with CVODES, share libraries, and many of them run in threads."""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from baselines import Projector
from programs import needs_c
from public_objects import impedance, planar, second, steps

import orthocas as oc
from orthocas.control import ControlStatus, Kinematic, PDPlus, Reference, Safety
from orthocas.control.controller import Controller
from orthocas.errors import InvalidValueError, UnknownNameError
from orthocas.fitting.fit import Fit
from orthocas.simulation import Friction, Noise, Outcome, Push, Stops, Trajectory, simulate
from orthocas.tools.checks import Array
from orthocas.tools.progress import Progress

pytestmark = needs_c
ARRAYS = ("times", "q", "dq", "command", "status", "value", "reference", "storage", "dissipated_power")


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Libraries of this file."""
    place = tmp_path_factory.mktemp("cache")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(place))
        yield place / "orthocas"


def both(law: Controller, reference: Reference, q0: Array, **settings: Any) -> tuple[Trajectory, Trajectory]:
    """The same run by CVODES and in C."""
    runs = [simulate(law, reference, q0, compiled=compiled, **settings) for compiled in (False, True)]
    return runs[0], runs[1]


def require_same(runs: Sequence[Trajectory], atol: float) -> None:
    """Numbers relative to the largest of their kind."""
    one, other = runs
    for name in ARRAYS:
        want, found = (np.asarray(getattr(run, name), dtype=float) for run in (one, other))
        scale = np.nan_to_num(np.abs(want)).max() + 1e-3
        np.testing.assert_allclose(found / scale, want / scale, atol=atol, err_msg=name)
    assert one.outcome is other.outcome
    assert one.reason == other.reason


@pytest.fixture(scope="module")
def law(planar_fit: Fit) -> PDPlus:
    return PDPlus(planar_fit.chart, 60.0, coupling="decoupled", limit=90.0)


@pytest.fixture(scope="module")
def reference(planar_fit: Fit) -> Reference:
    chart = planar_fit.chart
    phi = chart.phi(chart.problem.domain.centre)
    changes = [(0.1, {"x": float(phi[0]) + 0.05}), (0.7, {"xi1": 0.03})]
    return Reference.steps(chart.labels, phi, changes, 1.2)


@pytest.mark.slow
def test_continuous_runs_are_those_of_cvodes(law: PDPlus, reference: Reference) -> None:
    """With pushes, viscous friction and a heavier robot."""
    q0, robot = law.problem.domain.centre, law.problem.robot
    pushes = [Push(0.3, 0.2, (0.0, 3.0, 0.0)), Push(0.4, 0.5, torque=[1.0, 0.0, -1.0], link=1)]
    changed = {"plant": robot.with_scaled_masses([1.1, 0.9, 1.2]), "pushes": pushes, "friction": Friction(0.5)}
    runs = both(law, reference, q0, dq_start=[0.1, 0.0, -0.1], tolerance=1e-10, **changed)
    require_same(runs, 1e-8)
    assert np.abs(runs[0].q - q0).max() > 0.03
    assert not runs[1].fell_back.any()
    coarse = simulate(law, reference, q0, step=0.5, compiled=True)  # the integrator chooses its steps
    fine = simulate(law, reference, q0, tolerance=1e-11)
    np.testing.assert_allclose(coarse.q[-1], fine.q[-1], atol=1e-7)


@pytest.mark.slow
def test_coulomb_friction_and_stops_are_those_of_cvodes(law: PDPlus, reference: Reference) -> None:
    runs = both(law, reference, law.problem.domain.centre, friction=Friction(0.1, 2.0), stops=Stops(), tolerance=1e-9)
    require_same(runs, 1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("rate", [200.0, 1000.0])
def test_sampled_runs_are_those_of_cvodes(law: PDPlus, reference: Reference, rate: float) -> None:
    """With noise, a push within a tick, and a start beyond the domain, where the fallback holds the arm."""
    q0 = law.problem.domain.centre
    settings = {"control_rate": rate, "noise": Noise(1e-4, 1e-3, seed=3), "pushes": [Push(0.3, 0.0005, (0, 500.0, 0))]}
    runs = both(law, reference, q0, tolerance=1e-11, **settings)
    require_same(runs, 1e-7)
    assert not runs[1].fell_back.any()
    outside = both(law, reference, q0 + 0.5, control_rate=rate, must_be_reachable=False)
    require_same(outside, 1e-5)
    assert (outside[1].status[:3] == ControlStatus.OUTSIDE_DOMAIN).all()
    assert (outside[1].outcome, runs[1].outcome) == (Outcome.LOST, Outcome.COMPLETE)
    assert outside[1].reason == "the arm was outside the domain of the chart at t = 0 s"


@pytest.mark.slow
def test_velocity_laws_and_laws_without_a_chart_run_in_c(planar_fit: Fit, reference: Reference) -> None:
    chart = planar_fit.chart
    q0 = chart.problem.domain.centre
    require_same(both(Kinematic(chart, 5.0), reference, q0, tolerance=1e-10), 1e-8)
    require_same(both(Kinematic(chart, 5.0), reference, q0, control_rate=500.0), 1e-8)
    problem, task = planar(), second()
    projector = Projector(problem, 50.0, 10.0, second=task)
    start = np.concatenate([problem.task.function(q0).full().ravel(), task.function(q0).full().ravel()])
    wanted = Reference.steps(projector.labels, start, [(0.1, {"x": start[0] + 0.05})], 0.6)
    require_same(both(projector, wanted, q0, tolerance=1e-10), 1e-8)


@pytest.mark.slow
def test_a_long_run_of_the_7_dof_arm_is_that_of_cvodes(arm_chart: oc.Chart) -> None:
    q0 = arm_chart.problem.domain.centre
    phi = arm_chart.phi(q0)
    wanted = Reference.steps(arm_chart.labels, phi, [(0.1, {"x": float(phi[0]) + 0.03, "xi2": 0.05})], 1.0)
    law = PDPlus(arm_chart, 80.0)
    require_same(both(law, wanted, q0, tolerance=1e-10), 1e-7)
    require_same(both(law, wanted, q0, control_rate=1000.0, tolerance=1e-12), 1e-7)  # CVODES starts anew every tick


def test_runs_that_differ_in_numbers_share_libraries(law: PDPlus, reference: Reference, cache: Path) -> None:
    q0, robot = law.problem.domain.centre, law.problem.robot
    changes = [
        {"plant": robot.with_scaled_masses(scale), "pushes": [Push(0.2, 0.1, (force, 0.0, 0.0))]}
        for scale, force in ((0.99, 1.0), (1.0, -2.0), (1.01, 2.0))
    ]
    one = simulate(law, reference, q0, compiled=True, **changes[0])
    before = set(os.listdir(cache))
    seen: list[Progress] = []
    runs = oc.simulate_many(law, reference, q0, changes, compiled=True, monitor=seen.append)
    assert set(os.listdir(cache)) == before
    np.testing.assert_array_equal(runs[0].q, one.q)
    for run, change in zip(runs, changes, strict=True):
        np.testing.assert_allclose(run.q, simulate(law, reference, q0, tolerance=1e-10, **change).q, atol=1e-8)
    assert np.abs(runs[0].q - runs[1].q).max() > 1e-3
    assert [report.fraction for report in seen] == pytest.approx([1 / 3, 2 / 3, 1.0])


@pytest.mark.slow
def test_many_runs_keep_their_order_on_any_executor(monkeypatch: pytest.MonkeyPatch) -> None:
    law, reference = impedance(), steps()
    starts = [planar().domain.centre + shift for shift in (0.0, 0.01, -0.01, 0.02)]
    changes = [{"q_start": q} for q in starts]
    settings = {"must_be_reachable": False, "control_rate": 100.0}
    here = oc.simulate_many(law, reference, starts[0], changes, **settings)
    with ThreadPoolExecutor(1) as executor:
        there = oc.simulate_many(law, reference, starts[0], changes, executor=executor, **settings)
    monkeypatch.setattr("orthocas.simulation.run.THREADS", 3)
    compiled = oc.simulate_many(law, reference, starts[0], changes, compiled=True, **settings)
    for q, *runs in zip(starts, here, there, compiled, strict=True):
        for run in runs:
            np.testing.assert_array_equal(run.q[0], q)
            np.testing.assert_allclose(run.q, runs[0].q, atol=1e-7)


def test_steps_that_become_too_short_end_the_run(law: PDPlus, reference: Reference) -> None:
    run = simulate(law, reference, law.problem.domain.centre, tolerance=1e-300, compiled=True)
    assert run.outcome is Outcome.DIVERGED


def test_what_c_cannot_run_is_refused(law: PDPlus, reference: Reference) -> None:
    q0 = law.problem.domain.centre
    with pytest.raises(InvalidValueError, match="compiled is True, expected False with safety"):
        simulate(law, reference, q0, control_rate=500.0, safety=Safety.of(law), compiled=True)
    with pytest.raises(InvalidValueError, match="MuJoCo"):
        simulate(law, reference, q0, control_rate=500.0, plant="mujoco", compiled=True)
    with pytest.raises(UnknownNameError, match="'masses'"):
        oc.simulate_many(law, reference, q0, [{"masses": 1.1}])
