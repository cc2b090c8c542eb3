"""The plant whose joints stick: closed forms, all sign patterns, and MuJoCo."""

from itertools import product
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

import orthocas as oc
from orthocas.errors import InvalidValueError, ShapeError, SimulationError
from orthocas.simulation import Friction, MuJoCoPlant, StickingPlant
from orthocas.simulation.sticking import minimise_with_kinks


@pytest.fixture(scope="module")
def slider() -> oc.Robot:
    """One joint that slides 1 kg to and fro."""
    model = pin.Model()
    joint = model.addJoint(0, pin.JointModelPX(), pin.SE3.Identity(), "slider")
    model.appendBodyToJoint(joint, pin.Inertia(1.0, np.zeros(3), np.eye(3)), pin.SE3.Identity())
    model.addFrame(pin.Frame("tip", joint, 0, pin.SE3.Identity(), pin.FrameType.OP_FRAME))
    return oc.Robot.from_model(model, "tip")


def test_a_joint_slows_down_with_coulomb_friction_and_then_stands_exactly(slider: oc.Robot) -> None:
    """q = v^2 / (2 a) after v / a, with a = F / m."""
    plant = StickingPlant(slider, friction=Friction(coulomb=2.0))
    plant.reset([0.0], [1.0])
    plant.step([0.0], 0.4)
    assert abs(plant.dq[0] - 0.2) < 1e-9
    plant.step([0.0], 0.2)
    assert plant.dq[0] == 0.0
    # First order: half a step of 0.25 ms at 1 rad/s.
    assert abs(plant.q[0] - 0.25) < 2e-4
    stood = plant.q[0]
    plant.step([1.999], 1.0)
    assert (plant.q[0], plant.dq[0]) == (stood, 0.0)


@pytest.mark.slow
def test_a_joint_on_a_pulled_spring_sticks_and_slips_by_twice_the_excess(slider: oc.Robot) -> None:
    """Slips of 2 (breakaway - coulomb) / k where friction falls at once: and what is pulled meanwhile: half a swing."""
    coulomb, breakaway, k = 1.0, 1.5, 10_000.0
    friction = Friction(coulomb=coulomb, breakaway=breakaway, stribeck_speed=1e-6)
    plant, places = StickingPlant(slider, friction=friction, timestep=1e-4), []
    for tick in range(40_000):
        plant.step([k * (1e-4 * tick * 1e-4 - plant.q[0])], 1e-4)
        if plant.dq[0] == 0.0 and (not places or plant.q[0] > places[-1]):
            places.append(float(plant.q[0]))
    slips = np.diff(places)[1:]
    assert len(slips) > 1
    pulled = 1e-4 * np.pi / np.sqrt(k)
    np.testing.assert_allclose(slips, 2 * (breakaway - coulomb) / k + pulled, rtol=0.01)


def test_the_minimum_is_that_of_all_sign_patterns() -> None:
    """Each of 3^5 patterns gives a candidate; the conditions of the minimum hold for one only."""
    rng, n = np.random.default_rng(7), 5
    stuck = 0
    for _ in range(60):
        root = rng.normal(size=(n, n))
        A, b, size = root @ root.T + 0.05 * np.eye(n), 2 * rng.normal(size=n), rng.uniform(0, 2, n)
        size[rng.uniform(size=n) < 0.2] = 0.0
        best: tuple[float, Any] = (np.inf, None)
        for signs in product((-1.0, 0.0, 1.0), repeat=n):
            s = np.array(signs)
            moves, v = np.flatnonzero(s), np.zeros(n)
            v[moves] = np.linalg.solve(A[np.ix_(moves, moves)], (b - s * size)[moves])
            cost = float(v @ A @ v / 2 - b @ v + size @ np.abs(v))
            best = min(best, (cost, tuple(v)))
        v = minimise_with_kinks(A, b, size, rng.normal(size=n))
        np.testing.assert_allclose(v, best[1], atol=1e-9)
        stuck += int((v == 0).sum())
    assert stuck > 60


def test_seven_joints_move_and_stick_as_in_mujoco() -> None:
    """A panda that falls against friction, at MuJoCo's smallest steps; its frictionloss creeps by 1e-4 rad/s."""
    pytest.importorskip("mujoco")
    problem = oc.charts.load("panda-position").problem
    friction = Friction(0.5, [4.0, 4.0, 4.0, 4.0, 1.0, 1.0, 0.5])
    settings: dict[str, Any] = {"friction": friction, "effort_limits": False}
    fine = StickingPlant(problem.robot, timestep=1e-4, **settings)
    other = MuJoCoPlant(problem.robot, stops=False, timestep=1e-4, **settings)
    q = problem.domain.centre
    hold = problem.robot.gravity(q)
    for plant in (fine, other):
        plant.reset(q)
        for k in range(300):
            plant.step(hold + np.array([6.0, 3.0, -2.0, 8.0, 2.0, 0.5, 0.2]) * np.sin(0.01 * k), 1e-3)
    assert np.abs(fine.q - q).max() > 0.1
    np.testing.assert_allclose(fine.q, other.q, atol=5e-3)
    np.testing.assert_allclose(fine.dq, other.dq, atol=3e-2)
    assert (fine.dq == 0).any()


@pytest.mark.slow
def test_without_friction_energy_and_motion_are_those_of_the_arm(planar_chart: oc.Chart) -> None:
    """A fall of 0.5 s in steps of 0.05 ms, beside CVODES through `simulate` with a law that commands nothing."""
    robot = planar_chart.problem.robot
    plant = StickingPlant(robot, timestep=5e-5)
    q = planar_chart.problem.domain.centre
    plant.reset(q)
    height = _energy(robot, plant)
    plant.step(np.zeros(3), 0.5)
    assert np.abs(plant.q - q).max() > 0.1
    assert abs(_energy(robot, plant) - height) < 1e-2


def _energy(robot: oc.Robot, plant: StickingPlant) -> float:
    """Kinetic energy, and the work that gravity still has to do, by the integral of g along the straight way from 0."""
    way = np.linspace(0, 1, 2001)[:, None] * plant.q
    potential = float(np.trapezoid(robot.gravity(way) @ plant.q, dx=1 / 2000))
    return float(plant.dq @ robot.mass_matrix(plant.q) @ plant.dq) / 2 + potential


def test_friction_that_no_joint_has_is_refused(slider: oc.Robot) -> None:
    with pytest.raises(InvalidValueError, match=r"breakaway is \[0.5\], expected at least coulomb"):
        StickingPlant(slider, friction=Friction(coulomb=1.0, breakaway=0.5))
    with pytest.raises(InvalidValueError, match="stribeck_speed"):
        StickingPlant(slider, friction=Friction(coulomb=1.0, stribeck_speed=0.0))
    with pytest.raises(InvalidValueError, match="only StickingPlant has"):
        MuJoCoPlant(slider, friction=Friction(coulomb=1.0, breakaway=1.5))
    with pytest.raises(ShapeError, match="torque"):
        StickingPlant(slider).step([0.0, 0.0], 1e-3)
    with pytest.raises(InvalidValueError, match="seconds"):
        StickingPlant(slider).step([0.0], 0.0)
    with pytest.raises(SimulationError, match="ran away"):
        StickingPlant(slider, effort_limits=False).step([1e9], 1.0)


def test_simulations_in_continuous_time_rub_after_stribeck_too(planar_chart: oc.Chart) -> None:
    """At the same small speed, more friction before the joints are well under way takes more of the motion."""
    law = oc.control.PDPlus(planar_chart, 50.0)
    q = planar_chart.problem.domain.centre
    phi = planar_chart.phi(q)
    reference = oc.control.Reference.steps(planar_chart.labels, phi, [(0.0, {"x": phi[0] + 0.05})], duration=0.4)
    runs = [oc.simulate(law, reference, q, friction=Friction(0.0, 0.5, breakaway)) for breakaway in (None, 0.5, 1.5)]
    np.testing.assert_array_equal(runs[0].q, runs[1].q)
    errors = [np.abs(run.value - run.reference).max() for run in runs]
    assert errors[2] > 1.1 * errors[0]
