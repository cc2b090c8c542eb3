"""Charts: shapes, Jacobian against differences, the inverse map and its failures."""

import numpy as np
import pytest

import orthocas as oc
from orthocas.errors import InvalidValueError, InverseError, ShapeError, UnknownNameError
from orthocas.fitting.fit import Fit


@pytest.mark.slow
def test_shapes_of_single_and_batched_calls(iiwa_fit: Fit) -> None:
    chart, q = iiwa_fit.chart, np.zeros((5, 7))
    assert (chart.xi(q).shape, chart.xi(q[0]).shape) == ((5, 4), (4,))
    assert (chart.phi(q).shape, chart.phi(q[0]).shape) == ((5, 7), (7,))
    assert (chart.jacobian(q).shape, chart.jacobian(q[0]).shape) == ((5, 7, 7), (7, 7))
    np.testing.assert_array_equal(chart.phi(q)[2], chart.phi(q[2]))


@pytest.mark.parametrize(
    "parametrisation", [oc.Polynomial(3), oc.Fourier(1), oc.MLP((5,)), oc.Linear()], ids=lambda p: p.label
)
def test_jacobian_matches_differences_of_phi(planar_x: oc.Problem, parametrisation: object) -> None:
    chart = oc.fit(planar_x, parametrisation, samples=100).chart
    q, step = np.array([[0.5, 0.9, 0.7], [0.7, 0.6, 1.0]]), 1e-6
    want = np.stack([(chart.phi(q + step * e) - chart.phi(q - step * e)) / (2 * step) for e in np.eye(3)], axis=2)
    np.testing.assert_allclose(chart.jacobian(q), want, atol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("parametrisation", [oc.Polynomial(3), oc.MLP((5,))], ids=lambda p: p.label)
def test_casadi_functions_agree_with_batched_numpy(planar_x: oc.Problem, parametrisation: object) -> None:
    chart = oc.fit(planar_x, parametrisation, samples=100).chart
    q = np.array([0.5, 0.9, 0.7])
    np.testing.assert_allclose(np.array(chart.function("phi")(q)).ravel(), chart.phi(q), atol=1e-12)
    np.testing.assert_allclose(np.array(chart.function("jacobian")(q)), chart.jacobian(q), atol=1e-12)
    assert chart.function("xi").size_out(0) == (2, 1)


@pytest.mark.slow
def test_task_rows_come_first(iiwa_fit: Fit) -> None:
    chart, q = iiwa_fit.chart, np.full(7, 0.1)
    np.testing.assert_allclose(chart.phi(q)[:3], chart.problem.robot.tip_position(q), atol=1e-14)
    np.testing.assert_allclose(chart.jacobian(q)[:3], chart.problem.robot.tip_jacobian(q)[:3], atol=1e-13)


def test_inverse_returns_to_the_joint_position(iiwa_fit: Fit) -> None:
    chart = iiwa_fit.chart
    rng = np.random.default_rng(1)
    q = chart.problem.domain.centre + rng.uniform(-0.4, 0.4, (20, 7))
    starts = q + rng.uniform(-0.1, 0.1, q.shape)
    np.testing.assert_allclose(chart.inverse(chart.phi(q), starts), q, atol=1e-7)
    np.testing.assert_allclose(chart.inverse(chart.phi(q[0]), starts[0]), q[0], atol=1e-7)
    near = chart.problem.domain.centre + rng.uniform(-0.1, 0.1, (3, 7))
    np.testing.assert_allclose(chart.inverse(chart.phi(near), chart.problem.domain.centre), near, atol=1e-7)


def test_self_motion_on_command_keeps_the_tool_still(iiwa_fit: Fit) -> None:
    chart = iiwa_fit.chart
    start = chart.problem.domain.centre
    target = chart.phi(start) + np.concatenate([np.zeros(3), [0.2, 0, 0, 0]])
    q = chart.inverse(target, start)
    np.testing.assert_allclose(chart.x(q), chart.x(start), atol=1e-9)
    assert np.abs(q - start).max() > 0.05


def test_inverse_out_of_reach_fails_clearly(iiwa_fit: Fit, capfd: pytest.CaptureFixture[str]) -> None:
    chart = iiwa_fit.chart
    centre = chart.problem.domain.centre
    far = chart.phi(centre) + np.array([5.0, 0, 0, 0, 0, 0, 0])
    with pytest.raises(InverseError, match="no q with phi"):
        chart.inverse(far, centre)
    with pytest.raises(InverseError, match=r"rows \[1\]"):
        chart.inverse(np.array([chart.phi(centre), far]), centre)
    assert capfd.readouterr() == ("", "")  # the rootfinder's own warnings stay silent


def test_inverse_at_a_singular_jacobian_fails_clearly() -> None:
    robot = oc.Robot.planar([1.0, 1.0], [1.0, 1.0])
    task = oc.Task.custom(robot, "square", lambda q: q[0] ** 2)
    problem = oc.Problem(robot, task, domain=oc.Box([0.5, 0.0], 0.4))
    chart = oc.fit(problem, oc.Polynomial(1)).chart
    with pytest.raises(InverseError):
        chart.inverse([0.0, 0.0], [0.0, 0.0])
    with pytest.raises(InverseError):
        chart.inverse([-1.0, 0.0], [0.5, 0.0])  # squares are not negative


def test_bad_arguments_are_refused(iiwa_fit: Fit) -> None:
    chart = iiwa_fit.chart
    with pytest.raises(ShapeError, match="q has shape"):
        chart.xi(np.zeros(6))
    with pytest.raises(ShapeError, match="phi has shape"):
        chart.inverse(np.zeros(6), np.zeros(7))
    with pytest.raises(ShapeError, match="q_start"):
        chart.inverse(np.zeros((3, 7)), np.zeros((2, 7)))
    with pytest.raises(InvalidValueError, match="finite"):
        chart.jacobian(np.full(7, np.nan))
    with pytest.raises(UnknownNameError, match="known: xi, phi"):
        chart.function("psi")


@pytest.mark.parametrize("unit", [1e-9, 1.0, 1e6])
def test_inverse_is_as_accurate_in_any_unit_of_the_task(planar_x: oc.Problem, unit: float) -> None:
    """The same postures come back, whether the task is in m, nm or Mm."""
    task = oc.Task.custom(planar_x.robot, "scaled", lambda q: unit * planar_x.task.function(q))
    problem = oc.Problem(planar_x.robot, task, "euclidean", planar_x.domain)
    chart = oc.Chart(problem, oc.fit(planar_x, oc.Linear()).chart.coordinates)
    centre, half_width = problem.domain.centre, problem.domain.half_width
    q = centre + half_width * np.random.default_rng(5).uniform(-0.5, 0.5, (50, 3))
    np.testing.assert_allclose(chart.inverse(chart.phi(q), q + 1e-3), q, atol=1e-8)


def test_inverse_of_a_task_far_from_zero_needs_no_more_than_rounding_allows(planar_x: oc.Problem) -> None:
    task = oc.Task.custom(planar_x.robot, "far", lambda q: 1e7 + planar_x.task.function(q))
    chart = oc.Chart(
        oc.Problem(planar_x.robot, task, "euclidean", planar_x.domain), oc.fit(planar_x, oc.Linear()).chart.coordinates
    )
    q = planar_x.domain.centre + 0.1
    np.testing.assert_allclose(chart.inverse(chart.phi(q), q + 1e-3), q, atol=1e-7)


def test_inverse_still_refuses_values_out_of_reach_in_any_unit(planar_x: oc.Problem) -> None:
    task = oc.Task.custom(planar_x.robot, "nm", lambda q: 1e-9 * planar_x.task.function(q))
    problem = oc.Problem(planar_x.robot, task, "euclidean", planar_x.domain)
    chart = oc.Chart(problem, oc.fit(planar_x, oc.Linear()).chart.coordinates)
    phi = chart.phi(problem.domain.centre)
    with pytest.raises(InverseError, match="relative error is"):
        chart.inverse([4e-9, *phi[1:]], problem.domain.centre)
