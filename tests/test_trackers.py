"""Trackers: streams of phi, and where they stop."""

import pickle
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from programs import needs_c
from public_objects import circle, clear, wide
from scipy.optimize import minimize

import orthocas as oc
from orthocas.codegen.library import CompiledLibrary, compile_shared
from orthocas.errors import DomainError, InvalidValueError, NoExpressionError, ShapeError
from orthocas.fitting.fit import Fit
from orthocas.tasks.domains import bounds_of


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
    """What a tracker of the nearest x makes small, without the zones at the boundary."""
    e = (phi - chart.phi(q)) / chart.phi_sizes
    return float((e[: chart.m] ** 2).sum() + 1e-6 * (e[chart.m :] ** 2).sum())


@pytest.mark.slow
@pytest.mark.parametrize("make", [clear, lambda: oc.fit(oc.problems.get("planar_3r_xy"), oc.Polynomial(2)).chart])
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
    assert statuses[0] == statuses[-1] == oc.TrackerStatus.OK
    assert set(statuses) == {oc.TrackerStatus.OK, oc.TrackerStatus.NEAREST}
    np.testing.assert_allclose(q, start, atol=1e-9)
    wanted = home + out[-1] * direction
    low, high = bounds_of(domain)
    rooms = [{"type": "ineq", "fun": lambda q: -np.abs(q - start) + (high - low) / 2}]
    if domain.condition is not None:
        pivots = domain.condition.pivots
        rooms.append({"type": "ineq", "fun": lambda q: np.array(pivots(q))[:, 0]})
    other = minimize(lambda q: cost(chart, wanted, q), farthest, method="SLSQP", constraints=rooms, tol=1e-12)
    sizes = np.linalg.norm(chart.phi_sizes[: chart.m])
    assert np.sqrt(cost(chart, wanted, farthest)) < np.sqrt(other.fun) + 0.03 * sizes  # the zones


def test_xi_gives_way_to_x(planar_arm: oc.Chart) -> None:
    home = planar_arm.problem.domain.centre
    tracker, phi = planar_arm.tracker(home, nearest=True), planar_arm.phi(home)
    reach = planar_arm.xi_range(home)[0]
    for xi in np.linspace(phi[2], reach.high + 1.0, 100):
        q = tracker.step([phi[0], phi[1], xi])
    assert tracker.status == oc.TrackerStatus.NEAREST
    np.testing.assert_allclose(planar_arm.phi(q)[:2], phi[:2], atol=2e-3)
    assert planar_arm.xi(q)[0] == pytest.approx(reach.high, abs=0.05 * (reach.high - reach.low))
    again = pickle.loads(pickle.dumps(tracker))
    np.testing.assert_array_equal(again.step([phi[0], phi[1], 9.0]), tracker.step([phi[0], phi[1], 9.0]))


@pytest.mark.slow
def test_it_rests_where_a_target_pushes_it_against_the_boundary() -> None:
    """The target stays a step ahead of where the arm is, as that of a stick that is held."""
    chart = oc.charts.load("panda-wide")
    robot, q = chart.problem.robot, chart.problem.domain.centre
    tracker, x = chart.tracker(q, 0.01 * robot.velocity_limits, nearest=True), chart.task(q)
    path = []
    for _ in range(1200):
        xi = chart.xi(tracker.q) + 0.01
        path.append(tracker.step(np.concatenate([x, xi])).copy())
    assert tracker.status == oc.TrackerStatus.NEAREST
    room = np.minimum(path[-1] - robot.lower, robot.upper - path[-1]).min()
    assert 0 <= room < 0.005
    assert np.ptp(path[-300:], axis=0).max() < 1e-4
    np.testing.assert_allclose(robot.tip_position(np.array(path)), np.tile(x[:3], (1200, 1)), atol=5e-6)


def test_domains_without_a_nearest_x_are_named() -> None:
    known = oc.problems.get("planar_3r_xy")
    path = known.domain.centre + np.linspace(-0.2, 0.2, 5)[:, None] * np.ones(3)
    problem = oc.Problem(known.robot, known.task, domain=oc.Corridor(known.domain, path, 0.2))
    chart = oc.fit(problem, oc.Polynomial(2), samples=300).chart
    with pytest.raises(DomainError, match="expected a box or a clear box"):
        chart.tracker(chart.problem.domain.centre, nearest=True)


@needs_c
@pytest.mark.slow
@pytest.mark.parametrize("make", [clear, wide_chart])
def test_c_goes_to_the_same_nearest_x(make: Callable[[], oc.Chart], tmp_path: Path) -> None:
    chart = make()
    generated = oc.generate_c(chart, tmp_path, name="arm")
    library = CompiledLibrary(compile_shared(generated, tmp_path), "arm", chart.n)
    domain = chart.problem.domain
    q = domain.centre
    home, tracker = chart.phi(q), chart.tracker(q, largest_step=0.1, nearest=True)
    known = {0: oc.TrackerStatus.OK, 1: oc.TrackerStatus.NEAREST}
    found, alike = set(), []
    for s in np.linspace(0.0, 1.0, 800):
        phi = home + np.sin(np.pi * s) * np.array([4.0, 0.5 * np.sin(6 * s), 0.3])
        tracker.reset(q)
        q, status = library.nearest(phi, q, 0.1)
        other = tracker.step(phi)
        alike.append(np.abs(q - other).max() < 1e-3)
        assert known[status] == tracker.status or not alike[-1]
        assert domain.contains(q)
        found.add(status)
    assert found == {0, 1}
    assert np.mean(alike) > 0.97  # descents of 12 steps end where they are
    for bad in (np.nan, np.inf, 1e200):
        assert library.nearest(np.full_like(home, bad), q, 0.1)[1] == 3
        assert library.nearest(home, q, bad if bad != np.inf else -1.0)[1] in (0, 3)
    outside = domain.centre + 3 * domain.half_width
    same, status = library.nearest(home, outside, 0.1)
    assert status == 2
    np.testing.assert_array_equal(same, outside)
