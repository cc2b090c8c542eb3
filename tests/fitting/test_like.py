"""Coordinates that are like given quantities, against projected gradients and closed forms."""

import casadi as ca
import numpy as np
import pytest
from programs import Run

import orthocas as oc
from orthocas import problems
from orthocas.errors import InvalidValueError, OrthocasError
from orthocas.fitting.fit import Fit
from orthocas.fitting.like import Like
from orthocas.fitting.terms import Sizes
from orthocas.tasks.samples import sample_problem, sample_uniform
from orthocas.tools.checks import Array


def projected(problem: oc.Problem, slopes: Array, q: Array) -> Array:
    """What the task leaves of a gradient: g - J^T (J A^-1 J^T)^-1 J A^-1 g, with A^-1 by NumPy."""
    J = np.asarray(problem.task.jacobian_function(q))
    B = np.linalg.inv(np.asarray(problem.metric.function(q)))
    return np.asarray(slopes - J.T @ np.linalg.solve(J @ B @ J.T, J @ B @ slopes))


def angle_deg(v: Array, w: Array, B: Array) -> float:
    return float(np.degrees(np.arccos(np.clip(v @ B @ w / np.sqrt((v @ B @ v) * (w @ B @ w)), -1, 1))))


@pytest.fixture(scope="module", params=["euclidean", "inertia"])
def fit(request: pytest.FixtureRequest) -> Fit:
    known = problems.get("iiwa")
    problem = oc.Problem(known.robot, known.task, request.param, oc.Box(known.domain.centre, 0.25))
    return oc.fit(problem, oc.Polynomial(2), like="A3", samples=1500)


@pytest.mark.slow
def test_first_coordinate_follows_a_joint(fit: Fit) -> None:
    """The reported angle is that to the projected gradient; a fit without a meaning is farther from it."""
    chart, angles, B = fit.chart, [], np.eye(7)
    problem = chart.problem
    for q in sample_uniform(oc.Box(problem.domain.centre, 0.25), 400, 7):
        B = np.linalg.inv(np.asarray(problem.metric.function(q)))
        angles.append(angle_deg(chart.jacobian(q)[3], projected(problem, np.eye(7)[2], q), B))
    assert np.sqrt(np.mean(np.square(angles))) == pytest.approx(fit.like["A3 [rad]"], rel=0.15)
    assert fit.like["A3 [rad]"] < 15
    assert chart.xi(problem.domain.centre)[0] == pytest.approx(problem.domain.centre[2], abs=1e-12)
    assert chart.parts.named_coordinates[0] == "xi1: like A3 [rad]"
    plain = oc.fit(problem, oc.Polynomial(2), samples=1500).chart
    rows = plain.jacobian(problem.domain.centre)[3:]
    wanted = projected(problem, np.eye(7)[2], problem.domain.centre)
    own = angle_deg(chart.jacobian(problem.domain.centre)[3], wanted, B)
    assert own < min(angle_deg(row, wanted, B) for row in rows) + 1e-6


@pytest.mark.slow
def test_coordinates_stay_orthogonal_to_the_task(fit: Fit) -> None:
    plain = oc.fit(fit.chart.problem, oc.Polynomial(2), samples=1500).chart
    leaks = [oc.evaluate(chart, samples=4000).leak.rms for chart in (fit.chart, plain)]
    assert leaks[0] < 1.3 * leaks[1]
    assert fit.worst is not None
    assert fit.worst.least > 0.2


@pytest.mark.slow
def test_a_function_that_is_orthogonal_already_is_found() -> None:
    """Planar arm, task: the sum of the joints, A = I. q1 - q2 is orthogonal to it, and linear."""
    robot = oc.Robot.planar([1.0, 1.0, 1.0], [1.0, 1.0, 1.0])
    task = oc.Task.custom(robot, "turn", lambda q: q[0] + q[1] + q[2] + 0.05 * ca.sin(q[0] + q[1] + q[2]))
    problem = oc.Problem(robot, task, domain=oc.Box([0.3, 0.4, 0.5], 0.4))

    def difference(q: ca.SX) -> ca.SX:
        return q[0] - q[1]

    fit = oc.fit(problem, oc.Polynomial(2), like=difference, samples=500)
    assert fit.like["difference"] < 0.05
    q = np.array([0.5, 0.1, 0.2])
    assert fit.chart.xi(q)[0] == pytest.approx(0.4, abs=2e-3)


@pytest.mark.slow
def test_a_task_of_lower_priority() -> None:
    """Two hands of a planar tree of joints: the second position is followed across the first."""
    problem = problems.get("planar_3r_x")
    robot = problem.robot
    fit = oc.fit(problem, oc.Polynomial(3), like=oc.Task.position(robot, "y"), samples=800)
    assert set(fit.like) == {"y [m]"}
    # Not y itself: gradients are near to its own only.
    assert fit.chart.parts.named_coordinates == ("xi1: like y [m]", "xi2")
    chart, centre = fit.chart, problem.domain.centre
    wanted = projected(problem, np.asarray(oc.Task.position(robot, "y").jacobian_function(centre))[0], centre)
    B = np.linalg.inv(np.asarray(problem.metric.function(centre)))
    assert angle_deg(chart.jacobian(centre)[1], wanted, B) < 10


def test_a_task_without_reference_has_that_of_the_centre() -> None:
    known = problems.get("iiwa")
    turned = oc.Box([0.0, np.pi / 3, 0.0, -np.pi / 3, 0.0, np.pi / 3, 0.0], 0.1)  # half a turn from joints at zero
    problem = oc.Problem(known.robot, known.task, domain=turned)
    like = Like.of(problem, oc.Task.named(known.robot, "orientation"))
    np.testing.assert_allclose(np.asarray(like.function(turned.centre)), 0, atol=1e-12)
    moved = like.differentiate(turned.centre[None])[0]
    np.testing.assert_allclose(np.linalg.norm(moved, axis=0), 1, atol=1e-9)  # every joint turns the tip by its angle


def test_the_term_vanishes_for_the_projected_gradient() -> None:
    problem = problems.get("iiwa")
    like = Like.of(problem, ["A3", "A1"])
    term = like.build_term(problem, list(range(7)))
    samples = sample_problem(problem, 3, 4)
    J, Z = ca.SX.sym("J", 4, 7), ca.SX.sym("Z", 7, 4)
    q = ca.SX.sym("q", 7)
    rho = ca.Function("rho", [J, Z, q], [term.residuals(J, {"null_basis": Z, "points": q}, Sizes(7, 3, 4, True))])
    for point, basis in zip(samples.points, samples.null_basis, strict=True):
        rows = np.random.default_rng(0).normal(size=(4, 7))
        rows[0], rows[1] = (projected(problem, np.eye(7)[k], point) for k in (2, 0))
        np.testing.assert_allclose(np.asarray(rho(rows, basis, point)), 0, atol=1e-7)
        rows[1] = rows[0]
        assert np.abs(np.asarray(rho(rows, basis, point))).max() > 0.1


@pytest.mark.parametrize(
    ("like", "message"),
    [
        ("A9", "unknown like 'A9'"),
        ([], "at least one quantity"),
        (["A1", "A2", "A3", "A4", "A5"], "at most 3, one for a coordinate"),
        (lambda q: q, "like"),
        (lambda q: ca.sqrt(q[2]), "without a finite gradient in the domain"),
    ],
)
def test_refused_meanings(like: object, message: str) -> None:
    with pytest.raises(OrthocasError, match=message):
        oc.fit(problems.get("iiwa"), oc.Polynomial(1), like=like, samples=200)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("parametrisation", "settings", "message"),
    [
        (oc.Polynomial(1), {"max_mutual_deg": 1.0}, "given with max_mutual_deg"),
        (oc.Linear(), {}, "given with linear"),
        (oc.Polynomial(1), {"align_to": 0}, "given with align_to"),
    ],
)
def test_what_excludes_a_meaning(parametrisation: oc.Polynomial, settings: dict[str, object], message: str) -> None:
    problem = problems.get("iiwa")
    if "align_to" in settings:
        settings = {"align_to": oc.fit(problem, oc.Linear()).chart}
    with pytest.raises(InvalidValueError, match=message):
        oc.fit(problem, parametrisation, like="A3", samples=200, **settings)  # type: ignore[arg-type]


@pytest.mark.slow
def test_the_command_takes_meanings(run: Run) -> None:
    words = ("--param", "polynomial:2", "--like", "A3,A1", "--samples", "600", "--out", "a.orthocas")
    code, out, _ = run("fit", "iiwa", *words)
    assert code == 0
    assert "A3 [rad]" in out
    assert oc.load("a.orthocas").parts.named_coordinates[:2] == ("xi1: like A3 [rad]", "xi2: like A1 [rad]")
