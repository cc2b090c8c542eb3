"""Motions along tool paths: exact, within all limits, closed, and away from what the objective names."""

import csv
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from conftest import robot_data
from public_objects import circle
from scipy.integrate import trapezoid

import orthocas as oc
from orthocas import problems
from orthocas.errors import InvalidValueError, NoExpressionError, PathError, PathFileError, ShapeError
from orthocas.paths import JointMotion
from orthocas.paths.follow import MotionLimits
from orthocas.paths.joint_curve import JointCurve, PhiSolver
from orthocas.paths.tool_path import RULES as PATH_RULES
from orthocas.paths.tool_path import ToolPath
from orthocas.paths.xi_search import Costs, XiChoice, XiSearch, walk
from orthocas.robots.collisions import Collisions
from orthocas.robots.obstacles import Sphere
from orthocas.tools.checks import Array

START = np.array([0.6, 0.8, 0.8])


@cache
def planar() -> oc.Chart:
    """The arm with three links and task (x, y) on a box of 0.7 rad."""
    robot = oc.Robot.planar([1.0, 1.0, 1.0], [3.0, 3.0, 3.0])
    problem = oc.Problem(robot, oc.Task.position(robot, "xy"), domain=oc.Box(START, 0.7))
    return oc.fit(problem, oc.Polynomial(3), samples=500).chart


@cache
def iiwa() -> oc.Chart:
    return oc.fit(problems.get("iiwa"), oc.Polynomial(2)).chart


def loop(chart: oc.Chart, radius: float, waypoints: int = 60) -> Array:
    """A closed circle of the tool in the first and the last task component, from the centre of the domain."""
    angle, x = np.linspace(0, 2 * np.pi, waypoints), chart.x(chart.problem.domain.centre)
    path = np.tile(x, (waypoints, 1))
    path[:, 0] += radius * (np.cos(angle) - 1)
    path[:, -1] += radius * np.sin(angle)
    path[-1] = path[0]
    return path


@cache
def motion() -> JointMotion:
    return oc.follow(planar(), loop(planar(), 0.15), velocity_limits=[1.0, 1.5, 2.0], acceleration_limits=4.0)


@pytest.mark.slow
def test_tool_and_coordinates_are_where_they_should_be() -> None:
    found, chart = motion(), planar()
    np.testing.assert_allclose(chart.x(found.q), found.x, atol=1e-9)
    np.testing.assert_allclose(chart.xi(found.q), found.xi, atol=1e-9)
    np.testing.assert_allclose(found.xi, np.tile(chart.xi(START), (len(found.q), 1)), atol=1e-12)
    centre, x = loop(chart, 0.15)[0] - [0.15, 0.0], found.x
    np.testing.assert_allclose(np.linalg.norm(x - centre, axis=1), 0.15, atol=2e-6)  # the spline through 60 points


def test_closed_paths_close() -> None:
    found = motion()
    assert found.closed
    np.testing.assert_allclose(found.q[-1], found.q[0], atol=1e-9)
    np.testing.assert_allclose(found.q[0], START, atol=1e-9)
    for rest in (found.dq[0], found.dq[-1]):
        np.testing.assert_allclose(rest, 0, atol=1e-9)


def test_rates_are_finite_differences_of_positions() -> None:
    found = oc.follow(planar(), loop(planar(), 0.15), velocity_limits=1.0, acceleration_limits=4.0, period=1e-3)
    h = found.period
    np.testing.assert_allclose(np.diff(found.times), h, rtol=1e-9)
    dq = (found.q[2:] - found.q[:-2]) / (2 * h)
    assert np.abs(dq - found.dq[1:-1]).max() < 1e-4 * np.abs(found.dq).max()
    ddq = (found.q[2:] - 2 * found.q[1:-1] + found.q[:-2]) / h**2
    assert np.abs(ddq - found.ddq[1:-1])[5:-5].max() < 1e-2 * np.abs(found.ddq).max()  # jerk times h, at its largest
    np.testing.assert_allclose(found.q[0] + trapezoid(found.dq, dx=h, axis=0), found.q[-1], atol=1e-5)


@pytest.mark.slow
def test_limits_are_kept_in_corners() -> None:
    """A zigzag of straight lines, at periods that miss the corners and at one that sees them."""
    chart = planar()
    corners = chart.x(START) + np.array([[0.0, 0.0], [0.0, 0.1], [-0.1, 0.1], [-0.1, 0.0], [-0.2, 0.0], [-0.2, 0.1]])
    path = np.vstack([np.linspace(a, b, 20, endpoint=False) for a, b in pairwise(corners)])
    seconds = []
    for period in (0.05, 0.001):
        found = oc.follow(chart, path, velocity_limits=1.0, acceleration_limits=3.0, period=period)
        assert np.abs(found.dq).max() <= 1.0
        assert np.abs(found.ddq).max() <= 3.0
        seconds.append(found.duration)
    assert seconds[0] == pytest.approx(seconds[1], rel=0.05)


def test_limits_are_kept_and_used() -> None:
    found, kept = motion(), motion().margins
    assert (np.abs(found.dq) <= np.array([1.0, 1.5, 2.0]) * (1 + 1e-12)).all()
    assert (np.abs(found.ddq) <= 4.0 * (1 + 1e-12)).all()
    assert kept.velocity == pytest.approx((np.abs(found.dq) / [1.0, 1.5, 2.0]).max())
    assert kept.acceleration == pytest.approx(np.abs(found.ddq).max() / 4.0)
    assert max(kept.velocity, kept.acceleration) > 0.97
    assert planar().problem.domain.contains(found.q).all()
    assert kept.boundary == pytest.approx(1 - (np.abs(found.q - START) / 0.7).max())


@pytest.mark.slow
def test_motion_is_nearly_as_fast_as_possible() -> None:
    """One joint moves by a distance d at most with speed v and acceleration a: no motion takes less than d/v + v/a."""
    robot = oc.Robot.planar([1.0, 1.0], [3.0, 3.0])
    task = oc.Task.custom(robot, "first", lambda q: q[0])
    chart = oc.fit(oc.Problem(robot, task, domain=oc.Box([0.0, 0.0], 2.0)), oc.Linear()).chart
    for distance, speed, acceleration in ((1.5, 0.5, 2.0), (1.5, 10.0, 2.0)):
        path = [[0.0], [0.4], [distance]]
        found = oc.follow(chart, path, velocity_limits=speed, acceleration_limits=acceleration, period=1e-3)
        reaches = speed**2 / acceleration < distance
        least = distance / speed + speed / acceleration if reaches else 2 * np.sqrt(distance / acceleration)
        assert least * (1 - 1e-9) <= found.duration < 1.06 * least


@pytest.mark.slow
def test_schedules_go_through_their_values() -> None:
    chart = planar()
    path = loop(chart, 0.1, 12)
    xi = chart.xi(START) + 0.1 * np.sin(np.linspace(0, 2 * np.pi, 12))[:, None]
    xi[-1] = xi[0]
    found = oc.follow(chart, path, xi, velocity_limits=1.0)
    assert found.closed
    np.testing.assert_allclose(chart.phi(found.q), np.hstack([found.x, found.xi]), atol=1e-9)
    for x, value in zip(path, xi, strict=True):
        k = int(np.argmin(np.linalg.norm(np.hstack([found.x - x, found.xi - value]), axis=1)))
        assert abs(found.xi[k] - value).max() < 5e-3  # at the nearest time stamp
    there = oc.follow(chart, np.tile(path[0], (12, 1)), xi, velocity_limits=1.0)
    np.testing.assert_allclose(there.x, np.tile(path[0], (len(there.x), 1)), atol=1e-12)  # self-motion
    assert np.ptp(there.xi) > 0.18


def test_functions_of_s_are_followed() -> None:
    chart = planar()
    x, xi = chart.x(START), chart.xi(START)
    found = oc.follow(
        chart,
        lambda s: x + np.array([0.1 * np.sin(2 * np.pi * s), 0.05 * s]),
        lambda s: xi + 0.1 * s,
        velocity_limits=1.0,
    )
    expected = x + np.column_stack([0.1 * np.sin(2 * np.pi * found.s), 0.05 * found.s])
    np.testing.assert_allclose(found.x, expected, atol=1e-8)
    np.testing.assert_allclose(found.xi, xi + 0.1 * found.s[:, None], atol=1e-9)
    assert not found.closed


def test_start_settles_the_coordinates() -> None:
    chart = planar()
    other = START + np.array([0.2, -0.1, -0.2])
    found = oc.follow(chart, loop(chart, 0.05), q_start=other, velocity_limits=1.0)
    np.testing.assert_allclose(found.xi[0], chart.xi(other), atol=1e-12)


@pytest.mark.slow
def test_objective_keeps_away_from_boundaries() -> None:
    chart, q = planar(), START + np.array([0.4, -0.5, 0.4])
    path = chart.x(q) + loop(chart, 0.1) - loop(chart, 0.1)[0]
    held = oc.follow(chart, path, q_start=q, velocity_limits=1.0)
    chosen = oc.follow(chart, path, "objective", q_start=q, velocity_limits=1.0)
    assert chosen.closed
    np.testing.assert_allclose(chosen.q[-1], chosen.q[0], atol=1e-9)
    assert chosen.margins.boundary > held.margins.boundary + 0.1
    np.testing.assert_allclose(chart.x(chosen.q), chosen.x, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("offset", [[0.4, -0.5, 0.4], [-0.5, 0.5, -0.3]])
def test_objective_finds_a_way_where_holding_leaves_the_domain(offset: list[float]) -> None:
    chart, path, q = planar(), loop(planar(), 0.4), START + np.array(offset)
    with pytest.raises(PathError, match="it leaves the domain"):
        oc.follow(chart, path, "hold", q_start=q, velocity_limits=1.0)
    found = oc.follow(chart, path, "objective", q_start=q, velocity_limits=1.0)
    assert found.margins.boundary > 0.2
    assert chart.problem.domain.contains(found.q).all()


def test_walk_stays_on_the_path_and_inside() -> None:
    chart, limits, x = planar(), _limits(planar()), loop(planar(), 0.3)
    q = walk(chart, Costs(limits), x, START + np.array([0.4, -0.5, 0.4]))
    assert np.abs(chart.x(q)[1:] - x[1:]).max() < 1e-3
    assert chart.problem.domain.contains(q).all()


@pytest.mark.parametrize("bound", [None, 0.2])
def test_costs_have_the_gradients_of_finite_differences(bound: float | None) -> None:
    known = planar().problem
    problem = oc.Problem(known.robot, known.task, domain=oc.Box(START, 0.7), least_singular_value=bound)
    chart = oc.fit(problem, oc.Linear()).chart
    model = put_ball(known.robot, [0.5, 1.2, 0.0], 0.2, 0.1)
    costs = Costs(MotionLimits(chart, np.ones(3), np.ones(3), model, 0.01))
    q = START + np.random.default_rng(8).uniform(-0.8, 0.8, (30, 3))  # also outside
    residuals, gradients = costs(q)
    assert (residuals[:, -3:] > 1).any()  # near the ball
    # The pairs come in the order of their distance; overlaps are good to a micrometre.
    pairs = model.pair_distances(q)
    certain = (np.diff(np.sort(pairs), axis=1) > 1e-4).all(axis=1) & (pairs > 0).all(axis=1)
    assert certain.sum() > 5
    q, gradients = q[certain], gradients[certain]
    for i in range(3):
        step = 1e-6 * np.eye(3)[i]
        expected = (costs(q + step)[0] - costs(q - step)[0]) / 2e-6
        np.testing.assert_allclose(gradients[:, :, i], expected, rtol=1e-4, atol=1e-4)


def put_ball(robot: oc.Robot, centre: list[float], radius: float, thick: float) -> Collisions:
    """Rods for links, and a ball."""
    return robot.with_rods(thick).collisions.with_scene(oc.Scene({"ball": Sphere(centre, radius)}))


@pytest.mark.slow
def test_objective_is_that_of_ipopt() -> None:
    """The second method: the same problem with q and the spline as unknowns, costs in CasADi, by Ipopt."""
    chart, limits = planar(), _limits(planar())
    other = START + np.array([0.3, -0.4, 0.3])
    path = ToolPath.hold(chart, chart.x(other) + loop(chart, 0.1) - loop(chart, 0.1)[0], chart.xi(other))
    curve = JointCurve.trace(solver := PhiSolver(chart), path.phi, other)
    assert isinstance(curve, JointCurve)
    choice = XiChoice(path, Costs(limits), solver)
    values = choice.optimise(curve.q(choice.s)).xi(choice.nodes[:-1])
    expected = by_ipopt(choice, limits, curve.q(choice.s))
    np.testing.assert_allclose(values, expected, atol=0.02)
    assert cost(choice, values) < cost(choice, expected) * 1.001
    assert cost(choice, values) < 0.5 * cost(choice, np.tile(chart.xi(other), (len(values), 1)))


def _limits(chart: oc.Chart) -> MotionLimits:
    return MotionLimits(chart, np.ones(chart.n), np.ones(chart.n), None, 0.0)


def cost(choice: XiChoice, values: Array) -> float:
    state = choice._evaluate_state(values, np.tile(START, (len(choice.s), 1)))
    assert state is not None
    return state.cost


def by_ipopt(choice: XiChoice, limits: MotionLimits, first: Array) -> Array:
    """Values of the spline (K, 1)."""
    chart, P, scale = choice.chart, len(choice.s), limits.scale
    opti = ca.Opti()
    q, values = opti.variable(3, P), opti.variable(choice._basis.shape[1])
    xi, total = ca.DM(choice._basis) @ values, ca.MX(0)
    for k in range(P):
        goal = ca.vertcat(ca.DM(choice.path.x(choice.s[k])), xi[k])
        opti.subject_to(chart.function("phi")(q[:, k]) == goal)
        u = (q[:, k] - START) / 0.7
        J = chart.problem.task.jacobian_function(q[:, k]) / ca.repmat(ca.DM(scale), 1, 3)
        A = J @ J.T
        square = (ca.trace(A) - ca.sqrt((A[0, 0] - A[1, 1]) ** 2 + 4 * A[0, 1] ** 2)) / 2
        total += ca.sumsqr(u / ca.sqrt(1 - u**2)) + 0.01 / square
    opti.minimize(total / P + values.T @ ca.DM(choice._smooth) @ values)
    opti.set_initial(q, first.T)
    opti.set_initial(values, float(chart.xi(first[0])[0]))
    opti.solver("ipopt", {"print_time": False}, {"print_level": 0, "sb": "yes"})
    return np.asarray(opti.solve().value(values)).reshape(-1, 1)


@pytest.mark.slow
def test_objective_goes_round_obstacles() -> None:
    chart = iiwa()
    path, centre = loop(chart, 0.1, 200), [0.2, 0.15, 0.6]
    around = put_ball(chart.robot, centre, 0.1, 0.05)
    with pytest.raises(PathError, match=r"waypoint.* s 'link of A\d' and 'ball' .* expected a distance"):
        oc.follow(chart, path, collisions=around, clearance=0.01)
    found = oc.follow(chart, path, "objective", collisions=around, clearance=0.01)
    points = chart.problem.robot.joint_points(found.q)
    shares = np.linspace(0, 1, 50)[:, None, None, None]
    links = points[:, 1:-1] + shares * (points[:, 2:] - points[:, 1:-1])
    nearest = np.linalg.norm(links - centre, axis=-1).min() - 0.15
    assert nearest >= 0.01 - 1e-4
    assert found.margins.distance == pytest.approx(nearest, abs=1e-3)
    assert "'ball'" in found.margins.distance_pair


@pytest.mark.parametrize("closed", [False, True])
def test_a_search_finds_a_clear_way_or_none(closed: bool) -> None:
    """Between its stations too; a closed path ends with the posture with which it begins."""
    chart = planar()
    points = loop(chart, 0.1)[: None if closed else 40]
    path = ToolPath.hold(chart, points, chart.xi(START))
    held = JointCurve.trace(solver := PhiSolver(chart), path.phi, START)
    assert isinstance(held, JointCurve)
    # A ball on the way of the elbow, whose xi is held.
    elbow = chart.robot.joint_points(held.q(np.array([0.4])))[0, 2]
    around = put_ball(chart.robot, elbow.tolist(), 0.05, 0.02)
    cost = Costs(_limits(chart)).sum_squares
    found = XiSearch(solver, path, around, 0.01, cost).find()
    assert found is not None
    s, q = found
    assert path.closed == closed
    np.testing.assert_allclose(chart.x(q), path.x(s), atol=1e-8)
    if closed:
        np.testing.assert_array_equal(q[-1], q[0])
    dense = np.linspace(0.0, 1.0, 1000)
    goals = np.hstack([path.x(dense), np.interp(dense, s, chart.xi(q)[:, 0])[:, None]])
    way = solver.solve(np.column_stack([np.interp(dense, s, column) for column in q.T]), goals)
    assert chart.problem.domain.contains(way).all()
    assert around.distance(way).distance.min() > 0.005
    assert around.distance(held.q(dense)).distance.min() < 0
    # A ball that no posture gets around.
    everywhere = put_ball(chart.robot, [0.0, 0.0, 0.0], 1.5, 0.02)
    assert XiSearch(solver, path, everywhere, 0.01, cost).find() is None


def test_a_search_thins_the_postures_of_a_station(monkeypatch: pytest.MonkeyPatch) -> None:
    chart = planar()
    path = ToolPath.hold(chart, loop(chart, 0.1), chart.xi(START))
    far = put_ball(chart.robot, [5.0, 5.0, 0.0], 0.05, 0.02)
    search, x = XiSearch(PhiSolver(chart), path, far, 0.01, Costs(_limits(chart)).sum_squares), path.x(0.0)
    every = search._list_postures(x)
    monkeypatch.setattr("orthocas.paths.xi_search.RULES", replace(PATH_RULES, station_postures=5))
    few = search._list_postures(x)
    assert len(every) > len(few) == 5
    assert {tuple(q) for q in few} <= {tuple(q) for q in every}
    np.testing.assert_allclose(chart.x(every), np.tile(x, (len(every), 1)), atol=1e-6)


@pytest.mark.slow
def test_pose_paths() -> None:
    """Tool position and orientation move, the elbow is held."""
    known = problems.get("iiwa")
    problem = oc.Problem(known.robot, oc.Task.pose(known.robot), domain=oc.Box(known.domain.centre, 0.5))
    chart = oc.fit(problem, oc.Polynomial(2)).chart
    x = chart.x(problem.domain.centre)
    path = x + np.linspace(0, 1, 15)[:, None] * np.array([0.03, -0.02, 0.02, 0.05, 0.1, 0.0])
    found = oc.follow(chart, path)
    np.testing.assert_allclose(chart.x(found.q[-1]), path[-1], atol=1e-9)
    np.testing.assert_allclose(found.xi, 0 * found.xi + chart.xi(problem.domain.centre), atol=1e-9)


@pytest.mark.slow
def test_paths_that_leave_the_reach_are_told_where_and_why() -> None:
    chart = planar()
    with pytest.raises(PathError) as caught:
        oc.follow(chart, loop(chart, 0.8), velocity_limits=1.0)
    text = str(caught.value)
    assert "between waypoints" in text
    assert "of 0 to 59" in text
    assert "it leaves the domain, stopped by joint 'q" in text
    assert "just before, the coordinates reach xi1 in [" in text
    far = chart.x(START) + np.linspace(0, 1, 5)[:, None] * np.array([3.0, 0.0])
    with pytest.raises(PathError, match="of 0 to 4"):
        oc.follow(chart, far, velocity_limits=1.0)
    with pytest.raises(PathError, match=r"at s = 0\.\d+ \(x = "):
        oc.follow(chart, lambda s: chart.x(START) + np.array([2 * s, 0.0]), velocity_limits=1.0)
    with pytest.raises(PathError, match="at waypoint 0 of 0 to 4"):
        oc.follow(chart, far + 10, velocity_limits=1.0)


WRONG: dict[str, tuple[dict[str, Any], str]] = {
    "other columns": ({"tool_path": np.zeros((5, 3))}, r"tool_path \(x, y\) has shape \(5, 3\), expected \('any', 2\)"),
    "one waypoint": ({"tool_path": [[1.0, 2.0]]}, "number of rows of tool_path is 1"),
    "NaN": ({"tool_path": [[1.0, 2.0], [1.0, np.nan]]}, r"y of tool_path\[1\] is nan, expected a finite number"),
    "no motion": ({"tool_path": [[1.0, 2.0], [1.0, 2.0]]}, "waypoint 1 is the same as the previous one"),
    "failing function": ({"tool_path": lambda s: 1 / 0}, r"tool_path\(0\) is ZeroDivisionError"),
    "short schedule": ({"xi": np.zeros((5, 1))}, "number of rows of xi is 5, expected 60"),
    "unknown choice": ({"xi": "best"}, "xi is 'best', expected 'hold', 'objective'"),
    "no limits": ({"velocity_limits": None}, "velocity_limits of joint 'q1' is inf"),
    "period": ({"period": 0.0}, "period is 0.0"),
    "clearance": ({"clearance": -1.0}, "clearance is -1.0"),
    "chart": ({"chart": 3}, "chart is 3"),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_arguments_are_refused(name: str) -> None:
    arguments, message = WRONG[name]
    good = {"chart": planar(), "tool_path": loop(planar(), 0.1), "velocity_limits": 1.0}
    with pytest.raises((InvalidValueError, ShapeError), match=message):
        oc.follow(**(good | arguments))


def test_grown_charts_are_refused() -> None:
    with pytest.raises(NoExpressionError):
        oc.follow(circle(), [[0.5], [0.6]], velocity_limits=1.0)


def test_motions_are_saved_as_csv(tmp_path: Path) -> None:
    found, path = motion(), tmp_path / "q.csv"
    found.save_csv(path)
    with path.open(newline="") as stream:
        rows = list(csv.reader(stream))
    assert rows[0] == ["time_s", "q1", "q2", "q3", "d_q1", "d_q2", "d_q3", "dd_q1", "dd_q2", "dd_q3", "x", "y", "xi1"]
    table = np.array(rows[1:], dtype=float)
    np.testing.assert_array_equal(
        table, np.column_stack([found.times, found.q, found.dq, found.ddq, found.x, found.xi])
    )
    found.save_csv(path)  # its own file
    path.write_text("mine")
    with pytest.raises(PathFileError, match="orthocas did not write the file"):
        found.save_csv(path)
    found.save_csv(path, force=True)
    with pytest.raises(PathFileError, match="does not exist"):
        found.save_csv(tmp_path / "nowhere" / "q.csv")
    assert [file.name for file in tmp_path.iterdir()] == ["q.csv"]


def test_motions_are_read_only() -> None:
    for name in ("times", "q", "dq", "ddq", "x", "xi", "s"):
        assert not getattr(motion(), name).flags.writeable


@pytest.mark.slow
def test_two_arms_follow_a_path_of_their_relative_pose() -> None:
    """The path in x is met at every time stamp, with the links of both arms kept clear of a floor."""
    tips = ["left_gripper", "right_gripper"]
    robot = oc.Robot.from_urdf(robot_data("baxter_description/urdf/baxter.urdf"), tips=tips)
    home = np.array([0.3, -0.4, -0.5, 1.2, 0.2, 0.8, 0.1, -0.3, -0.4, 0.5, 1.2, -0.2, 0.8, -0.1])
    task = oc.Task.relative_pose(robot, *tips)
    chart = oc.fit(oc.Problem(robot, task, domain=oc.Box(home, 0.3)), oc.Polynomial(2)).chart
    path = chart.x(home) + np.linspace(0, 1, 10)[:, None] * [0.03, 0.02, 0, 0, 0, 0]
    floor = oc.Scene({"floor": oc.obstacles.Plane([0, 0, 1], [0, 0, -1.0])})
    around = robot.with_rods(0.01).collisions.with_scene(floor)
    motion = oc.follow(chart, path, q_start=home, collisions=around)
    np.testing.assert_allclose(chart.x(motion.q), motion.x, atol=1e-9)
    np.testing.assert_allclose(motion.x[-1], path[-1], atol=1e-9)
    assert len(around.pairs) == robot.n
