"""Runs that are refused, interrupted, or blow up."""

from typing import Any

import numpy as np
import pytest
from baselines import KinematicProjector, Projector
from closed_loops import K, resting

import orthocas as oc
from orthocas.control import ControlStatus, Impedance, Kinematic, PDPlus, Reference
from orthocas.errors import Interrupted, InvalidValueError, ShapeError, UnreachableReferenceError
from orthocas.simulation import (
    Friction,
    Noise,
    Outcome,
    Push,
    simulate,
)
from orthocas.tools.checks import Array
from orthocas.tools.progress import Progress


@pytest.mark.slow
def test_unreachable_reference_is_reported_before_the_run(planar_chart: oc.Chart, planar_q0: Array) -> None:
    away = Reference.steps(planar_chart.labels, planar_chart.phi(planar_q0), [(1.0, {"xi1": -2.0})], 3.0)
    seen: list[Progress] = []
    with pytest.raises(UnreachableReferenceError, match="leaves the domain at t = 1"):
        simulate(Impedance(planar_chart, K), away, planar_q0, monitor=seen.append)
    assert not seen
    run = simulate(Impedance(planar_chart, K, limit=20.0), away, planar_q0, must_be_reachable=False)
    assert run.outcome is Outcome.LOST
    first = np.flatnonzero(run.status == ControlStatus.OUTSIDE_DOMAIN)[0]
    assert run.reason == f"the arm left the domain of the chart at t = {run.times[first]:.4g} s"
    assert not planar_chart.problem.domain.contains(run.q[first])
    assert np.isfinite(run.command).all()


@pytest.mark.slow
def test_interrupt_keeps_what_was_simulated(planar_chart: oc.Chart, planar_steps: Reference, planar_q0: Array) -> None:
    for rate in (None, 500.0):

        def press(progress: Progress) -> None:
            if progress.fraction > 0.3:
                raise KeyboardInterrupt

        with pytest.raises(Interrupted) as stop:
            simulate(PDPlus(planar_chart, K), planar_steps, planar_q0, control_rate=rate, monitor=press)
        run = stop.value.result
        assert run.outcome is Outcome.INTERRUPTED
        assert 0.3 * 8 < run.times[-1] < 0.4 * 8
        assert len(run.q) == len(run.times) == len(run.command) == len(run.storage)


def test_run_that_blows_up_is_told(planar_chart: oc.Chart, planar_q0: Array) -> None:
    """Damping that is far too strong for 20 ticks a second, without walls to stop it."""
    robot = planar_chart.problem.robot
    problem = oc.Problem(robot, planar_chart.problem.task, "inertia", oc.Torus(3))
    law = Projector(problem, 1e7, 1e7, 5.0)
    still = Reference.steps(law.labels, law.measured(planar_q0).full().ravel(), [], 5.0)
    run = simulate(law, still, planar_q0 + 0.1, control_rate=20.0)
    assert run.outcome is Outcome.DIVERGED
    assert run.times[-1] < 5.0
    assert np.isfinite(run.q).all()


def test_progress_is_told(planar_chart: oc.Chart, planar_q0: Array) -> None:
    seen: list[Progress] = []
    simulate(Impedance(planar_chart, K), resting(planar_chart, planar_q0, 2.0), planar_q0, monitor=seen.append)
    fractions = [progress.fraction for progress in seen]
    assert fractions == sorted(fractions)
    assert fractions[-1] == pytest.approx(1.0)
    assert seen[0].stage == "simulate impedance"


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"q_start": np.zeros(2)}, ShapeError, r"q_start has shape \(2,\)"),
        ({"q_start": [0.0, np.nan, 0.0]}, InvalidValueError, r"q_start\[1\] is nan"),
        ({"dq_start": np.zeros(4)}, ShapeError, "dq_start"),
        ({"step": 0.0}, InvalidValueError, "step is 0.0"),
        ({"control_rate": -1.0}, InvalidValueError, "control_rate is -1.0"),
        ({"tolerance": np.nan}, InvalidValueError, "tolerance is nan"),
        ({"plant": oc.Robot.planar([1, 1], [1, 1])}, InvalidValueError, "joints of the plant is 2"),
        ({"pushes": [Push(0.0, 1.0, torque=[1.0])]}, ShapeError, "torque of a push"),
        ({"friction": Friction(viscous=-1.0)}, InvalidValueError, "viscous"),
        ({"step": "a"}, InvalidValueError, "step is 'a'"),
        ({"pushes": [Push(0.5, 0.1)]}, InvalidValueError, "start of a push is 0.5, expected a time before the end"),
        ({"q_start": [2.0, 2.0, 2.0]}, UnreachableReferenceError, "the start lies outside the domain: joint 'q"),
    ],
)
def test_bad_arguments_are_refused(
    planar_chart: oc.Chart, planar_q0: Array, change: dict[str, Any], error: type[Exception], words: str
) -> None:
    arguments = {"q_start": planar_q0, **change}
    with pytest.raises(error, match=words):
        simulate(Impedance(planar_chart, K), resting(planar_chart, planar_q0, 0.5), **arguments)


def test_what_would_be_ignored_is_refused(planar_chart: oc.Chart, planar_q0: Array) -> None:
    still = resting(planar_chart, planar_q0, 0.5)
    with pytest.raises(InvalidValueError, match="forces do not affect a velocity controller"):
        simulate(Kinematic(planar_chart), still, planar_q0, pushes=[Push(0.0, 0.1)])
    heavy = planar_chart.problem.robot.with_scaled_masses(2.0)
    with pytest.raises(InvalidValueError, match="forces do not affect a velocity controller"):
        simulate(Kinematic(planar_chart), still, planar_q0, plant=heavy)
    with pytest.raises(InvalidValueError, match="velocity is not a state"):
        simulate(Kinematic(planar_chart), still, planar_q0, dq_start=np.zeros(3))
    with pytest.raises(InvalidValueError, match=r"labels of the reference is \('x', 'xi1', 'xi2'\)"):
        simulate(KinematicProjector(planar_chart.problem), still, planar_q0)
    with pytest.raises(InvalidValueError, match="duration of a push"):
        Push(0.0, 0.0)
    with pytest.raises(InvalidValueError, match="position noise"):
        Noise(-1.0)
