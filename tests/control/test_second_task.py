"""Projectors with any second task: formulas written out with NumPy, what they leave undisturbed, and what they lose."""

from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from baselines import KinematicProjector, Projector
from charts import with_metric
from programs import needs_c
from scipy.linalg import sqrtm

import orthocas as oc
from orthocas.codegen import check_c
from orthocas.control import ControlStatus, Impedance, Reference
from orthocas.control.controller import Controller
from orthocas.errors import (
    InvalidValueError,
    NoExpressionError,
    ShapeError,
    SingularTaskError,
    UnreachableReferenceError,
)
from orthocas.tools.checks import Array

RNG = np.random.default_rng(15)


def pair(robot: oc.Robot, **names: Any) -> oc.Task:
    """Two independent functions."""
    return oc.Task.custom(robot, "pair", lambda q: ca.vertcat(ca.sin(q[0]), q[1] - q[2]), **names)


def middle(robot: oc.Robot) -> oc.Task:
    """A curved function of all joints."""
    return oc.Task.custom(robot, "middle", lambda q: ca.sin(q[0]) + q[1] * q[2], labels=["bend"])


@pytest.fixture(scope="module")
def linear(planar_xy: oc.Problem) -> oc.Chart:
    """Coordinates that are far from orthogonal away from the centre."""
    return oc.fit(planar_xy, oc.Linear()).chart


def second_of(kind: str, linear: oc.Chart) -> Any:
    return {"joints": None, "xi": linear, "task": middle(linear.problem.robot)}[kind]


def state(problem: oc.Problem) -> tuple[Array, Array]:
    return problem.domain.centre + RNG.uniform(-0.3, 0.3, problem.n), RNG.normal(size=problem.n)


def called(law: Controller, q: Array, dq: Array, *reference: Array, **gains: Any) -> Array:
    command, status = law.function(q, dq, *reference, *{**law.gains, **gains}.values())
    assert int(status) == ControlStatus.OK
    return np.asarray(command.full().ravel())


def derivative(function: Any, q: Array, along: Array) -> Array:
    """Central difference; error about 1e-9."""
    h = 1e-6
    return np.asarray(function(q + h * along) - function(q - h * along)) / (2 * h)


def second_jacobian(kind: str, linear: oc.Chart, q: Array) -> Array:
    """J_2 by hand."""
    if kind == "task":
        return np.array([[np.cos(q[0]), q[2], q[1]]])
    return np.eye(3) if kind == "joints" else linear.jacobian(q)[2:]


def sharp(J: Array, A: Array) -> Array:
    return np.asarray(np.linalg.solve(A, J.T) @ np.linalg.inv(J @ np.linalg.solve(A, J.T)))


@pytest.mark.parametrize("feed_forward", [False, True])
@pytest.mark.parametrize("metric", ["euclidean", "inertia"])
@pytest.mark.parametrize("kind", ["joints", "xi", "task"])
def test_torque_equals_equations_2_and_3_with_any_second_task(
    linear: oc.Chart, kind: str, metric: str, feed_forward: bool
) -> None:
    """P with the metric of the problem, inertias and feed-forward with M."""
    problem, K, Z = with_metric(linear.problem, metric), 150.0, 0.6
    law = Projector(problem, K, 40.0, Z, second=second_of(kind, linear), second_force=2.0, feed_forward=feed_forward)
    robot = problem.robot
    for _ in range(4):
        (q, dq), k = state(problem), len(law.labels)
        wanted = law.measured(q).full().ravel() + 0.1 * RNG.normal(size=k)
        rate, acceleration = RNG.normal(size=(2, k))
        M, C_dq = robot.mass_matrix(q), robot.bias(q, dq) - robot.gravity(q)
        J = linear.jacobian(q)[:2]
        J_2, error = second_jacobian(kind, linear, q), law.measured(q).full().ravel() - wanted
        forces = []
        for jacobian, stiffness, rows in (
            (lambda p: linear.jacobian(p)[:2], K, slice(0, 2)),
            (lambda p: second_jacobian(kind, linear, p), 40.0, slice(2, None)),
        ):
            here = jacobian(q)
            inertia = np.linalg.inv(here @ np.linalg.solve(M, here.T))
            D = 2 * Z * np.sqrt(stiffness) * sqrtm(inertia).real
            force = -stiffness * error[rows] - D @ here @ dq
            if feed_forward:
                drift = derivative(jacobian, q, dq) @ dq
                force += inertia @ (acceleration[rows] + here @ np.linalg.solve(M, C_dq) - drift) + D @ rate[rows]
            forces.append(force)
        P = np.eye(3) - sharp(J, M if metric == "inertia" else np.eye(3)) @ J
        want = J.T @ forces[0] + P.T @ J_2.T @ (forces[1] + 2.0) + robot.gravity(q)
        np.testing.assert_allclose(called(law, q, dq, wanted, rate, acceleration), want, rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize("metric", ["euclidean", "inertia"])
@pytest.mark.parametrize("kind", ["joints", "xi", "task"])
def test_velocity_equals_equation_1_and_leaves_the_task_alone(linear: oc.Chart, kind: str, metric: str) -> None:
    problem = with_metric(linear.problem, metric)
    law = KinematicProjector(problem, 2.0, 3.0, second=second_of(kind, linear))
    for _ in range(4):
        (q, _), k = state(problem), len(law.labels)
        ahead, rate = 0.1 * RNG.normal(size=(2, k))
        A = problem.robot.mass_matrix(q) if metric == "inertia" else np.eye(3)
        J, J_2 = linear.jacobian(q)[:2], second_jacobian(kind, linear, q)
        back = np.eye(3) if kind == "joints" else sharp(J_2, A)
        task, second = rate[:2] + 2.0 * ahead[:2], rate[2:] + 3.0 * ahead[2:]
        found = called(law, q, np.zeros(3), law.measured(q).full().ravel() + ahead, rate, np.zeros(k))
        np.testing.assert_allclose(found, sharp(J, A) @ task + (np.eye(3) - sharp(J, A) @ J) @ back @ second, rtol=1e-9)
        np.testing.assert_allclose(J @ found, task, rtol=1e-9)


@pytest.mark.parametrize("kind", ["joints", "xi", "task"])
def test_task_with_feed_forward_obeys_its_own_equation_whatever_the_second_task_does(
    linear: oc.Chart, kind: str
) -> None:
    """M_x dd_e + D_x d_e + K_x e = 0 for A = M, also while the second task moves fast and carries a force."""
    problem = linear.problem
    law = Projector(problem, 90.0, 30.0, 0.8, second=second_of(kind, linear), second_force=25.0, feed_forward=True)
    q, dq = state(problem)
    k = len(law.labels)
    wanted, rate, acceleration = law.measured(q).full().ravel() + RNG.normal(size=k), *RNG.normal(size=(2, k))
    ddq = problem.robot.forward_dynamics(q, dq, called(law, q, dq, wanted, rate, acceleration))
    J, M = linear.jacobian(q)[:2], problem.robot.mass_matrix(q)
    inertia = np.linalg.inv(J @ np.linalg.solve(M, J.T))
    D = 2 * 0.8 * np.sqrt(90.0) * sqrtm(inertia).real
    curved = derivative(lambda p: linear.jacobian(p)[:2], q, dq) @ dq
    error = law.measured(q).full().ravel()[:2] - wanted[:2]
    residual = inertia @ (J @ ddq + curved - acceleration[:2]) + D @ (J @ dq - rate[:2]) + 90.0 * error
    np.testing.assert_allclose(residual, 0.0, atol=1e-6)


def test_projector_removes_nothing_where_coordinates_are_exact(linear: oc.Chart) -> None:
    """Linear coordinates fulfil (5) at their base: there, and only there, the law is decoupled impedance control."""
    problem = linear.problem
    direct = Impedance(linear, [150.0, 150.0, 40.0], coupling="decoupled")
    law = Projector(problem, 150.0, 40.0, second=linear)
    dq, wanted = np.array([0.5, -1.0, 0.3]), np.array([1.0, 1.5, 0.4])
    for away, same in ((0.0, True), (0.3, False)):
        inputs = (problem.domain.centre + away, dq, wanted, np.zeros(3), np.zeros(3))
        difference = np.abs(called(law, *inputs) - called(direct, *inputs)).max()
        assert (difference < 1e-9) == same


def test_projected_springs_lose_passivity_and_direct_ones_do_not(linear: oc.Chart) -> None:
    """Without damping, V is constant under impedance control; behind the projector it rises for one sign of dq."""
    problem, rises = linear.problem, []
    q, wanted = problem.domain.centre + 0.3, np.array([1.0, 1.5, 0.6])
    for law in (
        Impedance(linear, [150.0, 150.0, 40.0], 0.0, "decoupled"),
        Projector(problem, 150.0, 40.0, 0.0, second=linear),
    ):
        for dq in (np.array([0.5, -0.4, 0.3]), np.array([-0.5, 0.4, -0.3])):
            inputs = (wanted, np.zeros(3), np.zeros(3), *law.gains.values())
            ddq = problem.robot.forward_dynamics(q, dq, called(law, q, dq, *inputs[:3]))

            def stored(t: float, law: Any = law, dq: Array = dq, ddq: Array = ddq, inputs: Any = inputs) -> float:
                return float(law.energy(q + t * dq + t**2 / 2 * ddq, dq + t * ddq, *inputs)[0])

            rises.append((stored(1e-5) - stored(-1e-5)) / 2e-5)
    np.testing.assert_allclose(rises[:2], 0.0, atol=1e-5)
    assert max(rises[2:]) > 0.1
    J, M = linear.jacobian(q), problem.robot.mass_matrix(q)
    taken = sharp(J[:2], M) @ J[:2] @ np.array([0.5, -0.4, 0.3])
    hidden = -40.0 * (linear.xi(q)[0] - wanted[2]) * J[2]
    assert rises[2] == pytest.approx(-hidden @ taken, rel=1e-5)  # tau_2^T (P - I) dq


def test_springs_in_regular_coordinates_cannot_hide(linear: oc.Chart) -> None:
    """P^T J_xi^T f vanishes only with f, however bad the coordinates; a posture spring has n - r directions to hide."""
    problem = linear.problem
    for _ in range(20):
        q, _ = state(problem)
        J, M = linear.jacobian(q), problem.robot.mass_matrix(q)
        P = np.eye(3) - sharp(J[:2], M) @ J[:2]
        assert np.linalg.norm(P.T @ J[2]) > 0.5 * np.linalg.norm(J[2])
        assert np.linalg.matrix_rank(P, tol=1e-9) == 1


def test_given_force_acts_alone_without_springs(linear: oc.Chart) -> None:
    """(3b): tau = J_x^T f_x + P^T J_2^T f_2 + g, f_2 from elsewhere, as an input of the law."""
    problem = linear.problem
    law = Projector(problem, 100.0, 0.0, 0.0, second=pair(problem.robot), second_force=[0.0, 0.0])
    assert tuple(law.gains) == ("stiffness", "damping_ratio", "second_force", "limit")
    q, dq = state(problem)
    rest = (np.zeros(4), np.zeros(4), np.zeros(4))
    difference = called(law, q, dq, *rest, second_force=[3.0, -2.0]) - called(law, q, dq, *rest)
    J, J_2 = linear.jacobian(q)[:2], np.array([[np.cos(q[0]), 0, 0], [0, 1, -1]])
    P = np.eye(3) - sharp(J, problem.robot.mass_matrix(q)) @ J
    np.testing.assert_allclose(difference, P.T @ J_2.T @ [3.0, -2.0], rtol=1e-9)


def test_only_charts_bring_a_domain(linear: oc.Chart) -> None:
    problem = linear.problem
    outside = problem.domain.centre + 1.01 * problem.domain.half_width
    for law in (Projector(problem, 10.0, 10.0, second=linear), KinematicProjector(problem, second=linear)):
        assert law.chart is linear
        command, status = law.function(outside, np.ones(3), *np.zeros((3, 3)), *law.gains.values())
        assert int(status) == ControlStatus.OUTSIDE_DOMAIN
        want = problem.robot.gravity(outside) if law.command == "torque" else np.zeros(3)
        np.testing.assert_allclose(command.full().ravel(), want, atol=1e-12)
    for second in (None, middle(problem.robot)):
        assert Projector(problem, 10.0, 10.0, second=second).chart is None
        free = Projector(problem, 10.0, 10.0, second=second)
        called(free, outside, np.ones(3), *np.zeros((3, len(free.labels))))


def test_second_task_that_loses_rank_is_told(planar_xy: oc.Problem) -> None:
    flat = oc.Task.custom(planar_xy.robot, "flat", lambda q: (q[0] - 0.6) ** 2 + (q[1] - 0.8) ** 2, labels=["flat"])
    law = Projector(planar_xy, 10.0, 10.0, second=flat)
    command, status = law.function([0.6, 0.8, 0.8], np.ones(3), *np.zeros((3, 3)), *law.gains.values())
    assert int(status) == ControlStatus.SINGULAR
    np.testing.assert_allclose(command.full().ravel(), planar_xy.robot.gravity([0.6, 0.8, 0.8]))
    assert int(law.function([0.7, 0.9, 0.8], np.ones(3), *np.zeros((3, 3)), *law.gains.values())[1]) == ControlStatus.OK


def test_whole_turns_do_not_load_springs_in_projected_coordinates(planar_xy: oc.Problem) -> None:
    problem = oc.Problem(planar_xy.robot, planar_xy.task, "inertia", oc.Box(planar_xy.domain.centre, 0.4, [0]))
    chart = oc.fit(problem, oc.Polynomial(2, cyclic=("q1",)), samples=300).chart
    q, turn = problem.domain.centre + 0.1, np.array([2 * np.pi, 0.0, 0.0])
    for law in (Projector(problem, 10.0, 10.0, second=chart), KinematicProjector(problem, 1.0, 1.0, second=chart)):
        reference = (chart.phi(q) + 0.05, np.zeros(3), np.zeros(3))
        there, again = (called(law, p, np.zeros(3), *reference) for p in (q, q + turn))
        np.testing.assert_allclose(again, there, rtol=1e-9, atol=1e-9)


def test_reference_beyond_the_domain_of_the_chart_is_refused(linear: oc.Chart) -> None:
    q = linear.problem.domain.centre
    law = Projector(linear.problem, 100.0, 10.0, second=linear)
    reference = Reference.steps(law.labels, linear.phi(q), [(0.1, {"xi1": 2.0})], 2.0)
    with pytest.raises(UnreachableReferenceError, match="at t = "):
        oc.simulate(law, reference, q)


def test_a_task_of_ones_own_runs_in_closed_loop(planar_xy: oc.Problem) -> None:
    """The second task reaches its target by self-motion, and the first is not disturbed."""
    law = Projector(planar_xy, 400.0, 200.0, 1.0, second=middle(planar_xy.robot), feed_forward=True)
    q = planar_xy.domain.centre
    start = law.measured(q).full().ravel()
    run = oc.simulate(law, Reference.steps(law.labels, start, [(0.0, {"bend": start[2] - 0.1})], 4.0), q)
    assert np.abs((run.value - run.reference)[:, :2]).max() < 1e-7
    assert abs(run.value[-1, 2] - start[2] + 0.1) < 1e-3


@pytest.mark.parametrize(
    ("make", "error", "words"),
    [
        (lambda c: {"second": "xi"}, InvalidValueError, "second is 'xi', expected a Task, a Chart, or None"),
        (lambda c: {"second": oc.Task.position(oc.problems.get("iiwa").robot)}, InvalidValueError, "of another robot"),
        (lambda c: {"second": pair(c.problem.robot, labels=["x", "z"])}, InvalidValueError, "the label 'x'"),
        (lambda c: {"second": oc.fit(oc.problems.get("planar_3r_x"), oc.Linear()).chart}, InvalidValueError, "another"),
        (
            lambda c: {"second": oc.Task.custom(c.problem.robot, "twice", lambda q: ca.vertcat(q[0], 2 * q[0]))},
            SingularTaskError,
            "'twice' has rank below 2",
        ),
        (
            lambda c: {"second": oc.Task.custom(c.problem.robot, "many", lambda q: ca.vertcat(q, ca.sin(q)))},
            SingularTaskError,
            "'many' has rank below 6",
        ),
        (lambda c: {"posture_stiffness": 0.0}, InvalidValueError, r"posture_stiffness\[0\] is 0.0"),
        (lambda c: {"posture_stiffness": -1.0, "second_force": 1.0}, InvalidValueError, r"posture_stiffness\[0\]"),
        (lambda c: {"second": c, "second_force": [1.0, 2.0]}, ShapeError, r"second_force has shape \(2,\)"),
        (lambda c: {"second_force": np.nan}, InvalidValueError, "second_force"),
        (lambda c: {"feed_forward": 1}, InvalidValueError, "feed_forward"),
    ],
)
def test_what_does_not_fit_is_refused(linear: oc.Chart, make: Any, error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words):
        Projector(linear.problem, **{"stiffness": 10.0, "posture_stiffness": 10.0, **make(linear)})


def test_grown_charts_are_refused_with_a_way_out(planar_x: oc.Problem) -> None:
    grown = oc.grow(planar_x, leaf="linear")
    with pytest.raises(NoExpressionError, match="distil"):
        Projector(planar_x, 1.0, 1.0, second=grown)
    with pytest.raises(NoExpressionError, match="distil"):
        KinematicProjector(planar_x, second=grown)


@needs_c
@pytest.mark.nightly
def test_generated_c_equals_python(planar_chart: oc.Chart, tmp_path: Path) -> None:
    """Also NaN, infinities and huge numbers: same status, same fallback."""
    problem = planar_chart.problem
    laws = [
        Projector(problem, 80.0, 10.0, limit=90.0, second=planar_chart),
        Projector(problem, 80.0, 10.0, second=planar_chart, second_force=1.0, feed_forward=True),
        Projector(problem, 80.0, 10.0, limit=90.0, second=middle(problem.robot)),
        KinematicProjector(problem, 1.0, 0.5, 2.0, second=planar_chart),
        KinematicProjector(problem, 1.0, 0.5, second=pair(problem.robot)),
    ]
    for i, law in enumerate(laws):
        generated = oc.generate_c(planar_chart, tmp_path / str(i), law, "arm")
        assert check_c(generated, planar_chart, law, states=200).differences["control"] < 1e-10
