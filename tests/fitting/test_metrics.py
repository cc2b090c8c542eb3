"""Metrics: kinds, and refusal of what is not symmetric positive definite."""

import dataclasses
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from conftest import robot_data

import orthocas as oc
from orthocas.errors import InvalidValueError, MetricError, ShapeError, UnknownNameError
from orthocas.tasks.metric import Metric

POINTS = np.random.default_rng(0).uniform(-1, 1, (10, 2))


def problem(metric: object) -> oc.Problem:
    robot = oc.Robot.planar([1.0, 1.0], [3.0, 3.0])
    return oc.Problem(robot, oc.Task.position(robot, "x"), metric)


def test_kinds_give_their_matrices() -> None:
    np.testing.assert_array_equal(problem("euclidean").metric.evaluate(POINTS)[3], np.eye(2))
    inertia = problem("inertia")
    np.testing.assert_allclose(inertia.metric.evaluate(POINTS), inertia.robot.mass_matrix(POINTS))
    stiffness = np.array([[2.0, 0.5], [0.5, 1.0]])
    np.testing.assert_allclose(problem(stiffness).metric.evaluate(POINTS)[7], stiffness)
    custom = problem(lambda q: ca.diag(ca.vertcat(1 + q[0] ** 2, 2)))
    np.testing.assert_allclose(custom.metric.evaluate(POINTS)[:, 0, 0], 1 + POINTS[:, 0] ** 2)


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


@pytest.mark.slow
def test_named_metric_shows_its_name_in_reports_and_after_loading(tmp_path: Path) -> None:
    robot = oc.Robot.planar([1.0, 1.0], [3.0, 3.0])
    stiffness = Metric.custom(robot, "stiffness", lambda q: ca.diag(ca.vertcat(1 + q[0] ** 2, 2)))
    chart = oc.fit(oc.Problem(robot, oc.Task.position(robot, "x"), stiffness), oc.Polynomial(1)).chart
    assert oc.evaluate(chart, 50).metric == "stiffness"
    chart.save(tmp_path / "a.orthocas")
    again = oc.load(tmp_path / "a.orthocas").problem.metric
    assert again.name == "stiffness"
    np.testing.assert_array_equal(again.evaluate(POINTS), stiffness.evaluate(POINTS))


def test_name_of_a_custom_metric_does_not_make_it_the_identity() -> None:
    robot = oc.Robot.planar([1.0, 1.0], [3.0, 3.0])
    metric = Metric.custom(robot, "euclidean", lambda q: 3 * ca.SX.eye(2))
    assert not metric.is_identity
    np.testing.assert_array_equal(metric.evaluate(POINTS)[0], 3 * np.eye(2))


def massless(robot: oc.Robot, i: int, **change: object) -> oc.Robot:
    """The robot with body i without mass."""
    masses, inertias = robot.tree.masses.copy(), robot.tree.inertias.copy()
    masses[i], inertias[i] = 0, 0
    return oc.Robot(dataclasses.replace(robot.tree, masses=masses, inertias=inertias, **change))


def test_joint_that_moves_no_mass_is_named_when_inertia_is_the_metric() -> None:
    ur5 = oc.Robot.from_urdf(robot_data("ur_description/urdf/ur5_robot.urdf"), "tool0")
    robot = massless(ur5, 5)
    with pytest.raises(MetricError, match="joint 'wrist_3_joint' moves no mass.*--lock wrist_3_joint=0"):
        oc.Problem(robot, oc.Task.position(robot), "inertia")
    problem = oc.Problem(robot, oc.Task.position(robot), "euclidean")  # needs no mass
    with pytest.raises(MetricError, match="joint 'wrist_3_joint' moves no mass.*for gains by modes"):
        oc.control.matched_stiffness(oc.fit(problem, oc.Linear()).chart)
    rotor = massless(ur5, 5, armatures=np.full(6, 0.01))
    oc.check(oc.Problem(rotor, oc.Task.position(rotor), "inertia"))
    carried = massless(ur5, 2)  # carries what has mass
    oc.check(oc.Problem(carried, oc.Task.position(carried), "inertia"))


def test_function_that_divides_by_zero_is_refused(planar_x: oc.Problem) -> None:
    with pytest.raises(InvalidValueError, match="metric is failing"):
        Metric.custom(planar_x.robot, "broken", lambda q: 1 / 0)
