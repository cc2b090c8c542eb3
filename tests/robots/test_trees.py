"""Robots with several tips, frames by name, and tasks of one frame in another, against Pinocchio."""

from pathlib import Path

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from conftest import robot_data

import orthocas as oc
from orthocas.errors import InvalidValueError, OrthocasError, UnknownNameError
from orthocas.robots.kinematics import build_point_jacobian
from orthocas.simulation.disturbances import place_of
from orthocas.tools.checks import Array

LEFT, RIGHT = "left_gripper", "right_gripper"


@pytest.fixture(scope="module")
def baxter_file() -> Path:
    return robot_data("baxter_description/urdf/baxter.urdf")


@pytest.fixture(scope="module")
def baxter(baxter_file: Path) -> oc.Robot:
    return oc.Robot.from_urdf(baxter_file, tips=[LEFT, RIGHT])


class Reference:
    """The whole robot in Pinocchio, at positions of some of its joints."""

    def __init__(self, path: Path, joints: tuple[str, ...]) -> None:
        self.model = pin.buildModelFromUrdf(str(path))
        self.data = self.model.createData()
        ids = [self.model.getJointId(name) for name in joints]
        self.places = [self.model.joints[i].idx_q for i in ids]
        self.columns = [self.model.joints[i].idx_v for i in ids]

    def at(self, q: Array) -> "Reference":
        whole = pin.neutral(self.model)
        whole[self.places] = q
        pin.computeJointJacobians(self.model, self.data, whole)
        pin.updateFramePlacements(self.model, self.data)
        return self

    def pose(self, name: str) -> pin.SE3:
        return self.data.oMf[self.model.getFrameId(name)]

    def jacobian(self, name: str) -> Array:
        frame = self.model.getFrameId(name)
        whole = pin.getFrameJacobian(self.model, self.data, frame, pin.LOCAL_WORLD_ALIGNED)
        return np.asarray(whole[:, self.columns])


def postures(robot: oc.Robot, count: int = 6) -> Array:
    return np.random.default_rng(1).uniform(-1, 1, (count, robot.n))


def test_two_tips_keep_the_joints_of_both_arms(baxter: oc.Robot) -> None:
    assert baxter.n == 14
    assert baxter.tips == (LEFT, RIGHT)
    assert "left_wrist" in baxter.frame_names
    assert "tips left_gripper, right_gripper" in str(baxter)


def test_frames_are_those_of_pinocchio(baxter: oc.Robot, baxter_file: Path) -> None:
    reference = Reference(baxter_file, baxter.joint_names)
    for q in postures(baxter):
        reference.at(q)
        for name in (LEFT, RIGHT, "left_wrist", "right_upper_forearm"):
            pose = reference.pose(name)
            np.testing.assert_allclose(baxter.frame_position(q, name), pose.translation, atol=1e-12)
            np.testing.assert_allclose(baxter.frame_rotation(q, name), pose.rotation, atol=1e-12)
            np.testing.assert_allclose(baxter.frame_jacobian(q, name), reference.jacobian(name), atol=1e-12)
        between = reference.pose(LEFT).inverse() * reference.pose(RIGHT)
        np.testing.assert_allclose(baxter.frame_position(q, RIGHT, LEFT), between.translation, atol=1e-12)
        np.testing.assert_allclose(baxter.frame_rotation(q, RIGHT, LEFT), between.rotation, atol=1e-12)


def test_jacobian_in_another_frame_is_the_rate_of_its_pose(baxter: oc.Robot) -> None:
    q, step = postures(baxter, 1)[0], 1e-6
    J, R = baxter.frame_jacobian(q, RIGHT, LEFT), baxter.frame_rotation(q, RIGHT, LEFT)
    for k in range(baxter.n):
        there, here = q + step * np.eye(baxter.n)[k], q - step * np.eye(baxter.n)[k]
        moved = (baxter.frame_position(there, RIGHT, LEFT) - baxter.frame_position(here, RIGHT, LEFT)) / (2 * step)
        turned = (baxter.frame_rotation(there, RIGHT, LEFT) - baxter.frame_rotation(here, RIGHT, LEFT)) / (2 * step)
        turning = turned @ R.T
        wanted = [*moved, turning[2, 1], turning[0, 2], turning[1, 0]]
        np.testing.assert_allclose(J[:, k], wanted, atol=1e-8)


def test_joints_that_carry_both_frames_take_no_part() -> None:
    """The lift under two arms cancels exactly, so it is an idle joint of the relative pose."""
    path = robot_data("pr2_description/urdf/pr2.urdf")
    robot = oc.Robot.from_urdf(path, tips=["l_gripper_tool_frame", "r_gripper_tool_frame"])
    lift = robot.joint_names.index("torso_lift_joint")
    task = oc.Task.relative_pose(robot, *robot.tips)
    q = ca.SX.sym("q", robot.n)
    assert not ca.depends_on(task.function(q), q[lift])


def test_centre_of_mass_is_that_of_pinocchio(baxter: oc.Robot) -> None:
    tree = baxter.tree
    assert tree.masses.sum() == pytest.approx(40.14, abs=0.01)
    for q in postures(baxter, 3):
        step = 1e-6
        potential = [
            -9.81 * tree.masses.sum() * -baxter.centre_of_mass(q + s * step * v)[2]
            for v in np.eye(baxter.n)
            for s in (1, -1)
        ]
        slopes = np.array(potential).reshape(-1, 2) @ [1, -1] / (2 * step)
        np.testing.assert_allclose(slopes, baxter.gravity(q), atol=1e-5)  # which is held against Pinocchio elsewhere


def test_line_to_draw_passes_all_joints_and_ends_at_the_first_tip(baxter: oc.Robot) -> None:
    q = postures(baxter, 2)
    points = baxter.joint_points(q)
    np.testing.assert_allclose(points[:, -1], baxter.tip_position(q), atol=1e-14)
    right = baxter.frame_position(q, RIGHT)
    assert np.abs(points - right[:, None]).max(axis=2).min(axis=1).max() < 1e-14
    lengths = np.linalg.norm(np.diff(points, axis=1), axis=2)
    assert lengths.max() < 0.6  # no line from one hand to the other shoulder


def test_tasks_of_frames(baxter: oc.Robot) -> None:
    q = postures(baxter)
    task = oc.Task.relative_position(baxter, LEFT, RIGHT, "xz")
    assert task.name == "position:xz of right_gripper in left_gripper"
    np.testing.assert_allclose(task.batched(q)[0], baxter.frame_position(q, RIGHT, LEFT)[:, [0, 2]], atol=1e-14)
    pose = oc.Task.relative_pose(baxter, LEFT, RIGHT).with_reference_at(q[0])
    assert np.abs(pose.batched(q[:1])[0][0, 3:]).max() < 1e-12
    assert pose.recipe["frame"] == RIGHT
    both = oc.Task.stack(oc.Task.position(baxter), oc.Task.position(baxter, frame=RIGHT))
    assert both.labels == ("x_1", "y_1", "z_1", "x_2", "y_2", "z_2")
    np.testing.assert_allclose(both.batched(q)[0][:, 3:], baxter.frame_position(q, RIGHT), atol=1e-14)


@pytest.mark.parametrize(
    "make",
    [
        lambda robot: oc.Task.relative_pose(robot, LEFT, RIGHT),
        lambda robot: oc.Task.relative_pose(robot, LEFT, RIGHT, axis="z"),
        lambda robot: oc.Task.position_and_axis(robot, frame=RIGHT),
        lambda robot: oc.Task.pointing(robot, LEFT, RIGHT),
        lambda robot: oc.Task.stack(oc.Task.pose(robot), oc.Task.axis(robot, frame=RIGHT)),
        lambda robot: oc.Task.centre_of_mass(robot, "xy"),
    ],
)
def test_jacobians_of_tasks_are_their_rates(baxter: oc.Robot, make: object) -> None:
    q, step = postures(baxter, 1)[0], 1e-6
    task = make(baxter).with_reference_at(q + 0.1)  # type: ignore[operator]
    J = np.asarray(task.jacobian_function(q))
    for k in range(baxter.n):
        v = step * np.eye(baxter.n)[k]
        slope = (np.asarray(task.function(q + v)) - np.asarray(task.function(q - v))) / (2 * step)
        np.testing.assert_allclose(J[:, [k]], slope, atol=2e-8)


def test_a_camera_that_looks_at_its_target_has_no_error() -> None:
    robot = oc.Robot.planar([1.0, 1.0], [1.0, 1.0])
    task = oc.Task.pointing(robot, "tip", [3.0, 0.0, 0.0], "x")
    np.testing.assert_allclose(np.asarray(task.function([0.0, 0.0])).ravel(), [0, 0], atol=1e-15)
    turned = np.asarray(task.function([0.0, 0.3])).ravel()  # the tip at (1 + cos 0.3, sin 0.3), which looks along 0.3
    angle = np.arctan2(-np.sin(0.3), 2 - np.cos(0.3)) - 0.3
    np.testing.assert_allclose(turned, [2 * np.sin(angle / 2), 0], atol=1e-14)


@pytest.mark.slow
def test_files_keep_frames_and_tasks(baxter: oc.Robot, tmp_path: Path) -> None:
    centre = 0.5 * postures(baxter, 1)[0]
    for task in (
        oc.Task.relative_pose(baxter, LEFT, RIGHT),
        oc.Task.stack(
            oc.Task.pointing(baxter, LEFT, [1, 0, 1]),
            oc.Task.custom(baxter, "height", lambda q: baxter.frame_position(q, RIGHT)[2]),
        ),
    ):
        problem = oc.Problem(baxter, task, domain=oc.Box(centre, 0.1))
        chart = oc.fit(problem, oc.Polynomial(1), samples=200, weights=oc.Weights(folds=0)).chart
        chart.save(tmp_path / "arms.orthocas")
        back = oc.load(tmp_path / "arms.orthocas")
        assert back.problem.robot.tips == (LEFT, RIGHT)
        q = centre + 0.05
        np.testing.assert_array_equal(back.phi(q), chart.phi(q))
        np.testing.assert_array_equal(
            back.problem.robot.frame_position(q, "left_wrist"), baxter.frame_position(q, "left_wrist")
        )


def test_names_of_the_command_line(baxter: oc.Robot) -> None:
    assert oc.Task.named(baxter, "relative_pose:z").recipe["relative_to"] == LEFT
    assert oc.Task.named(baxter, "relative_position:xy").m == 2
    one = oc.Robot.planar([1.0, 1.0], [1.0, 1.0])
    with pytest.raises(InvalidValueError, match="a robot with two tips"):
        oc.Task.named(one, "relative_pose")
    with pytest.raises(UnknownNameError, match="unknown task 'relative_centre_of_mass'"):
        oc.Task.named(baxter, "relative_centre_of_mass")


def test_a_stack_of_stacks_is_a_stack(baxter: oc.Robot) -> None:
    first, second = oc.Task.pose(baxter), oc.Task.axis(baxter, frame=RIGHT)
    whole = oc.Task.stack(oc.Task.stack(first, second), oc.Task.position(baxter, "x"))
    assert [part.name for part in whole.parts] == [first.name, second.name, "position:x"]
    assert whole.labels[0] == "x_1"


@pytest.mark.parametrize(
    ("tip", "tips", "message"),
    [
        (LEFT, [RIGHT], "nothing, because tip is given"),
        (None, [LEFT, LEFT], "different names"),
        (None, "left_gripper", "different names"),
        (None, [LEFT, "tail"], "unknown frame 'tail'"),
    ],
)
def test_refused_tips(baxter_file: Path, tip: str | None, tips: list[str], message: str) -> None:
    with pytest.raises(OrthocasError, match=message):
        oc.Robot.from_urdf(baxter_file, tip, tips=tips)


def test_unknown_frames_are_named(baxter: oc.Robot) -> None:
    with pytest.raises(UnknownNameError, match="unknown frame 'elbow'"):
        baxter.frame_position(np.zeros(14), "elbow")
    with pytest.raises(UnknownNameError, match="unknown frame 'elbow'"):
        oc.Task.position(baxter, frame="elbow")
    with pytest.raises(UnknownNameError, match="unknown robot function 'frame_position'"):
        baxter.function("frame_position")


@pytest.mark.parametrize(
    ("file", "tip"),
    [
        ("so_arm_description/urdf/so101.urdf", "gripper_frame_link"),
        ("so_arm_description/urdf/so100.urdf", "gripper"),
        ("z1_description/urdf/z1.urdf", "gripperStator"),
        ("talos_data/robots/talos_left_arm.urdf", "wrist_left_ft_tool_link"),
        ("panda_description/urdf/panda.urdf", "panda_hand_tcp"),
        ("finger_edu_description/robots/finger_edu.urdf", "finger_tip_link"),
    ],
)
def test_default_tip_is_no_finger(file: str, tip: str) -> None:
    robot = oc.Robot.from_urdf(robot_data(file))
    assert robot.tips == (tip,)
    assert not any("gripper" in name.lower() or "jaw" in name for name in robot.joint_names)


def test_pushes_act_at_frames(baxter: oc.Robot) -> None:
    """The generalised force of a push is J^T f with the Jacobian of the frame."""
    place = place_of(baxter.tree, "right_wrist", np.array([0.1, 0.0, 0.0]))
    tree = baxter.tree
    q = postures(baxter, 1)[0]
    symbol = ca.SX.sym("q", baxter.n)
    J = ca.Function("J", [symbol], [build_point_jacobian(tree, symbol, place.body, np.array(place.point))])(q)
    R, whole = baxter.frame_rotation(q, "right_wrist"), baxter.frame_jacobian(q, "right_wrist")
    arm = R @ [0.1, 0.0, 0.0]
    moved = whole[:3] + np.cross(whole[3:].T, arm).T
    np.testing.assert_allclose(np.asarray(J), moved, atol=1e-12)


def test_matrices_of_one_joint_are_matrices() -> None:
    robot = oc.Robot.planar([1.0], [1.0])
    assert robot.mass_matrix([0.3]).shape == (1, 1)
    assert robot.tip_jacobian(np.zeros((5, 1))).shape == (5, 6, 1)
    assert robot.frame_jacobian([0.3], "tip").shape == (6, 1)
    assert robot.gravity([0.3]).shape == (1,)


@pytest.mark.slow
def test_two_hands_on_one_object_move_it_by_the_names_of_coordinates(baxter: oc.Robot, baxter_file: Path) -> None:
    """The grasp of Pinocchio's hands stays to rounding while the coordinate of the left hand's x moves."""
    home = np.array([0.3, -0.4, -0.5, 1.2, 0.2, 0.8, 0.1, -0.3, -0.4, 0.5, 1.2, -0.2, 0.8, -0.1])
    problem = oc.Problem(baxter, oc.Task.relative_pose(baxter, LEFT, RIGHT), domain=oc.Box(home, 0.3))
    chart = oc.fit(problem, oc.Polynomial(1), like=oc.Task.position(baxter), samples=600).chart
    assert chart.parts.named_coordinates[:4] == ("xi1: like x [m]", "xi2: like y [m]", "xi3: like z [m]", "xi4")
    wanted = chart.phi(home)
    np.testing.assert_allclose(wanted[6:9], baxter.tip_position(home), atol=1e-9)
    wanted[6] += 0.05
    reference = Reference(baxter_file, baxter.joint_names)
    left, right = [], []
    for q in (home, chart.inverse(wanted, home)):
        at = reference.at(q)
        left.append(at.pose(LEFT).copy())
        right.append(at.pose(RIGHT).copy())
    grasps = [first.actInv(second) for first, second in zip(left, right, strict=True)]
    np.testing.assert_allclose(grasps[1].homogeneous, grasps[0].homogeneous, atol=1e-9)
    moved = left[1].translation - left[0].translation
    assert 0.04 < moved[0] < 0.06
    assert np.abs(moved[1:]).max() < 0.02


def test_equivalent_stacks_are_equally_far_from_singular_positions(baxter: oc.Robot) -> None:
    """The poses of both hands, and one of them with the pose of the other in it: the same J up to a regular factor."""
    q = postures(baxter, 40)
    left, right = (oc.Task.pose(baxter, frame=name) for name in (LEFT, RIGHT))
    stacks = [
        oc.Task.stack(left, right),
        oc.Task.stack(left, oc.Task.relative_pose(baxter, LEFT, RIGHT)),
        oc.Task.stack(oc.Task.relative_pose(baxter, RIGHT, LEFT), right),
        oc.Task.stack(oc.Task.relative_pose(baxter, RIGHT, LEFT), left),
    ]
    want, *found = (
        np.linalg.svd(stack.batched_frame_jacobian(q)[0].reshape(40, 12, 14), compute_uv=False) for stack in stacks
    )
    for values in found:
        np.testing.assert_allclose(values, want, atol=1e-12)


def test_rows_of_a_stack_span_those_of_its_jacobian(baxter: oc.Robot) -> None:
    """Also with positions in another frame, along some of its axes, where that one is seen from a third."""
    q = 0.3 * postures(baxter, 10)  # near the references, where J_x has its rank
    left = oc.Task.pose(baxter, frame=LEFT)
    stacks = [
        oc.Task.stack(left, oc.Task.relative_position(baxter, LEFT, RIGHT, "xz")),
        oc.Task.stack(
            oc.Task.position(baxter, "x", "right_upper_forearm", RIGHT),
            left,
            oc.Task.relative_pose(baxter, LEFT, RIGHT),
        ),
    ]
    for stack in stacks:
        shape = (len(q), stack.m, baxter.n)
        several = stack.batched_frame_jacobian(q)[0].reshape(shape), stack.batched_jacobian(q)[0].reshape(shape)
        for rows, J in zip(*several, strict=True):
            combined = J @ np.linalg.pinv(rows)
            np.testing.assert_allclose(combined @ rows, J, atol=1e-9)
            assert np.linalg.matrix_rank(combined) == stack.m
