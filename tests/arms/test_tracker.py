"""Trackers of arms: x and xi where they can be had, x first elsewhere, and the nearest x out of reach."""

import pickle
from functools import cache

import numpy as np
import pytest
from conftest import ROBOTS, robot_data
from programs import nightly

import orthocas as oc
from orthocas.arms import ArmTracker, TrackStatus
from orthocas.errors import InvalidValueError
from orthocas.tools.checks import Array

PERIOD = 0.01


@cache
def panda() -> oc.Arm:
    chart = oc.load("panda-wide")
    return oc.Arm(chart.problem.task, (chart,))


def centre() -> Array:
    return np.array(panda().charts[0].problem.domain.centre)


def lead(tracker: ArmTracker, targets: Array, xi: float | None = None) -> list[TrackStatus]:
    """The status of each call; each keeps the limits of position and velocity."""
    robot, found = panda().robot, []
    for x in targets:
        before = tracker.q
        q = tracker.step(x, xi)
        assert (np.abs(q - before) <= robot.velocity_limits * PERIOD * (1 + 1e-9)).all()
        assert ((q >= robot.lower) & (q <= robot.upper)).all()
        found.append(tracker.status)
    return found


def along(x: Array, way: Array, steps: int) -> Array:
    """Targets from x to x + way."""
    shares = (1 - np.cos(np.linspace(0, np.pi, steps))) / 2
    targets = np.tile(x, (steps, 1))
    targets[:, : len(way)] += shares[:, None] * way
    return targets


@pytest.mark.slow
def test_inside_a_chart_x_and_xi_are_met() -> None:
    arm, chart, q = panda(), panda().charts[0], centre()
    tracker, phi = arm.tracker(q, period=PERIOD), chart.phi(centre())
    targets = along(phi[:6], np.array([0.1, 0.1, -0.1]), 200)
    for x, xi in zip(targets, phi[6] + np.linspace(0.0, 0.2, 200), strict=True):
        posture = tracker.step(x, xi)
        assert tracker.status is TrackStatus.OK
        assert np.abs(chart.phi(posture) - np.append(x, xi)).max() < 1e-8
    assert tracker.xi == pytest.approx(phi[6] + 0.2, abs=1e-8)
    assert tracker.branch == arm.branch_names[0]


def test_near_a_posture_the_free_motion_of_the_joints_leads_no_nearer() -> None:
    """With x met, the self-motion is at right angles to the way to the posture; the way plays no part."""
    arm, wish = panda(), centre() + np.array([0.3, -0.2, 0.2, 0.1, -0.3, 0.2, -0.1])
    tracker, x, rng = arm.tracker(centre(), period=PERIOD), arm.x(centre()), np.random.default_rng(4)
    answers = []
    for _ in range(3):
        out = along(x, rng.uniform(-0.1, 0.1, 3), 100)
        for target in (*out, *out[::-1], *[x] * 60):
            tracker.step(target, posture=wish)
            assert tracker.status is TrackStatus.OK
        answers.append(tracker.q)
    assert answers[1] == pytest.approx(answers[0], abs=1e-9)
    assert answers[2] == pytest.approx(answers[0], abs=1e-9)
    J = arm.maps.evaluate(answers[0][None], arm.maps.targets_of(answers[0][None]))[1][0]
    assert abs(np.linalg.svd(J)[2][-1] @ (answers[0] - wish)) < 1e-8
    assert np.linalg.norm(answers[0] - wish) < np.linalg.norm(centre() - wish)
    assert tracker.step(x) == pytest.approx(answers[0], abs=1e-9)
    tracker.step(x, posture=np.full(7, np.nan))
    assert tracker.status is TrackStatus.BAD_INPUT
    with pytest.raises(InvalidValueError, match="one of the two"):
        tracker.step(x, 0.1, posture=wish)
    for _ in range(200):
        tracker.step(x, 0.1)
    assert tracker.xi == pytest.approx(0.1, abs=1e-8)


def test_out_of_reach_it_rests_at_a_minimum_and_comes_back_with_its_xi() -> None:
    arm, q = panda(), centre()
    tracker, x = arm.tracker(q, period=PERIOD), arm.x(q)
    far = along(x, np.array([0.9, 0.0, 0.0]), 200)
    assert TrackStatus.NEAREST not in lead(tracker, far)
    statuses = lead(tracker, np.tile(far[-1], (100, 1)))
    rest = tracker.q
    assert statuses[-1] is TrackStatus.NEAREST
    assert (tracker.step(far[-1]) == rest).all()
    # No posture nearby is nearer.
    target = arm.maps.targets.build(far[-1:])
    nearby = np.clip(rest + 0.02 * np.random.default_rng(0).normal(size=(2000, 7)), arm.robot.lower, arm.robot.upper)
    errors = np.linalg.norm(arm.maps.evaluate(np.vstack([rest, nearby]), np.tile(target, (2001, 1)))[0], axis=1)
    assert errors[0] <= errors[1:].min() + 1e-6
    statuses = lead(tracker, np.vstack([far[::-1], np.tile(x, (100, 1))]))
    assert statuses[-1] is TrackStatus.OK
    assert tracker.q == pytest.approx(q, abs=1e-7)


def test_jumps_are_followed_as_fast_as_joints_may() -> None:
    arm, rng = panda(), np.random.default_rng(1)
    tracker, x = arm.tracker(centre(), period=PERIOD), arm.x(centre())
    low, high = arm.robot.lower, arm.robot.upper
    for q in rng.uniform(low, high, (6, 7)):
        lead(tracker, np.tile(arm.x(q), (30, 1)), rng.uniform(-1, 1))
    xi = float(panda().charts[0].xi(centre())[0])
    statuses = lead(tracker, np.tile(x, (700, 1)), xi)
    assert statuses[-1] in (TrackStatus.OK, TrackStatus.YIELDING)
    assert np.abs(arm.x(tracker.q) - x).max() < 1e-8


@pytest.mark.slow
@pytest.mark.parametrize("name", ["xarm7-wide", *nightly("iiwa7-wide", "baxter-left-wide")])
def test_hostile_streams_neither_break_limits_nor_lose_the_arm(name: str) -> None:
    """Jumps, targets out of reach and behind the base, NaN: afterwards, x and xi of the begin are met again."""
    chart, rng = oc.load(name), np.random.default_rng(4)
    arm, home = oc.Arm(chart.task, (chart,)), chart.domain.centre
    tracker, low, high = arm.tracker(home, period=PERIOD), arm.robot.lower, arm.robot.upper
    x0, most = arm.x(home), arm.robot.velocity_limits * PERIOD * (1 + 1e-9)
    for kind in range(4):
        jumps = arm.x(rng.uniform(np.maximum(low, -np.pi), np.minimum(high, np.pi), (8, arm.robot.n)))
        far = x0 + np.append(1.5 * rng.normal(size=3), np.zeros(3))
        behind = x0 * np.array([-1, -1, 1, 1, 1, 1])
        for x in (jumps, [far] * 8, [behind] * 8, [np.full(6, np.nan), *jumps])[kind]:
            for _ in range(20):
                before, q = tracker.q, tracker.step(x)
                assert (np.abs(q - before) <= most).all()
                assert ((q >= low) & (q <= high)).all()
        for _ in range(900):
            tracker.step(x0)
        assert np.abs(arm.x(tracker.q) - x0).max() < 1e-8, kind
        assert tracker.status is TrackStatus.OK, kind
        assert tracker.xi == pytest.approx(float(chart.xi(home)[0]), abs=1e-8)


def test_xi_on_another_arc_is_reached_again() -> None:
    """From a posture of the same pose on another arc, the arm leaves x for a while; without detours, it may not."""
    arm, chart = panda(), panda().charts[0]
    q = np.array([0.3, -0.9, 1.2, -1.9, 0.6, 2.0, 0.2])
    x, xi = arm.x(q), float(chart.xi(q)[0])
    arcs, own = arm.self_motion(x), arm.self_motion(x).nearest(q).component
    others = [arc.at(arc.length / 2) for k, arc in enumerate(arcs) if k != own]
    other = min(others, key=lambda posture: float(np.abs(posture - q).max()))
    for detours, end in ((True, TrackStatus.OK), (False, TrackStatus.YIELDING)):
        tracker = arm.tracker(q, period=PERIOD, detours=detours)
        lead(tracker, arm.x(np.linspace(q, other, 300)))  # so that the chart is the one of the begin
        statuses = lead(tracker, np.tile(x, (900, 1)), xi)
        assert np.abs(arm.x(tracker.q) - x).max() < 1e-8
        if statuses[0] is not TrackStatus.OK:
            assert statuses[-1] is end
        assert detours or TrackStatus.BEHIND not in statuses


def test_joints_keep_limits_of_acceleration_and_stop_before_their_ends() -> None:
    """Random jumps, out of reach as well, and NaN; a slow motion is followed exactly, a jump after it swings."""
    arm, rng, most = panda(), np.random.default_rng(5), 10.0 * PERIOD**2
    tracker, low, high = (
        arm.tracker(centre(), period=PERIOD, acceleration_limits=10.0),
        arm.robot.lower,
        arm.robot.upper,
    )
    before, step = tracker.q, np.zeros(7)
    jumps = arm.x(rng.uniform(low, high, (12, 7)))
    jumps[3, :3] += 2.0
    jumps[6] = np.nan
    for x in jumps:
        for _ in range(30):
            q = tracker.step(x, rng.uniform(-1, 1))
            assert (np.abs((q - before) - step) <= most * (1 + 1e-6)).all()
            assert (np.abs(q - before) <= arm.robot.velocity_limits * PERIOD * (1 + 1e-9)).all()
            assert ((q >= low) & (q <= high)).all()
            before, step = q, q - before
    tracker.reset(centre())
    phi = panda().charts[0].phi(centre())
    for x in along(phi[:6], np.array([0.2, 0.1, 0.0]), 200):
        tracker.step(x)
        assert tracker.status is TrackStatus.OK
    far, errors = along(phi[:6], np.array([-0.1, 0.2, 0.1]), 2)[-1], []
    for _ in range(300):
        errors.append(float(np.linalg.norm((arm.x(tracker.step(far)) - far)[:3])))
    assert tracker.status in (TrackStatus.OK, TrackStatus.YIELDING)
    # within a second it swings about the target by some per cent of the jump, then it is there
    assert max(errors[100:]) < 0.03 * errors[0]
    assert max(errors[150:]) < 1e-9


def test_on_a_moving_base_x_is_followed_and_the_posture_comes_back() -> None:
    """Of the planar arm with three joints too many; a heavy first joint moves least."""
    robot = oc.Robot.planar(lengths=[1.0, 1.0, 0.5, 0.5, 0.3], masses=[1.0] * 5)
    arm, q = oc.Arm(oc.Task.position(robot, "xy")), np.array([0.2, 0.5, 0.4, -0.6, 0.8])
    moved = []
    for weights in (None, [100.0, 1.0, 1.0, 1.0, 1.0]):
        tracker, x = arm.tracker(q, velocity_limits=1.5, weights=weights), arm.x(q)
        for share in np.linspace(0.0, 1.0, 200):
            tracker.step(x - 0.4 * share)
            assert tracker.status is TrackStatus.OK
            assert np.abs(arm.x(tracker.q) - x + 0.4 * share).max() < 1e-8
        moved.append(abs(tracker.q[0] - q[0]))
        lead_back = [tracker.step(x) for _ in range(300)]
        assert lead_back[-1] == pytest.approx(q, abs=1e-6)
    assert moved[1] < moved[0] / 2
    with pytest.raises(InvalidValueError, match="n - m = 3"):
        arm.self_motion(arm.x(q))


def test_without_detours_the_error_of_a_target_at_rest_never_rises() -> None:
    arm = panda()
    for q in np.random.default_rng(2).uniform(arm.robot.lower, arm.robot.upper, (4, 7)):
        tracker, x = arm.tracker(centre(), period=PERIOD, detours=False), arm.x(q)
        target, errors = arm.maps.targets.build(x[None]), []
        for _ in range(150):
            e = arm.maps.evaluate(tracker.step(x)[None], target)[0]
            errors.append(float(np.linalg.norm(e)))
        assert (np.diff(errors) <= 1e-7).all()


def test_targets_that_are_not_finite_or_no_orientation_leave_the_arm_where_it_is() -> None:
    tracker, x = panda().tracker(centre()), panda().x(centre())
    broken = np.eye(4)
    broken[0, 3] = np.nan
    # No orientation has a vector of a length above 2 = 2 sin(pi/2).
    beyond = np.append(x[:3], [1.9, 1.9, 0.0])
    for bad in (np.full(6, np.nan), np.append(x[:5], np.inf), broken, beyond, np.append(x[:3], [0.0, 0.0, 1e9])):
        assert (tracker.step(bad) == centre()).all()
        assert tracker.status is TrackStatus.BAD_INPUT
    assert (tracker.step(x, np.nan) == centre()).all()
    assert tracker.status is TrackStatus.BAD_INPUT
    tracker.step(np.append(x[:3], [0.0, 0.0, 2.0]))
    assert tracker.status is TrackStatus.BEHIND
    for _ in range(300):
        tracker.step(x)
    assert tracker.status is TrackStatus.OK


@pytest.mark.slow
def test_along_a_rail_without_limits_a_tracker_does_the_same_anywhere() -> None:
    file, tip = ROBOTS["ur5"]
    robot = oc.Robot.from_urdf(robot_data(file), tip, base="rail:x")
    arm, rail = oc.Arm(oc.Task.pose(robot)), np.eye(robot.n)[0]
    for seed in (0, 7, 16):
        q, goal = (robot.sample(1, seed=k)[0] for k in (seed, 1000 + seed))
        for shift in (0.0, -1000.0):
            tracker, x = arm.tracker(q + shift * rail), robot.pose(goal + shift * rail)
            for _ in range(900):
                tracker.step(x)
            assert tracker.status is TrackStatus.OK
            assert np.abs(robot.pose(tracker.q) - x).max() < 1e-6


def test_an_arm_without_charts_keeps_x() -> None:
    arm = oc.Arm(oc.problems.get("planar_3r_xy").task)
    q = np.array([0.3, 0.9, 0.8])
    tracker, x = arm.tracker(q, velocity_limits=1.0), arm.x(q)
    for target in x + np.linspace(0.0, 0.3, 100)[:, None] * [1.0, -1.0]:
        tracker.step(target)
        assert tracker.status is TrackStatus.OK
        assert arm.x(tracker.q) == pytest.approx(target, abs=1e-9)
    with pytest.raises(InvalidValueError, match="without charts"):
        tracker.step(x, 0.1)


def test_following_a_path_is_a_call_for_each_of_its_values() -> None:
    arm, x = panda(), panda().x(centre())
    targets = along(x, np.array([0.0, 0.2, 0.1]), 150)
    q, statuses = arm.follow(targets, q=centre(), period=PERIOD)
    tracker = arm.tracker(centre(), period=PERIOD)
    assert statuses == tuple(lead(tracker, targets))
    assert q[-1] == pytest.approx(tracker.q, abs=1e-12)
    assert np.abs(arm.x(q) - targets).max() < 1e-8


@pytest.mark.slow
def test_a_copied_tracker_goes_on_where_the_first_one_is() -> None:
    arm = panda()
    tracker, x = arm.tracker(centre()), arm.x(centre())
    ahead = np.array([0.003, 0.0, 0.0, 0.0, 0.0, 0.0])
    tracker.step(x + ahead, None)
    other = pickle.loads(pickle.dumps(tracker))
    for target in (x + 2 * ahead, x):
        assert other.step(target) == pytest.approx(tracker.step(target), abs=1e-9)


def test_a_fold_is_passed_in_the_direction_of_the_motion() -> None:
    """The poses of a straight joint motion lead to a posture where J nearly loses rank, and joints beyond it."""
    arm = oc.Arm(panda().task)
    begin = np.array([-0.5968, -0.1594, -1.3922, -3.0717, 0.3344, 2.8393, 0.4327])
    end = np.array([-1.3968, 0.2521, -0.6078, -2.8718, 0.5942, 2.3023, -0.1178])
    shares = np.linspace(0, 1, 150) ** 2 * (3 - 2 * np.linspace(0, 1, 150))
    tracker, least = arm.tracker(begin, period=PERIOD, detours=False), np.inf

    for share in shares:
        x = arm.x(begin + share * (end - begin))
        tracker.step(x)
        assert np.abs(arm.x(tracker.q) - x).max() < 5e-3
        least = min(least, float(np.linalg.svd(arm.robot.jacobian(tracker.q), compute_uv=False)[-1]))
    assert least < 6e-3
    assert np.abs(arm.x(tracker.q) - x).max() < 1e-8


def test_from_a_symmetric_posture_a_turn_leaves_the_plane() -> None:
    """The iiwa in its vertical plane turns its tool until the wrist is at its limit; the rest is beside the plane."""
    arm = oc.Arm(oc.Task.pose(oc.problems.get("iiwa").robot))
    home = np.array([0.0, 1.309, 0.0, 1.309, 0.0, -0.982, 0.0])
    tracker, pose = arm.tracker(home, period=PERIOD, detours=False), np.array(arm.robot.pose(home))
    for angle in 0.97 * np.pi * (1 - np.cos(np.linspace(0, np.pi, 300))) / 2:
        turned = pose.copy()
        turned[:3, :3] = pose[:3, :3] @ np.array(
            [[np.cos(angle), 0, -np.sin(angle)], [0, 1, 0], [np.sin(angle), 0, np.cos(angle)]]
        )
        q = tracker.step(turned)
    assert tracker.status in (TrackStatus.OK, TrackStatus.YIELDING)
    assert np.array(arm.robot.pose(q)) == pytest.approx(turned, abs=1e-8)
    assert abs(q[2]) > 0.1
