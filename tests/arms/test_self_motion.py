"""The self-motions of a pose: all postures within the limits are on their arcs, and nothing else is."""

import importlib.util
import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pinocchio as pin
import pytest
from conftest import ROBOTS, robot_data
from conftest import arm as read_arm
from programs import needs_c, nightly
from random_arms import random_arm

import orthocas as oc
from orthocas.arms.kernel import Curve, evaluate_cubic
from orthocas.arms.self_motion import SelfMotions, find_motions
from orthocas.errors import CompileError, InvalidValueError, SingularTaskError, UnknownNameError
from orthocas.tasks.domains import StopKind
from orthocas.tools.checks import Array


@cache
def panda() -> oc.Arm:
    return oc.Arm(oc.load("panda-wide").problem.task)


@cache
def planar() -> oc.Arm:
    return oc.Arm(oc.problems.get("planar_3r_xy").task)


def postures(arm: oc.Arm, count: int, seed: int) -> Array:
    low, high = np.maximum(arm.robot.lower, -np.pi), np.minimum(arm.robot.upper, np.pi)
    return np.random.default_rng(seed).uniform(low, high, (count, arm.robot.n))


def newton(arm: oc.Arm, target: Array, q: Array) -> Array:
    """Postures within the limits where damped least squares from q (S, n) end, if x is met there."""
    lower, upper, targets, q = arm.robot.lower, arm.robot.upper, np.tile(target, (len(q), 1)), q.copy()
    for _ in range(40):
        e, J = arm.maps.evaluate(q, targets)
        error, gram = np.abs(e).max(axis=1), J @ J.transpose(0, 2, 1)
        damping = np.where(error > 0.1, 1e-2, np.where(error > 1e-3, 1e-6, 1e-14)) * np.trace(gram, axis1=1, axis2=2)
        y = np.linalg.solve(gram + damping[:, None, None] * np.eye(e.shape[1]), e[:, :, None])
        step = (J.transpose(0, 2, 1) @ y)[:, :, 0]
        q += step * np.minimum(1.0, 0.7 / np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1e-300))
    bounded = np.isfinite(lower) & arm.maps.turning
    q[:, bounded] = lower[bounded] + (q[:, bounded] - lower[bounded]) % (2 * np.pi)
    met = np.abs(arm.maps.evaluate(q, targets)[0]).max(axis=1) < 1e-9
    return np.asarray(q[met & ((q >= lower) & (q <= upper)).all(axis=1)])


def require_all_found(arm: oc.Arm, seed: int, poses: int, starts: int) -> None:
    """Postures that Newton's method finds are on the arcs, and these keep x and the limits."""
    for target in arm.maps.targets_of(postures(arm, poses, seed)):
        motions = find_motions(arm.maps, target)
        ends = newton(arm, target, postures(arm, starts, seed + 1))[:100]
        assert len(ends) > 0
        assert max(motions.nearest(q).value for q in ends) < 1e-6
        q = np.vstack([arc.q for arc in motions])
        assert np.abs(arm.maps.evaluate(q, np.tile(target, (len(q), 1)))[0]).max() < 1e-10
        assert ((q >= arm.robot.lower) & (q <= arm.robot.upper)).all()


@pytest.mark.slow
def test_postures_of_newtons_method_are_on_the_arcs_of_panda() -> None:
    require_all_found(panda(), seed=1, poses=5, starts=100)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 2, 3])
def test_postures_of_newtons_method_are_on_the_arcs_of_random_positions(seed: int) -> None:
    """Four joints, some of them sliding, turning up to 6 rad either way."""
    require_all_found(oc.Arm(oc.Task.position(random_arm(np.random.default_rng(seed), 4, 0.25))), seed, 2, 60)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["xarm7-wide", *nightly("iiwa7-wide", "baxter-left-wide")])
def test_postures_of_newtons_method_are_on_the_arcs_of_other_arms(name: str) -> None:
    require_all_found(oc.Arm(oc.Task.pose(oc.load(name).robot)), seed=2, poses=2, starts=100)


@pytest.mark.slow
def test_postures_of_newtons_method_are_on_the_arcs_of_other_tasks() -> None:
    rng = np.random.default_rng(5)
    require_all_found(oc.Arm(oc.Task.position_and_axis(random_arm(rng, 6, 0.0))), 1, 1, 60)
    require_all_found(oc.Arm(oc.Task.pose(random_arm(rng, 7, 0.2), axis="z")), 2, 1, 60)
    require_all_found(oc.Arm(oc.Task.orientation(random_arm(rng, 4, 0.0))), 3, 1, 60)


def test_small_arms_with_a_slide_have_arcs_although_no_position_counts_as_clear() -> None:
    """An arm of 5 cm: a slide of 1 cm moves its tip as far as a fifth of a radian does."""
    robots = []
    for seed in (7, 6):
        tree = random_arm(np.random.default_rng(seed), 4, 0.3).tree
        lengths = {"translations": 0.05 * tree.translations, "tip_translation": 0.05 * tree.tip_translation}
        reach = np.where(tree.prismatic, 0.01, 2.0)
        robots.append(oc.Robot(replace(tree, **lengths, lower=-reach, upper=reach)))
        assert any(tree.prismatic)
        with pytest.raises(SingularTaskError):
            oc.branches(robots[-1], oc.Task.position(robots[-1]))
    require_all_found(oc.Arm(oc.Task.position(robots[0])), 0, 3, 200)
    # The joints of the other one move its tip on a surface only.
    with pytest.raises(SingularTaskError, match="at all postures"):
        oc.Arm(oc.Task.position(robots[1])).self_motion([0.0, 0.0, 0.0])


def test_pinocchio_finds_the_pose_at_all_postures() -> None:
    model, tip = read_arm("panda")
    data, frame = model.createData(), model.getFrameId(tip)

    def place(q: Array) -> pin.SE3:
        pin.framesForwardKinematics(model, data, q)
        return data.oMf[frame].copy()

    for q in postures(panda(), 3, 8):
        pose = place(q)
        for posture in panda().self_motion(pose).sample(40):
            assert np.abs(place(posture).homogeneous - pose.homogeneous).max() < 1e-9


def test_ends_are_limits_and_next_to_them_arcs_would_leave() -> None:
    arm = panda()
    for q in postures(arm, 5, 3):
        for arc in arm.self_motion(arm.x(q)):
            assert not arc.closed
            for stop, end, inside in zip(arc.ends, (0.0, arc.length), (1e-4, arc.length - 1e-4), strict=True):
                k = arm.robot.joint_names.index(stop.joint)
                posture, before = arc.at(end), arc.at(inside)
                assert stop.is_limit
                assert stop.value in (arm.robot.lower[k], arm.robot.upper[k])
                assert posture[k] == pytest.approx(stop.value, abs=1e-12)
                assert abs(before[k] - stop.value) > 1e-9


@pytest.mark.slow
def test_arcs_of_joints_with_several_turns_differ_by_whole_turns() -> None:
    arm = oc.Arm(oc.Task.pose(oc.load("xarm7-wide").robot))
    q = postures(arm, 1, 3)[0]
    shifted = q.copy()
    shifted[0] += 2 * np.pi if q[0] < 0 else -2 * np.pi
    motions = arm.self_motion(arm.x(q))
    assert motions.nearest(q).value < 1e-9
    assert motions.nearest(shifted).value < 1e-9
    assert motions.nearest(q).component != motions.nearest(shifted).component


def test_planar_arm_without_limits_has_one_closed_arc() -> None:
    q = np.array([0.3, 0.9, 0.8])
    motions = planar().self_motion(planar().x(q))
    assert [arc.closed for arc in motions] == [True]
    assert motions.components[0].ends[0].kind is StopKind.ENDLESS
    ends = motions.components[0].at([0.0, motions.length])
    turned = (ends[1] - ends[0]) / (2 * np.pi)
    assert np.abs(turned - np.round(turned)).max() < 1e-9
    there = motions.nearest(q + np.array([0.0, 0.0, 2 * np.pi]))  # a turn of an endless joint does not count
    assert there.value < 1e-9


@pytest.mark.parametrize("bend", [1e-2, 3e-4, 1e-4, 3e-5])
def test_a_nearly_stretched_arm_has_one_short_closed_arc(bend: float) -> None:
    """With three links of length 1, |x|^2 = 9 - 2 (q2^2 + q2 q3 + q3^2) for small bends: an ellipse, if both are b.

    The direction of x holds 3 q1 + 2 q2 + q3.
    """
    arm = planar()
    (arc,) = arm.self_motion(arm.x([0.3, bend, bend]))
    assert arc.closed
    # The ellipse is 3 (q2 + q3)^2 + (q2 - q3)^2 = 12 b^2.
    angle = np.linspace(0, 2 * np.pi, 2001)
    total, difference = 2 * bend * np.cos(angle), 2 * np.sqrt(3) * bend * np.sin(angle)
    q2, q3 = (total + difference) / 2, (total - difference) / 2
    way = np.column_stack([-(2 * q2 + q3) / 3, q2, q3])
    assert arc.length == pytest.approx(np.linalg.norm(np.diff(way, axis=0), axis=1).sum(), rel=2e-3)


def test_points_on_an_arc_are_as_far_apart_as_their_places() -> None:
    arc = panda().self_motion(panda().x(postures(panda(), 1, 4)[0])).components[0]
    q = arc.at(np.linspace(0.0, arc.length, 20_001))
    assert np.linalg.norm(np.diff(q, axis=0), axis=1).sum() == pytest.approx(arc.length, rel=1e-4)


def test_short_arcs_and_those_with_bends_have_the_length_of_dense_samples() -> None:
    lower, upper, rng = panda().robot.lower, panda().robot.upper, np.random.default_rng(5)
    for k in range(109):
        # Every other elbow is at its limit, nearly stretched, where limits cut curves to pieces of 0.005 rad.
        q = rng.uniform(lower, upper)
        if k % 2:
            q[3] = min(0.02 * rng.standard_normal(), upper[3])
        if k not in (1, 39, 108):
            continue
        arcs = panda().self_motion(panda().x(q)).components
        assert min(arc.length for arc in arcs) < 1.3
        for arc in arcs:
            dense = arc.at(np.linspace(0.0, arc.length, 2001))
            assert arc.length == pytest.approx(np.linalg.norm(np.diff(dense, axis=0), axis=1).sum(), rel=5e-4)


@pytest.mark.slow
def test_a_rail_without_limits_takes_the_arm_to_far_targets() -> None:
    file, tip = ROBOTS["ur5"]
    arm = oc.Arm(oc.Task.pose(oc.Robot.from_urdf(robot_data(file), tip, base="rail:x")))
    near = postures(arm, 3, 0)
    for q in near:
        counts = []
        for rail in (0.0, 10.0, 30.0, 1000.0):
            there = q + rail * np.eye(arm.robot.n)[0]
            x = arm.x(there)
            motions = arm.self_motion(x)
            # The posture itself is among them, and all are shifted.
            assert motions.nearest(there).value < 1e-6
            counts.append(len(motions))
            solved = arm.solve(x)
            assert solved.found
            assert np.allclose(arm.x(solved.q), x, rtol=0, atol=1e-8)
        assert len(set(counts)) == 1


def test_samples_have_equal_distances_in_their_metric() -> None:
    arc = panda().self_motion(panda().x(postures(panda(), 1, 4)[0])).components[0]
    q = arc.sample(201, "inertia")
    M, steps = panda().robot.mass_matrix((q[1:] + q[:-1]) / 2), np.diff(q, axis=0)
    lengths = np.sqrt(np.einsum("ki,kij,kj->k", steps, M, steps))
    assert lengths.max() / lengths.min() < 1.02
    assert np.array_equal(q[[0, -1]], arc.at([0.0, arc.length]))


def test_nearest_posture_is_nearer_than_dense_samples() -> None:
    motions = panda().self_motion(panda().x(postures(panda(), 1, 4)[0]))
    dense = np.vstack([arc.at(np.linspace(0.0, arc.length, 2000)) for arc in motions])
    for wish in postures(panda(), 10, 6):
        found = motions.nearest(wish)
        assert found.value <= np.linalg.norm(dense - wish, axis=1).min() + 1e-9
        assert found.value == pytest.approx(np.linalg.norm(found.q - wish))


@pytest.mark.parametrize("reach", [2.9, 2.99, 2.9999])
def test_nearest_posture_of_a_small_closed_curve(reach: float) -> None:
    """Of a nearly stretched arm; the distance bends much along it, seen from far away."""
    arm, rng = planar(), np.random.default_rng(3)
    motions = arm.self_motion([reach, 0.0])
    (arc,) = motions
    assert arc.closed
    dense = arc.at(np.linspace(0.0, arc.length, 4000))
    for wish in rng.uniform(-3, 3, (20, 3)):
        away = np.linalg.norm(motions.measure_away(dense, wish), axis=1).min()
        assert motions.nearest(wish).value < away + 1e-7


def test_best_posture_is_better_than_dense_samples() -> None:
    motions = panda().self_motion(panda().x(postures(panda(), 1, 4)[0]))
    found = motions.best(lambda q: -np.abs(q[:, 2] - 0.3))
    dense = np.vstack([arc.at(np.linspace(0.0, arc.length, 2000)) for arc in motions])
    assert found.value >= (-np.abs(dense[:, 2] - 0.3)).max() - 1e-9
    found = motions.best("manipulability")
    J = panda().robot.jacobian(dense)
    assert found.value >= np.sqrt(np.linalg.det(J @ J.transpose(0, 2, 1))).max() - 1e-9
    with pytest.raises(UnknownNameError, match="known: manipulability"):
        motions.best("dexterity")
    with pytest.raises(InvalidValueError, match="a number at some of them"):
        motions.best(lambda q: np.full(len(q), np.nan))
    with pytest.raises(InvalidValueError, match="lengths along the arc"):
        motions.components[0].at(np.nan)
    with pytest.raises(InvalidValueError, match="what f returns"):
        motions.best(lambda q: q)


@pytest.mark.parametrize("short", [-0.02, -0.005, 0.005, 0.02])
def test_best_posture_of_a_closed_arc_may_lie_on_both_sides_of_its_seam(short: float) -> None:
    motions = planar().self_motion([2.5, 0.0])
    (arc,) = motions
    assert arc.closed
    wish = arc.at(short % arc.length)
    found = motions.best(lambda q: -np.linalg.norm(motions.measure_away(q, wish), axis=1))
    assert found.value > -1e-6
    np.testing.assert_allclose(arc.at(found.place), found.q, atol=1e-9)


def lies_on(curve: Curve, q: Array, tangent: Array) -> bool:
    """Whether a posture (n,) lies on a curve, up to full turns: near points of it at most 0.02 rad apart."""
    parts = (curve.q[:-1], curve.q[1:], curve.tangent[:-1], curve.tangent[1:], curve.length[:-1, None])
    points, along = evaluate_cubic(*(part[:, None] for part in parts), np.linspace(0, 1, 21)[None, :, None])
    away = points - q
    away = np.linalg.norm(away - 2 * np.pi * np.rint(away / (2 * np.pi)), axis=2)
    k = np.unravel_index(np.argmin(away), away.shape)
    return bool(away[k] < 0.015 and along[k] @ tangent > 0)


@needs_c
def test_no_curve_is_found_twice() -> None:
    arm = panda()
    for target in arm.maps.targets_of(postures(arm, 10, 9)):
        curves = arm.maps.find_curves(target)
        for k, curve in enumerate(curves):
            assert lies_on(curve, curve.q[3], curve.tangent[3])
            others = curves[:k] + curves[k + 1 :]
            assert not any(lies_on(other, curve.q[3], curve.tangent[3]) for other in others)


@pytest.mark.slow
@pytest.mark.parametrize("ask", ["self_motion", "solve", "tracker"])
def test_without_a_compiler_an_error_says_how_to_get_one(ask: str, monkeypatch: pytest.MonkeyPatch) -> None:
    arm, q = oc.Arm(panda().task, (oc.load("panda-wide"),)), postures(panda(), 1, 0)[0]
    x = arm.x(q)
    monkeypatch.setattr(shutil, "which", lambda _: None)
    find_spec = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "ziglang" else find_spec(name))
    calls = {
        "self_motion": lambda: arm.self_motion(x),
        "solve": lambda: arm.solve(x, 0.1),
        "tracker": lambda: arm.tracker(q),
    }
    with pytest.raises(CompileError, match="pip install ziglang"):
        calls[ask]()


@pytest.mark.slow
def test_arcs_beyond_the_seam_of_a_curve_keep_x_where_joints_have_no_end() -> None:
    """Gen3's curves wind around its endless joints: pieces on both sides of the first point are full turns apart."""
    arm = oc.Arm(oc.load("gen3-wide").task)
    joined = 0
    for x in arm.x(postures(arm, 12, 3)):
        for arc in arm.self_motion(x):
            joined += len(arc.pieces) > 1
            q = arc.at(np.linspace(0.0, arc.length, 200))
            assert np.abs(arm.maps.evaluate(q, np.tile(arc.target, (200, 1)))[0]).max() < 1e-8
            assert np.abs(np.diff(q, axis=0)).max() < 0.5
    assert joined > 3


def test_out_of_reach_there_is_no_arc() -> None:
    motions = planar().self_motion([9.0, 0.0])
    assert (len(motions), motions.length, motions.sample(5).shape) == (0, 0.0, (0, 3))
    assert isinstance(motions, SelfMotions)
    with pytest.raises(InvalidValueError, match="within the limits"):
        motions.nearest([0.0, 0.0, 0.0])


def test_a_gap_between_nearly_parallel_arcs_is_perpendicular_to_both() -> None:
    """Where neither posture is an end: by differences along the arcs."""
    arm = oc.Arm(oc.Task.pose(oc.problems.get("iiwa").robot))
    motions = arm.self_motion(arm.x([-1.569, -0.755, 1.78, 0.03, 0.038, -1.105, -2.966]))
    gap, step = motions.gap(2, 0), 1e-4
    away = motions.measure_away(gap.second.q[None], gap.first.q)[0]
    for posture in (gap.first, gap.second):
        arc = motions.components[posture.component]
        assert step < posture.place < arc.length - step
        along = (arc.at(posture.place + step) - arc.at(posture.place - step)) / (2 * step)
        assert abs(away @ along) < 1e-5 * gap.value


def test_gap_and_merge_of_a_planar_arm_are_those_of_its_linkage() -> None:
    """With the tip at a distance r of the base, links of 1 m make a four-bar linkage of sides 1, 1, 1, r.

    Its configurations have two components for r < 1 and one for r in (1, 3) (Grashof), so they join where the tip has
    gone out by 1 - r.
    """
    arm, r = oc.Arm(oc.problems.get("planar_3r_xy").task), 0.7
    motions = arm.self_motion([r, 0.0])
    assert len(motions) == 2
    gap, merge = motions.gap(0, 1), motions.merge(0, 1)
    dense = [arc.at(np.linspace(0, arc.length, 400)) for arc in motions]
    apart = [np.linalg.norm(motions.measure_away(dense[1], q), axis=1).min() for q in dense[0]]
    assert gap.value == pytest.approx(min(apart), abs=1e-3)
    assert gap.value <= min(apart) + 1e-6
    assert np.linalg.norm(motions.measure_away(gap.second.q[None], gap.first.q)) == pytest.approx(gap.value, abs=1e-6)
    out = np.linalg.norm(merge.x - [r, 0.0])
    assert out == pytest.approx(1 - r, rel=1e-6)
    assert np.linalg.norm(arm.x(merge.q)) == pytest.approx(1.0, abs=1e-6)
    errors = np.linalg.norm(arm.x(merge.way) - [r, 0.0], axis=1)
    assert errors[[0, -1]].max() < 1e-6
    assert errors.max() < 1.1 * out
    figure = motions.plot()
    assert len(figure.axes) == 2
    with pytest.raises(InvalidValueError, match="another component"):
        motions.gap(1, 1)
    with pytest.raises(InvalidValueError, match="one of 2 components"):
        motions.merge(0, 5)


def test_the_error_of_a_merge_is_that_of_all_of_its_way() -> None:
    """Of these arcs, any way turns the hand by pi in between; at 31 postures of it the error was 2.7 at most."""
    arm = oc.Arm(oc.load("xarm7-wide").task)
    pose = arm.robot.pose(arm.robot.sample(1, seed=1)[0])
    merge = arm.self_motion(pose).merge(1, 2)
    whole = np.vstack([np.linspace(a, b, 50) for a, b in zip(merge.way, merge.way[1:], strict=False)])
    turned = np.einsum("kij,ij->k", arm.robot.pose(whole)[:, :3, :3], pose[:3, :3])
    angles = np.arccos(np.clip((turned - 1) / 2, -1, 1))
    assert angles.max() > 3.1
    assert merge.value >= angles.max() - 1e-3
    assert np.linalg.norm(np.diff(merge.way, axis=0), axis=1).max() < 0.15


@needs_c
@pytest.mark.parametrize("which", [panda, planar])
def test_solve_gives_the_best_posture_of_all_arcs(which: Callable[[], oc.Arm]) -> None:
    """No point of the arcs, 2 mrad apart, is nearer to the start or farther from the limits, but for rounding."""
    arm = which()
    starts = postures(arm, 4, 12)
    x = arm.x(postures(arm, 4, 11))
    near, free = arm.solve(x, start=starts), arm.solve(x)
    assert near.found.all()
    assert free.found.all()
    np.testing.assert_allclose(arm.x(near.q), x, atol=1e-9)
    np.testing.assert_allclose(arm.x(free.q), x, atol=1e-9)
    bounded, ranges = np.isfinite(arm.robot.lower), arm.robot.upper - arm.robot.lower
    for row, start in enumerate(starts):
        motions = arm.self_motion(x[row])
        q = np.vstack([arc.at(np.arange(0.0, arc.length, 2e-3)) for arc in motions])
        away = np.linalg.norm(motions.measure_away(np.vstack([near.q[row], q]), start), axis=1)
        assert away[0] <= away[1:].min() + 1e-9
        assert away[0] > away[1:].min() - 1e-3
        every = np.vstack([free.q[row], q])
        room = np.minimum(every - arm.robot.lower, arm.robot.upper - every)[:, bounded] / ranges[bounded]
        least = room.min(axis=1, initial=0.5)
        assert least[0] >= least[1:].max() - 1e-9
        assert least[0] < least[1:].max() + 1e-3
