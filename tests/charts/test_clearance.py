"""Solutions without contacts come first, and trackers keep their margin: by coal at every posture, and between them."""

import pickle
from pathlib import Path

import numpy as np
import pytest
from solid_arms import build_arm

import orthocas as oc
from orthocas.charts.inverse import InverseStatus
from orthocas.charts.trackers import TrackerStatus
from orthocas.errors import InvalidValueError, InverseError
from orthocas.robots.collisions import Collisions
from orthocas.tools.checks import Array

HOME = np.array([0.6, 0.8, 0.8])
LINK = '<box size="0.3 0.04 0.04"/>'


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> tuple[oc.Robot, oc.Chart]:
    """A planar arm whose last two links are boxes, with a chart of the place of its tip."""
    robot = build_arm(Path(tmp_path_factory.mktemp("arm")), ["", LINK, LINK, LINK]).with_tool([1.0, 0.0, 0.0])
    task = oc.Task.position(robot, axes="xy")
    chart = oc.fit(oc.Problem(robot, task, "euclidean", oc.Box(HOME, 0.7)), oc.Polynomial(3), samples=500).chart
    return robot, chart


def put_post(robot: oc.Robot, q: Array, link: str = "link2", radius: float = 0.02) -> Collisions:
    """A scene with a post at the solid of a link in posture q."""
    place = robot.frame_position(q, link) + 0.8 * robot.frame_rotation(q, link)[:, 0]
    post = oc.obstacles.Capsule([*place[:2], -1.0], [*place[:2], 1.0], radius)
    return robot.collisions.with_scene(oc.Scene({"post": post}))


def turn_elbow(chart: oc.Chart, most: float, count: int = 300) -> Array:
    """phi while xi goes to and fro about HOME and the tip stays."""
    path: Array = np.tile(chart.phi(HOME), (count, 1))
    path[:, -1] += most * np.sin(np.linspace(0, 2 * np.pi, count))
    return path


def place_ahead(chart: oc.Chart, xi: float) -> Array:
    """The posture with the tip at that of HOME, and another xi."""
    return np.asarray(chart.inverse(chart.phi(HOME) + np.array([0.0, 0.0, xi]), HOME))


@pytest.mark.parametrize("nearest", [False, True])
@pytest.mark.parametrize("avoid", [None, 0.05])
def test_trackers_keep_the_margin_between_their_postures_too(
    arm: tuple[oc.Robot, oc.Chart], nearest: bool, avoid: float | None
) -> None:
    robot, chart = arm
    around = put_post(robot, place_ahead(chart, 0.7))
    path = turn_elbow(chart, 0.8)
    free = chart.solve(path, HOME).q
    assert around.distance(free).distance.min() < 0  # the wish itself goes through the post
    tracker = chart.tracker(HOME, nearest=nearest, collisions=around, margin=0.02, avoid=avoid)
    q, statuses = [HOME], []
    for phi in path:
        q.append(tracker.step(phi))
        statuses.append(tracker.status)
    way = np.array(q)
    # No posture nearer than the margin, and none between them nearer than half of it: 40 samples of each step.
    assert around.distance(way).distance.min() > 0.02 - 1e-6
    dense = (way[:-1, None] + np.linspace(0, 1, 40)[:, None] * (way[1:] - way[:-1])[:, None]).reshape(-1, 3)
    assert around.distance(dense).distance.min() > 0.01 - 1e-6
    if avoid is not None:
        # The tip stays where it is to be, and xi alone gives way; away from the post xi is met.
        assert around.distance(way).distance.min() > avoid - 1e-4
        assert set(statuses) == {TrackerStatus.OK, TrackerStatus.YIELDING}
        np.testing.assert_allclose(chart.x(way[1:]), path[:, :2], atol=1e-8)
        assert np.mean(np.array(statuses) == TrackerStatus.OK) > 0.5
    elif nearest:
        assert TrackerStatus.NEAREST in statuses
        np.testing.assert_allclose(chart.x(way[1:]), path[:, :2], atol=1e-5)
    else:
        assert TrackerStatus.BRAKED in statuses
    assert statuses[-1] == TrackerStatus.OK
    np.testing.assert_allclose(way[-1], HOME, atol=1e-7)


def test_xi_gives_way_to_the_value_that_a_search_of_all_finds(arm: tuple[oc.Robot, oc.Chart]) -> None:
    """Of a dense sweep of xi with the tip held, the tracker has the last one before distances fall below 0.05 m."""
    robot, chart = arm
    around = put_post(robot, place_ahead(chart, 0.7))
    tracker = chart.tracker(HOME, collisions=around, margin=0.02, avoid=0.05)
    wish = chart.phi(place_ahead(chart, 0.7))
    q = [tracker.step(wish) for _ in range(50)][-1]
    assert tracker.status == TrackerStatus.YIELDING
    values = np.linspace(0.0, 0.7, 2001)
    sweep = chart.solve(chart.phi(HOME) + np.column_stack([0 * values, 0 * values, values]), HOME).q
    first = int(np.argmax(around.distance(sweep).distance < 0.05))
    assert 0.1 < values[first] < 0.6
    assert chart.phi(q)[2] - chart.phi(HOME)[2] == pytest.approx(values[first], abs=4e-4)


def test_a_tracker_in_free_space_is_the_plain_one(arm: tuple[oc.Robot, oc.Chart]) -> None:
    robot, chart = arm
    far = robot.collisions.with_scene(oc.Scene({"ball": oc.obstacles.Sphere([5.0, 0.0, 0.0], 0.1)}))
    plain, kept = chart.tracker(HOME), chart.tracker(HOME, collisions=far, avoid=0.05)
    again = pickle.loads(pickle.dumps(kept))
    for phi in turn_elbow(chart, 0.8):
        q = plain.step(phi)
        np.testing.assert_array_equal(kept.step(phi), q)
        np.testing.assert_array_equal(again.step(phi), q)
        assert kept.status == plain.status


def test_a_model_without_pairs_stops_nothing() -> None:
    """The rods of a planar arm are all neighbours: the distance of no pair is infinite, and no contact."""
    rods = oc.Robot.planar([1.0, 1.0, 1.0], [1.0, 1.0, 1.0]).with_rods(0.01)
    task = oc.Task.position(rods, axes="xy")
    chart = oc.fit(oc.Problem(rods, task, "euclidean", oc.Box(HOME, 0.4)), oc.Linear(), samples=300).chart
    assert np.isinf(rods.collisions.distance(HOME).distance)
    free, reach = chart.xi_range(HOME), chart.xi_range(HOME, rods.collisions)
    np.testing.assert_allclose([reach.low, reach.high], [free.low, free.high], atol=1e-8)


@pytest.mark.slow
def test_hostile_streams_touch_nothing(arm: tuple[oc.Robot, oc.Chart]) -> None:
    robot, chart = arm
    around = put_post(robot, place_ahead(chart, 0.7), radius=0.05)
    rng = np.random.default_rng(11)
    for nearest in (False, True):
        tracker = chart.tracker(HOME, largest_step=0.3, nearest=nearest, collisions=around, avoid=0.04)
        q = [HOME]
        for _ in range(400):
            far = rng.choice([0.01, 0.1, 1.0])
            q.append(tracker.step(chart.phi(q[-1]) + far * rng.normal(size=3)))
        way = np.array(q)
        assert around.find_contact(way, clearance=0.004) is None
        assert around.distance(way).distance.min() > 0.01 - 1e-6


def test_bad_distances_and_starts_are_refused(arm: tuple[oc.Robot, oc.Chart]) -> None:
    robot, chart = arm
    around = put_post(robot, HOME)
    with pytest.raises(InvalidValueError, match="'link2' and 'post' touch"):
        chart.tracker(HOME, collisions=around)
    free = robot.collisions
    with pytest.raises(InvalidValueError, match="margin"):
        chart.tracker(HOME, collisions=free, margin=-1.0)
    with pytest.raises(InvalidValueError, match="above the margin of 0.01 m"):
        chart.tracker(HOME, collisions=free, avoid=0.005)
    with pytest.raises(InvalidValueError, match="no collision model is given"):
        chart.tracker(HOME, avoid=0.05)


@pytest.fixture(scope="module")
def folded(tmp_path_factory: pytest.TempPathFactory) -> tuple[oc.Robot, oc.Chart]:
    """An arm of two links whose chart of the tip's x has two postures for one phi."""
    robot = build_arm(Path(tmp_path_factory.mktemp("folded")), ["", LINK, LINK])
    problem = oc.Problem(robot, oc.Task.position(robot, "x"), domain=oc.Box([0.5, 0.5], 1.0))
    return robot, oc.fit(problem, oc.Linear()).chart


def test_free_solutions_come_first(folded: tuple[oc.Robot, oc.Chart]) -> None:
    robot, chart = folded
    phi = chart.phi([0.4, 0.3])
    plain = chart.solutions(phi)
    assert len(plain) == 2
    around = put_post(robot, plain[0], radius=0.05)
    np.testing.assert_allclose(chart.solutions(phi, collisions=around), plain[::-1], atol=1e-12)
    every = chart.solve(phi, all=True, collisions=around)
    assert every.statuses == (InverseStatus.FOUND, InverseStatus.COLLIDING)
    assert every.error.max() < 1e-9
    # One solution: the free one is taken where the first one touches, and a status says where none is free.
    np.testing.assert_allclose(chart.solve(phi, plain[0]).q[0], plain[0], atol=1e-9)
    found = chart.solve([phi, phi + np.nan], plain[0], collisions=around)
    assert found.statuses == (InverseStatus.FOUND, InverseStatus.BAD_INPUT)
    np.testing.assert_allclose(found.q[0], plain[1], atol=1e-9)
    both = robot.collisions.with_scene(oc.Scene({"ball": oc.obstacles.Sphere([0.0, 0.0, 0.0], 3.0)}))
    touching = chart.solve(phi, plain[0], collisions=both)
    assert touching.statuses == (InverseStatus.COLLIDING,)
    with pytest.raises(InverseError, match="touch"):
        touching.require()
    with pytest.raises(InvalidValueError, match="neither of them"):
        chart.solve(phi, plain[0], all=True)
    assert not len(chart.solve(phi + 100.0, all=True, collisions=around))


def test_near_pairs_have_the_distances_of_all_pairs_and_their_gradients(arm: tuple[oc.Robot, oc.Chart]) -> None:
    robot, chart = arm
    around = put_post(robot, place_ahead(chart, 0.7))
    for q in chart.problem.domain.sample(20, 3):
        near = around.find_near(q, 0.6)
        every = dict(zip(around.pairs, around.pair_distances(q), strict=True))
        assert set(near.pairs) == {pair for pair, value in every.items() if value < 0.6}
        assert (np.diff(near.distance) >= 0).all()
        for pair, value, gradient in zip(near.pairs, near.distance, near.gradient, strict=True):
            assert value == pytest.approx(every[pair], abs=2e-6)
            if value > 1e-3:
                column = around.pairs.index(pair)
                moves = 1e-6 * np.eye(3)
                ahead, behind = around.pair_distances(q + moves), around.pair_distances(q - moves)
                np.testing.assert_allclose(gradient, (ahead - behind)[:, column] / 2e-6, atol=1e-4)
