"""Ranges of coordinates and self-motions end just where the domain, a fold or nothing stops them."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from public_objects import circle, clear, disk, fitted, on_planes
from scipy.optimize import fsolve

import orthocas as oc
from orthocas import problems
from orthocas.charts.self_motion import SelfMotionCurve
from orthocas.errors import InvalidValueError
from orthocas.tasks.domains import StopKind
from orthocas.tools.checks import Array

LINKS = 3


def planar_arm(domain: oc.Box | oc.Torus, bound: float | None = None, degree: int = 2) -> oc.Chart:
    """A fitted chart of the planar arm with three links of 1 m and task (x, y)."""
    robot = oc.Robot.planar([1.0] * LINKS, [3.0] * LINKS)
    problem = oc.Problem(robot, oc.Task.position(robot, "xy"), domain=domain, least_singular_value=bound)
    return oc.fit(problem, oc.Polynomial(degree), samples=300).chart


def closed_form(x: Array, heading: Array, elbow: float) -> Array:
    """Joint positions of that arm with the tip at x and the last link at an angle (N,) to the x axis, (N, 3).

    The first two links reach the wrist x - (cos heading, sin heading); the elbow is on one of two sides.
    """
    wrist = x - np.column_stack([np.cos(heading), np.sin(heading)])
    q2 = elbow * np.arccos(np.clip((wrist**2).sum(axis=1) / 2 - 1, -1, 1))
    q1 = np.arctan2(wrist[:, 1], wrist[:, 0]) - q2 / 2
    return np.column_stack([q1, q2, heading - q1 - q2])


def test_self_motion_of_a_planar_arm_is_the_closed_form() -> None:
    chart = planar_arm(oc.Box([0.6, 0.8, 0.8], 0.6))
    motion = chart.self_motion([0.6, 0.8, 0.8])
    assert isinstance(motion, SelfMotionCurve)
    expected = closed_form(motion.x, motion.q.sum(axis=1), 1.0)
    np.testing.assert_allclose(motion.q, expected, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["panda-wide", "xarm7-pose", "circle"])
def test_c_and_python_end_at_the_same_places(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a C compiler, Python follows the curves: ranges agree to 1e-9, and so do ends of self-motions."""
    chart = circle() if name == "circle" else oc.load(name)
    q = chart.domain.sample(6 if name == "circle" else 20, 5)
    in_c = [(chart.xi_range(point), chart.self_motion(point)) for point in q]
    monkeypatch.setattr(type(chart.parts), "motion_kernel", None)
    for point, (reach, motion) in zip(q, in_c, strict=True):
        other, curve = chart.xi_range(point), chart.self_motion(point)
        np.testing.assert_allclose(reach.low, other.low, rtol=0, atol=1e-9)
        np.testing.assert_allclose(reach.high, other.high, rtol=0, atol=1e-9)
        assert str(reach[0].low_stop) == str(other[0].low_stop)
        assert isinstance(motion, SelfMotionCurve)
        assert isinstance(curve, SelfMotionCurve)
        assert (motion.closed, motion.folds) == (curve.closed, curve.folds)
        np.testing.assert_allclose(motion.q[[0, -1]], curve.q[[0, -1]], rtol=0, atol=1e-9)


def _raise_for_home() -> Path:
    raise RuntimeError("Could not determine home directory.")


@pytest.mark.parametrize("fault", ["home", "#!/bin/sh\nexit 0\n", "not a program"])
def test_without_a_library_python_follows_the_curves(
    fault: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Users without a home, as in containers, and compilers that make nothing or do not start."""
    if fault == "home":
        monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
        monkeypatch.setattr(Path, "home", _raise_for_home)
    else:
        (tmp_path / "gcc").write_text(fault)
        (tmp_path / "gcc").chmod(0o700)
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
        monkeypatch.setenv("PATH", str(tmp_path))
    chart = oc.load("panda-pose")
    assert chart.parts.motion_kernel is None
    assert len(chart.xi_range(chart.domain.centre)) == 1


@pytest.mark.slow
def test_ranges_of_a_grown_chart_end_where_it_ends() -> None:
    """The curves of some postures leave the chart, those of others the domain."""
    chart, ends = disk(), set()
    for q in chart.domain.sample(12, 0)[::3]:
        if np.isfinite(chart.xi(q)).all():
            ranges = chart.xi_range(q)
            assert (ranges.low <= chart.xi(q)).all()
            assert (ranges.high >= chart.xi(q)).all()
            ends |= {stop.kind for interval in ranges for stop in (interval.low_stop, interval.high_stop)}
    assert {StopKind.JOINT, StopKind.FOLD, StopKind.SINGULAR} <= ends


def test_arc_length_is_that_of_the_closed_form() -> None:
    chart = planar_arm(oc.Box([0.6, 0.8, 0.8], 0.6))
    motion = chart.self_motion([0.6, 0.8, 0.8], step=0.1)
    assert isinstance(motion, SelfMotionCurve)
    first, last = motion.q[[0, -1]].sum(axis=1)
    dense = closed_form(motion.x, np.linspace(first, last, 100_001), 1.0)
    length = np.linalg.norm(np.diff(dense, axis=0), axis=1).sum()
    assert abs(motion.arc_length[-1] - motion.arc_length[0] - length) < 1e-5  # steps of 0.1: an error of order h^4
    assert motion.arc_length[motion.start] == 0
    np.testing.assert_array_equal(motion.q[motion.start], [0.6, 0.8, 0.8])


def test_self_motion_on_a_torus_closes() -> None:
    """The self-motion of the closed form has two halves, one for each side of the elbow."""
    chart = planar_arm(oc.Torus(LINKS))
    motion = chart.self_motion([0.6, 0.8, 0.8])
    assert isinstance(motion, SelfMotionCurve)
    assert motion.closed
    turns = (motion.q[-1] - motion.q[0]) / (2 * np.pi)
    np.testing.assert_allclose(turns, np.round(turns), atol=1e-9)
    np.testing.assert_allclose(chart.x(motion.q), np.tile(motion.x, (len(motion.q), 1)), atol=1e-9)
    sides = np.sign(np.sin(motion.q[:, 1]))
    assert {-1.0, 1.0} <= set(sides)
    for side in (-1.0, 1.0):
        at = motion.q[sides == side]
        found = closed_form(motion.x, at.sum(axis=1), side) - at
        np.testing.assert_allclose(np.exp(1j * found), 1.0, atol=1e-6)


def test_curve_ends_where_a_joint_stops() -> None:
    """Bisection on the closed form finds the same end: the heading at which the first joint leaves its interval."""
    chart = planar_arm(oc.Box([0.6, 0.8, 0.8], 0.6))
    motion, box = chart.self_motion([0.6, 0.8, 0.8]), chart.problem.domain
    for row, towards in ((motion.q[0], -1.0), (motion.q[-1], 1.0)):
        at = motion.q[motion.start].sum()
        side = np.sign(row.sum() - at)
        inside, outside = at, at + side * 2.0
        for _ in range(60):
            middle = (inside + outside) / 2
            if box.contains(closed_form(motion.x, np.array([middle]), 1.0))[0]:
                inside = middle
            else:
                outside = middle
        np.testing.assert_allclose(row, closed_form(motion.x, np.array([inside]), 1.0)[0], atol=1e-7)
        stop = motion.extent[0].low_stop if towards < 0 else motion.extent[0].high_stop
        i = chart.problem.robot.joint_names.index(stop.joint)
        assert stop.value == pytest.approx(row[i], abs=1e-9)
        assert abs(abs(stop.value - box.centre[i]) - 0.6) < 1e-12
    assert chart.problem.domain.contains(motion.q).all()


def test_curve_of_a_clear_box_ends_at_its_bound() -> None:
    chart = planar_arm(oc.Box([0.6, 0.8, 0.8], 0.75), bound=0.37)
    motion, box = chart.self_motion([0.6, 0.8, 0.8]), chart.problem.domain
    assert isinstance(box, oc.ClearBox)
    assert box.contains(motion.q).all()
    stops = (motion.extent[0].low_stop, motion.extent[0].high_stop)
    assert StopKind.NEAR_SINGULAR in {stop.kind for stop in stops}
    for stop, row in zip(stops, motion.q[[0, -1]], strict=True):
        if stop.kind is StopKind.NEAR_SINGULAR:
            assert box.singular_values(row) == pytest.approx(0.37, abs=1e-9)


@pytest.mark.slow
def test_range_is_that_of_a_dense_search() -> None:
    """The second method: solve phi(q) = target for a row of targets, and keep what stays inside."""
    chart = fitted().chart
    q = chart.problem.domain.centre + np.array([0.05, -0.1, 0.1])
    reach, phi = chart.xi_range(q), chart.phi(q)
    for k, label in enumerate(("xi1", "xi2")):
        for sign, end in ((-1, reach[label].low), (1, reach[label].high)):
            inside, outside, start = 0.0, 1.0, q
            for _ in range(45):
                middle = (inside + outside) / 2
                goal = phi.copy()
                goal[chart.m + k] += sign * middle
                found, _, state, _ = fsolve(
                    lambda p, goal=goal: chart.phi(p) - goal, start, xtol=1e-13, full_output=True
                )
                if state == 1 and chart.problem.domain.contains(found):
                    inside, start = middle, found
                else:
                    outside = middle
            assert end == pytest.approx(phi[chart.m + k] + sign * inside, abs=1e-6)


def test_range_keeps_what_it_holds() -> None:
    """From the end of a range, the way back is the whole range; the other coordinates are those of the start."""
    chart = fitted().chart
    q = chart.problem.domain.centre
    reach = chart.xi_range(q)
    goal = chart.phi(q)
    goal[-1] = reach["xi2"].high - 1e-9
    end = chart.inverse(goal, q)
    back = chart.xi_range(end)
    assert back["xi2"].low == pytest.approx(reach["xi2"].low, abs=1e-8)
    assert back["xi2"].high == pytest.approx(reach["xi2"].high, abs=1e-8)
    assert back["xi2"].high_stop == reach["xi2"].high_stop
    assert reach["xi2"].here in reach["xi2"]
    assert reach["xi2"].high + 0.1 not in reach["xi2"]


@pytest.mark.slow
def test_fold_stops_a_coordinate() -> None:
    """Linear coordinates on a torus turn back where J is singular; points of the closed curve show the same."""
    robot = oc.Robot.planar([1.0] * LINKS, [3.0] * LINKS)
    problem = oc.Problem(robot, oc.Task.position(robot, "xy"), domain=oc.Torus(LINKS))
    chart = oc.fit(problem, oc.Linear(base=(0.6, 0.8, 0.8))).chart
    q = np.array([0.6, 0.8, 0.8])
    reach, motion = chart.xi_range(q)["xi1"], chart.self_motion(q, step=0.01)
    assert isinstance(motion, SelfMotionCurve)
    assert (reach.low_stop.kind, reach.high_stop.kind) == (StopKind.FOLD, StopKind.FOLD)
    assert motion.folds >= 2
    around = motion.xi[:, 0] - reach.here
    high = next(k for k in range(1, len(around)) if around[k + 1] < around[k])
    assert reach.high == pytest.approx(motion.xi[high, 0], abs=1e-3)  # a parabola at points 0.01 apart
    assert reach.high >= motion.xi[high, 0]


@pytest.mark.parametrize("kind", ["torus", "box"])
def test_extent_does_not_depend_on_the_points_of_the_curve(kind: str) -> None:
    """Where xi turns back between points, the extent is that of a dense search around the largest and least point."""
    robot = oc.Robot.planar([1.0] * LINKS, [3.0] * LINKS)
    domain = oc.Torus(LINKS) if kind == "torus" else oc.Box([0.6, 0.8, 0.8], 2.2)
    problem = oc.Problem(robot, oc.Task.position(robot, "xy"), domain=domain)
    chart = oc.fit(problem, oc.Linear(base=(0.6, 0.8, 0.8))).chart
    q = np.array([0.6, 0.8, 0.8])
    rough, fine = (chart.self_motion(q, step=step) for step in (0.5, 1e-3))
    assert isinstance(fine, SelfMotionCurve)
    assert fine.folds > 0
    for motion in (rough, fine):
        # Points are 1e-3 apart, so the parabola through them rises by 1e-6 at most.
        assert 0 <= motion.extent.high[0] - fine.xi.max() < 1e-6
        assert 0 <= fine.xi.min() - motion.extent.low[0] < 1e-6
    np.testing.assert_allclose(rough.extent.low, fine.extent.low, atol=1e-9)
    np.testing.assert_allclose(rough.extent.high, fine.extent.high, atol=1e-9)


def test_joint_limits_are_told_from_other_boundaries() -> None:
    arm = oc.Robot.planar([1.0] * LINKS, [3.0] * LINKS)
    robot = oc.Robot(replace(arm.tree, lower=np.array([-np.inf, -np.inf, 0.5])))
    problem = oc.Problem(robot, oc.Task.position(robot, "xy"), domain=oc.Box([0.6, 0.8, 0.8], 0.3))
    reach = oc.fit(problem, oc.Linear()).chart.xi_range([0.6, 0.8, 0.8])["xi1"]
    assert {str(reach.low_stop), str(reach.high_stop)} == {"joint 'q2' at 0.5", "joint 'q3' at 0.5, its limit"}


def test_nothing_stops_an_unbounded_joint() -> None:
    robot = oc.Robot.planar([1.0, 1.0], [3.0, 3.0])
    task = oc.Task.custom(robot, "bend", lambda q: q[1])
    problem = oc.Problem(robot, task, domain=oc.Box([0.0, 0.5], 0.3, unbounded=[0]))
    chart = oc.fit(problem, oc.Linear()).chart
    reach = chart.xi_range([0.1, 0.6])["xi1"]
    assert (reach.low, reach.high) == (-np.inf, np.inf)
    motion = chart.self_motion([0.1, 0.6])
    assert isinstance(motion, SelfMotionCurve)
    assert motion.closed
    assert motion.arc_length[-1] == pytest.approx(2 * np.pi, abs=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("build", [lambda: fitted().chart, on_planes])
def test_sets_keep_the_task_and_fill_the_domain(build: Callable[[], oc.Chart]) -> None:
    """Every point of the domain near the self-motion, moved onto it, has coordinates within a cell of the lattice."""
    chart = build()
    q = chart.problem.domain.centre
    motion = chart.self_motion(q, samples=400)
    assert chart.problem.domain.contains(motion.q).all()
    assert np.abs(chart.x(motion.q) - motion.x).max() < 1e-9
    np.testing.assert_allclose(motion.xi, chart.xi(motion.q), atol=1e-9)
    cell = (chart.xi_range(q).high - chart.xi_range(q).low) / 20
    rng, checked = np.random.default_rng(5), 0
    for start in q + chart.problem.domain.half_width * rng.uniform(-0.9, 0.9, (40, chart.n)):
        point = start
        for _ in range(20):  # onto the set x = x(q), the shortest way
            point = point - np.linalg.pinv(chart.jacobian(point)[: chart.m]) @ (chart.x(point) - motion.x)
        if np.abs(point - q).max() <= 0.95 * chart.problem.domain.half_width.max():
            checked += 1
            assert np.abs((motion.xi - chart.xi(point)) / cell).max(axis=1).min() < 1.01
    assert checked > 20


@pytest.mark.slow
def test_extent_of_a_set_is_at_least_that_of_single_coordinates() -> None:
    chart = fitted().chart
    q = chart.problem.domain.centre
    motion, alone = chart.self_motion(q, samples=200), chart.xi_range(q)
    assert (motion.extent.low <= alone.low + 1e-9).all()
    assert (motion.extent.high >= alone.high - 1e-9).all()
    assert (motion.extent.high - motion.extent.low > 1.01 * (alone.high - alone.low)).any()


@pytest.mark.slow
def test_self_motion_of_grown_coordinates() -> None:
    motion = circle().self_motion([1.0, 0.2])
    assert isinstance(motion, SelfMotionCurve)
    assert motion.closed
    assert motion.xi[-1, 0] - motion.xi[0, 0] == pytest.approx(2 * np.pi, abs=1e-6)


@pytest.mark.slow
def test_range_of_grown_coordinates_ends_with_the_chart() -> None:
    reach = disk().xi_range(disk().problem.domain.centre)
    assert reach[0].high == pytest.approx(1.0, abs=1e-2)  # the base leaf is mapped to the unit disk


def test_points_outside_the_domain_are_refused() -> None:
    chart = clear()
    with pytest.raises(InvalidValueError, match=r"q is .*, expected a point of the domain, .* joint 'q2' at"):
        chart.xi_range([0.6, 2.0, 0.8])
    with pytest.raises(InvalidValueError, match="step is 2"):
        chart.self_motion(chart.problem.domain.centre, step=2)
    with pytest.raises(InvalidValueError, match="label is 'xi9'"):
        chart.xi_range(chart.problem.domain.centre)["xi9"]


def test_self_motions_are_read_only() -> None:
    motion = clear().self_motion(clear().problem.domain.centre)
    for name in ("x", "q", "xi", "arc_length"):
        assert not getattr(motion, name).flags.writeable
    with pytest.raises(AttributeError):
        motion.start = 3  # type: ignore[misc]
    assert replace(motion, start=0).start == 0


@pytest.mark.slow
def test_seven_joints() -> None:
    """The self-motions of the arm have four dimensions; all points are on the lattice around the start."""
    chart = oc.fit(problems.get("iiwa"), oc.Linear()).chart
    motion = chart.self_motion(chart.problem.domain.centre, samples=100)
    assert len(motion.q) > 50
    assert np.abs(chart.x(motion.q) - motion.x).max() < 1e-9
