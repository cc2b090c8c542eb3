"""References: steps through the low pass, splines through points, and what leaves the domain."""

import re
from typing import Any

import numpy as np
import pytest
from baselines import posture_reference
from scipy.integrate import solve_ivp

import orthocas as oc
from orthocas.control import Reference, joint_path
from orthocas.errors import InvalidValueError, OrthocasError, ShapeError, UnknownNameError, UnreachableReferenceError

STEPS = [(0.5, {"x": 1.0}), (0.9, {"xi1": -2.0}), (3.0, {"x": 0.0, "xi1": 0.5})]


@pytest.mark.parametrize("zeta", [0.0, 0.7, 1.0, 3.0])
def test_steps_solve_the_differential_equation_of_the_low_pass(zeta: float) -> None:
    """Against SciPy, also where one step comes before the last has settled."""
    omega, start = 5.0, np.array([0.2, 0.1])
    reference = Reference.steps(("x", "xi1"), start, STEPS, 5.0, omega, zeta)

    def target(t: float) -> Any:
        return [[0.2, 0.1], [1.0, 0.1], [1.0, -2.0], [0.0, 0.5]][int(np.searchsorted([0.5, 0.9, 3.0], t, "right"))]

    state = np.array([*start, 0.0, 0.0])
    for begin, end in ((0.0, 0.5), (0.5, 0.9), (0.9, 3.0), (3.0, 5.0)):
        goal = np.array(target(begin))
        times = np.linspace(begin, end, 9)[:-1]
        run = solve_ivp(
            lambda _, s, goal=goal: [*s[2:], *(omega**2 * (goal - s[:2]) - 2 * zeta * omega * s[2:])],
            (begin, end),
            state,
            t_eval=[*times, end],
            rtol=1e-11,
            atol=1e-12,
        )
        value, velocity, acceleration = reference.sample(times)
        np.testing.assert_allclose(value, run.y[:2, :-1].T, atol=1e-8)
        np.testing.assert_allclose(velocity, run.y[2:, :-1].T, atol=1e-7)
        np.testing.assert_allclose(acceleration, omega**2 * (goal - value) - 2 * zeta * omega * velocity, atol=1e-9)
        state = run.y[:, -1]


def test_over_damped_filter_does_not_overflow_after_hours() -> None:
    value = Reference.steps(("x",), [0.0], [(0.0, {"x": 1.0})], 1e5, 10.0, 5.0).sample([9e4])[0]
    assert value[0, 0] == pytest.approx(1.0, abs=1e-12)


def test_spline_passes_its_points_smoothly_and_rests_at_both_ends() -> None:
    times, points = [0.0, 1.0, 1.5, 4.0], np.array([[0.0, 1.0], [1.0, 0.0], [0.5, 0.3], [-1.0, 2.0]])
    reference = Reference.through(("x", "y"), times, points)
    value, velocity, acceleration = reference.sample(times)
    np.testing.assert_allclose(value, points, atol=1e-12)
    np.testing.assert_allclose([velocity[[0, -1]], acceleration[[0, -1]]], 0.0, atol=1e-11)
    t = np.linspace(0.05, 3.95, 200)
    before, here, after = (reference.sample(t + dt) for dt in (-1e-5, 0.0, 1e-5))
    np.testing.assert_allclose((after[0] - before[0]) / 2e-5, here[1], atol=1e-7)
    np.testing.assert_allclose((after[1] - before[1]) / 2e-5, here[2], atol=1e-6)
    assert reference.duration == 4.0


@pytest.mark.parametrize(
    ("changes", "error", "words"),
    [
        ([(1.0, {"z": 1.0})], UnknownNameError, "unknown quantity 'z', known: x, xi1"),
        ([(1.0, {"x": np.nan})], InvalidValueError, "target of x is nan"),
        ([(2.0, {"x": 1.0}), (1.0, {"x": 0.0})], InvalidValueError, "time of a step is 1.0, expected from 2"),
        ([(9.0, {"x": 1.0})], InvalidValueError, "below the duration 5 s"),
        ([("soon", {"x": 1.0})], InvalidValueError, "time of a step"),
    ],
)
def test_bad_steps_are_refused(changes: Any, error: type[OrthocasError], words: str) -> None:
    with pytest.raises(error, match=words):
        Reference.steps(("x", "xi1"), [0.0, 0.0], changes, 5.0)


@pytest.mark.parametrize(
    "setting", [{"natural_frequency": 0.0}, {"damping_ratio": -0.1}, {"natural_frequency": np.inf}]
)
def test_bad_filters_are_refused(setting: dict[str, float]) -> None:
    with pytest.raises(InvalidValueError, match=next(iter(setting))):
        Reference.steps(("x",), [0.0], [], 5.0, **setting)


@pytest.mark.parametrize("times", [[0.0], [0.1, 1.0], [0.0, 2.0, 1.0]])
def test_bad_times_of_points_are_refused(times: list[float]) -> None:
    with pytest.raises(InvalidValueError, match="increasing times that begin with 0"):
        Reference.through(("x",), times, np.zeros((len(times), 1)))


def test_points_of_another_size_are_refused() -> None:
    with pytest.raises(ShapeError, match="points has shape"):
        Reference.through(("x", "y"), [0.0, 1.0], np.zeros((2, 3)))


@pytest.mark.slow
def test_path_follows_the_reference_and_comes_back(planar_chart: oc.Chart) -> None:
    q0 = planar_chart.problem.domain.centre
    phi0 = planar_chart.phi(q0)
    reference = Reference.steps(
        planar_chart.labels,
        phi0,
        [(0.0, {"x": phi0[0] + 0.05}), (2.0, {"xi1": 0.05}), (4.0, {"x": phi0[0], "xi1": 0.0})],
        8.0,
    )
    path = joint_path(planar_chart, reference, q0)
    np.testing.assert_allclose(planar_chart.phi(path), reference.sample(reference.grid())[0], atol=1e-9)
    assert np.abs(path - q0).max() > 0.05
    np.testing.assert_allclose(path[-1], q0, atol=1e-5)  # the low pass has come to rest within 1e-7 of its targets


def test_reference_that_leaves_the_domain_is_reported_with_time_and_joint(planar_chart: oc.Chart) -> None:
    q0 = planar_chart.problem.domain.centre
    start = planar_chart.phi(q0)
    away = Reference.steps(planar_chart.labels, start, [(1.0, {"xi1": 0.6})], 4.0)
    with pytest.raises(UnreachableReferenceError, match=r"leaves the domain at t = 1\.\d+ s, at x = .*joint 'q\d' at"):
        joint_path(planar_chart, away, q0)
    far = Reference.steps(planar_chart.labels, start, [(1.0, {"x": 5.0})], 4.0)  # the arm is 3 m long
    with pytest.raises(UnreachableReferenceError, match=r"at t = 1"):
        joint_path(planar_chart, far, q0)


def test_coordinate_that_cannot_be_reached_is_named_with_its_range(planar_chart: oc.Chart) -> None:
    q0 = planar_chart.problem.domain.centre
    start, reach = planar_chart.phi(q0), planar_chart.xi_range(q0)["xi1"]
    away = Reference.steps(planar_chart.labels, start, [(1.0, {"xi1": 0.6})], 4.0)
    stopped = f"xi1 = 0.6 is asked for, at the last x it reaches [{reach.low:.4g}"
    with pytest.raises(UnreachableReferenceError, match=re.escape(stopped)) as caught:
        joint_path(planar_chart, away, q0)
    assert f"stopped by joint '{reach.high_stop.joint}' at {reach.high_stop.value:.4g}; " in str(caught.value)
    within = Reference.steps(planar_chart.labels, start, [(1.0, {"xi1": 0.9 * reach.high})], 4.0)
    assert len(joint_path(planar_chart, within, q0)) == len(within.grid())


def test_reference_with_other_labels_is_refused(planar_chart: oc.Chart) -> None:
    q0 = planar_chart.problem.domain.centre
    swapped = Reference.steps(("x", "xi2", "xi1"), planar_chart.phi(q0), [], 1.0)
    with pytest.raises(InvalidValueError, match="labels of the reference"):
        joint_path(planar_chart, swapped, q0)


def test_fast_swings_are_seen(planar_chart: oc.Chart) -> None:
    """A low pass of 20 Hz overshoots between the points of a coarse grid."""
    q0 = planar_chart.problem.domain.centre
    phi = planar_chart.phi(q0)
    fast = Reference.steps(planar_chart.labels, phi, [(0.01, {"xi1": 0.09})], 1.0, 125.66, 0.05)
    peak = np.abs(fast.sample(np.linspace(0, 1, 5001))[0][:, 1]).max()
    assert np.abs(fast.sample(fast.grid())[0][:, 1]).max() > 0.97 * peak


@pytest.mark.parametrize("time", [-0.1, 4.1])
def test_times_outside_the_reference_are_refused(time: float) -> None:
    reference = Reference.through(("x",), [0.0, 4.0], [[0.0], [1.0]])
    with pytest.raises(InvalidValueError, match="from 0 to 4 s"):
        reference.sample([time])


def test_posture_reference_means_the_same_motion(planar_chart: oc.Chart) -> None:
    q0 = planar_chart.problem.domain.centre
    phi0 = planar_chart.phi(q0)
    reference = Reference.steps(planar_chart.labels, phi0, [(0.5, {"xi2": 0.02}), (1.5, {"x": phi0[0] - 0.05})], 3.0)
    posture = posture_reference(planar_chart, reference, q0)
    assert posture.labels == ("x", *planar_chart.problem.robot.joint_names)
    times = np.linspace(0, 3.0, 31)
    wanted, given = reference.sample(times)[0], posture.sample(times)[0]
    np.testing.assert_allclose(given[:, 0], wanted[:, 0], atol=1e-4)  # splined every 0.05 s
    np.testing.assert_allclose(planar_chart.phi(given[:, 1:]), wanted, atol=1e-4)
