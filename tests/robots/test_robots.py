"""Symbolic kinematics and dynamics against Pinocchio's numbers, and joints that are locked."""

from pathlib import Path

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from conftest import ROBOTS, arm, pinocchio_position, robot_data

import orthocas as oc
from orthocas.errors import InvalidValueError, RobotError
from orthocas.problems import iiwa_robot
from orthocas.robots import pinocchio_model, urdf


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


def test_mimic_joint_that_is_to_be_locked_names_the_joint_to_lock() -> None:
    path = robot_data("panda_description/urdf/panda.urdf")
    suggest_lock = r"locked=\{'panda_finger_joint1': 0.0\} or --lock panda_finger_joint1=0"
    with pytest.raises(RobotError, match=f"'panda_finger_joint2' mimics joint 'panda_finger_joint1'.*{suggest_lock}"):
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
    model, mimics = urdf.read_urdf(path)
    model = pinocchio_model.lock_joints(model, {"panda_finger_joint1": 0.0}, mimics)
    want = oc.Robot.from_model(model, "panda_hand").mass_matrix(q)
    np.testing.assert_allclose(oc.Robot.from_urdf(path, "panda_hand").mass_matrix(q), want, atol=1e-12)
    opened = oc.Robot.from_urdf(path, "panda_hand", {"panda_finger_joint1": 0.04}).mass_matrix(q)
    assert np.abs(opened - want).max() > 1e-5


def robot_with_arms(arms: int) -> tuple[oc.Robot, pin.Model]:
    """A torso with arms of three joints."""
    model, rng = pin.Model(), np.random.default_rng(4)

    def add(parent: int, axis: int) -> int:
        name, joint = f"j{model.njoints}", pin.JointModelRevoluteUnaligned(np.eye(3)[axis])
        joint_id = int(model.addJoint(parent, joint, pin.SE3(np.eye(3), rng.normal(size=3)), name))
        model.appendBodyToJoint(joint_id, pin.Inertia.Random(), pin.SE3.Identity())
        return joint_id

    torso = add(0, 2)
    for _ in range(arms):
        hand = add(add(add(torso, 2), 1), 0)
    model.addFrame(pin.Frame("tip", hand, pin.SE3.Identity(), pin.FrameType.OP_FRAME))
    return oc.Robot.from_model(model, "tip"), model


def test_operations_of_forward_dynamics_grow_linearly_with_the_branches() -> None:
    operations = []
    for arms in (1, 3, 5):
        robot, model = robot_with_arms(arms)
        function = robot.function("forward_dynamics").expand()
        operations.append(function.n_instructions())
        state = np.random.default_rng(5).normal(size=(3, robot.n))
        want = pin.aba(model, model.createData(), *state)
        np.testing.assert_allclose(robot.forward_dynamics(*state), want, rtol=1e-10, atol=1e-10 * np.abs(want).max())
    assert operations[2] - operations[1] == pytest.approx(operations[1] - operations[0], rel=0.05)


def test_coriolis_product_of_many_joints_is_two_calls_of_the_bias() -> None:
    robot, model = robot_with_arms(5)
    q, v, w = np.random.default_rng(6).normal(size=(3, robot.n))
    want = pin.computeCoriolisMatrix(model, model.createData(), q, v) @ w
    np.testing.assert_allclose(robot.coriolis_product(q, v, w), want, atol=1e-10 * np.abs(want).max())
    payload = np.array([2.0, 0.1, 0.2, 0.3, 0.5, 0.0, 0.0, 0.5, 0.0, 0.5])
    found = robot.function("coriolis_product_with_payload")(q, v, w, payload).full().ravel()
    want = robot.with_payload(payload).coriolis_product(q, v, w)
    np.testing.assert_allclose(found, want, atol=1e-10 * np.abs(want).max())
    assert robot.function("coriolis_product").n_instructions() < 20


def test_locked_joint_on_the_way_to_the_tip_stays_where_it_is() -> None:
    path = robot_data("tiago_description/robots/tiago.urdf")
    free = oc.Robot.from_file(path, "arm_tool_link")
    locked = oc.Robot.from_file(path, "arm_tool_link", {"torso_lift_joint": 0.2, "arm_4_joint": 1.0})
    assert set(free.joint_names) - set(locked.joint_names) == {"torso_lift_joint", "arm_4_joint"}
    q = np.linspace(0.1, 0.9, free.n)
    q[[free.joint_names.index(name) for name in ("torso_lift_joint", "arm_4_joint")]] = 0.2, 1.0
    rest = q[[name in locked.joint_names for name in free.joint_names]]
    np.testing.assert_allclose(locked.tip_position(rest), free.tip_position(q), atol=1e-12)


def test_a_joint_is_locked_within_its_limits_only() -> None:
    """The file of panda says [-3.0718, -0.0698] for joint 4; its rounded last digits are no error."""
    path = robot_data("panda_description/urdf/panda.urdf")
    for value in (-3.0718, -0.0698, -0.0698 + 1e-7):
        assert oc.Robot.from_urdf(path, "panda_hand", {"panda_joint4": value}).n == 6
    for joint, value in (("panda_joint4", 0.5), ("panda_joint4", 0.0), ("panda_finger_joint1", 20.0)):
        with pytest.raises(InvalidValueError, match=rf"'{joint}' is {value:g}, expected a position within its limits"):
            oc.Robot.from_urdf(path, "panda_hand", {joint: value})


def test_floating_base_of_a_file_is_held_where_the_file_puts_it(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """As files of humanoids have it for MuJoCo; with base='floating' it moves."""
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
    robot = oc.Robot.from_file(path, "hand")
    assert "the base floats in the file (joint 'root') and is held: base='floating' lets it move" in caplog.text
    assert robot.joint_names == ("j1", "j2")
    np.testing.assert_allclose(robot.tip_position([np.pi / 2, 0.3]), [0, 1, 1], atol=1e-12)
    caplog.clear()
    assert oc.Robot.from_file(path, "hand", base="floating").n == 8
    with pytest.raises(
        RobotError, match="locked position of joint 'root' is 0.5, expected 0: .*only be locked at its neutral"
    ):
        oc.Robot.from_file(path, "hand", {"root": 0.5})
    robot = oc.Robot.from_file(path, "hand", {"root": 0.0})
    assert robot.joint_names == ("j1", "j2")
    np.testing.assert_allclose(robot.tip_position(np.array([np.pi / 2, 0.3]))[:2], [0, 1], atol=1e-12)


def test_slightly_indefinite_inertias_of_published_robots_are_accepted() -> None:
    """The hip of romeo_laas_small has -7 % of its largest entry, and a positive definite mass matrix."""
    robot = oc.Robot.from_urdf(robot_data("romeo_description/urdf/romeo_laas_small.urdf"), "RKneePitch_link")
    assert np.linalg.eigvalsh(robot.tree.inertias)[:, 0].min() < -1e-3
    assert np.linalg.eigvalsh(robot.mass_matrix(np.zeros(robot.n)))[0] > 0


LATE_LEADER = """<robot name="r"><link name="base"/>
<link name="arm"><inertial><mass value="2"/><origin xyz="0.1 0 0.2"/><inertia ixx="0.1" iyy="0.2" izz="0.2"
ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="shoulder" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" effort="9" velocity="3"/></joint>{fingers}</robot>"""
FINGER = """<link name="{name}"><inertial><mass value="0.7"/><origin xyz="0.3 0 0"/><inertia ixx="0.01" iyy="0.02"
izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="{name}_joint" type="{kind}"><parent link="arm"/>
<child link="{name}"/><origin xyz="0 0 0.5" rpy="0 {pitch} 0"/>{rest}</joint>"""
TURNS = '<axis xyz="0 1 0"/><limit lower="0.2" upper="1" effort="9" velocity="3"/>'


def test_joints_that_mimic_a_later_joint_are_locked_where_it_is(tmp_path: Path) -> None:
    """Pinocchio refuses to keep such mimic joints. The same arm with fixed fingers is the reference."""
    path = tmp_path / "arm.urdf"

    def written(*fingers: tuple[str, str, float, str]) -> Path:
        parts = [FINGER.format(name=name, kind=kind, pitch=pitch, rest=rest) for name, kind, pitch, rest in fingers]
        path.write_text(LATE_LEADER.format(fingers="".join(parts)))
        return path

    def mimic(leader: str) -> str:
        return f'{TURNS}<mimic joint="{leader}_joint" multiplier="-2" offset="0.1"/>'

    hand = (("a", "revolute", 0.0, mimic("b")), ("b", "revolute", 0.0, mimic("z")), ("z", "revolute", 0.0, TURNS))
    for locked, leader in (({}, 0.2), ({"z_joint": 0.9}, 0.9)):  # 0.2 is the limit closest to 0
        robot = oc.Robot.from_urdf(written(*hand), "arm", locked)
        follower = 0.1 - 2 * leader
        pitches = (("a", 0.1 - 2 * follower), ("b", follower), ("z", leader))
        fixed = oc.Robot.from_urdf(written(*((name, "fixed", pitch, "") for name, pitch in pitches)), "arm")
        assert robot.joint_names == ("shoulder",)
        np.testing.assert_allclose(robot.mass_matrix([0.3]), fixed.mass_matrix([0.3]), rtol=1e-12)
        np.testing.assert_allclose(robot.gravity([0.3]), fixed.gravity([0.3]), rtol=1e-12)
    assert oc.Robot.from_urdf(written(*hand), "a").mimics == ("a_joint = 4 z_joint -0.1", "b_joint = -2 z_joint +0.1")
    with pytest.raises(RobotError, match="joint 'a_joint' mimics itself"):
        oc.Robot.from_urdf(written(("a", "revolute", 0.0, mimic("b")), ("b", "revolute", 0.0, mimic("a"))), "arm")


@pytest.mark.parametrize(
    ("file", "tip", "n"),
    [
        ("talos_data/robots/talos_full_v2.urdf", "gripper_left_joint", 10),
        ("romeo_description/urdf/romeo.urdf", "l_wrist", 8),
    ],
)
def test_humanoids_with_late_leaders_have_the_dynamics_of_pinocchio(file: str, tip: str, n: int) -> None:
    """Arms in front of hands of mimic joints: M is S^T M S of the file read without mimics, other joints locked."""
    path = robot_data(file)
    robot = oc.Robot.from_urdf(path, tip)
    model = pin.buildModelFromUrdf(str(path))
    data, q = model.createData(), pin.neutral(model)
    for name, value in zip(robot.joint_names, np.linspace(0.1, 0.5, robot.n), strict=True):
        q[model.joints[model.getJointId(name)].idx_q] = value
    pin.framesForwardKinematics(model, data, q)
    placed = data.oMf[model.getFrameId(tip)]
    assert robot.n == n
    np.testing.assert_allclose(robot.tip_position(np.linspace(0.1, 0.5, n)), placed.translation, atol=1e-12)
    rows = {name: model.joints[model.getJointId(name)].idx_v for name in list(model.names)[1:]}
    S = np.zeros((model.nv, robot.n))
    S[[rows[name] for name in robot.joint_names], range(robot.n)] = 1.0
    mimics = urdf.read_urdf(path)[1]
    # Others stand at the limit closest to zero, or where they follow their leader.
    for name in [*(name for name in rows if name not in (*robot.joint_names, *mimics)), *mimics]:
        k = model.joints[model.getJointId(name)].idx_q
        q[k] = np.clip(0.0, model.lowerPositionLimit[k], model.upperPositionLimit[k])
        if name in mimics:
            leader, factor, offset = mimics[name]
            q[k] = factor * q[model.joints[model.getJointId(leader)].idx_q] + offset
            S[rows[name]] = factor * S[rows[leader]]
    whole = pin.crba(model, data, q)
    whole = np.triu(whole) + np.triu(whole, 1).T
    np.testing.assert_allclose(robot.mass_matrix(np.linspace(0.1, 0.5, n)), S.T @ whole @ S, rtol=1e-9, atol=1e-12)
