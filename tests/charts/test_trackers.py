"""Trackers: streams of phi, and where they stop."""

import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from programs import needs_c
from public_objects import circle, clear, wide
from scipy.optimize import minimize

import orthocas as oc
from orthocas.charts.regular_part import RegularPart
from orthocas.charts.trackers import TrackerStatus
from orthocas.codegen.library import CompiledLibrary, compile_shared
from orthocas.errors import DomainError, InvalidValueError, NoExpressionError, ShapeError
from orthocas.fitting.fit import Fit
from orthocas.tasks.corridor import Corridor
from orthocas.tasks.domains import Domain


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
        assert tracker.status == TrackerStatus.OK
    np.testing.assert_allclose(chart.phi(np.array(q)), path, atol=1e-9)
    np.testing.assert_allclose(q[-1], start, atol=1e-9)
    np.testing.assert_allclose(tracker.q, q[-1], atol=0)


def test_x_and_xi_are_asked_for_by_name_and_what_is_not_asked_stays(planar_arm: oc.Chart) -> None:
    home = np.array(planar_arm.domain.centre)
    tracker, phi = planar_arm.tracker(home), planar_arm.phi(home)
    away = phi + np.array([0.02, 0.0, 0.01])
    tracker.step(x=away[:2])
    assert planar_arm.phi(tracker.q) == pytest.approx([*away[:2], phi[2]], abs=1e-9)
    tracker = pickle.loads(pickle.dumps(tracker))
    tracker.step(np.full(3, np.nan))
    tracker.step(xi=away[2])
    assert planar_arm.phi(tracker.q) == pytest.approx(away, abs=1e-9)
    with pytest.raises(InvalidValueError, match="phi alone"):
        tracker.step(phi, xi=0.1)
    with pytest.raises(ShapeError, match="x has shape"):
        tracker.step(x=phi)


def test_a_tracker_keeps_the_last_position_where_it_must_not_go(planar_arm: oc.Chart) -> None:
    """It says why, and goes on from there when the stream comes back."""
    domain = planar_arm.problem.domain
    start, known = domain.centre, planar_arm.phi(domain.centre)
    tracker = planar_arm.tracker(start, largest_step=0.2)
    edge = start + 0.99 * domain.half_width * [1, 0, 0]
    at_edge = planar_arm.tracker(edge)
    cases = {
        "OUTSIDE_DOMAIN": (at_edge, edge, planar_arm.phi(edge + np.array([0.01, 0, 0]))),
        "JUMP": (tracker, start, planar_arm.phi(start + np.array([0.21, 0.0, 0.0]))),
        "LOST": (tracker, start, known + np.array([9.0, 0.0, 0.0])),
        "BAD_INPUT": (tracker, start, known * np.nan),
    }
    for name, (follower, last, phi) in cases.items():
        np.testing.assert_array_equal(follower.step(phi), last)
        assert follower.status.name == name
    q = tracker.step(planar_arm.phi(start + 0.01))
    assert tracker.status == TrackerStatus.OK
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
    assert tracker.status in (TrackerStatus.SINGULAR, TrackerStatus.LOST)
    bounded = clear()
    q = bounded.problem.domain.centre.copy()
    follower, last = bounded.tracker(q), q
    for _ in range(200):  # straighten the arm
        q = q - [0.0, 0.01, 0.01]
        last = follower.step(bounded.phi(q))
        if follower.status != TrackerStatus.OK:
            break
    assert follower.status == TrackerStatus.OUTSIDE_DOMAIN
    assert bounded.problem.domain.contains(last)
    assert not bounded.problem.domain.contains(q)


def test_trackers_are_made_for_fitted_charts_and_points_inside(planar_arm: oc.Chart) -> None:
    centre = planar_arm.problem.domain.centre
    with pytest.raises(InvalidValueError, match="q is .*, expected a point of the domain"):
        planar_arm.tracker(centre + 9)
    with pytest.raises(InvalidValueError, match="largest_step"):
        planar_arm.tracker(centre, largest_step=0.0)
    with pytest.raises(NoExpressionError, match="tracker"):
        circle().tracker([1.0, 0.0])
    tracker = planar_arm.tracker(centre)
    for wrong in (np.zeros(2), 0.5, [[0.0, 0.0, 0.0]]):
        with pytest.raises(ShapeError, match="phi has shape"):
            tracker.step(wrong)


def wide_chart() -> oc.Chart:
    return wide().chart


def cost(chart: oc.Chart, phi: np.ndarray, q: np.ndarray) -> float:
    """What a tracker of the nearest x makes small."""
    e = chart.parts.phi_map.difference(phi, chart.phi(q)) / chart.parts.phi_sizes
    return float((e[: chart.m] ** 2).sum() + 9e-8 * (e[chart.m :] ** 2).sum())


def differences(f: Callable[[np.ndarray], Any], q: np.ndarray) -> np.ndarray:
    """Central differences, (n,) or (k, n)."""
    steps = 1e-6 * np.eye(len(q))
    return np.stack([(np.asarray(f(q + step)) - np.asarray(f(q - step))) / 2e-6 for step in steps], axis=-1)


def metres_nearer(chart: oc.Chart, phi: np.ndarray, q: np.ndarray) -> float:
    """How much nearer SLSQP comes from q (n,), with the domain's own conditions: of |D^-1 e_x|, in sizes of a place."""
    domain, scale = chart.problem.domain, 1 / cost(chart, phi, q)
    low, high = domain.bounds

    def rooms(q: np.ndarray) -> np.ndarray:
        bound = domain.singular_bound
        found = [] if bound is None else [bound.singular_values(q) - bound.least_singular_value]
        if isinstance(domain, RegularPart):
            found.append(domain.volumes(q) - domain.least_volume)
        if domain.path_bound is not None:
            found.append(1 - domain.path_bound.squared_distance(q[None])[0])
        return np.array(found)

    constraint = {"type": "ineq", "fun": rooms, "jac": lambda q: differences(rooms, q)}
    found = minimize(
        lambda q: scale * cost(chart, phi, q),
        q,
        jac=lambda q: scale * differences(lambda q: cost(chart, phi, q), q),
        bounds=list(zip(low, high, strict=True)),
        constraints=[constraint] if len(rooms(q)) else [],
        method="SLSQP",
        options={"ftol": 1e-13, "maxiter": 300},
    )
    if not domain.contains(np.clip(found.x, low, high)) and rooms(found.x).min() < -1e-7:
        return 0.0
    return float((np.sqrt(cost(chart, phi, q)) - np.sqrt(cost(chart, phi, found.x))) * chart.parts.phi_sizes[0])


def led_along_the_border(chart: oc.Chart, away: float, aside: float, ticks: int) -> np.ndarray:
    """Targets straight out of reach from the middle of the domain, then sideways, then at rest, (N, n)."""
    home = chart.phi(chart.problem.domain.centre)
    out = home[:3] / np.linalg.norm(home[:3])
    side = np.cross(out, [0.0, 0.0, 1.0])
    ways = [away * s * out for s in np.linspace(0, 1, ticks)]
    ways += [away * out + aside * s * side for s in np.linspace(0, 1, ticks)]
    ways += [ways[-1]] * ticks
    return np.array([home + np.concatenate([way, np.zeros(chart.n - 3)]) for way in ways])


BORDERS = ["panda-wide", "iiwa7-wide", "xarm7-wide", "baxter-left-wide", "panda-pose", "panda-position"]


@pytest.mark.slow
@pytest.mark.parametrize("name", BORDERS)
def test_trackers_follow_along_the_border_and_come_to_rest_where_nothing_is_nearer(name: str) -> None:
    chart = oc.charts.load(name)
    domain, step = chart.problem.domain, 0.01 * chart.problem.robot.velocity_limits
    ticks = 150
    targets = led_along_the_border(chart, 0.5, 0.2, ticks)
    tracker = chart.tracker(domain.centre, step, nearest=True)
    q = np.array([tracker.step(phi) for phi in targets])
    assert domain.contains(q).all()
    assert (np.abs(np.diff(q, axis=0)) <= step * (1 + 1e-9)).all()
    assert tracker.status == TrackerStatus.NEAREST
    np.testing.assert_array_equal(q[-1], q[-20])
    places = chart.x(q)[:, :3]
    assert np.linalg.norm(places[-1] - places[ticks - 1]) > 0.02  # one that froze at the border moves by 0
    assert np.linalg.norm(places[-1] - targets[-1, :3]) > 0.05
    assert metres_nearer(chart, targets[-1], q[-1]) < 1e-5


def test_a_tracker_that_stands_at_no_minimum_says_so(planar_arm: oc.Chart) -> None:
    """The largest step ends the first call; after enough of them it stands at a minimum."""
    start = planar_arm.problem.domain.centre
    away = planar_arm.phi(start) + np.array([9.0, 1.0, 0.0])
    tracker, costs = planar_arm.tracker(start, 0.01, nearest=True), [cost(planar_arm, away, start)]
    tracker.step(away)
    assert tracker.status == TrackerStatus.NEARER
    while tracker.status == TrackerStatus.NEARER:
        costs.append(cost(planar_arm, away, tracker.step(away)))
        assert costs[-1] <= costs[-2]
    assert tracker.status == TrackerStatus.NEAREST
    assert len(costs) > 20
    assert metres_nearer(planar_arm, away, tracker.q) < 1e-6


def corridor() -> oc.Chart:
    """A chart near a line of postures."""
    known = oc.problems.get("planar_3r_xy")
    path = known.domain.centre + np.linspace(-0.2, 0.2, 5)[:, None] * np.ones(3)
    problem = oc.Problem(known.robot, known.task, domain=Corridor(known.domain, path, 0.2))
    return oc.fit(problem, oc.Polynomial(2), samples=300).chart


KINDS = [clear, corridor, lambda: oc.fit(oc.problems.get("planar_3r_xy"), oc.Polynomial(2)).chart]


@pytest.mark.slow
@pytest.mark.parametrize("make", KINDS)
def test_trackers_go_to_the_nearest_x_and_come_back(make: Callable[[], oc.Chart]) -> None:
    """Far out of reach, the end is as near as what another method finds, inside; on the way nothing jumps."""
    chart = make()
    domain = chart.problem.domain
    start, home = domain.centre, chart.phi(domain.centre)
    tracker, q, statuses = chart.tracker(start, nearest=True), start, []
    direction = np.zeros(chart.n)
    direction[: chart.m] = home[: chart.m] / np.linalg.norm(home[: chart.m])
    out = np.linspace(0.0, 3.0, 600)
    for away in np.concatenate([out, out[::-1]]):
        new = tracker.step(home + away * direction)
        assert domain.contains(new)
        assert np.abs(new - q).max() < 0.05
        q = new
        statuses.append(tracker.status)
        if away == out[-1]:
            farthest = q
    assert statuses[0] == statuses[-1] == TrackerStatus.OK
    assert TrackerStatus.NEAREST in statuses
    np.testing.assert_allclose(q, start, atol=1e-9)
    assert metres_nearer(chart, home + out[-1] * direction, farthest) < 1e-5


def test_xi_gives_way_to_x(planar_arm: oc.Chart) -> None:
    home = planar_arm.problem.domain.centre
    tracker, phi = planar_arm.tracker(home, nearest=True), planar_arm.phi(home)
    reach = planar_arm.xi_range(home)[0]
    for xi in np.linspace(phi[2], reach.high + 1.0, 100):
        q = tracker.step([phi[0], phi[1], xi])
    assert tracker.status == TrackerStatus.NEAREST
    np.testing.assert_allclose(planar_arm.phi(q)[:2], phi[:2], atol=1e-5)
    assert planar_arm.xi(q)[0] == pytest.approx(reach.high, abs=1e-4 * (reach.high - reach.low))
    again = pickle.loads(pickle.dumps(tracker))
    np.testing.assert_array_equal(again.step([phi[0], phi[1], 9.0]), tracker.step([phi[0], phi[1], 9.0]))


@pytest.mark.slow
def test_it_rests_where_a_target_pushes_it_against_the_boundary() -> None:
    """The target stays a step ahead of where the arm is, as that of a stick that is held."""
    chart = oc.charts.load("panda-wide")
    robot, q = chart.problem.robot, chart.problem.domain.centre
    tracker, x = chart.tracker(q, 0.01 * robot.velocity_limits, nearest=True), chart.x(q)
    path = []
    for _ in range(1200):
        xi = chart.xi(tracker.q) + 0.01
        path.append(tracker.step(np.concatenate([x, xi])).copy())
    assert tracker.status == TrackerStatus.NEAREST
    room = np.minimum(path[-1] - robot.lower, robot.upper - path[-1]).min()
    assert 0 <= room < 1e-6
    assert np.ptp(path[-300:], axis=0).max() < 1e-6
    np.testing.assert_allclose(robot.tip_position(np.array(path)), np.tile(x[:3], (1200, 1)), atol=5e-6)


def test_domains_without_an_expression_are_named() -> None:
    class Ball(oc.Box):
        """Without an expression of its condition."""

        name, is_box = "ball", False
        condition = Domain.condition

    known = oc.problems.get("planar_3r_xy")
    chart = oc.fit(known, oc.Polynomial(2), samples=300).chart
    problem = oc.Problem(known.robot, known.task, domain=Ball(known.domain.centre, known.domain.half_width))
    with pytest.raises(DomainError, match="kind 'ball' has no CasADi expression of its condition"):
        oc.Chart(problem, chart.coordinates).tracker(known.domain.centre, nearest=True)


@needs_c
@pytest.mark.slow
@pytest.mark.parametrize("make", [clear, wide_chart, corridor])
def test_c_goes_to_the_same_nearest_x(make: Callable[[], oc.Chart], tmp_path: Path) -> None:
    chart = make()
    generated = oc.generate_c(chart, tmp_path, name="arm")
    library = CompiledLibrary(compile_shared(generated, tmp_path), "arm", chart.n)
    domain = chart.problem.domain
    q = domain.centre
    home, tracker = chart.phi(q), chart.tracker(q, largest_step=0.1, nearest=True)
    known = {0: TrackerStatus.OK, 1: TrackerStatus.NEAREST, 12: TrackerStatus.NEARER}
    found, alike = set(), []
    for s in np.linspace(0.0, 1.0, 800):
        phi = home + np.sin(np.pi * s) * np.array([4.0, 0.5 * np.sin(6 * s), 0.3])
        tracker.reset(q)
        q, status = library.nearest(phi, q, 0.1)
        other = tracker.step(phi)
        alike.append(known[status] == tracker.status and np.abs(q - other).max() < 1e-8)
        assert domain.contains(q)
        found.add(status)
    assert {0, 1} <= found
    assert np.mean(alike) > 0.99  # C and Python search for phi in their own ways, before they descend
    for bad in (np.nan, np.inf, 1e200):
        assert library.nearest(np.full_like(home, bad), q, 0.1)[1] == 3
        assert library.nearest(home, q, bad if bad != np.inf else -1.0)[1] in (0, 3)
    outside = domain.centre + 3 * domain.half_width
    same, status = library.nearest(home, outside, 0.1)
    assert status == 2
    np.testing.assert_array_equal(same, outside)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["panda-wide", "xarm7-wide"])
def test_steps_of_a_fifth_of_a_radian_are_found(name: str) -> None:
    """Where whole steps of Newton's method go too far, shorter ones lead to where they converge."""
    chart, rng = oc.load(name), np.random.default_rng(0)
    tracker, tried = chart.tracker(chart.domain.centre, largest_step=1.0), 0
    for q in chart.domain.sample(150, seed=3):
        step = rng.normal(size=chart.n)
        there = q + rng.uniform(0.1, 0.3) * step / np.linalg.norm(step)
        if chart.domain.contains(there):
            tracker.reset(q)
            np.testing.assert_allclose(tracker.step(chart.phi(there)), there, atol=1e-8)
            tried += 1
    assert tried > 100
