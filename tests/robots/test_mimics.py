"""Mimic joints on the way to the tip: q_full = S q + s_0, by Pinocchio's own mimic joints and by all joints free."""

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from conftest import robot_data

import orthocas as oc
from orthocas.codegen import check_c
from orthocas.errors import RobotError, UnknownNameError
from orthocas.robots.capsules import fit_capsules
from orthocas.robots.pinocchio_model import Mimic
from orthocas.robots.urdf import read_urdf

LINK = """<link name="{name}"><inertial><mass value="{mass}"/><origin xyz="0.02 0.01 {half}"/>
<inertia ixx="0.02" iyy="0.03" izz="0.01" ixy="0.001" ixz="0" iyz="0"/></inertial>
<collision><origin xyz="0 0 {half}"/><geometry><cylinder radius="0.04" length="{length}"/></geometry></collision>
</link>"""
JOINT = """<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>
<origin xyz="0 0 {at}" rpy="{tilt} 0 0"/><axis xyz="{axis}"/>
<limit lower="{low}" upper="{high}" effort="50" velocity="{speed}"/>{mimic}</joint>"""
#: an arm of six free joints: joint 3 follows joint 2 at half its speed, a slide follows joint 5, and a rod beside the
#: arm follows joint 2, as the rods of parallelograms do
JOINTS = (
    ("j1", "revolute", "base", "l1", 0.2, "0 0 1", 2.9, ""),
    ("j2", "revolute", "l1", "l2", 0.2, "0 1 0", 2.0, ""),
    ("j3", "revolute", "l2", "l3", 0.25, "0 1 0", 0.8, '<mimic joint="j2" multiplier="-0.5" offset="0.1"/>'),
    ("j4", "revolute", "l3", "l4", 0.25, "1 0 0", 2.9, ""),
    ("j5", "revolute", "l4", "l5", 0.2, "0 1 0", 2.9, ""),
    ("s5", "prismatic", "l5", "l6", 0.1, "0 0 1", 0.2, '<mimic joint="j5" multiplier="0.05" offset="0.02"/>'),
    ("j6", "revolute", "l6", "l7", 0.1, "1 0 0", 2.9, ""),
    ("j7", "revolute", "l7", "l8", 0.1, "0 0 1", 2.9, ""),
    ("rod", "revolute", "l1", "rod_link", 0.1, "0 1 0", 2.9, '<mimic joint="j2" multiplier="1.2"/>'),
)


@pytest.fixture(scope="module")
def arm_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    links = [("base", 1.0), *((child, 2.0 - 0.15 * k) for k, (_, _, _, child, *_) in enumerate(JOINTS))]
    parts = [LINK.format(name=name, mass=mass, half=0.08, length=0.16) for name, mass in links]
    for k, (name, kind, parent, child, at, axis, end, mimic) in enumerate(JOINTS):
        numbers = {"at": at, "tilt": 0.1 * (k % 3), "axis": axis, "low": -end, "high": end, "speed": 2 + k}
        parts.append(JOINT.format(name=name, kind=kind, parent=parent, child=child, mimic=mimic, **numbers))
    path = tmp_path_factory.mktemp("mimics") / "arm.urdf"
    path.write_text(f'<robot name="arm">{"".join(parts)}</robot>')
    return path


@pytest.fixture(scope="module")
def robot(arm_file: Path) -> oc.Robot:
    return oc.Robot.from_urdf(arm_file, "l8")


def test_joints_are_the_free_ones_and_limits_keep_mimic_joints_in_theirs(robot: oc.Robot) -> None:
    assert robot.joint_names == ("j1", "j2", "j4", "j5", "j6", "j7")
    assert robot.mimics == ("j3 = -0.5 j2 +0.1", "s5 = 0.05 j5 +0.02", "rod = 1.2 j2")
    # |0.1 - 0.5 q2| <= 0.8, and |1.2 q2| <= 2.9; the slide, of 7 m/s, would allow joint 5 140 rad/s
    np.testing.assert_allclose([robot.lower[1], robot.upper[1]], [-1.4, 1.8])
    assert robot.velocity_limits[1] == 3.0
    np.testing.assert_allclose([robot.lower[3], robot.upper[3]], [-2.9, 2.9])
    assert "mimic" in robot.facts()


@pytest.mark.parametrize("base", [None, "planar"])
def test_kinematics_and_dynamics_are_those_of_all_joints_free(arm_file: Path, base: str | None) -> None:
    """The file without its mimic elements: J S, S^T M S, S^T (C S dq + g) at q_full = S q + s_0."""
    robot = oc.Robot.from_urdf(arm_file, "l8", base=base)
    whole, mimics = read_urdf(arm_file)
    free = oc.Robot.from_model(whole, "l8", base=base)
    assert mimics["rod"] == Mimic("j2", 1.2, 0.0)
    # S and s_0 by the names of the free robot
    S, s0 = np.zeros((free.n, robot.n)), np.zeros(free.n)
    for row, name in enumerate(free.joint_names):
        leader, factor, s0[row] = mimics.get(name, Mimic(name, 1.0, 0.0))
        S[row, robot.joint_names.index(leader)] = factor
    rng = np.random.default_rng(7)
    for q in np.clip(robot.sample(5, seed=7), -3, 3):
        dq, ddq = rng.normal(size=(2, robot.n))
        Q, dQ, ddQ = S @ q + s0, S @ dq, S @ ddq
        np.testing.assert_allclose(robot.pose(q), free.pose(Q), atol=1e-13)
        np.testing.assert_allclose(robot.pose(q, "l4"), free.pose(Q, "l4"), atol=1e-13)
        np.testing.assert_allclose(robot.tip_jacobian(q), free.tip_jacobian(Q) @ S, atol=1e-13)
        relative = free.frame_jacobian(Q, "l6", "l2") @ S
        np.testing.assert_allclose(robot.frame_jacobian(q, "l6", "l2"), relative, atol=1e-13)
        np.testing.assert_allclose(robot.centre_of_mass(q), free.centre_of_mass(Q), atol=1e-13)
        M = S.T @ free.mass_matrix(Q) @ S
        np.testing.assert_allclose(robot.mass_matrix(q), M, atol=1e-12)
        np.testing.assert_allclose(robot.gravity(q), S.T @ free.gravity(Q), atol=1e-12)
        np.testing.assert_allclose(robot.bias(q, dq), S.T @ free.bias(Q, dQ), atol=1e-11)
        tau = S.T @ free.inverse_dynamics(Q, dQ, ddQ)
        np.testing.assert_allclose(robot.inverse_dynamics(q, dq, ddq), tau, atol=1e-11)
        np.testing.assert_allclose(robot.forward_dynamics(q, dq, tau), ddq, atol=1e-8)


@pytest.mark.parametrize(
    ("kind", "factor", "endless"), [("continuous", -2, True), ("continuous", 0.5, False), ("prismatic", 1, False)]
)
def test_endless_joints_have_one_turn_if_the_next_takes_a_mimic_joint_elsewhere(
    kind: str, factor: float, endless: bool, tmp_path: Path
) -> None:
    """Charts, trackers and C take positions of joints without limits to repeat after a turn."""
    joints = (
        ("j1", "continuous", "base", "l1", ""),
        ("j2", kind, "l1", "l2", f'<mimic joint="j1" multiplier="{factor}"/>'),
        ("j3", "continuous", "l2", "l3", ""),
    )
    parts = [LINK.format(name=name, mass=1, half=0.08, length=0.16) for name in ("base", "l1", "l2", "l3")]
    for name, of, parent, child, mimic in joints:
        numbers = {"at": 0.2, "tilt": 0.3, "axis": "0 1 0", "low": -1e12, "high": 1e12, "speed": 2}
        parts.append(JOINT.format(name=name, kind=of, parent=parent, child=child, mimic=mimic, **numbers))
    (tmp_path / "arm.urdf").write_text(f'<robot name="arm">{"".join(parts)}</robot>')
    robot = oc.Robot.from_urdf(tmp_path / "arm.urdf", "l3")
    end = np.inf if endless else np.pi
    np.testing.assert_array_equal([robot.lower, robot.upper], [[-end, -np.inf], [end, np.inf]])
    turned = np.abs(robot.pose([0.3 + 2 * np.pi, 0.1]) - robot.pose([0.3, 0.1])).max()
    assert (turned < 1e-9) == endless
    with pytest.raises(RobotError, match="a Torus domain: not possible with mimic joints"):
        oc.Problem(robot, oc.Task.position(robot, "x"), domain=oc.Torus(2))


def test_dynamics_are_those_of_mimic_joints_of_pinocchio(arm_file: Path, robot: oc.Robot) -> None:
    model = pin.buildModelFromUrdf(str(arm_file), mimic=True)
    data = model.createData()
    assert model.nq == robot.n
    rng = np.random.default_rng(3)
    for q in robot.sample(5, seed=3):
        dq, ddq = rng.normal(size=(2, robot.n))
        np.testing.assert_allclose(robot.inverse_dynamics(q, dq, ddq), pin.rnea(model, data, q, dq, ddq), atol=1e-11)
        # Columns of M by unit accelerations: with several mimic joints, Pinocchio 4.1's crba differs from its own rnea.
        still = np.zeros(robot.n)
        rest = pin.rnea(model, data, q, still, still)
        M = np.array([pin.rnea(model, data, q, still, unit) - rest for unit in np.eye(robot.n)]).T
        np.testing.assert_allclose(robot.mass_matrix(q), M, atol=1e-11)


def test_finger_that_mimics_the_other_one_opens_and_locks(tmp_path: Path) -> None:
    path = robot_data("panda_description/urdf/panda.urdf")
    robot = oc.Robot.from_urdf(path, "panda_rightfinger")
    assert robot.n == 8
    q = np.full(8, 0.3)
    q[7] = 0.03
    locked = oc.Robot.from_urdf(path, "panda_rightfinger", {"panda_finger_joint1": 0.03})
    np.testing.assert_allclose(robot.pose(q), locked.pose(q[:7]), atol=1e-13)
    np.testing.assert_allclose(robot.mass_matrix(q)[:7, :7], locked.mass_matrix(q[:7]), atol=1e-12)


def test_distances_and_their_gradients_move_with_mimic_joints(robot: oc.Robot) -> None:
    collisions = robot.collisions.with_scene(oc.Scene({"post": oc.obstacles.Sphere([0.4, 0.1, 0.5], 0.1)}))
    for q in robot.sample(20, seed=5):
        near, steps = collisions.find_near(q, 1.0), 1e-6 * np.eye(robot.n)
        apart = [k for k, distance in enumerate(near.distance) if distance > 0.01]
        ahead, behind = (collisions.pair_distances(q + sign * steps) for sign in (1, -1))
        columns = [collisions.pairs.index(near.pairs[k]) for k in apart]
        assert columns
        np.testing.assert_allclose(near.gradient[apart], (ahead - behind)[:, columns].T / 2e-6, atol=2e-4)
    # the bound of how fast joints move a pair holds between random postures
    q, p = robot.sample(200, seed=6), robot.sample(200, seed=8)
    moved = np.abs(collisions.pair_distances(q) - collisions.pair_distances(p))
    names = [collisions.pairs[k] for k in collisions._owners]
    for pair, rates in zip(names, collisions.rates, strict=True):
        apart = moved[:, collisions.pairs.index(pair)]
        assert (apart <= np.abs(q - p) @ rates + 1e-9).all()


def test_chart_of_an_arm_with_mimic_joints_is_fitted_saved_and_inverted(robot: oc.Robot, tmp_path: Path) -> None:
    """The file holds the mimic joints; a controller on the chart runs on its own plant."""
    problem = oc.Problem(robot, oc.Task.position(robot, "xyz"), domain=oc.Box([0.3, 0.6, 0.2, 0.9, 0.3, 0.0], 0.3))
    chart = oc.fit(problem, oc.Polynomial(degree=2)).chart
    chart.save(tmp_path / "arm.orthocas")
    again = oc.load(tmp_path / "arm.orthocas")
    assert again.robot.mimics == robot.mimics
    q = chart.domain.sample(20, seed=1)
    np.testing.assert_allclose(again.phi(q), chart.phi(q), rtol=0, atol=1e-14)
    np.testing.assert_allclose(chart.inverse(chart.phi(q[1]), q[0]), q[1], atol=1e-6)
    assert abs(oc.evaluate(chart, samples=500).task_angle.mean - 90) < 1
    # energy of the plant without torque and friction stays what it was: M, bias and gravity belong together
    tree = robot.with_gravity([0.0, 0.0, 0.0])
    q, dq = q[0], np.full(6, 0.3)
    start = dq @ tree.mass_matrix(q) @ dq
    for _ in range(400):
        # explicit midpoint
        ddq = tree.forward_dynamics(q, dq, np.zeros(6))
        half_q, half_dq = q + 5e-4 * dq, dq + 5e-4 * ddq
        q, dq = q + 1e-3 * half_dq, dq + 1e-3 * tree.forward_dynamics(half_q, half_dq, np.zeros(6))
    assert abs(dq @ tree.mass_matrix(q) @ dq / start - 1) < 1e-6


@pytest.mark.slow
def test_law_on_mimic_joints_follows_a_step_and_agrees_in_c(robot: oc.Robot, tmp_path: Path) -> None:
    domain = oc.Box([0.3, 0.6, 0.2, 0.9, 0.3, 0.0], 0.3)
    chart = oc.fit(oc.Problem(robot, oc.Task.position(robot, "xyz"), "inertia", domain), oc.Polynomial(2)).chart
    law, start = oc.control.PDPlus(chart), chart.phi(chart.domain.centre)
    reference = oc.control.Reference.steps(law.labels, start, [(0.1, {"xi1": start[3] + 0.05})], duration=0.5)
    run = oc.simulate(law, reference, chart.domain.centre, control_rate=1000.0)
    assert np.max(run.tracking_error) < 1e-4
    assert not run.status.any()
    generated = oc.generate_c(chart, tmp_path / "c", law)
    assert max(check_c(generated, chart, law, states=50).differences.values()) < 1e-9
    # body poses and distances that C takes along the tree know no mimic joints
    with pytest.raises(RobotError, match="distances in C: not possible with mimic joints; here 'j3' mimics 'j2'"):
        oc.generate_c(chart, tmp_path / "d", law, capsules=fit_capsules(robot.collisions))


def test_what_is_not_possible_with_mimic_joints_is_said(robot: oc.Robot, arm_file: Path) -> None:
    with pytest.raises(UnknownNameError):
        oc.Robot.from_urdf(arm_file, "l8", {"j99": 0.0})
    with pytest.raises(RobotError, match="'j3' mimics joint 'j2', expected an independent joint"):
        oc.Robot.from_urdf(arm_file, "l8", {"j3": 0.0})
    model = pin.buildModelFromUrdf(str(arm_file), mimic=True)
    with pytest.raises(RobotError, match="'j3' of the model is a mimic joint, .* Robot.from_urdf"):
        oc.Robot.from_model(model, "l8")
