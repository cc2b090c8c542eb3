"""Tasks: Jacobians against finite differences, orientation against rotation vectors, polar against Cartesian."""

import re
from typing import Any

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from conftest import arm, robot_data

import orthocas as oc
from orthocas.errors import InvalidValueError, ShapeError, UnknownNameError
from orthocas.problems import iiwa_robot
from orthocas.tasks.domains import default_box
from orthocas.tools.expressions import read_tape, write_tape

Q = np.array([0.3, 0.7, -0.4, -1.0, 0.5, 0.9, 0.2])
READY = np.array([0, -np.pi / 4, 0, -3 * np.pi / 4, 0, np.pi / 2, np.pi / 4])  # of the Panda: its hand points down


KINDS = [
    *("position", "position:xz", "polar", "orientation", "orientation:x", "pose", "pose:y", "pose:z"),
    *("axis", "axis:x", "axis:y", "position+axis"),
]


def panda() -> oc.Robot:
    return oc.Robot.from_urdf(robot_data("panda_description/urdf/panda.urdf"), "panda_hand")


@pytest.mark.parametrize("kind", KINDS)
def test_task_jacobian_matches_central_differences(kind: str) -> None:
    task = oc.Task.named(iiwa_robot(), kind, Q + 0.2)
    step = 1e-6
    h = [np.array(task.function(Q + s * step * e)).ravel() for e in np.eye(7) for s in (1, -1)]
    want = np.array([(h[2 * k] - h[2 * k + 1]) / (2 * step) for k in range(7)]).T
    np.testing.assert_allclose(np.array(task.jacobian_function(Q)), want, atol=1e-8)
    assert task.m == want.shape[0] == len(task.labels) == len(task.units)


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


@pytest.mark.parametrize("name", "xyz")
def test_axis_task_is_the_tilt_of_that_axis_whatever_the_turn_about_it(name: str) -> None:
    robot, k = iiwa_robot(), "xyz".index(name)
    reference = np.array([0.3, -0.5, -2.0])
    task = oc.Task.axis(robot, name, reference)
    for q in np.random.default_rng(5).uniform(-2, 2, (50, 7)):
        direction = robot.tip_rotation(q)[:, k]
        angle = np.arccos(direction @ reference / np.linalg.norm(reference))
        x = np.array(task.function(q)).ravel()
        np.testing.assert_allclose(np.linalg.norm(x), 2 * np.sin(angle / 2), atol=1e-12)
    about_z = np.array(oc.Task.axis(robot, "z", reference).jacobian_function(Q))[:, 6]
    np.testing.assert_allclose(about_z, 0, atol=1e-12)  # the last joint turns about the flange's z axis


def test_axis_task_is_the_angular_velocity_across_the_axis_at_the_reference() -> None:
    robot = iiwa_robot()
    task = oc.Task.named(robot, "axis:z", Q)
    np.testing.assert_allclose(np.array(task.function(Q)), 0, atol=1e-12)
    turning = robot.tip_rotation(Q).T @ robot.tip_jacobian(Q)[3:]  # z tilts towards x by a turn about y
    np.testing.assert_allclose(np.array(task.jacobian_function(Q)), [turning[1], -turning[0]], atol=1e-12)


@pytest.mark.parametrize("name", "xyz")
def test_turn_about_an_axis_is_what_the_shortest_tilt_of_that_axis_leaves(name: str) -> None:
    """Tilt the axis by the rotation across both directions, then turn about it: that is the tip's rotation."""
    robot, k = iiwa_robot(), "xyz".index(name)
    reference = robot.tip_rotation(Q + 0.4)
    task = oc.Task.orientation(robot, reference, name)
    np.testing.assert_array_equal(task.labels[:2], oc.Task.axis(robot, name).labels)
    for q in np.random.default_rng(6).uniform(-2, 2, (50, 7)):
        rotation = reference.T @ robot.tip_rotation(q)
        unit, direction = np.eye(3)[k], rotation[:, k]
        across = np.cross(unit, direction)
        tilt = pin.exp3(across / np.linalg.norm(across) * np.arccos(direction[k]))
        x = np.array(task.function(q)).ravel()
        np.testing.assert_allclose(tilt @ pin.exp3(x[2] * unit), rotation, atol=1e-9)
        np.testing.assert_allclose(x[:2], np.delete(direction, k) * np.sqrt(2 / (1 + direction[k])), atol=1e-12)
    about_z = np.array(oc.Task.pose(robot, reference, "z").jacobian_function(Q))[:, 6]
    np.testing.assert_allclose(about_z, [0, 0, 0, 0, 0, 1], atol=1e-12)  # joint 7 turns about the flange's z axis


@pytest.mark.parametrize(("kind", "rank"), [("axis:x", 2), ("axis:z", 2), ("position+axis:y", 5), ("position+axis", 5)])
def test_axis_tasks_have_full_rank_and_turn_smoothly(kind: str, rank: int) -> None:
    robot = panda()
    task = oc.Task.named(robot, kind, READY)
    points = READY + np.random.default_rng(1).uniform(-0.6, 0.6, (200, 7))
    J = task.batched_jacobian(points)[0].reshape(-1, rank, 7)
    assert task.m == rank
    assert np.linalg.svd(J, compute_uv=False)[:, -1].min() > 1e-3
    way = READY + np.linspace(-1, 1, 2001)[:, None] * np.array([0.3, -0.6, 0.5, 0.4, 0.6, -0.5, 2.5])
    x = task.batched(way)[0]
    assert np.abs(np.diff(x, axis=0)).max() < 4e-3  # steps of 1e-3 along 2.8 rad: no jump
    assert np.abs(np.diff(x, 2, axis=0)).max() < 2e-5


def test_hand_that_points_down_gets_its_reference_from_the_domain() -> None:
    robot = panda()
    hand = robot.tip_rotation(READY)
    np.testing.assert_allclose(hand[:, 2], [0, 0, -1], atol=1e-4)
    box = oc.Box(READY, 0.2)
    way = READY + np.linspace(-1, 1, 2000)[:, None] * np.full(7, 0.2)
    from_identity = oc.Task.orientation(robot, np.eye(3)).batched(way)[0]
    assert np.abs(np.diff(from_identity, axis=0)).max() > 3.9  # through the half turn, from 2 to -2
    for kind, at in (("orientation", 0), ("pose", 3), ("pose:z", 3), ("axis", 0)):
        task = oc.Task.named(robot, kind)
        bound = oc.Problem(robot, task, domain=box).task
        assert task.lacks_reference
        assert not bound.lacks_reference
        x = bound.batched(way)[0][:, at:]
        np.testing.assert_allclose(np.array(bound.function(READY)).ravel()[at:], 0, atol=1e-12)
        assert np.abs(np.diff(x, axis=0)).max() < 2e-3
        middle = np.array(task.function(default_box(robot).centre)).ravel()[at:]
        np.testing.assert_allclose(middle, 0, atol=1e-12)  # the task alone: the default centre


def test_problem_keeps_a_task_that_has_its_reference() -> None:
    robot = panda()
    box = oc.Box(READY, 0.2)
    for task in (oc.Task.position(robot), oc.Task.pose(robot, np.eye(3)), oc.Task.axis(robot, "z", [0, 0, -1])):
        assert oc.Problem(robot, task, domain=box).task is task


def test_units_follow_the_kind_of_task() -> None:
    robot = iiwa_robot()
    assert oc.Task.position(robot, "zx").units == ("m", "m")
    assert oc.Task.polar(robot).units == ("m", "rad")
    assert oc.Task.pose(robot).units == ("m",) * 3 + ("rad",) * 3
    assert oc.Task.position_and_axis(robot, "y").labels == ("x", "y", "z", "tilt_x", "tilt_z")
    assert oc.Task.position_and_axis(robot, "y").units == ("m",) * 3 + ("rad",) * 2
    assert oc.Task.pose(robot, axis="y").labels == ("x", "y", "z", "tilt_x", "tilt_z", "turn_y")
    assert oc.Task.pose(robot, axis="y").units == ("m",) * 3 + ("rad",) * 3
    assert oc.Task.custom(robot, "a", lambda q: q[:2]).units == ("", "")
    assert oc.Task.custom(robot, "a", lambda q: q[:2], units=("rad", "")).units == ("rad", "")


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
    again = ca.Function("again", [symbol], [read_tape(write_tape(task.function), symbol)])
    for q in np.random.default_rng(0).uniform(-2, 2, (20, 3)):
        np.testing.assert_allclose(np.array(again(q)), np.array(task.function(q)), atol=1e-14)


def test_bad_tasks_are_refused() -> None:
    robot = iiwa_robot()
    for axes in ("", "xx", "xw"):
        with pytest.raises(InvalidValueError, match="axes"):
            oc.Task.position(robot, axes)
    with pytest.raises(UnknownNameError, match="unknown task 'grasp', known: position"):
        oc.Task.named(robot, "grasp")
    with pytest.raises(UnknownNameError, match="unknown axis of the tip 'w', known: x, y, z"):
        oc.Task.named(robot, "position+axis:w")
    for axis in ("", "xy"):
        for build in (oc.Task.axis, oc.Task.pose):
            with pytest.raises(UnknownNameError, match="axis of the tip"):
                build(robot, axis=axis)
    with pytest.raises(InvalidValueError, match="a direction other than zero"):
        oc.Task.axis(robot, "z", [0, 0, 0])
    with pytest.raises(ShapeError, match="reference"):
        oc.Task.axis(robot, "z", np.eye(3))
    with pytest.raises(ShapeError, match="units"):
        oc.Task.custom(robot, "one", lambda q: q[0], units=("m", "m"))
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


SPINS = {  # rows of Pinocchio's frame Jacobian in the tip's axes, with signs: the axis z moves by (w_y, -w_x)
    "orientation": ([3, 4, 5], [1, 1, 1]),
    "pose": ([0, 1, 2, 3, 4, 5], [1, 1, 1, 1, 1, 1]),
    "orientation:x": ([5, 4, 3], [1, -1, 1]),
    "pose:z": ([0, 1, 2, 4, 3, 5], [1, 1, 1, 1, -1, 1]),
    "axis:y": ([5, 3], [-1, 1]),
    "position+axis:x": ([0, 1, 2, 5, 4], [1, 1, 1, 1, -1]),
}


@pytest.mark.parametrize("kind", SPINS)
def test_rows_that_judge_are_those_of_pinocchios_frame_jacobian(kind: str) -> None:
    """Also half a turn from the reference, where J_x loses rank; at the reference both turn alike."""
    model, tip = arm("panda")
    robot, data = oc.Robot.from_model(model, tip), model.createData()
    task = oc.Task.named(robot, kind, READY)
    rows, signs = SPINS[kind]
    for q in (READY, READY + np.pi * np.eye(7)[6], READY + 0.4, READY - [0.9, -0.3, 0.5, 0.2, -0.7, 0.1, 0.8]):
        J = pin.computeFrameJacobian(model, data, q, model.getFrameId(tip), pin.LOCAL)
        found = np.array(task.frame_jacobian_function(q))
        np.testing.assert_allclose(found, np.array(signs)[:, None] * J[rows], atol=1e-9)
    turning = slice(3 if kind.startswith("po") else 0, None)
    at_reference = np.array(task.jacobian_function(READY))[turning]
    np.testing.assert_allclose(np.array(task.frame_jacobian_function(READY))[turning], at_reference, atol=1e-9)


def test_other_tasks_are_judged_by_their_own_rows() -> None:
    for kind in ("position", "position:xz", "polar"):
        task = oc.Task.named(iiwa_robot(), kind)
        assert task.frame_jacobian_function is task.jacobian_function


@pytest.mark.parametrize("kind", ["orientation", "pose", "pose:z", "axis:x", "position+axis:y"])
def test_the_distance_from_half_a_turn_is_that_of_rotation_matrices(kind: str) -> None:
    robot = iiwa_robot()
    task, points = oc.Task.named(robot, kind, Q), np.random.default_rng(4).uniform(-2, 2, (50, 7))
    R = robot.tip_rotation(Q).T @ robot.tip_rotation(points)
    if task.turn is None or task.turn.axis is None:
        cosines = (np.trace(R, axis1=1, axis2=2) - 1) / 2
    else:
        k = "xyz".index(task.turn.axis)
        cosines = R[:, k, k]
    wanted = np.cos(np.arccos(np.clip(cosines, -1, 1)) / 2)
    if kind == "pose:z":  # its turn ends at half a turn as well
        wanted = np.minimum(wanted, np.cos(task.batched(points)[0][:, 5] / 2))
    assert task.turn is not None
    found = task.turn.measure_half_turn_distance(task.batched(points)[0].reshape(50, -1))
    np.testing.assert_allclose(found, wanted, atol=1e-7)


@pytest.mark.parametrize(
    ("function", "reason"),
    [
        (lambda q: ca.sin("x"), "Wrong number or type of arguments for overloaded function 'sin'"),
        (lambda q: q[7], "Assertion .* out of bounds"),
        (lambda q: 1 / 0, "division by zero"),
    ],
)
def test_a_function_that_fails_is_named_without_places_in_libraries(function: Any, reason: str) -> None:
    robot = oc.Robot.planar([1.0, 1.0, 1.0], [1.0, 1.0, 1.0])
    with pytest.raises(InvalidValueError, match=rf"task 'mine' is failing \({reason}") as error:
        oc.Task.custom(robot, "mine", function)
    assert not re.search(r"prototype|\.cpp|::", str(error.value))
