"""Robots on moving bases against Pinocchio, and coordinates that hold at every place and heading."""

from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from conftest import robot_data

import orthocas as oc
from orthocas.certificates import check_certificate
from orthocas.codegen import check_c, generate_c
from orthocas.errors import CertifyError, InvalidValueError, OrthocasError
from orthocas.tools.checks import Array

PANDA = robot_data("panda_description/urdf/panda.urdf")
HOME = np.array([0, 0, 0, 0, -0.6, 0, -2.1, 0, 1.5, 0.78])


@pytest.fixture(scope="module")
def robot() -> oc.Robot:
    return oc.Robot.from_urdf(PANDA, base="planar")


@pytest.fixture(scope="module")
def chart(robot: oc.Robot) -> oc.Chart:
    task = oc.Task.pose(robot).with_reference_at(HOME)
    problem = oc.Problem(robot, task, domain=oc.Box(HOME, 0.2))
    return oc.fit(problem, oc.Mobile(oc.Polynomial(2)), samples=600).chart


def test_planar_base_is_that_of_pinocchio(robot: oc.Robot) -> None:
    """Kinematics, inertia with the links of the base, and gravity; Pinocchio's velocities are in axes of the base."""
    model = pin.buildModelFromUrdf(str(PANDA), pin.JointModelPlanar())
    fingers = [model.getJointId(f"panda_finger_joint{k}") for k in (1, 2)]
    model = pin.buildReducedModel(model, fingers, pin.neutral(model))
    data = model.createData()
    assert robot.tree.masses[2] > 0.5  # the first link stands on the base
    for q in np.random.default_rng(0).uniform(-1, 1, (5, robot.n)):
        c, s = np.cos(q[2]), np.sin(q[2])
        whole = np.concatenate([q[:2], [c, s], q[3:]])
        pin.framesForwardKinematics(model, data, whole)
        pose = data.oMf[model.getFrameId(robot.tips[0])]
        np.testing.assert_allclose(robot.tip_position(q), pose.translation, atol=1e-12)
        np.testing.assert_allclose(robot.tip_rotation(q), pose.rotation, atol=1e-12)
        M = pin.crba(model, data, whole)
        M = np.triu(M) + np.triu(M, 1).T
        across = np.eye(robot.n)
        across[:2, :2] = [[c, s], [-s, c]]
        np.testing.assert_allclose(robot.mass_matrix(q), across.T @ M @ across, atol=1e-11)
        gravity = across.T @ pin.computeGeneralizedGravity(model, data, whole)
        np.testing.assert_allclose(robot.gravity(q), gravity, atol=1e-11)


@pytest.mark.parametrize(("base", "axis"), [("rail:x", 0), ("rail:y", 1), ("rail:z", 2)])
def test_rails(base: str, axis: int) -> None:
    fixed, moving = oc.Robot.from_urdf(PANDA), oc.Robot.from_urdf(PANDA, base=base)
    q = HOME[3:]
    moved = moving.tip_position([0.7, *q]) - fixed.tip_position(q)
    np.testing.assert_allclose(moved, 0.7 * np.eye(3)[axis], atol=1e-14)
    np.testing.assert_allclose(moving.tip_rotation([0.7, *q]), fixed.tip_rotation(q), atol=1e-14)
    np.testing.assert_allclose(moving.frame_position([0.7, *q], "panda_link0"), 0.7 * np.eye(3)[axis], atol=1e-14)


def test_wheels_are_refused_with_advice() -> None:
    with pytest.raises(InvalidValueError, match="use planar, and let the base follow the motion"):
        oc.Robot.from_urdf(PANDA, base="differential")


def places(count: int) -> Array:
    rng = np.random.default_rng(5)
    return np.column_stack([rng.uniform(-80, 80, (count, 2)), rng.uniform(-20, 20, count)])


@pytest.mark.slow
def test_one_chart_holds_at_every_place_and_heading(robot: oc.Robot, chart: oc.Chart) -> None:
    """The volume of the tip's velocities and J_xi by finite differences, at home and elsewhere."""
    arms = HOME + 0.15 * np.random.default_rng(2).uniform(-1, 1, (4, 10))
    assert chart.problem.domain.unbounded == (0, 1, 2)

    def volume(q: Array) -> float:
        step = 1e-6
        slopes = [(chart.xi(q + step * e) - chart.xi(q - step * e)) / (2 * step) for e in np.eye(10)]
        return float(np.linalg.det(np.vstack([robot.tip_jacobian(q), np.transpose(slopes)])))

    for q in arms:
        here = volume(q)
        assert abs(here) > 1e-4
        for place in places(3):
            there = q.copy()
            there[:3] = place
            assert chart.problem.domain.contains(there)
            assert volume(there) == pytest.approx(here, rel=1e-5)


@pytest.mark.slow
def test_a_report_is_one_of_all_headings(chart: oc.Chart) -> None:
    """The leaks of the two coordinates that change places as the base turns, against headings of one's own."""
    rng = np.random.default_rng(5)
    q = HOME + 0.2 * rng.uniform(-1, 1, (4000, 10))
    q[:, 2] = rng.uniform(-np.pi, np.pi, 4000)
    wanted = oc.evaluate(chart, points=q).leak.rms_of_each
    assert oc.evaluate(chart, samples=4000).leak.rms_of_each == pytest.approx(wanted, rel=0.05)


@pytest.mark.slow
def test_closed_paths_bring_the_base_back(chart: oc.Chart) -> None:
    tracker, start = chart.tracker(HOME), chart.phi(HOME)
    along, furthest = chart.jacobian(HOME)[6:, :2], 0.0
    for s in 2 * np.pi * np.arange(1, 3001) / 1000:
        shift = 2 * np.array([np.cos(s) - 1, np.sin(s)])
        tool = [shift[0] + 0.03 * np.sin(2 * s), shift[1] + 0.03 * np.sin(s), 0, 0, 0, 0]
        tracker.step(start + np.concatenate([tool, along @ shift]))
        furthest = max(furthest, abs(tracker.q[0]))
    assert furthest > 3.9
    np.testing.assert_allclose(tracker.q, HOME, atol=1e-9)


@pytest.mark.slow
def test_a_slow_base_sets_the_time_of_a_path(chart: oc.Chart) -> None:
    """By finite differences of the joint motion; with a faster base the same path takes less time."""
    shifts = np.outer(np.linspace(0, 1, 30), [0.5, 0.2])
    tool = chart.x(HOME) + np.hstack([shifts, np.zeros((30, 4))])
    xi = chart.xi(HOME) + shifts @ chart.jacobian(HOME)[6:, :2].T  # of a motion of the base with all that it carries
    arm, times = np.full(7, 2.0), []
    for base in (0.05, 0.2):
        limits = np.concatenate([[base, base, 2 * base], arm])
        motion = oc.follow(chart, tool, xi, velocity_limits=limits, q_start=HOME)
        speeds = np.abs(np.diff(motion.q, axis=0) / np.diff(motion.times)[:, None]).max(axis=0)
        assert (speeds <= 1.01 * limits).all()
        times.append(motion.times[-1])
        nearest = (speeds / limits).argmax()
        assert nearest < 3  # the base is what is slow
    assert times[0] > 2 * times[1]


@pytest.mark.slow
def test_no_fold_is_proved_for_every_place_and_heading(robot: oc.Robot, chart: oc.Chart) -> None:
    """And determinants by the tip's velocities have one sign at 20,000 places, half of the arms near the boundary."""
    certificate = oc.certify(chart, time_limit=60)
    assert certificate.proved
    assert check_certificate(chart, certificate)
    assert certificate.injective is None
    rng = np.random.default_rng(8)
    u = rng.uniform(-1, 1, (20_000, 7))
    u[::2] = np.sign(u[::2]) * np.abs(u[::2]) ** 0.05
    q = HOME + np.concatenate([np.zeros((len(u), 3)), 0.2 * u], axis=1)
    q[:, :2], q[:, 2] = rng.uniform(-90, 90, (len(u), 2)), rng.uniform(-20, 20, len(u))
    J = np.concatenate([robot.tip_jacobian(q), chart.jacobian(q)[:, 6:]], axis=1)
    volumes = np.linalg.det(J)
    assert volumes.min() * volumes.max() > 0
    with pytest.raises(CertifyError, match="on a moving base, expected 0"):
        oc.certify(chart, 0.1)


@pytest.mark.slow
def test_a_base_that_turns_about_another_axis_is_no_base_for_a_proof(chart: oc.Chart) -> None:
    """A file may name joints of the base that do not move on a plane."""
    tree = chart.problem.robot.tree
    rotations = tree.rotations.copy()
    rotations[2] = rotations[2] @ np.array([[1, 0, 0], [0, 0.8, -0.6], [0, 0.6, 0.8]])
    tilted = oc.Robot(replace(tree, rotations=rotations))
    task = oc.Task.pose(tilted).with_reference_at(HOME)
    forged = oc.Chart(oc.Problem(tilted, task, domain=chart.problem.domain), chart.coordinates)
    with pytest.raises(CertifyError, match="the base of the chart is not a planar base"):
        oc.certify(forged)


@pytest.mark.slow
def test_tasks_that_do_not_turn_with_the_base_are_not_proved_so(robot: oc.Robot) -> None:
    task = oc.Task.custom(
        robot, "reach", lambda q: ca.vertcat(robot.tip_position(q)[0] ** 3 / 3 + robot.tip_position(q)[1], q[3] + q[4])
    )
    problem = oc.Problem(robot, task, domain=oc.Box(HOME, 0.1))
    chart = oc.fit(problem, oc.Mobile(oc.Polynomial(1)), samples=300, weights=oc.Weights(folds=0)).chart
    with pytest.raises(CertifyError, match="is unbounded and J depends on it"):
        oc.certify(chart)


@pytest.mark.slow
def test_files_and_c_are_the_chart(chart: oc.Chart, tmp_path: Path) -> None:
    chart.save(tmp_path / "mobile.orthocas")
    back = oc.load(tmp_path / "mobile.orthocas")
    q = HOME + 0.1
    np.testing.assert_array_equal(back.phi(q), chart.phi(q))
    law = oc.control.PDPlus(back, stiffness=100.0)
    generated = generate_c(back, tmp_path / "c", law, "mobile")
    assert max(check_c(generated, back, law, states=30).differences.values()) < 1e-11


@pytest.mark.parametrize(
    ("arm", "base", "message"),
    [
        (oc.Linear(), oc.Mobile(oc.Polynomial(1)).base, "a parametrisation to fit"),
        (oc.Polynomial(2, cyclic=["panda_joint1"]), oc.Mobile(oc.Polynomial(1)).base, "whose joints are not cyclic"),
        (oc.Polynomial(2), ("base_x", "base_y"), "names of three joints"),
        (oc.Polynomial(2), ("base_y", "base_x", "base_heading"), "slide along x, then along y"),
        (oc.Polynomial(2), ("base_x", "base_y", "wheel"), "one of the joints base_x"),
    ],
)
def test_refused_bases(robot: oc.Robot, arm: oc.Polynomial, base: tuple[str, ...], message: str) -> None:
    with pytest.raises(OrthocasError, match=message):
        oc.Mobile(arm, base).for_problem(oc.Problem(robot, oc.Task.position(robot), domain=oc.Box(HOME, 0.2)))
