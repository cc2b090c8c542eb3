"""Symbolic kinematics and dynamics against Pinocchio's numbers, and what robots are refused."""

import dataclasses
from pathlib import Path

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from conftest import ROBOTS, arm, pinocchio_position, robot_data

import orthocas as oc
from orthocas.errors import InvalidValueError, OrthocasError, RobotError, ShapeError, UnknownNameError
from orthocas.problems.iiwa import robot as iiwa_robot
from orthocas.robots import files
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
    robot = oc.Robot.from_urdf(robot_data("panda_description/urdf/panda.urdf"), "panda_hand")
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


def test_mimic_joint_on_the_way_names_the_joint_to_lock() -> None:
    path = robot_data("panda_description/urdf/panda.urdf")
    remedy = r"locked=\{'panda_finger_joint1': 0.0\} or --lock panda_finger_joint1=0"
    with pytest.raises(RobotError, match=f"panda_finger_joint2.*mimic.*{remedy}"):
        oc.Robot.from_urdf(path, "panda_rightfinger")
    with pytest.raises(RobotError, match=f"'panda_finger_joint2' mimics joint 'panda_finger_joint1'.*{remedy}"):
        oc.Robot.from_urdf(path, "panda_rightfinger", {"panda_finger_joint2": 0.0})
    finger = oc.Robot.from_urdf(path, "panda_rightfinger", {"panda_finger_joint1": 0.03})
    hand = oc.Robot.from_urdf(path, "panda_hand")
    q = np.full(7, 0.3)
    assert finger.joint_names == hand.joint_names == tuple(f"panda_joint{k}" for k in range(1, 8))
    offset = hand.tip_rotation(q).T @ (finger.tip_position(q) - hand.tip_position(q))
    np.testing.assert_allclose(offset, [0, -0.03, 0.0584], atol=1e-12)  # the mimic joint follows its leader


def test_joints_off_the_way_are_locked_next_to_zero_and_those_of_the_user_where_asked() -> None:
    path = robot_data("panda_description/urdf/panda.urdf")
    q = np.full(7, 0.3)
    model = files.lock_joints(files.read_urdf(path), {"panda_finger_joint1": 0.0})
    want = oc.Robot.from_model(model, "panda_hand").mass_matrix(q)
    np.testing.assert_allclose(oc.Robot.from_urdf(path, "panda_hand").mass_matrix(q), want, atol=1e-12)
    opened = oc.Robot.from_urdf(path, "panda_hand", {"panda_finger_joint1": 0.04}).mass_matrix(q)
    assert np.abs(opened - want).max() > 1e-5


def test_locked_joint_on_the_way_to_the_tip_stays_where_it_is() -> None:
    path = robot_data("tiago_description/robots/tiago.urdf")
    free = oc.Robot.from_file(path, "arm_tool_link")
    locked = oc.Robot.from_file(path, "arm_tool_link", {"torso_lift_joint": 0.2, "arm_4_joint": 1.0})
    assert set(free.joint_names) - set(locked.joint_names) == {"torso_lift_joint", "arm_4_joint"}
    q = np.linspace(0.1, 0.9, free.n)
    q[[free.joint_names.index(name) for name in ("torso_lift_joint", "arm_4_joint")]] = 0.2, 1.0
    rest = q[[name in locked.joint_names for name in free.joint_names]]
    np.testing.assert_allclose(locked.tip_position(rest), free.tip_position(q), atol=1e-12)


def test_floating_base_on_the_way_is_locked_by_zero(tmp_path: Path) -> None:
    path = tmp_path / "humanoid.xml"
    path.write_text(
        """<mujoco><worldbody><body name="trunk" pos="0 0 1"><freejoint name="root"/>
        <geom type="sphere" size="0.1" mass="5"/>
        <body name="a"><joint name="j1" type="hinge" axis="0 0 1"/>
        <geom type="capsule" size="0.05" fromto="0 0 0 1 0 0" mass="2"/>
        <body name="hand" pos="1 0 0"><joint name="j2" type="hinge" axis="0 0 1"/>
        <geom type="sphere" size="0.1" mass="1"/></body></body>
        <body name="b"><joint name="ball" type="ball"/><geom type="sphere" size="0.1" mass="1"/></body>
        </body></worldbody></mujoco>"""
    )
    with pytest.raises(RobotError, match=r"'root' .*6 degrees of freedom.*locked=\{'root': 0.0\} or --lock root=0"):
        oc.Robot.from_file(path, "hand")
    with pytest.raises(
        RobotError, match="locked position of joint 'root' is 0.5, expected 0: .*only be locked at its neutral"
    ):
        oc.Robot.from_file(path, "hand", {"root": 0.5})
    robot = oc.Robot.from_file(path, "hand", {"root": 0.0})
    assert robot.joint_names == ("j1", "j2")
    np.testing.assert_allclose(robot.tip_position(np.array([np.pi / 2, 0.3]))[:2], [0, 1], atol=1e-12)


def test_misspelled_tip_gets_the_similar_names_first() -> None:
    with pytest.raises(UnknownNameError, match="unknown frame 'panda_hnd', known: panda_hand, "):
        oc.Robot.from_urdf(robot_data("panda_description/urdf/panda.urdf"), "panda_hnd")


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
        oc.Robot.from_urdf(robot_data("tiago_description/robots/tiago.urdf"))


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
    robot = oc.Robot.from_urdf(one_joint(tmp_path, joint="a"), "a")
    assert robot.joint_names == ("a",)


def test_limits_the_wrong_way_round_are_refused(tmp_path: Path) -> None:
    with pytest.raises(RobotError, match="joint 'j' has limits"):
        oc.Robot.from_urdf(one_joint(tmp_path, lower="2"), "a")


def test_joints_of_any_type_off_the_chain_are_locked_unless_a_model_is_taken_whole(tmp_path: Path) -> None:
    path = one_joint(tmp_path)
    floating = (
        """<link name="b"/><joint name="free" type="floating"><parent link="base"/><child link="b"/></joint></robot>"""
    )
    path.write_text(path.read_text().replace("</robot>", floating))
    assert oc.Robot.from_urdf(path, "a").joint_names == ("j",)
    with pytest.raises(RobotError, match="'free' .*--lock free=0"):
        oc.Robot.from_model(files.read_urdf(path), "a")


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


def test_effort_and_velocity_limits_come_from_the_file() -> None:
    robot = oc.Robot.from_urdf(robot_data("panda_description/urdf/panda.urdf"), "panda_hand")
    np.testing.assert_array_equal(robot.effort_limits, [87, 87, 87, 87, 12, 12, 12])
    np.testing.assert_array_equal(robot.velocity_limits, [2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61])
    wrist = oc.Robot.from_urdf(
        robot_data("panda_description/urdf/panda.urdf"), "panda_hand", dict.fromkeys(robot.joint_names[:4], -0.5)
    )
    np.testing.assert_array_equal(wrist.effort_limits, [12, 12, 12])  # locking joints keeps the others' limits
    assert np.isinf(oc.Robot.planar([1.0, 1.0], [1.0, 1.0]).velocity_limits).all()


@pytest.mark.parametrize("name", [name for name in ROBOTS if "continuous" not in name])  # its file has no limits
def test_limits_of_effort_and_velocity_of_real_files_are_pinocchios(name: str) -> None:
    model, tip = arm(name)
    robot = oc.Robot.from_model(model, tip)
    np.testing.assert_array_equal(robot.effort_limits, model.effortLimit)
    np.testing.assert_array_equal(robot.velocity_limits, model.velocityLimit)
    assert np.isfinite(robot.effort_limits).all()
    for changed in (robot.with_scaled_masses(2.0), robot.with_tool([0, 0, 0.1])):
        np.testing.assert_array_equal(changed.effort_limits, robot.effort_limits)
        np.testing.assert_array_equal(changed.velocity_limits, robot.velocity_limits)


def test_limits_of_the_iiwa_are_those_of_its_data_sheet(iiwa: oc.Problem) -> None:
    np.testing.assert_array_equal(iiwa.robot.effort_limits, [176, 176, 110, 110, 110, 40, 40])
    np.testing.assert_allclose(np.degrees(iiwa.robot.velocity_limits), [98, 98, 100, 130, 140, 180, 180])
    facts = iiwa.robot.facts()
    assert (facts["effort"], facts["velocity"][:11]) == ("176, 176, 110, 110, 110, 40, 40", "1.71, 1.71,")
    assert "effort" not in oc.Robot.planar([1.0], [1.0]).facts()


@pytest.mark.parametrize("what", ["effort", "velocity"])
def test_negative_limits_are_refused_by_name(tmp_path: Path, what: str) -> None:
    path = one_joint(tmp_path)
    path.write_text(path.read_text().replace(f'{what}="1"', f'{what}="-7"'))
    with pytest.raises(RobotError, match=rf"arm\.urdf: {what} of <limit> of joint 'j' is '-7', expected a number >= 0"):
        oc.Robot.from_urdf(path, "a")


def test_limits_of_a_model_are_not_nan() -> None:
    model = planar_model([1.0, 1.0], [1.0, 1.0])
    model.effortLimit = np.array([1.0, np.nan])
    with pytest.raises(RobotError, match="joint 'q2' has the effort limit nan, expected a number >= 0"):
        oc.Robot.from_model(model, "tip")


@pytest.mark.parametrize(
    ("written", "effort", "velocity"),
    [
        ('effort="0" velocity="0"', np.inf, np.inf),
        ('effort="7" velocity="0"', 7, np.inf),
        ('effort="1e300" velocity="3"', np.inf, 3),
    ],
)
def test_limits_of_nothing_are_unknown(tmp_path: Path, written: str, effort: float, velocity: float) -> None:
    path = one_joint(tmp_path)
    path.write_text(path.read_text().replace('effort="1" velocity="1"', written))
    robot = oc.Robot.from_urdf(path, "a")
    assert (robot.effort_limits[0], robot.velocity_limits[0]) == (effort, velocity)


def test_effort_limits_must_be_positive() -> None:
    tree = oc.Robot.planar([1.0, 1.0], [1.0, 1.0]).tree
    for bad in (-1.0, 0.0, np.nan):
        with pytest.raises(RobotError, match="joint 'q2' has the effort limit"):
            dataclasses.replace(tree, effort_limits=np.array([1.0, bad]))


@pytest.mark.slow
def test_tool_moves_the_tip_as_a_transform_of_the_old_one() -> None:
    path = robot_data("panda_description/urdf/panda.urdf")
    hand = oc.Robot.from_urdf(path, "panda_hand")
    q = np.random.default_rng(2).uniform(-1, 1, (20, 7))
    R, p = hand.tip_rotation(q), hand.tip_position(q)
    angles = np.array([0.3, -0.4, 1.2])
    turn = pin.rpy.rpyToMatrix(angles)
    offset = np.array([0.01, -0.02, 0.15])
    full = np.eye(4)
    full[:3, :3], full[:3, 3] = turn, offset
    for tool, rotation in ((offset, np.eye(3)), (np.concatenate([offset, angles]), turn), (full, turn)):
        for robot in (hand.with_tool(tool), oc.Robot.from_urdf(path, "panda_hand", tool=tool)):
            np.testing.assert_allclose(robot.tip_position(q), p + R @ offset, atol=1e-12)
            np.testing.assert_allclose(robot.tip_rotation(q), R @ rotation, atol=1e-12)
            np.testing.assert_array_equal(robot.mass_matrix(q), hand.mass_matrix(q))  # no mass
            assert robot.tree.tip_name == "panda_hand + tool"
    tcp = oc.Robot.from_urdf(path, "panda_hand_tcp")
    np.testing.assert_allclose(hand.with_tool((0, 0, 0.1034)).tip_position(q), tcp.tip_position(q), atol=1e-12)


def test_bad_tools_are_refused() -> None:
    robot = oc.Robot.planar([1.0, 1.0], [1.0, 1.0])
    with pytest.raises(InvalidValueError, match=r"shape of tool is \(2,\), expected \(3,\), \(6,\) or \(4, 4\)"):
        robot.with_tool([0.1, 0.2])
    with pytest.raises(InvalidValueError, match="rotation of tool"):
        robot.with_tool(2 * np.eye(4) - np.diag([0, 0, 0, 1]))
    with pytest.raises(InvalidValueError, match="last row of tool"):
        robot.with_tool(np.ones((4, 4)))
    with pytest.raises(InvalidValueError, match=r"tool\[1\] is nan"):
        robot.with_tool([0.0, np.nan, 0.0])


def test_homes_come_from_the_srdf_file_of_a_urdf() -> None:
    panda = oc.Robot.from_urdf(robot_data("panda_description/urdf/panda.urdf"), "panda_hand")
    want = [0, -0.785398, 0, -2.35619, 0, 1.5707, 0.785398]
    np.testing.assert_allclose(panda.home("default"), want, atol=1e-6)
    xarm = oc.Robot.from_urdf(robot_data("xarm_description/urdf/xarm7.urdf"), "link_eef")
    assert set(xarm.homes) == {"home", "hold-up"}
    np.testing.assert_array_equal(xarm.home("hold-up"), [0, 0, 0, 0, 0, -1.5708, 0])
    kinova = oc.Robot.from_urdf(robot_data("kinova_description/robots/kinova.urdf"), "j2s6s200_end_effector")
    np.testing.assert_array_equal(kinova.home("arm_up"), [1.5707, 2.618, -1.5707, 3.1415, 2.618, 0])
    with pytest.raises(UnknownNameError, match="unknown home 'up', known: home, hold-up"):
        xarm.home("up")
    with pytest.raises(UnknownNameError, match="the robot's files name no posture"):
        iiwa_robot().home("up")
    assert set(panda.with_tool((0, 0, 0.1)).with_scaled_masses(2.0).homes) == {"default"}


def test_homes_leave_out_locked_joints_and_states_of_other_joints(tmp_path: Path) -> None:
    path = robot_data("panda_description/urdf/panda.urdf")
    robot = oc.Robot.from_urdf(path, "panda_hand", {"panda_joint3": 0.1})
    np.testing.assert_allclose(robot.home("default"), [0, -0.785398, -2.35619, 0, 1.5707, 0.785398], atol=1e-6)
    assert oc.Robot.from_urdf(path, "panda_hand").homes.keys() == {"default"}
    own = one_joint(tmp_path)
    (tmp_path / "arm.srdf").write_text(
        """<robot name="r"><group_state name="up" group="arm"><joint name="j" value="0.5"/></group_state>
        <group_state name="open" group="hand"><joint name="finger" value="0.5"/></group_state>
        <group_state name="odd" group="arm"><joint name="j" value="0 0 0"/></group_state></robot>"""
    )
    assert list(oc.Robot.from_urdf(own, "a").homes) == ["up"]
    (tmp_path / "arm.srdf").write_text("<robot")
    with pytest.raises(RobotError, match=r"arm\.srdf is not an SRDF file"):
        oc.Robot.from_urdf(own, "a")


def test_homes_come_from_the_keyframes_of_an_mjcf_file(tmp_path: Path) -> None:
    path = tmp_path / "arm.xml"
    path.write_text(
        """<mujoco><worldbody><body name="trunk"><freejoint name="root"/><geom type="sphere" size="0.1" mass="5"/>
        <body name="a"><joint name="j1" type="hinge" axis="0 0 1"/>
        <geom type="capsule" size="0.05" fromto="0 0 0 1 0 0" mass="2"/>
        <body name="hand" pos="1 0 0"><joint name="j2" type="slide" axis="0 0 1"/>
        <geom type="sphere" size="0.1" mass="1"/></body></body></body></worldbody>
        <keyframe><key name="ready" qpos="0 0 1 1 0 0 0 0.5 0.2"/></keyframe></mujoco>"""
    )
    robot = oc.Robot.from_mjcf(path, "hand", {"root": 0.0})
    assert list(robot.homes) == ["ready"]
    np.testing.assert_allclose(robot.home("ready"), [0.5, 0.2])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"joint_names": ("a", "b", 3)}, r"joint_names\[2\] is 3, expected printable text"),
        ({"joint_names": ("a", "b", "a")}, "two joints are called 'a'"),
        ({"joint_names": ("a", "b", "c\x1b[2J")}, r"joint_names\[2\] is .*, expected printable text"),
        ({"parents": (-1, 0, 1.0)}, r"parents\[2\] is 1.0, expected an index from -1 to 1"),
        ({"parents": (-1, 0, True)}, r"parents\[2\] is True, expected an index"),
        ({"joint_kinds": ("revolute", "revolute", [])}, "unknown joint kind"),
        ({"lower": np.array([1j, 0, 0])}, "lower is .*, expected an array of numbers"),
    ],
)
def test_names_and_numbers_that_no_robot_has_are_refused(change: dict[str, object], message: str) -> None:
    tree = oc.Robot.planar([1.0] * 3, [1.0] * 3).tree
    with pytest.raises(OrthocasError, match=message):
        dataclasses.replace(tree, **change)


def test_slightly_indefinite_inertias_of_published_robots_are_accepted() -> None:
    """The hip of romeo_laas_small has -7 % of its largest entry, and a positive definite mass matrix."""
    robot = oc.Robot.from_urdf(robot_data("romeo_description/urdf/romeo_laas_small.urdf"), "RKneePitch_link")
    assert np.linalg.eigvalsh(robot.tree.inertias)[:, 0].min() < -1e-3
    assert np.linalg.eigvalsh(robot.mass_matrix(np.zeros(robot.n)))[0] > 0
