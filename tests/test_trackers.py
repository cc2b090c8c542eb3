"""Trackers: streams of phi, and where they stop."""

import numpy as np
import pytest
from public_objects import circle, clear

import orthocas as oc
from orthocas.errors import InvalidValueError, NoExpressionError, ShapeError
from orthocas.fitting.fit import Fit


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
