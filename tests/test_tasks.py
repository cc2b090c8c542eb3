"""Tasks: Jacobians against finite differences, orientation against rotation vectors, polar against Cartesian."""

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest

import orthocas as oc
from orthocas.casadi_tools.tape import from_tape, to_tape
from orthocas.errors import InvalidValueError, ShapeError, UnknownNameError
from orthocas.problems.iiwa import robot as iiwa_robot

Q = np.array([0.3, 0.7, -0.4, -1.0, 0.5, 0.9, 0.2])


@pytest.mark.parametrize("kind", ["position", "position:xz", "polar", "orientation", "pose"])
def test_task_jacobian_matches_central_differences(kind: str) -> None:
    task = oc.Task.named(iiwa_robot(), kind, Q + 0.2)
    step = 1e-6
    h = [np.array(task.function(Q + s * step * e)).ravel() for e in np.eye(7) for s in (1, -1)]
    want = np.array([(h[2 * k] - h[2 * k + 1]) / (2 * step) for k in range(7)]).T
    np.testing.assert_allclose(np.array(task.jacobian_function(Q)), want, atol=1e-8)
    assert task.m == want.shape[0] == len(task.labels)


def test_orientation_is_half_angle_vector_of_the_relative_rotation() -> None:
    robot = iiwa_robot()
    reference = robot.tip_rotation(Q + 0.3)
    x = np.array(oc.Task.orientation(robot, reference).function(Q)).ravel()
    vector = pin.log3(reference.T @ robot.tip_rotation(Q))
    angle = np.linalg.norm(vector)
    np.testing.assert_allclose(x, 2 * np.sin(angle / 2) * vector / angle, atol=1e-12)


def test_orientation_is_zero_at_the_reference_and_its_jacobian_is_the_angular_one() -> None:
    robot = iiwa_robot()
    reference = robot.tip_rotation(Q)
    task = oc.Task.orientation(robot, reference)
    np.testing.assert_allclose(np.array(task.function(Q)), 0, atol=1e-12)
    want = reference.T @ robot.tip_jacobian(Q)[3:]
    np.testing.assert_allclose(np.array(task.jacobian_function(Q)), want, atol=1e-12)


def test_polar_and_cartesian_tasks_have_the_same_row_space() -> None:
    robot = oc.Robot.planar([1.0, 1.0, 1.0], [1.0, 1.0, 1.0])
    q = np.array([0.3, 0.8, -0.4])
    J_c = np.array(oc.Task.position(robot, "xy").jacobian_function(q))
    J_p = np.array(oc.Task.polar(robot).jacobian_function(q))
    assert np.linalg.matrix_rank(np.vstack([J_c, J_p]), tol=1e-10) == 2
    x, y = robot.tip_position(q)[:2]
    np.testing.assert_allclose(np.array(oc.Task.polar(robot).function(q)).ravel(), [np.hypot(x, y), np.arctan2(y, x)])


def test_custom_task_survives_its_recipe() -> None:
    robot = oc.Robot.planar([1.0, 1.0, 1.0], [1.0, 1.0, 1.0])

    def odd(q: ca.SX) -> ca.SX:
        p = robot.tip_position(q)
        mixed = ca.if_else(q[0] > 0, ca.exp(q[1]), ca.tanh(q[2])) + ca.fmax(q[0], q[1]) ** 3
        return ca.vertcat(ca.sqrt(p[0] ** 2 + 1), ca.atan2(p[1], 2 + p[0]) + mixed / (1 + q[2] ** 2))

    task = oc.Task.custom(robot, "odd", odd, labels=("a", "b"))
    symbol = ca.SX.sym("q", 3)
    again = ca.Function("again", [symbol], [from_tape(to_tape(task.function), symbol)])
    for q in np.random.default_rng(0).uniform(-2, 2, (20, 3)):
        np.testing.assert_allclose(np.array(again(q)), np.array(task.function(q)), atol=1e-14)


def test_bad_tasks_are_refused() -> None:
    robot = iiwa_robot()
    for axes in ("", "xx", "xw"):
        with pytest.raises(InvalidValueError, match="axes"):
            oc.Task.position(robot, axes)
    with pytest.raises(UnknownNameError, match="unknown task 'grasp', known: position"):
        oc.Task.named(robot, "grasp")
    with pytest.raises(InvalidValueError, match="rotation matrix"):
        oc.Task.orientation(robot, np.ones((3, 3)))
    with pytest.raises(ShapeError, match="reference"):
        oc.Task.pose(robot, np.eye(4))
    with pytest.raises(ShapeError, match="task 'flat'"):
        oc.Task.custom(robot, "flat", lambda q: ca.horzcat(q[0], q[1]))
    broken = {
        "none": lambda q: None,
        "mx": lambda q: ca.MX.sym("x"),
        "too far": lambda q: q[7],
        "free": lambda q: q[0] + ca.SX.sym("unknown"),
        "two arguments": lambda q, p: q,
        "text": "q[0]",
    }
    for name, function in broken.items():
        with pytest.raises(InvalidValueError, match=f"task '{name}' is"):
            oc.Task.custom(robot, name, function)
    with pytest.raises(ShapeError, match="labels"):
        oc.Task.custom(robot, "one", lambda q: q[0], labels=("a", "b"))
