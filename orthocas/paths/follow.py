"""From a tool path to a motion of the joints."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from orthocas.charts.chart import Chart
from orthocas.errors import InvalidValueError, SolveError
from orthocas.paths.checks import Limits
from orthocas.paths.choose_xi import Costs, XiChoice, walk
from orthocas.paths.joint_curve import JointCurve, Lost, Solver, TimeLaw, checked_places, fastest
from orthocas.paths.joint_motion import JointMotion
from orthocas.paths.plan import Plan
from orthocas.robots.obstacles import LinkDistances, Obstacle
from orthocas.tools.checks import Array, as_float_array, as_number, as_point, require_kind

HOLD = "hold"
OBJECTIVE = "objective"
_TO_FULL_SPEED = 0.5  # [s] that a joint takes to its velocity limit with the default acceleration limits
_STRETCHES, _MARGIN = 20, 1.001  # how often time is stretched, and a little more than needed
_INSTANTS = 2001  # at which the limits are kept besides
_MOST_STAMPS = 1_000_000


def follow(
    chart: Chart,
    tool_path: Any,
    xi: Any = HOLD,
    *,
    q_start: ArrayLike | None = None,
    period: float = 0.01,
    velocity_limits: ArrayLike | None = None,
    acceleration_limits: ArrayLike | None = None,
    obstacles: Sequence[Obstacle] = (),
    link_radius: ArrayLike = 0.0,
    clearance: float = 0.0,
) -> JointMotion:
    """Move the tool along a path: joint positions, velocities and accelerations on time stamps, from rest to rest.

    The path is a cubic spline through the waypoints, periodic if it ends where it begins. At every time stamp, q has
    the x and xi of the splines to 1e-10. The speed along the path is the fastest smooth profile that keeps the
    limits of velocity and acceleration in 300 parts of the path; then time is stretched until 2,000 instants
    and all time stamps keep them.

    Args:
        chart: a fitted chart.
        tool_path: task values of waypoints (N, m), or a function of s in [0, 1] that returns task values (m,).
        xi: "hold" keeps the coordinates of `q_start`. An array (N, r) gives them at the waypoints, a function of s in
            [0, 1] along the path. "objective" chooses them: away from the boundary of the domain, from positions where
            the task is near-singular, and from obstacles, and with little motion. Circle-valued coordinates go from
            each waypoint to the next by the shorter way, and count on beyond pi.
        q_start: a joint position (n,) near the start of the path. Default: the centre of the domain.
        period: distance of the time stamps [s].
        velocity_limits: (n,) or one number [rad/s] or [m/s]. Default: those of the robot's file.
        acceleration_limits: (n,) or one number [rad/s^2] or [m/s^2]. Default: full speed within 0.5 s.
        obstacles: spheres, capsules and planes of `orthocas.robots.obstacles`, which the links must not touch.
        link_radius: radius of the links, see `orthocas.robots.obstacles.LinkDistances` [m].
        clearance: smallest distance from obstacles [m].

    Raises:
        PathError: if the path leaves the reach or the domain, or touches an obstacle. The message names the waypoint,
            what stops the motion there, and how far the coordinates reach before it.
        InvalidValueError, ShapeError: for arguments of the wrong value or shape.
        NoExpressionError: for grown charts.

    Source:
        ours.

    Example:
        >>> import numpy as np
        >>> import orthocas as oc
        >>> from orthocas import problems
        >>> chart = oc.fit(problems.get("planar_3r_xy"), oc.Linear()).chart
        >>> start = chart.task([0.6, 0.8, 0.8])
        >>> angle = np.linspace(0.0, 2 * np.pi, 50)
        >>> circle = start + 0.1 * np.column_stack([np.cos(angle) - 1, np.sin(angle)])
        >>> motion = oc.follow(chart, circle, velocity_limits=1.0)
        >>> motion.closed, bool(abs(motion.q[-1] - motion.q[0]).max() < 1e-9)
        (True, True)
    """
    require_kind("chart", chart, Chart)
    chart.function("second_derivative")  # raises for grown charts
    start = chart.problem.domain.centre if q_start is None else as_point("q_start", q_start, chart.n)
    distances = LinkDistances(chart.problem.robot, obstacles, link_radius)
    limits = _limits(chart, velocity_limits, acceleration_limits, distances, clearance)
    stamp = as_number("period", period)
    if not 1e-5 <= stamp <= 10:
        raise InvalidValueError("period", period, "a time from 1e-5 to 10 s")
    plan = _plan(chart, tool_path, xi, start)
    solver = Solver(chart)
    curve = JointCurve.along(solver, plan.phi, start)
    if isinstance(xi, str) and xi == OBJECTIVE:
        plan, curve = _chosen(solver, plan, curve, limits, start)
    if isinstance(curve, Lost):
        limits.require_kept(plan, curve.s, curve.q)
        raise limits.lost(plan, curve)
    s = plan.checked()
    limits.require_kept(plan, s, curve.q(s))
    _, first, second = curve.at(checked_places())
    law = fastest(first, second, limits.velocity, limits.acceleration)
    return _on_stamps(plan, curve, law, limits, stamp)


def _plan(chart: Chart, tool_path: Any, xi: Any, start: Array) -> Plan:
    """The tool path with scheduled coordinates, or with those of the start."""
    if not isinstance(xi, str):
        return Plan.scheduled(chart, tool_path, xi)
    if xi not in (HOLD, OBJECTIVE):
        raise InvalidValueError("xi", repr(xi)[:80], f"'{HOLD}', '{OBJECTIVE}', an array or a function")
    return Plan.held(chart, tool_path, chart.xi(start))


def _chosen(
    solver: Solver, plan: Plan, held: JointCurve | Lost, limits: Limits, start: Array
) -> tuple[Plan, JointCurve | Lost]:
    """The path with coordinates by objective, from those that are held, or from a walk where that is not possible."""
    costs = Costs(limits)
    choice = XiChoice(plan, costs, solver)
    q = walk(solver.chart, costs, plan.x(choice.s), start) if isinstance(held, Lost) else held.q(choice.s)
    chosen = choice.best(q)
    return chosen, JointCurve.along(solver, chosen.phi, q[0])


def _limits(
    chart: Chart,
    velocity: ArrayLike | None,
    acceleration: ArrayLike | None,
    distances: LinkDistances,
    clearance: float,
) -> Limits:
    """Limits of all joints, > 0 and finite."""
    most = chart.problem.robot.velocity_limits if velocity is None else velocity
    speeds = _of_joints(chart, "velocity_limits", most)
    given = speeds / _TO_FULL_SPEED if acceleration is None else acceleration
    gap = as_number("clearance", clearance)
    if not 0 <= gap < np.inf:
        raise InvalidValueError("clearance", clearance, "a length >= 0 [m]")
    return Limits(chart, speeds, _of_joints(chart, "acceleration_limits", given), distances, gap)


def _of_joints(chart: Chart, name: str, value: ArrayLike) -> Array:
    given = as_float_array(name, value)
    if given.shape not in ((), (chart.n,)):
        raise InvalidValueError(name, f"an array of shape {given.shape}", f"one number, or {chart.n}")
    limits = np.broadcast_to(given, (chart.n,))
    bad = np.flatnonzero(~((limits > 0) & np.isfinite(limits)))
    if bad.size:
        joint = chart.problem.robot.joint_names[bad[0]]
        raise InvalidValueError(f"{name} of joint '{joint}'", limits[bad[0]], "a positive, finite number")
    return limits


def _on_stamps(plan: Plan, curve: JointCurve, law: TimeLaw, limits: Limits, period: float) -> JointMotion:
    """The motion at multiples of the period, slower until these and other instants keep the limits."""
    law = _slowed(law, limits, *_motion(curve, law, np.linspace(0.0, law.duration, _INSTANTS))[2:])
    for _ in range(_STRETCHES):
        stamps = max(4, int(np.ceil(law.duration / period - 1e-9)))
        if stamps > _MOST_STAMPS:
            raise InvalidValueError("period", period, f"at most {_MOST_STAMPS} time stamps in {law.duration:.3g} s")
        law = law.stretched(stamps * period)
        times = period * np.arange(stamps + 1, dtype=float)
        s, q, dq, ddq = _motion(curve, law, times)
        slower = _slowed(law, limits, dq, ddq)
        if slower is law:
            break
        law = slower
    else:
        raise SolveError("no speed along the path keeps the limits at all time stamps")
    x, xi = plan.x(s), plan.xi(s)
    names = limits.chart.labels, limits.chart.problem.robot.joint_names
    return JointMotion(*names, times, q, dq, ddq, x, xi, s, plan.closed, limits.margins(q, dq, ddq))


def _motion(curve: JointCurve, law: TimeLaw, times: Array) -> tuple[Array, Array, Array, Array]:
    """s (N,), and q, dq, ddq (N, n) at times (N,)."""
    s, speed, rate = law.at(times)
    q, first, second = curve.at(s)
    dq, ddq = first * speed[:, None], second * speed[:, None] ** 2 + first * rate[:, None]
    return s, q, np.asarray(dq, dtype=float), np.asarray(ddq, dtype=float)


def _slowed(law: TimeLaw, limits: Limits, dq: Array, ddq: Array) -> TimeLaw:
    """The law, or a slower one if velocities or accelerations (N, n) exceed their limits."""
    used = max((np.abs(dq) / limits.velocity).max(), np.sqrt((np.abs(ddq) / limits.acceleration).max()))
    return law if used <= 1 else law.stretched(law.duration * float(used) * _MARGIN)
