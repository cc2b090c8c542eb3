"""The inverse map for many rows: a status for each, starts, and all solutions."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from charts import beyond_domain
from public_objects import circle

import orthocas as oc
from orthocas import problems
from orthocas.charts.inverse import beyond_reach
from orthocas.charts.newton import inverses
from orthocas.errors import InvalidValueError, InverseError, NoExpressionError, ShapeError
from orthocas.fitting.fit import Fit
from orthocas.tasks.samples import sample_uniform

FOUND = oc.InverseStatus.FOUND
BEYOND = (oc.InverseStatus.OUTSIDE_DOMAIN, oc.InverseStatus.LIMIT)


def test_every_point_of_the_domain_is_found_without_a_start(iiwa_fit: Fit) -> None:
    chart = iiwa_fit.chart
    q = sample_uniform(chart.problem.domain, 3000, 5)
    solutions = chart.solve(chart.phi(q))
    assert solutions.found.all()
    assert solutions.error.max() <= 1e-9
    np.testing.assert_allclose(chart.phi(solutions.q), chart.phi(q), atol=1e-9)
    np.testing.assert_allclose(solutions.q, q, atol=1e-7)  # this chart does not fold, so they are the same points
    np.testing.assert_allclose(chart.inverse(chart.phi(q)), q, atol=1e-7)


def test_rows_do_not_depend_on_each_other(iiwa_fit: Fit) -> None:
    """Rows out of reach, outside the domain and without numbers leave the others as they are."""
    chart = iiwa_fit.chart
    q = sample_uniform(chart.problem.domain, 40, 6)
    phi = chart.phi(q)
    phi[3, 0], phi[7, 5], phi[11] = 9.0, np.nan, chart.phi(beyond_domain(chart, 12, 1.5)[-1])
    solutions = chart.solve(phi)
    assert solutions.statuses[3] == oc.InverseStatus.OUT_OF_REACH
    assert solutions.statuses[7] == oc.InverseStatus.BAD_INPUT
    assert solutions.statuses[11] in BEYOND
    good = np.setdiff1d(np.arange(40), [3, 7, 11])
    assert solutions.found.nonzero()[0].tolist() == good.tolist()
    np.testing.assert_allclose(solutions.q[good], q[good], atol=1e-7)
    assert np.isnan(solutions.q[7]).all()
    assert np.isfinite(np.delete(solutions.q, 7, axis=0)).all()
    assert solutions.error[3] == pytest.approx(
        np.abs((phi[3] - chart.phi(solutions.q[3])) / (chart.parts.phi_sizes + 1e-5 * np.abs(phi[3]))).max()
    )


def test_few_rows_and_many_have_the_same_solutions(iiwa_fit: Fit) -> None:
    """Few rows are solved one by one, in another way."""
    chart = iiwa_fit.chart
    q = sample_uniform(chart.problem.domain, 30, 7)
    starts = q + np.random.default_rng(0).uniform(-0.3, 0.3, q.shape)
    together = chart.solve(chart.phi(q), starts)
    for k in range(30):
        alone = chart.solve(chart.phi(q[k]), starts[k])
        np.testing.assert_allclose(alone.q[0], together.q[k], atol=1e-9)
        assert alone.status[0] == together.status[k]


def test_a_solution_lies_near_its_start(planar_arm: oc.Chart) -> None:
    """With a start, the search follows the solution out of the domain; without one, it stays inside if it can."""
    q = beyond_domain(planar_arm, 400, 1.6)
    inside = planar_arm.problem.domain.contains(q)
    solutions = planar_arm.solve(planar_arm.phi(q), q + 1e-3)
    near = np.abs(solutions.q - q).max(axis=1) < 1e-6
    assert near.mean() > 0.97  # the others lie at a fold
    assert (solutions.found == inside)[near].all()
    assert planar_arm.solve(planar_arm.phi(q)).found.sum() >= inside.sum()


@pytest.mark.slow
def test_what_is_found_lies_inside_and_solves(planar_arm: oc.Chart) -> None:
    wide = planar_arm.phi(beyond_domain(planar_arm, 1000, 1.5))
    solutions = planar_arm.solve(wide)
    assert 100 < solutions.found.sum() < 1000
    q, found = solutions.q, solutions.found
    assert planar_arm.problem.domain.contains(q[found]).all()
    assert not planar_arm.problem.domain.contains(q[np.isin(solutions.status, BEYOND)]).any()
    np.testing.assert_allclose(planar_arm.phi(q[found]), wide[found], atol=1e-8)


def test_corners_of_the_domain_are_found_inside(planar_arm: oc.Chart) -> None:
    """Rounding does not push solutions on the boundary out of the domain."""
    domain = planar_arm.problem.domain
    corners = domain.centre + domain.half_width * np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T
    assert planar_arm.solve(planar_arm.phi(corners)).found.all()


def test_joint_limits_and_the_boundary_of_the_domain_are_told_apart() -> None:
    robot = problems.get("iiwa").robot
    task = oc.Task.position(robot, "xyz")
    centre = np.where(np.isfinite(robot.upper), robot.upper - 0.3, 0.0)
    chart = oc.fit(oc.Problem(robot, task, domain=oc.Box(centre, 0.25)), oc.Polynomial(2), samples=500).chart
    q = np.vstack([centre + 0.2, centre + 0.28, centre + 0.35, centre - 0.35])
    statuses = chart.solve(chart.phi(q), q).statuses
    assert [status.name for status in statuses] == ["FOUND", "OUTSIDE_DOMAIN", "LIMIT", "OUTSIDE_DOMAIN"]


def test_a_singular_solution_is_named() -> None:
    robot = oc.Robot.planar([1.0, 1.0], [1.0, 1.0])
    task = oc.Task.custom(robot, "square", lambda q: q[0] ** 2)
    chart = oc.fit(oc.Problem(robot, task, domain=oc.Box([0.5, 0.0], 0.6)), oc.Polynomial(1)).chart
    phi = chart.phi([[0.0, 0.1], [0.5, 0.1]])
    solutions = chart.solve(phi, [[0.0, 0.1], [0.4, 0.1]])
    assert solutions.statuses == (oc.InverseStatus.SINGULAR, FOUND)
    with pytest.raises(InverseError, match="singular at the solution of row 0"):
        solutions.require()


def test_require_names_the_rows(planar_arm: oc.Chart) -> None:
    q = np.vstack([planar_arm.problem.domain.centre, beyond_domain(planar_arm, 30, 3.0)[29]])
    phi = np.insert(planar_arm.phi(q), 1, [9.0, 0.0, 0.0], axis=0)
    solutions = planar_arm.solve(phi)
    with pytest.raises(InverseError, match=r"rows \[1\]: relative error is"):
        solutions.require()
    assert planar_arm.solve(phi[:1]).require().found.all()


@pytest.mark.slow
def test_all_solutions_of_a_folded_chart_are_found() -> None:
    """x = cos q1 + cos(q1 + q2) and xi linear: the solutions of one equation in one unknown, counted on a net."""
    robot = oc.Robot.planar(lengths=[1.0, 1.0], masses=[1.0, 1.0])
    problem = oc.Problem(robot, oc.Task.position(robot, "x"), domain=oc.Box([0.5, 0.5], 1.0))
    chart = oc.fit(problem, oc.Linear()).chart
    g = chart.jacobian(problem.domain.centre)[1]
    along = np.array([-g[1], g[0]])
    for q in sample_uniform(problem.domain, 20, 4):
        line = q + np.linspace(-4, 4, 80_001)[:, None] * along  # all q with the same xi
        line = line[problem.domain.contains(line)]
        crossings = np.count_nonzero(np.diff(np.sign(chart.x(line)[:, 0] - chart.x(q)[0] + 1e-13)))
        found = chart.solutions(chart.phi(q))
        assert len(found) == crossings
        np.testing.assert_allclose(chart.phi(found), np.tile(chart.phi(q), (len(found), 1)), atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "inside"), [("ur10-position", False), ("iiwa7-position", True)])
def test_corner_heavy_round_trips_of_a_ready_chart_are_found(name: str, inside: bool) -> None:
    """Restarts near stored samples missed 157 of 2,000 points near faces and in corners of the first chart."""
    chart = oc.charts.load(name)
    domain = chart.problem.domain
    rng = np.random.default_rng(77)
    unit = rng.uniform(-1, 1, (2000, chart.n))
    unit = np.sign(unit) * np.abs(unit) ** rng.choice([0.25, 0.1, 0.0], (2000, 1))
    phi = chart.phi(np.clip(domain.centre + domain.half_width * unit, *domain.bounds))
    solutions = chart.solve(phi, inside=inside)
    assert solutions.found.all()
    np.testing.assert_allclose(chart.phi(solutions.q), phi, atol=1e-8)
    assert domain.contains(solutions.q).all()


@pytest.mark.slow
def test_a_certified_chart_has_all_the_solutions_that_newton_finds() -> None:
    """No fold is not one solution: Newton's method from 3,000 points finds several, and no more than `solutions`."""
    chart = oc.charts.load("ur5-position")
    domain = chart.problem.domain
    starts, several = sample_uniform(domain, 3000, 2), 0
    for q in sample_uniform(domain, 4, 3):
        phi = chart.phi(q)
        found = chart.solutions(phi)
        np.testing.assert_allclose(chart.phi(found), np.tile(phi, (len(found), 1)), atol=1e-8)
        assert domain.contains(found).all()
        tried = chart.solve(np.tile(phi, (len(starts), 1)), starts)
        away = np.abs(tried.q[tried.found][:, None] - found).max(axis=2)
        assert away.min(axis=1).max() < 1e-5
        signs = np.sign(np.linalg.det(chart.jacobian(found)))
        assert len(np.unique(signs)) == 1
        several += len(found) > 1
    assert several >= 2


@pytest.mark.slow
def test_out_of_reach_is_said_only_where_the_arm_is_too_short(planar_arm: oc.Chart) -> None:
    """The three links of 1 m reach 3 m; a task of the user's own has no such bound."""
    phi = planar_arm.phi(planar_arm.problem.domain.centre)
    turn = np.array([np.cos(0.3), np.sin(0.3)])
    targets = [[*(length * turn), phi[2]] for length in (2.9999, 3.0001)]
    statuses = planar_arm.solve(targets).statuses
    assert statuses[0] != oc.InverseStatus.OUT_OF_REACH
    assert statuses[1] == oc.InverseStatus.OUT_OF_REACH
    robot = oc.Robot.planar([1.0, 1.0], [1.0, 1.0])
    task = oc.Task.custom(robot, "cosine", lambda q: ca.cos(q[0]))
    chart = oc.fit(oc.Problem(robot, task, domain=oc.Box([1.0, 0.0], 0.5)), oc.Polynomial(1)).chart
    assert chart.solve([2.0, 0.0]).statuses == (oc.InverseStatus.NOT_FOUND,)


def test_no_tip_is_farther_away_than_beyond_reach_says() -> None:
    """Random postures of arms with tools, offsets and prismatic joints, and the same along a straight arm."""
    for name in ("iiwa7-position", "ur10-position", "tiago-pro-left-pose", "pr2-left-position"):
        chart = oc.charts.load(name)
        robot = chart.problem.robot
        low, high = np.maximum(robot.lower, -4.0), np.minimum(robot.upper, 4.0)
        x = chart.x(np.random.default_rng(0).uniform(low, high, (2000, chart.n)))
        assert not beyond_reach(chart.problem.task, x).any()
        assert beyond_reach(chart.problem.task, x + np.eye(chart.m)[0] * 9.0).all()


@pytest.mark.slow
def test_inverse_refuses_what_lies_outside_and_has_the_nearest_inside() -> None:
    """The ready chart of the Panda: with xi1 moved by 9, q1 and q6 end beyond their limits."""
    chart = oc.charts.load("panda-position")
    domain = chart.problem.domain
    centre = domain.centre
    phi = chart.phi(centre) + 9.0 * np.eye(chart.n)[chart.m]
    with pytest.raises(InverseError, match=r"outside the domain for phi: joint '.*expected within") as caught:
        chart.inverse(phi, centre)
    nearest = caught.value.nearest
    assert nearest is not None
    assert nearest.shape == (chart.n,)
    assert domain.contains(nearest)
    np.testing.assert_array_equal(nearest, chart.solve(phi, centre, inside=True).q[0])
    beyond = chart.inverse(phi, centre, outside=True)
    assert not domain.contains(beyond)
    np.testing.assert_allclose(chart.phi(beyond), phi, atol=1e-7)
    with pytest.raises(InverseError, match=r"rows \[1\]") as caught:
        chart.inverse([chart.phi(centre), phi], centre)
    assert caught.value.nearest is not None
    np.testing.assert_allclose(caught.value.nearest, [centre, nearest], atol=1e-7)
    with pytest.raises(InvalidValueError, match="outside"):
        chart.inverse(phi, centre, outside=1)  # type: ignore[arg-type]


@pytest.mark.parametrize("kind", ["orientation", "orientation:z"])
def test_no_rotation_is_more_than_half_a_turn_away(kind: str) -> None:
    """Half a turn, 2 sin(pi / 2), is found; no q has components that are longer."""
    robot = problems.iiwa_robot()
    chart = oc.fit(robot, oc.Task.named(robot, kind), parametrisation=oc.Linear(), samples=500).chart
    q = sample_uniform(chart.problem.domain, 1, 3)[0]
    # the reference is a little less than half a turn about x, which tilts z, away from the tip
    almost = pin.exp3(np.array([np.pi - 0.01, 0.0, 0.0]))
    task = oc.Task.orientation(robot, robot.tip_rotation(q) @ almost, kind[12:] or None)
    chart = oc.Chart(replace(chart.problem, task=task), chart.coordinates)
    phi, k = chart.phi(q), 3 if kind == "orientation" else 2
    np.testing.assert_allclose(np.linalg.norm(phi[:k]), 2 * np.cos(0.005), atol=1e-9)
    longer = np.concatenate([2.1 / np.linalg.norm(phi[:k]) * phi[:k], phi[k:]])
    for start in (q, None):
        found = chart.solve([phi, longer], start)
        assert found.statuses == (FOUND, oc.InverseStatus.OUT_OF_REACH)
        assert found.error[1] > 0.099
    assert chart.solve(longer, q, inside=True).statuses == (oc.InverseStatus.OUT_OF_REACH,)
    with pytest.raises(InverseError):
        chart.inverse(longer, q)


def test_grown_charts_solve_with_their_own_inverse() -> None:
    chart = circle()
    phi = np.vstack([chart.phi([1.0, 0.2]), [9.0, 9.0]])
    solutions = chart.solve(phi, [1.0, 0.1])
    assert solutions.statuses == (FOUND, oc.InverseStatus.OUT_OF_REACH)
    np.testing.assert_allclose(solutions.q[0], [1.0, 0.2], atol=1e-7)
    with pytest.raises(NoExpressionError, match="inside"):
        chart.solve(phi, inside=True)


def test_bad_arguments_are_refused(planar_arm: oc.Chart) -> None:
    phi = planar_arm.phi(planar_arm.problem.domain.centre)
    with pytest.raises(ShapeError, match="phi has shape"):
        planar_arm.solve(np.zeros((4, 2)))
    with pytest.raises(ShapeError, match="q_start has shape"):
        planar_arm.solve(np.tile(phi, (3, 1)), np.zeros((2, 3)))
    with pytest.raises(InvalidValueError, match="tolerance"):
        planar_arm.solve(phi, tolerance=-1.0)
    with pytest.raises(InvalidValueError, match="phi"):
        planar_arm.solve("centre")
    with pytest.raises(InvalidValueError, match="finite"):
        planar_arm.inverse([np.nan, 0.0, 0.0])
    assert planar_arm.solve([np.inf, 0.0, 0.0]).statuses == (oc.InverseStatus.BAD_INPUT,)


def test_no_rows_have_no_solutions(planar_arm: oc.Chart) -> None:
    solutions = planar_arm.solve(np.empty((0, 3)))
    assert (solutions.q.shape, len(solutions), solutions.found.all()) == ((0, 3), 0, True)
    assert repr(solutions) == "Solutions: no rows"


def test_solutions_show_counts_and_are_read_only(planar_arm: oc.Chart) -> None:
    solutions = planar_arm.solve(np.vstack([planar_arm.phi(planar_arm.problem.domain.centre), [9.0, 0.0, 0.0]]))
    assert repr(solutions).startswith("Solutions: 1 FOUND, 1 OUT_OF_REACH\n")
    with pytest.raises(ValueError, match="read-only"):
        solutions.q[0] = 0


def test_inverses_of_singular_and_undefined_matrices() -> None:
    A = np.array([np.diag([2.0, 4.0]), np.diag([2.0, 0.0]), np.full((2, 2), np.nan)])
    found, singular = inverses(A)
    np.testing.assert_allclose(found[:2], [np.diag([0.5, 0.25]), np.diag([0.5, 0.0])], atol=1e-15)
    assert np.isnan(found[2]).any()
    assert singular.tolist() == [False, True, False]
