"""Metrics: kinds, and refusal of what is not symmetric positive definite."""

import casadi as ca
import numpy as np
import pytest

import orthocas as oc
from orthocas.errors import MetricError, ShapeError, UnknownNameError
from orthocas.metrics import metric_matrices

POINTS = np.random.default_rng(0).uniform(-1, 1, (10, 2))


def problem(metric: object) -> oc.Problem:
    robot = oc.Robot.planar([1.0, 1.0], [3.0, 3.0])
    return oc.Problem(robot, oc.Task.position(robot, "x"), metric)


def test_kinds_give_their_matrices() -> None:
    np.testing.assert_array_equal(metric_matrices(problem("euclidean").metric, POINTS)[3], np.eye(2))
    inertia = problem("inertia")
    np.testing.assert_allclose(metric_matrices(inertia.metric, POINTS), inertia.robot.mass_matrix(POINTS))
    stiffness = np.array([[2.0, 0.5], [0.5, 1.0]])
    np.testing.assert_allclose(metric_matrices(problem(stiffness).metric, POINTS)[7], stiffness)
    custom = problem(lambda q: ca.diag(ca.vertcat(1 + q[0] ** 2, 2)))
    np.testing.assert_allclose(metric_matrices(custom.metric, POINTS)[:, 0, 0], 1 + POINTS[:, 0] ** 2)


@pytest.mark.parametrize("matrix", [[[1.0, 0.0], [0.0, -1.0]], [[1.0, 1.0], [1.0, 1.0]], [[1.0, 0.5], [0.0, 1.0]]])
def test_constant_metric_must_be_spd(matrix: list[list[float]]) -> None:
    with pytest.raises(MetricError, match="expected symmetric positive definite"):
        problem(matrix)


def test_custom_metric_is_checked_on_the_domain() -> None:
    sometimes_negative = problem(lambda q: ca.diag(ca.vertcat(q[0], 1)))
    with pytest.raises(MetricError, match="eigenvalue -0"):
        oc.check(sometimes_negative)
    with pytest.raises(MetricError):
        oc.fit(sometimes_negative, oc.Polynomial(1))
    with pytest.raises(MetricError, match="not finite"):
        oc.check(problem(lambda q: ca.diag(ca.vertcat(1 / ca.fmax(q[0] - 10, 0), 1))))


def test_metric_of_another_robot_is_refused() -> None:
    big = oc.Robot.planar([1.0] * 3, [1.0] * 3)
    other = oc.Problem(big, oc.Task.position(big, "x"), "inertia").metric
    with pytest.raises(ShapeError, match="metric"):
        problem(other)


def test_wrong_shape_and_unknown_name_are_refused() -> None:
    with pytest.raises(ShapeError, match="metric"):
        problem(np.eye(3))
    with pytest.raises(ShapeError, match="metric"):
        problem(lambda q: q)
    with pytest.raises(UnknownNameError, match="known: euclidean, inertia"):
        problem("mass")
