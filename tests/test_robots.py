"""Symbolic kinematics and dynamics against Pinocchio's numbers, and what robots are refused."""

from pathlib import Path

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from conftest import ROBOTS, arm, pinocchio_position, robot_data
from orthocas.problems.iiwa import robot as iiwa_robot

import orthocas as oc
from orthocas.errors import InvalidValueError, RobotError, ShapeError, UnknownNameError
from orthocas.robots.planar import planar_model


@pytest.mark.slow
@pytest.mark.parametrize("name", ROBOTS)
def test_dynamics_and_kinematics_match_pinocchio_on_random_states(name: str) -> None:
    model, tip = arm(name)
    robot = oc.Robot.from_model(model, tip)
    data, frame = model.createData(), model.getFrameId(tip)
    rng = np.random.default_rng(7)
    q, dq, ddq, w = rng.uniform(-2, 2, (4, 100, robot.n))
    M, bias, tau = robot.mass_matrix(q), robot.bias(q, dq), robot.inverse_dynamics(q, dq, ddq)
    gravity, Cw = robot.gravity(q), robot.coriolis_product(q, dq, w)
    position, rotation, J = robot.tip_position(q), robot.tip_rotation(q), robot.tip_jacobian(q)
    for k in range(100):
        p = pinocchio_position(model, q[k])
        want = pin.crba(model, data, p)
        scale = max(1.0, np.abs(want).max())
        np.testing.assert_allclose(M[k], np.triu(want) + np.triu(want, 1).T, atol=1e-10 * scale)
        for got, force in (
            (bias[k], pin.nonLinearEffects(model, data, p, dq[k])),
            (gravity[k], pin.computeGeneralizedGravity(model, data, p)),
            (tau[k], pin.rnea(model, data, p, dq[k], ddq[k])),
            (Cw[k], pin.computeCoriolisMatrix(model, data, p, dq[k]) @ w[k]),
        ):
            np.testing.assert_allclose(got, force, atol=1e-10 * max(1.0, np.abs(force).max()))
        pin.framesForwardKinematics(model, data, p)
        np.testing.assert_allclose(position[k], data.oMf[frame].translation, atol=1e-10)
        np.testing.assert_allclose(rotation[k], data.oMf[frame].rotation, atol=1e-10)
        want = pin.computeFrameJacobian(model, data, p, frame, pin.LOCAL_WORLD_ALIGNED)
        np.testing.assert_allclose(J[k], want, atol=1e-10)


def test_iiwa_flange_agrees_with_closed_dh_form() -> None:
    robot = iiwa_robot()

    def rz(a: float) -> np.ndarray:
        return np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])

    def ry(a: float) -> np.ndarray:
        return np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])

    for q in np.random.default_rng(3).uniform(-2, 2, (50, 7)):
        upper = rz(q[0]) @ ry(q[1])
        fore = upper @ rz(q[2]) @ ry(-q[3])
        hand = fore @ rz(q[4]) @ ry(q[5])
        z = np.array([0, 0, 1])
        want = 0.34 * z + 0.4 * upper @ z + 0.4 * fore @ z + 0.126 * hand @ z
        np.testing.assert_allclose(robot.tip_position(q), want, atol=1e-12)


def test_unaligned_axes_and_prismatic_joints_match_pinocchio() -> None:
    model = pin.Model()
    axis = np.array([1.0, 2.0, -0.5]) / np.linalg.norm([1.0, 2.0, -0.5])
    rng = np.random.default_rng(2)
    parent = 0
    for i, joint in enumerate((pin.JointModelRevoluteUnaligned(axis), pin.JointModelPrismaticUnaligned(axis)) * 2):
        limit = np.full(1, 10.0)
        parent = model.addJoint(parent, joint, pin.SE3.Random(), f"j{i}", limit, limit, -limit, limit)
        model.appendBodyToJoint(parent, pin.Inertia.Random(), pin.SE3.Random())
    model.addFrame(pin.Frame("tip", parent, pin.SE3.Random(), pin.FrameType.OP_FRAME))
    model.armature = np.array([0.1, 0.2, 0.3, 0.4])
    robot, data = oc.Robot.from_model(model, "tip"), model.createData()
    for q, dq, ddq in rng.uniform(-2, 2, (20, 3, 4)):
        want = pin.crba(model, data, q)
        np.testing.assert_allclose(robot.mass_matrix(q), np.triu(want) + np.triu(want, 1).T, atol=1e-10)
        np.testing.assert_allclose(robot.inverse_dynamics(q, dq, ddq), pin.rnea(model, data, q, dq, ddq), atol=1e-9)


def test_mass_matrix_matches_kinetic_energy_hessian() -> None:
    robot = oc.Robot.planar([1.0, 0.7], [3.0, 2.0])
    q = np.array([0.3, -1.1])

    def energy(dq: np.ndarray) -> float:
        """Two rods: translation of the centres and rotation about them."""
        a1, a2 = q[0], q[0] + q[1]
        w1, w2 = dq[0], dq[0] + dq[1]
        v1 = 0.5 * w1 * np.array([-np.sin(a1), np.cos(a1)])
        v2 = w1 * np.array([-np.sin(a1), np.cos(a1)]) + 0.35 * w2 * np.array([-np.sin(a2), np.cos(a2)])
        spin = 3.0 / 12 * w1**2 + 2.0 * 0.49 / 12 * w2**2
        return float(0.5 * (3.0 * v1 @ v1 + 2.0 * v2 @ v2 + spin))

    e1, e2 = np.eye(2)
    cross = energy(e1 + e2) - energy(e1) - energy(e2)
    want = np.array([[2 * energy(e1), cross], [cross, 2 * energy(e2)]])
    np.testing.assert_allclose(robot.mass_matrix(q), want, atol=1e-12)


def test_planar_gravity_acts_along_minus_y() -> None:
    robot = oc.Robot.planar([1.0], [2.0])
    np.testing.assert_allclose(robot.gravity(np.zeros(1)), [2.0 * 9.81 * 0.5], atol=1e-12)
    np.testing.assert_allclose(robot.gravity(np.array([np.pi / 2])), [0.0], atol=1e-12)


def test_same_kind_comes_out_as_went_in() -> None:
    robot = oc.Robot.planar([1.0, 1.0], [1.0, 1.0])
    assert isinstance(robot.mass_matrix(ca.SX.sym("q", 2)), ca.SX)
    assert isinstance(robot.bias(ca.MX.sym("q", 2), ca.MX.sym("dq", 2)), ca.MX)
    assert robot.mass_matrix(np.zeros(2)).shape == (2, 2)
    assert robot.mass_matrix(np.zeros((5, 2))).shape == (5, 2, 2)
    assert robot.bias(np.zeros((5, 2)), np.zeros((5, 2))).shape == (5, 2)


def test_symbolic_gravity_is_gradient_of_potential_energy() -> None:
    robot = oc.Robot.planar([1.0, 1.0, 1.0], [3.0, 3.0, 3.0])
    q0, step = np.array([0.4, -0.7, 1.1]), 1e-6

    def potential(q: np.ndarray) -> float:
        a = np.cumsum(q)
        heights = np.concatenate([[0.0], np.cumsum(np.sin(a))])
        return float(3.0 * 9.81 * np.sum(heights[:-1] + 0.5 * np.sin(a)))

    want = [(potential(q0 + step * e) - potential(q0 - step * e)) / (2 * step) for e in np.eye(3)]
    np.testing.assert_allclose(robot.gravity(q0), want, atol=1e-6)


def test_locking_a_joint_keeps_the_mass_it_carries() -> None:
    path = robot_data("panda_description/urdf/panda.urdf")
    open_hand = oc.Robot.from_urdf(path, "panda_hand", {"panda_finger_joint1": 0.04})
    closed_hand = oc.Robot.from_urdf(path, "panda_hand", {"panda_finger_joint1": 0.0})
    q = np.full(7, 0.3)
    assert open_hand.n == closed_hand.n == 7
    difference = np.abs(open_hand.mass_matrix(q) - closed_hand.mass_matrix(q)).max()
    assert 1e-5 < difference < 1e-1  # the fingers moved, so the inertia did


def test_continuous_joints_are_one_angle_without_limits() -> None:
    robot = oc.Robot.from_urdf(robot_data(ROBOTS["double pendulum, continuous"][0]))
    assert robot.n == 2
    assert np.isinf(robot.upper).all()


def test_limits_come_from_the_file() -> None:
    robot = oc.Robot.chain_from_file(robot_data("panda_description/urdf/panda.urdf"), "panda_hand")
    np.testing.assert_allclose(robot.upper[3], -0.0698, atol=1e-12)


def test_mjcf_files_are_read(tmp_path: Path) -> None:
    path = tmp_path / "arm.xml"
    path.write_text(
        """<mujoco><worldbody><body name="a"><joint name="j1" type="hinge" axis="0 0 1"/>
        <geom type="capsule" size="0.05" fromto="0 0 0 1 0 0" mass="2"/>
        <body name="b" pos="1 0 0"><joint name="j2" type="slide" axis="1 0 0"/>
        <geom type="sphere" size="0.1" mass="1"/></body></body></worldbody></mujoco>"""
    )
    robot = oc.Robot.from_mjcf(path, "b")
    assert robot.tree.joint_kinds == ("revolute", "prismatic")
    np.testing.assert_allclose(robot.tip_position(np.array([np.pi / 2, 0.5])), [0, 1.5, 0], atol=1e-12)


@pytest.mark.parametrize(("angle", "hinge"), [("", 90.0), ('<compiler angle="radian"/>', np.pi / 2)])
def test_ranges_of_mjcf_slides_are_metres(tmp_path: Path, angle: str, hinge: float) -> None:
    path = tmp_path / "arm.xml"
    path.write_text(
        f"""<mujoco>{angle}<worldbody><body name="a"><joint name="j1" type="slide" axis="0 1 1" range="-0.5 2"/>
        <geom type="sphere" size="0.1" mass="2"/>
        <body name="b" pos="1 0 0"><joint name="j2" type="hinge" axis="0 0 1" range="-{hinge} {hinge}"/>
        <geom type="sphere" size="0.1" mass="1"/></body></body></worldbody></mujoco>"""
    )
    robot = oc.Robot.from_mjcf(path, "b")
    np.testing.assert_allclose(robot.lower, [-0.5, -np.pi / 2])
    np.testing.assert_allclose(robot.upper, [2, np.pi / 2])


def test_mimic_joint_is_refused_by_name() -> None:
    with pytest.raises(RobotError, match="panda_finger_joint2.*mimic"):
        oc.Robot.from_urdf(robot_data("panda_description/urdf/panda.urdf"), "panda_hand")


@pytest.mark.parametrize(
    ("joint", "kind"),
    [
        (pin.JointModelSpherical(), "Spherical"),
        (pin.JointModelFreeFlyer(), "FreeFlyer"),
        (pin.JointModelPlanar(), "Planar"),
    ],
)
def test_joints_with_several_freedoms_are_refused_by_name(joint: object, kind: str) -> None:
    model = pin.Model()
    model.addJoint(0, joint, pin.SE3.Identity(), "odd_joint")
    model.addFrame(pin.Frame("tip", 1, pin.SE3.Identity(), pin.FrameType.OP_FRAME))
    with pytest.raises(RobotError, match=f"odd_joint.*{kind}"):
        oc.Robot.from_model(model, "tip")


def test_helical_joint_is_refused_by_name() -> None:
    model = pin.Model()
    model.addJoint(0, pin.JointModelHZ(0.1), pin.SE3.Identity(), "screw")
    model.addFrame(pin.Frame("tip", 1, pin.SE3.Identity(), pin.FrameType.OP_FRAME))
    with pytest.raises(RobotError, match="screw.*helical"):
        oc.Robot.from_model(model, "tip")


def test_robot_without_joints_is_refused() -> None:
    path = robot_data("ur_description/urdf/ur5_robot.urdf")
    names = oc.Robot.from_urdf(path, "tool0").joint_names
    with pytest.raises(RobotError, match="no movable joint"):
        oc.Robot.from_urdf(path, "tool0", dict.fromkeys(names, 0.0))


def test_unknown_frame_and_joint_list_what_exists() -> None:
    path = robot_data("ur_description/urdf/ur5_robot.urdf")
    with pytest.raises(UnknownNameError, match="unknown frame 'hand'.*tool0"):
        oc.Robot.from_urdf(path, "hand")
    with pytest.raises(UnknownNameError, match="unknown joint 'elbow'.*elbow_joint"):
        oc.Robot.from_urdf(path, "tool0", {"elbow": 0.0})
    with pytest.raises(InvalidValueError, match="elbow_joint.*nan"):
        oc.Robot.from_urdf(path, "tool0", {"elbow_joint": float("nan")})


def test_branching_robot_needs_a_tip() -> None:
    with pytest.raises(RobotError, match="name the tip frame"):
        oc.Robot.chain_from_file(robot_data("tiago_description/robots/tiago.urdf"))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("hello", "not a URDF file"),
        ("<robot><lin", "not a URDF file"),
        ("<sdf/>", "root element is <sdf>"),
        ('<robot name="a"><link name="b"/><joint name="j" type="revolute"/></robot>', "not a usable URDF"),
    ],
)
def test_malformed_urdf_gets_one_clear_error(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], text: str, message: str
) -> None:
    path = tmp_path / "bad.urdf"
    path.write_text(text)
    with pytest.raises(RobotError, match=message):
        oc.Robot.from_urdf(path)
    assert capfd.readouterr().err == ""  # the C++ parser's own lines are part of the message instead


ARM = """<robot name="r"><link name="base"/>
<link name="a"><inertial><mass value="{mass}"/>
<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
<joint name="{joint}" type="{kind}"><parent link="base"/><child link="a"/><axis xyz="0 0 1"/>
<limit lower="{lower}" upper="1" effort="1" velocity="1"/></joint></robot>"""


def one_joint(folder: Path, mass: str = "1", joint: str = "j", kind: str = "revolute", lower: str = "-1") -> Path:
    path = folder / "arm.urdf"
    path.write_text(ARM.format(mass=mass, joint=joint, kind=kind, lower=lower))
    return path


@pytest.mark.parametrize(("mass", "message"), [("nan", "mass"), ("abc", "mass"), ("-1", "mass -1 kg, expected >= 0")])
def test_broken_inertias_are_not_swallowed(tmp_path: Path, mass: str, message: str) -> None:
    with pytest.raises(RobotError, match=message):
        oc.Robot.from_urdf(one_joint(tmp_path, mass=mass), "a")


def test_link_and_joint_may_share_a_name(tmp_path: Path) -> None:
    robot = oc.Robot.chain_from_file(one_joint(tmp_path, joint="a"), "a")
    assert robot.joint_names == ("a",)


def test_limits_the_wrong_way_round_are_refused(tmp_path: Path) -> None:
    with pytest.raises(RobotError, match="joint 'j' has limits"):
        oc.Robot.from_urdf(one_joint(tmp_path, lower="2"), "a")


def test_joints_of_any_type_off_the_chain_are_locked(tmp_path: Path) -> None:
    path = one_joint(tmp_path)
    floating = (
        """<link name="b"/><joint name="free" type="floating"><parent link="base"/><child link="b"/></joint></robot>"""
    )
    path.write_text(path.read_text().replace("</robot>", floating))
    assert oc.Robot.chain_from_file(path, "a").joint_names == ("j",)
    with pytest.raises(RobotError, match="free"):
        oc.Robot.from_urdf(path, "a")


def test_locked_must_be_a_mapping_to_numbers() -> None:
    path = robot_data("ur_description/urdf/ur5_robot.urdf")
    with pytest.raises(InvalidValueError, match="mapping"):
        oc.Robot.from_urdf(path, "tool0", ["elbow_joint"])  # type: ignore[arg-type]
    with pytest.raises(InvalidValueError, match="elbow_joint"):
        oc.Robot.from_urdf(path, "tool0", {"elbow_joint": "x"})  # type: ignore[dict-item]


def test_long_lists_of_names_are_cut_to_the_nearest() -> None:
    with pytest.raises(UnknownNameError, match="gripper_left_base_link.*and .* more") as caught:
        oc.Robot.from_urdf(robot_data("talos_data/robots/talos_reduced.urdf"), "gripper_left_base_lin")
    assert len(str(caught.value)) < 1000  # the robot has 170 frames


def test_missing_urdf_names_the_path(tmp_path: Path) -> None:
    with pytest.raises(RobotError, match=r"nowhere\.urdf: No such file"):
        oc.Robot.from_urdf(tmp_path / "nowhere.urdf")


def test_wrong_shapes_and_nan_are_refused() -> None:
    robot = oc.Robot.planar([1.0, 1.0], [1.0, 1.0])
    with pytest.raises(ShapeError, match=r"q has shape \(3,\), expected \(2,\)"):
        robot.mass_matrix(np.zeros(3))
    with pytest.raises(InvalidValueError, match="finite"):
        robot.mass_matrix(np.array([0.0, np.nan]))
    with pytest.raises(ShapeError):
        robot.mass_matrix(ca.SX.sym("q", 3))
    with pytest.raises(ShapeError):
        robot.bias(np.zeros((2, 2)), np.zeros((3, 2)))
    with pytest.raises(InvalidValueError, match="array of numbers"):
        robot.mass_matrix("abc")


def test_bad_planar_arms_are_refused() -> None:
    with pytest.raises(ShapeError, match="masses"):
        planar_model([1.0, 1.0], [1.0])
    with pytest.raises(InvalidValueError, match="lengths"):
        planar_model([1.0, -1.0], [1.0, 1.0])
