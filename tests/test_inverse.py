"""The inverse map: batches with a status for each row, starts, the domain, trackers, derivatives, and compiled C."""

import pickle
from itertools import pairwise
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from programs import needs_c
from public_objects import circle, clear

import orthocas as oc
from orthocas import problems
from orthocas.domains import sample_uniform
from orthocas.errors import CompileError, InvalidValueError, InverseError, NoExpressionError, ShapeError
from orthocas.fitting.fit import Fit
from orthocas.inverting.newton import inverses

FOUND, NEAREST = oc.InverseStatus.FOUND, oc.InverseStatus.NEAREST
BEYOND = (oc.InverseStatus.OUTSIDE_DOMAIN, oc.InverseStatus.LIMIT)


@pytest.fixture(scope="module")
def arm() -> oc.Chart:
    """A planar arm with one coordinate."""
    return oc.fit(problems.get("planar_3r_xy"), oc.Polynomial(3), samples=300).chart


def beyond_domain(chart: oc.Chart, count: int, share: float) -> np.ndarray:
    """Joint positions of a domain that is wider by a share."""
    domain = chart.problem.domain
    points: np.ndarray = domain.centre + share * (sample_uniform(domain, count, 3) - domain.centre)
    return points


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
        np.abs((phi[3] - chart.phi(solutions.q[3])) / (chart.phi_sizes + 1e-5 * np.abs(phi[3]))).max()
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


def test_a_solution_lies_near_its_start(arm: oc.Chart) -> None:
    """With a start, the search follows the solution out of the domain; without one, it stays inside if it can."""
    q = beyond_domain(arm, 400, 1.6)
    inside = arm.problem.domain.contains(q)
    solutions = arm.solve(arm.phi(q), q + 1e-3)
    near = np.abs(solutions.q - q).max(axis=1) < 1e-6
    assert near.mean() > 0.97  # the others lie at a fold
    assert (solutions.found == inside)[near].all()
    assert arm.solve(arm.phi(q)).found.sum() >= inside.sum()


def test_what_is_found_lies_inside_and_solves(arm: oc.Chart) -> None:
    wide = arm.phi(beyond_domain(arm, 1000, 1.5))
    solutions = arm.solve(wide)
    assert 100 < solutions.found.sum() < 1000
    q, found = solutions.q, solutions.found
    assert oc.contains(arm.problem.domain, q[found]).all()
    assert not oc.contains(arm.problem.domain, q[np.isin(solutions.status, BEYOND)]).any()
    np.testing.assert_allclose(arm.phi(q[found]), wide[found], atol=1e-8)


def test_corners_of_the_domain_are_found_inside(arm: oc.Chart) -> None:
    """Rounding does not push solutions on the border out of the domain."""
    domain = arm.problem.domain
    corners = domain.centre + domain.half_width * np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T
    assert arm.solve(arm.phi(corners)).found.all()


def test_joint_limits_and_the_border_of_the_domain_are_told_apart() -> None:
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


def test_require_names_the_rows(arm: oc.Chart) -> None:
    phi = np.vstack([arm.phi(arm.problem.domain.centre), [9.0, 0.0, 0.0], arm.phi(beyond_domain(arm, 30, 3.0)[29])])
    solutions = arm.solve(phi)
    with pytest.raises(InverseError, match=r"rows \[1\]: relative error is"):
        solutions.require()
    assert arm.solve(phi[:1]).require().found.all()


def test_inside_gives_the_nearest_coordinates_that_keep_the_task(arm: oc.Chart) -> None:
    """No point of a fine net of self-motions inside the domain is nearer, and rows without such points say so."""
    domain = arm.problem.domain
    phi = arm.phi(beyond_domain(arm, 60, 1.25))
    solutions = arm.solve(phi, inside=True)
    assert {FOUND, NEAREST} <= set(solutions.statuses)
    kept = np.isin(solutions.status, (FOUND, NEAREST))
    assert domain.contains(solutions.q).all()
    np.testing.assert_allclose(arm.task(solutions.q[kept]), phi[kept, :2], atol=1e-8)
    np.testing.assert_allclose(solutions.distance, np.abs(arm.xi(solutions.q) - phi[:, 2:])[:, 0], atol=1e-9)
    for k in np.flatnonzero(solutions.status != FOUND):
        inner = self_motion(arm, phi[k, :2])
        if solutions.status[k] == NEAREST:
            least = np.abs(arm.xi(inner) - phi[k, 2]).min() if len(inner) else np.inf
            assert solutions.distance[k] <= least + 1e-7  # Ipopt stays a little off the border
        else:
            assert len(inner) == 0


def self_motion(arm: oc.Chart, x: np.ndarray) -> np.ndarray:
    """Joint positions of the planar arm inside the domain with the tip at x, in closed form for 4,001 last joints."""
    domain = arm.problem.domain
    wrist_angle = np.linspace(*(domain.centre[2] + domain.half_width[2] * np.array([-1, 1])), 4001)
    reach = np.hypot(1 + np.cos(wrist_angle), np.sin(wrist_angle))  # of links 2 and 3 as one
    bend = np.arctan2(np.sin(wrist_angle), 1 + np.cos(wrist_angle))
    cosine = (x @ x - 1 - reach**2) / (2 * reach)
    found = []
    for sign in (-1, 1):
        with np.errstate(invalid="ignore"):
            elbow = sign * np.arccos(cosine)
        shoulder = np.arctan2(x[1], x[0]) - np.arctan2(reach * np.sin(elbow), 1 + reach * np.cos(elbow))
        found.append(np.stack([shoulder, elbow - bend, wrist_angle], axis=1))
    q = np.concatenate(found)
    q = q[np.isfinite(q).all(axis=1)]
    return q[domain.contains(q)]


def test_inside_keeps_clear_of_singular_positions() -> None:
    """The part of a box that is clear counts as inside, and no other."""
    chart = clear()
    box = oc.Box(chart.problem.domain.centre, 1.2 * chart.problem.domain.half_width)
    solutions = chart.solve(chart.phi(sample_uniform(box, 150, 1)), inside=True)
    kept = np.isin(solutions.status, (FOUND, NEAREST))
    assert (solutions.status == NEAREST).sum() > 5
    assert chart.problem.domain.contains(solutions.q[kept]).all()


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
        crossings = np.count_nonzero(np.diff(np.sign(chart.task(line)[:, 0] - chart.task(q)[0] + 1e-13)))
        found = chart.solutions(chart.phi(q))
        assert len(found) == crossings
        np.testing.assert_allclose(chart.phi(found), np.tile(chart.phi(q), (len(found), 1)), atol=1e-9)


def test_grown_charts_solve_with_their_own_inverse() -> None:
    chart = circle()
    phi = np.vstack([chart.phi([1.0, 0.2]), [9.0, 9.0]])
    solutions = chart.solve(phi, [1.0, 0.1])
    assert solutions.statuses == (FOUND, oc.InverseStatus.OUT_OF_REACH)
    np.testing.assert_allclose(solutions.q[0], [1.0, 0.2], atol=1e-7)
    with pytest.raises(NoExpressionError, match="inside"):
        chart.solve(phi, inside=True)


def test_bad_arguments_are_refused(arm: oc.Chart) -> None:
    phi = arm.phi(arm.problem.domain.centre)
    with pytest.raises(ShapeError, match="phi has shape"):
        arm.solve(np.zeros((4, 2)))
    with pytest.raises(ShapeError, match="q_start has shape"):
        arm.solve(np.tile(phi, (3, 1)), np.zeros((2, 3)))
    with pytest.raises(InvalidValueError, match="tolerance"):
        arm.solve(phi, tolerance=-1.0)
    with pytest.raises(InvalidValueError, match="phi"):
        arm.solve("centre")
    with pytest.raises(InvalidValueError, match="finite"):
        arm.inverse([np.nan, 0.0, 0.0])
    assert arm.solve([np.inf, 0.0, 0.0]).statuses == (oc.InverseStatus.BAD_INPUT,)


def test_no_rows_have_no_solutions(arm: oc.Chart) -> None:
    solutions = arm.solve(np.empty((0, 3)))
    assert (solutions.q.shape, len(solutions), solutions.found.all()) == ((0, 3), 0, True)
    assert repr(solutions) == "Solutions: no rows"


def test_solutions_show_counts_and_are_read_only(arm: oc.Chart) -> None:
    solutions = arm.solve(np.vstack([arm.phi(arm.problem.domain.centre), [9.0, 0.0, 0.0]]))
    assert repr(solutions).startswith("Solutions: 1 FOUND, 1 OUT_OF_REACH\n")
    with pytest.raises(ValueError, match="read-only"):
        solutions.q[0] = 0


def test_inverses_of_singular_and_undefined_matrices() -> None:
    A = np.array([np.diag([2.0, 4.0]), np.diag([2.0, 0.0]), np.full((2, 2), np.nan)])
    found, singular = inverses(A)
    np.testing.assert_allclose(found[:2], [np.diag([0.5, 0.25]), np.diag([0.5, 0.0])], atol=1e-15)
    assert np.isnan(found[2]).any()
    assert singular.tolist() == [False, True, False]


def circle_of_the_tool(chart: oc.Chart, count: int = 500) -> np.ndarray:
    """Values of phi for a circle of the tool while one coordinate moves to and fro."""
    angle = np.linspace(0, 2 * np.pi, count)
    path: np.ndarray = np.tile(chart.phi(chart.problem.domain.centre), (count, 1))
    path[:, 0] += 0.05 * np.sin(angle)
    path[:, 1] += 0.05 * (1 - np.cos(angle))
    path[:, chart.m] += 0.1 * np.sin(angle)
    return path


def test_a_tracker_follows_a_stream_and_comes_back(iiwa_fit: Fit) -> None:
    chart = iiwa_fit.chart
    path, start = circle_of_the_tool(chart), chart.problem.domain.centre
    tracker = chart.tracker(start)
    q = []
    for phi in path:
        q.append(tracker.step(phi))
        assert tracker.status == oc.TrackerStatus.OK
    np.testing.assert_allclose(chart.phi(np.array(q)), path, atol=1e-9)
    np.testing.assert_allclose(q[-1], start, atol=1e-9)
    np.testing.assert_allclose(tracker.q, q[-1], atol=0)


def test_a_tracker_keeps_the_last_position_where_it_must_not_go(arm: oc.Chart) -> None:
    """It says why, and goes on from there when the stream comes back."""
    domain = arm.problem.domain
    start, known = domain.centre, arm.phi(domain.centre)
    tracker = arm.tracker(start, largest_step=0.2)
    edge = start + 0.99 * domain.half_width * [1, 0, 0]
    at_edge = arm.tracker(edge)
    cases = {
        "OUTSIDE_DOMAIN": (at_edge, edge, arm.phi(edge + np.array([0.01, 0, 0]))),
        "JUMP": (tracker, start, arm.phi(start + np.array([0.21, 0.0, 0.0]))),
        "LOST": (tracker, start, known + np.array([9.0, 0.0, 0.0])),
        "BAD_INPUT": (tracker, start, known * np.nan),
    }
    for name, (follower, last, phi) in cases.items():
        np.testing.assert_array_equal(follower.step(phi), last)
        assert follower.status.name == name
    q = tracker.step(arm.phi(start + 0.01))
    assert tracker.status == oc.TrackerStatus.OK
    np.testing.assert_allclose(q, start + 0.01, atol=1e-9)
    tracker.reset(edge)
    np.testing.assert_array_equal(tracker.q, edge)


def test_a_tracker_stops_at_a_singular_position_and_clear_of_it() -> None:
    """J of a square task is singular at 0; and a clear box counts as the domain."""
    robot = oc.Robot.planar([1.0, 1.0], [1.0, 1.0])
    task = oc.Task.custom(robot, "square", lambda q: q[0] ** 2)
    chart = oc.fit(oc.Problem(robot, task, domain=oc.Box([0.3, 0.0], 0.5)), oc.Polynomial(1)).chart
    tracker = chart.tracker([0.05, 0.0], largest_step=1.0)
    xi = chart.xi([0.0, 0.0])[0]
    tracker.step([0.0, xi])
    assert tracker.status in (oc.TrackerStatus.SINGULAR, oc.TrackerStatus.LOST)
    bounded = clear()
    q = bounded.problem.domain.centre.copy()
    follower, last = bounded.tracker(q), q
    for _ in range(200):  # straighten the arm
        q = q - [0.0, 0.01, 0.01]
        last = follower.step(bounded.phi(q))
        if follower.status != oc.TrackerStatus.OK:
            break
    assert follower.status == oc.TrackerStatus.OUTSIDE_DOMAIN
    assert bounded.problem.domain.contains(last)
    assert not bounded.problem.domain.contains(q)


def test_trackers_are_made_for_fitted_charts_and_points_inside(arm: oc.Chart) -> None:
    centre = arm.problem.domain.centre
    with pytest.raises(InvalidValueError, match="q is .*, expected a point of the domain"):
        arm.tracker(centre + 9)
    with pytest.raises(InvalidValueError, match="largest_step"):
        arm.tracker(centre, largest_step=0.0)
    with pytest.raises(NoExpressionError, match="tracker"):
        circle().tracker([1.0, 0.0])
    tracker = arm.tracker(centre)
    for wrong in (np.zeros(2), 0.5, [[0.0, 0.0, 0.0]]):
        with pytest.raises(ShapeError, match="phi has shape"):
            tracker.step(wrong)


def test_inverse_function_has_first_and_second_derivatives(arm: oc.Chart) -> None:
    """J^-1 for the first; differences of it for the second; the start does not matter."""
    n, inverse = arm.n, arm.function("inverse")
    q = arm.problem.domain.centre + 0.2
    phi, start, weights = arm.phi(q), arm.problem.domain.centre, np.arange(1.0, n + 1)
    np.testing.assert_allclose(inverse(phi, start).full()[:, 0], q, atol=1e-10)
    p, s = ca.MX.sym("p", n), ca.MX.sym("s", n)
    value = inverse(p, s)
    first = ca.Function("first", [p, s], [ca.jacobian(value, p), ca.jacobian(value, s)])
    second = ca.Function("second", [p, s], [ca.hessian(ca.dot(weights, value), p)[0]])
    by_phi, by_start = (part.full() for part in first(phi, start))
    np.testing.assert_allclose(by_phi, np.linalg.inv(arm.jacobian(q)), atol=1e-12)
    assert not by_start.any()

    def gradient(at: np.ndarray) -> np.ndarray:
        return weights @ np.linalg.inv(arm.jacobian(arm.inverse(at, q)))

    step = 1e-5
    differences = np.array([(gradient(phi + step * e) - gradient(phi - step * e)) / (2 * step) for e in np.eye(n)])
    np.testing.assert_allclose(second(phi, start).full(), differences, atol=1e-6)


def test_inverse_function_is_nan_where_it_finds_nothing(arm: oc.Chart, capfd: pytest.CaptureFixture[str]) -> None:
    inverse, centre = arm.function("inverse"), arm.problem.domain.centre
    assert np.isnan(inverse(arm.phi(centre) + np.array([9.0, 0.0, 0.0]), centre).full()).all()
    assert capfd.readouterr() == ("", "")


def test_inverse_and_phi_give_the_same_optimum(arm: oc.Chart) -> None:
    """The shortest joint path while the tool moves on a line: over xi with the inverse, and over q with phi."""
    start, knots = arm.problem.domain.centre, 6
    line = arm.task(start) + np.linspace(0, 1, knots)[:, None] * [0.05, -0.1]
    by_inverse, over_q = ca.Opti(), ca.Opti()
    xi = by_inverse.variable(knots)
    inverse, guess = arm.function("inverse"), ca.DM(start)
    q = [inverse(ca.vertcat(line[k], xi[k]), guess) for k in range(knots)]
    by_inverse.minimize(sum(ca.sumsqr(b - a) for a, b in pairwise(q)))
    by_inverse.subject_to(xi[0] == arm.xi(start)[0])
    by_inverse.set_initial(xi, arm.xi(start)[0])
    Q = over_q.variable(3, knots)
    over_q.minimize(ca.sumsqr(Q[:, 1:] - Q[:, :-1]))
    for k in range(1, knots):
        over_q.subject_to(arm.task(Q[:, k]) == line[k])
    over_q.subject_to(Q[:, 0] == start)
    over_q.set_initial(Q, np.tile(start[:, None], knots))
    lengths = []
    for problem in (by_inverse, over_q):
        problem.solver("ipopt", {"print_time": False}, {"print_level": 0, "sb": "yes"})
        lengths.append(problem.solve().value(problem.f))
    assert lengths[0] == pytest.approx(lengths[1], rel=1e-7)


@needs_c
def test_compiled_c_gives_the_same_solutions(iiwa_fit: Fit, tmp_path: Path) -> None:
    """Of all kinds: found, outside, out of reach and without numbers, with starts and without."""
    chart = iiwa_fit.chart
    compiled = oc.compile_inverse(chart, tmp_path / "cache")
    q = beyond_domain(chart, 600, 1.15)
    phi = chart.phi(q)
    phi[5, 0], phi[9, 2] = 9.0, np.nan
    for start, most in ((None, 0), (q + 0.05, 0), (chart.problem.domain.centre, 6)):  # the last one is far away
        mine, theirs = chart.solve(phi, start), compiled.solve(phi, start)
        assert {0, 2, 5, 6} <= set(mine.statuses)
        same = theirs.status == mine.status
        assert np.count_nonzero(~same) <= most
        np.testing.assert_allclose(theirs.q[same], mine.q[same], atol=1e-9)
        assert theirs.error[theirs.found].max() <= 1e-9


@needs_c
def test_a_library_is_compiled_once(arm: oc.Chart, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    first = oc.compile_inverse(arm)
    (library,) = (tmp_path / "orthocas").iterdir()
    written = library.stat().st_mtime_ns
    again = oc.compile_inverse(arm)
    assert (again.library, library.stat().st_mtime_ns) == (first.library, written)
    assert oc.compile_inverse(clear()).library != library
    copy = pickle.loads(pickle.dumps(first))
    phi = arm.phi(arm.problem.domain.centre)
    np.testing.assert_array_equal(copy.solve(phi).q, first.solve(phi).q)


@needs_c
def test_singular_solutions_of_compiled_c_are_named(tmp_path: Path) -> None:
    robot = oc.Robot.planar([1.0, 1.0], [1.0, 1.0])
    task = oc.Task.custom(robot, "square", lambda q: q[0] ** 2)
    chart = oc.fit(oc.Problem(robot, task, domain=oc.Box([0.5, 0.0], 0.6)), oc.Polynomial(1)).chart
    phi = chart.phi([[0.0, 0.1], [0.5, 0.1]])
    solutions = oc.compile_inverse(chart, tmp_path).solve(phi, [[0.0, 0.1], [0.4, 0.1]])
    assert solutions.statuses == (oc.InverseStatus.SINGULAR, FOUND)


@needs_c
def test_a_damaged_library_and_grown_charts_are_refused(arm: oc.Chart, tmp_path: Path) -> None:
    compiled = oc.compile_inverse(arm, tmp_path)
    compiled.library.write_bytes(b"damaged")
    with pytest.raises(CompileError, match="delete it"):
        oc.compile_inverse(arm, tmp_path).solve(arm.phi(arm.problem.domain.centre))
    with pytest.raises(NoExpressionError):
        oc.compile_inverse(circle(), tmp_path)
    with pytest.raises(InvalidValueError, match="local"):
        arm.solve(arm.phi(arm.problem.domain.centre), local=3)  # type: ignore[arg-type]
