"""Arms with a collision model: postures without contacts, and trackers that never touch."""

import pickle
from pathlib import Path

import numpy as np
import pytest
from solid_arms import build_arm

import orthocas as oc
from orthocas.arms import TrackStatus
from orthocas.charts.inverse import InverseStatus
from orthocas.errors import InvalidValueError
from orthocas.robots.collisions import Collisions

HOME = np.array([0.6, 0.8, 0.8])
LINK = '<box size="0.3 0.04 0.04"/>'


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> tuple[oc.Arm, Collisions]:
    """A planar arm with a chart, and a post that its second link meets on the way of the elbow."""
    robot = build_arm(Path(tmp_path_factory.mktemp("arm")), ["", LINK, LINK, LINK]).with_tool([1.0, 0.0, 0.0])
    task = oc.Task.position(robot, axes="xy")
    chart = oc.fit(oc.Problem(robot, task, "euclidean", oc.Box(HOME, 0.7)), oc.Polynomial(3), samples=500).chart
    q = chart.inverse(chart.phi(HOME) + np.array([0.0, 0.0, 0.7]), HOME)
    place = (robot.frame_position(q, "link2") + 0.8 * robot.frame_rotation(q, "link2")[:, 0])[:2]
    post = oc.obstacles.Capsule([*place, -1.0], [*place, 1.0], 0.02)
    return oc.Arm(task, (chart,)), robot.collisions.with_scene(oc.Scene({"post": post}))


@pytest.mark.slow
@pytest.mark.parametrize("avoid", [None, 0.05])
def test_an_arm_s_tracker_keeps_clear(arm: tuple[oc.Arm, Collisions], avoid: float | None) -> None:
    whole, around = arm
    chart = whole.charts[0]
    tracker = whole.tracker(HOME, velocity_limits=2.0, collisions=around, margin=0.02, avoid=avoid)
    again = pickle.loads(pickle.dumps(tracker))
    x, xi = chart.x(HOME), float(chart.xi(HOME)[0])
    way, statuses = [HOME], []
    for turn in np.linspace(0, 2 * np.pi, 400):
        way.append(tracker.step(x, xi + 0.8 * np.sin(turn)))
        statuses.append(tracker.status)
        np.testing.assert_array_equal(again.step(x, xi + 0.8 * np.sin(turn)), way[-1])
    q = np.array(way)
    assert around.distance(q).distance.min() > (0.02 if avoid is None else avoid) - 1e-4
    assert around.find_contact(q, clearance=0.009) is None
    if avoid is None:
        assert TrackStatus.BRAKED in statuses
    else:
        assert set(statuses) == {TrackStatus.OK, TrackStatus.YIELDING}
        np.testing.assert_allclose(chart.x(q), np.broadcast_to(x, (401, 2)), atol=1e-8)
    kept, _ = whole.follow(np.tile(x, (30, 1)), xi + 0.7, q=HOME, velocity_limits=2.0, collisions=around, margin=0.02)
    assert around.distance(kept).distance.min() > 0.02 - 1e-6


def test_free_postures_take_the_place_of_those_that_touch(arm: tuple[oc.Arm, Collisions]) -> None:
    whole, around = arm
    start = whole.robot.sample(3000, seed=4)
    start = np.concatenate([start[:40], start[~around.check_free(start)]])
    targets = whole.x(start)
    plain = whole.solve(targets, start=start)
    touches = ~around.check_free(plain.q)
    assert 20 < touches.sum() < 150
    found = whole.solve(targets, start=start, collisions=around)
    np.testing.assert_array_equal(found.q[~touches], plain.q[~touches])
    free = found.status == InverseStatus.FOUND
    assert around.check_free(found.q[free]).all()
    np.testing.assert_allclose(whole.x(found.q[free]), targets[free], atol=1e-8)
    assert free[touches].any()
    # Where none is said to be free, a dense sample of all arcs has none either, but for gaps of 0.05 rad.
    for row in np.flatnonzero(found.status == InverseStatus.COLLIDING):
        q = whole.self_motion(targets[row]).sample(2000)
        assert around.check_free(q).mean() < 0.02
    # With xi: exact if it is free, else the nearest one that is.
    x, xi = whole.x(HOME), float(whole.charts[0].xi(HOME)[0])
    touching = whole.solve(x, xi + 0.7, start=HOME)
    assert not around.check_free(touching.q)
    near = whole.solve(x, xi + 0.7, start=HOME, collisions=around)
    assert near.status in (InverseStatus.FOUND, InverseStatus.NEAREST)
    assert around.check_free(near.q)
    np.testing.assert_allclose(whole.x(near.q), x, atol=1e-8)
    every = whole.solve(x, xi + 0.7, collisions=around, all=True)
    assert isinstance(every.status, np.ndarray)
    assert InverseStatus.COLLIDING in every.status
    np.testing.assert_array_equal(around.check_free(every.q), every.status == InverseStatus.FOUND)
    with pytest.raises(InvalidValueError, match="an xi with it"):
        whole.solve(x, collisions=around, all=True)
    with pytest.raises(InvalidValueError, match="those of the chart's robot"):
        whole.solve(x, collisions=Collisions(oc.Robot.planar([2.0, 1.0], [1.0, 1.0]).tree, around.parts[:1], ()))
