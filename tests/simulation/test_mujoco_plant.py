"""MuJoCo as plant: against Pinocchio, our own dynamics, energy, and finite differences."""

import pickle
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from conftest import ROBOTS, arm, pinocchio_position
from scipy.integrate import solve_ivp

import orthocas as oc
from orthocas.errors import InvalidValueError, MissingExtraError, ShapeError, SimulationError
from orthocas.simulation import Elasticity, Friction, MuJoCoPlant, Payload, Wall
from orthocas.tools import checks
from orthocas.tools.checks import Array

pytest.importorskip("mujoco", minversion="4", reason="the extra orthocas[mujoco] is not installed")

Q = np.array([0.3, -0.5, 0.2, -1.5, 0.1, 1.5, 0.2])  # of the panda


@pytest.fixture(scope="module")
def panda() -> tuple[pin.Model, oc.Robot]:
    model, tip = arm("panda")
    return model, oc.Robot.from_model(model, tip)


@pytest.fixture
def plant(panda: tuple[pin.Model, oc.Robot]) -> MuJoCoPlant:
    return MuJoCoPlant(panda[1])


@pytest.mark.parametrize("name", ROBOTS)
def test_acceleration_is_pinocchios_and_ours(name: str) -> None:
    """Also inertias that MuJoCo's compiler refuses, armatures, prismatic joints and two arms; to 1e-9."""
    model, tip = arm(name)
    robot, data = oc.Robot.from_model(model, tip), model.createData()
    plant = MuJoCoPlant(robot, stops=False, effort_limits=False)
    for q, dq, tau in np.random.default_rng(7).uniform(-1.5, 1.5, (5, 3, robot.n)) * np.array([[1], [1], [20]]):
        plant.reset(q, dq)
        plant.step(tau, 1e-3)
        want = robot.forward_dynamics(plant.q, plant.dq, tau)
        theirs = pin.aba(model, data, pinocchio_position(model, plant.q), plant.dq, tau)
        np.testing.assert_allclose(plant.acceleration, want, rtol=0, atol=1e-9 * max(1, np.abs(want).max()))
        np.testing.assert_allclose(plant.acceleration, theirs, rtol=0, atol=1e-9 * max(1, np.abs(want).max()))


def test_free_motion_keeps_its_energy(panda: tuple[pin.Model, oc.Robot]) -> None:
    model, robot = panda
    data, plant = model.createData(), MuJoCoPlant(robot, stops=False)

    def energy() -> float:
        return float(pin.computeMechanicalEnergy(model, data, plant.q, plant.dq))

    plant.reset(Q, np.full(7, 0.3))
    begin = energy()
    for _ in range(500):
        plant.step(np.zeros(7), 1e-3)
    fallen = begin - float(pin.computePotentialEnergy(model, data, plant.q))
    assert abs(energy() - begin) < 1e-6 * fallen
    assert fallen > 10.0


@pytest.mark.parametrize(("viscous", "tolerance"), [(0.5, 1e-8), (60.0, 1e-4)])
def test_viscous_friction_is_integrated_whether_stiff_or_not(
    panda: tuple[pin.Model, oc.Robot], viscous: float, tolerance: float
) -> None:
    """Against SciPy on Pinocchio's dynamics. RK4 with steps of 1 ms would diverge with the larger one."""
    model, robot = panda
    data, tau = model.createData(), 0.5 * robot.gravity(Q)
    plant = MuJoCoPlant(robot, stops=False, friction=Friction(viscous))
    plant.reset(Q)
    for _ in range(300):
        plant.step(tau, 1e-3)

    def rate(_t: float, s: Array) -> Array:
        return np.concatenate([s[7:], pin.aba(model, data, s[:7], s[7:], tau - viscous * s[7:])])

    want = solve_ivp(rate, (0, 0.3), np.concatenate([Q, np.zeros(7)]), method="LSODA", rtol=1e-10, atol=1e-11).y[:, -1]
    np.testing.assert_allclose(plant.q, want[:7], rtol=0, atol=tolerance)
    assert np.abs(want[:7] - Q).max() > 100 * tolerance


def test_coulomb_friction_holds_what_is_below_it(panda: tuple[pin.Model, oc.Robot]) -> None:
    robot = panda[1]
    stuck, moves = MuJoCoPlant(robot, friction=Friction(0.0, 8.0)), MuJoCoPlant(robot)
    for plant in (stuck, moves):
        plant.reset(Q)
        for _ in range(200):
            plant.step(0.9 * robot.gravity(Q), 1e-3)  # 6 N m are missing
    assert np.abs(stuck.q - Q).max() < 0.01
    assert np.abs(moves.q - Q).max() > 0.05


def test_light_joints_hardly_creep_below_their_coulomb_friction() -> None:
    robot = oc.problems.get("iiwa").robot  # the last joint has an inertia of 3e-4 kg m^2
    plant = MuJoCoPlant(robot, friction=Friction(coulomb=0.3))
    plant.reset(np.zeros(7))
    for _ in range(500):
        plant.step(robot.gravity(plant.q) + 0.1, 1e-3)
    assert np.abs(plant.dq).max() < 0.005


@pytest.mark.slow
def test_elastic_gears_swing_as_the_equations_of_motion_say() -> None:
    """M ddq + C dq + g = k (theta - q) + d (dtheta - dq), B ddtheta = u - k (theta - q) - d (dtheta - dq)."""
    robot = oc.Robot.planar(lengths=[0.6, 0.4], masses=[3.0, 2.0])
    k, B, d = np.array([900.0, 400.0]), np.array([0.3, 0.1]), np.array([2.0, 0.5])
    plant = MuJoCoPlant(robot, elasticity=Elasticity(k, B, d), timestep=5e-4)
    q0, u = np.array([0.3, 0.7]), np.array([8.0, -3.0])
    plant.reset(q0)
    sag = np.asarray(robot.gravity(q0)) / k
    assert plant.motor_q == pytest.approx(q0 + sag)
    for _ in range(100):
        plant.step(u, 1e-3)

    def rates(_: float, state: np.ndarray) -> np.ndarray:
        q, theta, dq, dtheta = state.reshape(4, 2)
        gear = k * (theta - q) + d * (dtheta - dq)
        ddq = np.linalg.solve(np.asarray(robot.mass_matrix(q)), gear - np.asarray(robot.bias(q, dq)))
        return np.concatenate([dq, dtheta, ddq, (u - gear) / B])

    start = np.concatenate([q0, q0 + sag, np.zeros(4)])
    end = solve_ivp(rates, (0.0, 0.1), start, rtol=1e-9, atol=1e-11).y[:, -1].reshape(4, 2)
    found = np.array([plant.q, plant.motor_q, plant.dq, plant.motor_dq])
    assert np.abs(found - end).max() < 1e-5
    assert np.abs(end[1] - end[0]).max() > 5e-3
    assert np.array_equal(plant.torque, u)


def test_stiff_gears_are_rigid_ones_with_the_armature_of_the_rotors() -> None:
    robot = oc.Robot.planar(lengths=[0.6, 0.4], masses=[3.0, 2.0])
    tree = replace(robot.tree, armatures=np.array([0.3, 0.1]))
    stiff = MuJoCoPlant(robot, elasticity=Elasticity(1e5, tree.armatures, 100.0))
    rigid = MuJoCoPlant(oc.Robot(tree))
    for plant in (stiff, rigid):
        plant.reset([0.3, 0.7])
        for _ in range(100):
            plant.step(np.array([8.0, -3.0]), 1e-3)
    assert stiff.q == pytest.approx(rigid.q, abs=2e-4)


@pytest.mark.slow
def test_stops_hold(panda: tuple[pin.Model, oc.Robot], plant: MuJoCoPlant) -> None:
    robot = panda[1]
    for sign in (-1, 1):
        plant.reset(Q)
        for _ in range(2500):
            plant.step(robot.gravity(plant.q) - 3 * plant.dq + sign * 10, 1e-3)
        beyond = np.maximum(robot.lower - plant.q, plant.q - robot.upper)
        assert beyond.max() < 0.003
        assert np.abs(plant.dq).max() < 0.01
        assert (beyond > -1e-3).sum() >= 5  # most joints reached them


def test_motors_saturate_at_the_limits_of_effort_but_loads_do_not(plant: MuJoCoPlant) -> None:
    limits = plant.robot.effort_limits
    plant.reset(Q)
    plant.step(1e3 * np.ones(7), 1e-3)
    np.testing.assert_array_equal(plant.torque, limits)
    want = plant.robot.forward_dynamics(plant.q, plant.dq, limits)
    np.testing.assert_allclose(plant.acceleration, want, atol=1e-9 * np.abs(want).max())
    plant.reset(Q)
    plant.step(np.zeros(7), 1e-3, 1e3 * np.ones(7))
    assert plant.acceleration[0] > want[0] + 1e3
    free = MuJoCoPlant(plant.robot, effort_limits=False)
    free.step(1e3 * np.ones(7), 1e-3)
    np.testing.assert_array_equal(free.torque, np.full(7, 1e3))


@pytest.mark.parametrize("link", [2, 3, "panda_joint6", 6])
def test_push_at_a_link_is_the_force_through_the_points_jacobian(
    panda: tuple[pin.Model, oc.Robot], link: int | str
) -> None:
    """What the push adds to the acceleration is M^-1 J^T f, with J from finite differences of Pinocchio's poses."""
    model, robot = panda
    data, plant, tau = model.createData(), MuJoCoPlant(robot, stops=False), robot.gravity(Q)
    index = link if isinstance(link, int) else robot.joint_names.index(link)
    points, forces = np.array([[0.1, -0.05, 0.2], [0.0, 0.1, 0.0]]), np.array([[20.0, -30.0, 40.0], [5.0, 0.0, 9.0]])

    def place(q: Array, point: Array) -> Array:
        pin.forwardKinematics(model, data, q)
        return np.asarray(data.oMi[index + 1].act(point))

    def jacobian(point: Array) -> Array:
        steps = 1e-5 * np.eye(7)
        return np.column_stack([(place(plant.q + e, point) - place(plant.q - e, point)) / 2e-5 for e in steps])

    plant.reset(Q)
    plant.step(tau, 1e-3)
    loads, resting = np.zeros(7), plant.acceleration
    for point, force in zip(points, forces, strict=True):  # the second one comes on top
        plant.push(force, link, point)
        loads += jacobian(point).T @ force
        want = np.linalg.solve(robot.mass_matrix(plant.q), loads)
        np.testing.assert_allclose(plant.acceleration - resting, want, rtol=0, atol=1e-6 * np.abs(want).max())
    plant.release()
    np.testing.assert_allclose(plant.acceleration, resting, atol=1e-9)


def test_push_without_link_acts_at_the_tip(plant: MuJoCoPlant) -> None:
    robot, force = plant.robot, np.array([3.0, 4.0, 5.0])
    plant.reset(Q)
    before = plant.acceleration
    plant.push(force)
    want = np.linalg.solve(robot.mass_matrix(Q), robot.tip_jacobian(Q)[:3].T @ force)
    np.testing.assert_allclose(plant.acceleration - before, want, atol=1e-9 * np.abs(want).max())


def test_payload_is_a_body_of_the_last_link(panda: tuple[pin.Model, oc.Robot]) -> None:
    """Pinocchio adds the same inertia to the same frame."""
    model, robot = panda
    inertia = pin.Inertia(1.5, np.array([0.02, -0.03, 0.1]), np.diag([0.01, 0.02, 0.025]))
    loaded = model.copy()
    frame = loaded.frames[loaded.getFrameId("panda_hand", pin.FrameType.BODY)]
    loaded.appendBodyToJoint(frame.parentJoint, inertia, frame.placement)
    plant = MuJoCoPlant(robot, payload=Payload(inertia.mass, inertia.lever, inertia.inertia))
    tau, dq = robot.gravity(Q), np.linspace(-1, 1, 7)
    plant.reset(Q, dq)
    plant.step(tau, 1e-3)
    want = pin.aba(loaded, loaded.createData(), plant.q, plant.dq, tau)
    np.testing.assert_allclose(plant.acceleration, want, atol=1e-9 * np.abs(want).max())
    assert np.abs(want - robot.forward_dynamics(plant.q, plant.dq, tau)).max() > 1.0


@pytest.mark.slow
def test_wall_stops_the_tip_and_pushes_back(panda: tuple[pin.Model, oc.Robot]) -> None:
    """A spring pulls the tip into the wall. The force of contact is what the equation of motion lacks."""
    robot = panda[1]
    tip = robot.tip_position(Q)
    plant = MuJoCoPlant(robot, wall=Wall(tip + np.array([0.05, 0, 0]), [-2.0, 0, 0], tip_radius=0.03))
    goal = tip + np.array([0.04, 0, 0])
    plant.reset(Q)
    for _ in range(800):
        spring = robot.tip_jacobian(plant.q)[:3].T @ (1000 * (goal - robot.tip_position(plant.q)))
        tau = robot.gravity(plant.q) + spring - 8 * plant.dq
        plant.step(tau, 1e-3)
    lacking = robot.inverse_dynamics(plant.q, plant.dq, plant.acceleration) - tau
    force, J = plant.contact_force, robot.tip_jacobian(plant.q)
    arm = plant.data.contact[0].pos - robot.tip_position(plant.q)
    np.testing.assert_allclose(J[:3].T @ force + J[3:].T @ np.cross(arm, force), lacking, rtol=0, atol=1e-6)
    assert force[0] < -15  # the spring pulls by 20 mm
    assert abs(robot.tip_position(plant.q)[0] - (tip[0] + 0.02)) < 2e-3  # the sphere touches the face


def test_ticks_are_divided_into_short_steps(panda: tuple[pin.Model, oc.Robot]) -> None:
    coarse, fine = MuJoCoPlant(panda[1]), MuJoCoPlant(panda[1])
    for plant in (coarse, fine):
        plant.reset(Q)
    coarse.step(np.zeros(7), 0.0101)
    for _ in range(11):
        fine.step(np.zeros(7), 0.0101 / 11)
    assert coarse.time == pytest.approx(0.0101)
    np.testing.assert_array_equal(coarse.q, fine.q)


def test_reset_forgets_the_past(plant: MuJoCoPlant) -> None:
    ends = []
    for _ in range(2):
        plant.reset(Q)
        assert (plant.time, plant.acceleration.shape) == (0.0, (7,))
        plant.push([50.0, 0, 0], link=3)
        for _ in range(50):
            plant.step(np.ones(7), 1e-3, np.ones(7))
        ends.append(plant.q)
    np.testing.assert_array_equal(*ends)


def test_plant_travels_with_its_state(plant: MuJoCoPlant) -> None:
    plant.reset(Q)
    plant.push([50.0, 0, 0], link=3)
    plant.step(np.ones(7), 1e-3)
    copy = pickle.loads(pickle.dumps(plant))
    for one in (plant, copy):
        one.step(np.ones(7), 1e-3)
    np.testing.assert_array_equal(plant.q, copy.q)


def test_runaways_raise_an_error_and_write_nothing(plant: MuJoCoPlant, capfd: pytest.CaptureFixture[str]) -> None:
    free = MuJoCoPlant(plant.robot, stops=False, effort_limits=False)
    with pytest.raises(SimulationError, match="the simulation diverged at 0.01 s: joint velocities beyond"):
        free.step(np.full(7, 1e9), 0.01)
    assert capfd.readouterr() == ("", "")


def test_wrong_arguments_are_named(plant: MuJoCoPlant) -> None:
    with pytest.raises(InvalidValueError, match=r"torque\[0\] is nan, expected a finite number"):
        plant.step([np.nan] * 7, 1e-3)
    with pytest.raises(InvalidValueError, match=r"torque is .*nan.*, expected numbers up to 1e\+10"):
        plant.step(np.full(7, np.nan), 1e-3)
    with pytest.raises(InvalidValueError, match=r"loads is .*00.*, expected numbers up to 1e\+10"):
        plant.step(np.zeros(7), 1e-3, np.full(7, 1e11))
    with pytest.raises(ShapeError, match=r"torque has shape \(6,\), expected \(7,\)"):
        plant.step(np.zeros(6), 1e-3)
    with pytest.raises(InvalidValueError, match="seconds is 0, expected a number > 0, at most 100"):
        plant.step(np.zeros(7), 0)
    with pytest.raises(InvalidValueError, match="payload is 1, expected a Payload"):
        MuJoCoPlant(plant.robot, payload=1)  # type: ignore[arg-type]
    with pytest.raises(InvalidValueError, match="timestep is 0, expected a number from 1e-06 to 0.01"):
        MuJoCoPlant(plant.robot, timestep=0)
    with pytest.raises(InvalidValueError, match="normal of a wall"):
        Wall([0, 0, 0], [0, 0, 0])
    with pytest.raises(InvalidValueError, match="mass of a payload"):
        Payload(-1.0)


def test_missing_package_is_named_with_its_extra(monkeypatch: pytest.MonkeyPatch, plant: MuJoCoPlant) -> None:
    def missing(name: str) -> None:
        raise ModuleNotFoundError(name)

    monkeypatch.setattr(checks, "import_module", missing)
    with pytest.raises(MissingExtraError, match=r"MuJoCo as plant needs .* pip install 'orthocas\[mujoco\]'"):
        MuJoCoPlant(plant.robot)


@pytest.mark.slow
def test_branches_keep_the_order_of_the_tree() -> None:
    """Bodies in an order that is not depth-first: MuJoCo orders them otherwise."""
    model, tip = arm("talos, both arms and the torso")
    tree = oc.Robot.from_model(model, tip).tree
    depth = [0] * tree.n
    for i, parent in enumerate(tree.parents):
        depth[i] = depth[parent] + 1 if parent >= 0 else 0
    order = np.argsort(depth, kind="stable")
    place = np.argsort(order)
    arrays = {k: v[order] for k, v in vars(tree).items() if isinstance(v, np.ndarray) and len(v) == tree.n}
    texts = {k: tuple(getattr(tree, k)[i] for i in order) for k in ("joint_names", "joint_kinds")}
    parents = tuple(int(place[tree.parents[i]]) if tree.parents[i] >= 0 else -1 for i in order)
    robot = oc.Robot(replace(tree, **arrays, **texts, parents=parents, tip_parent=int(place[tree.tip_parent])))
    plant = MuJoCoPlant(robot, stops=False, effort_limits=False)
    q, dq, tau = np.random.default_rng(3).uniform(-1, 1, (3, robot.n))
    plant.reset(q, dq)
    plant.step(tau, 1e-4, tau)
    want = robot.forward_dynamics(plant.q, plant.dq, 2 * tau)
    np.testing.assert_allclose(plant.acceleration, want, atol=1e-9 * np.abs(want).max())
