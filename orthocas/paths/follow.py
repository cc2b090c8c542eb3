"""`follow`: a joint motion along a tool path."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from orthocas.charts.chart import Chart
from orthocas.charts.self_motion import counted_on, xi_range
from orthocas.charts.walls import Walls, require_collisions
from orthocas.errors import InvalidValueError, PathError, SolveError
from orthocas.paths.joint_curve import JointCurve, LostCurve, PhiSolver, TimeLaw, compute_fastest_law, list_places
from orthocas.paths.joint_motion import JointMotion, Margins
from orthocas.paths.tool_path import RULES, ToolPath, build_spline
from orthocas.paths.xi_search import Costs, XiChoice, XiSearch, walk
from orthocas.robots.collisions import Collisions
from orthocas.robots.tree import require_driven
from orthocas.tasks.samples import compute_row_scale, sample_uniform
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array, as_float_array, as_number, as_point, require_kind
from orthocas.tools.columns import BlockedFunction

HOLD = "hold"
OBJECTIVE = "objective"


def follow(
    chart: Chart,
    tool_path: Any,
    xi: Any = HOLD,
    *,
    q_start: ArrayLike | None = None,
    period: float = 0.01,
    velocity_limits: ArrayLike | None = None,
    acceleration_limits: ArrayLike | None = None,
    clearance: float = 0.0,
    collisions: Collisions | None = None,
) -> JointMotion:
    """Move the tool along a path, from rest to rest: joint positions, velocities and accelerations on time stamps.

    The path is a cubic spline through the waypoints, periodic if it ends where it begins. At every time stamp, q has
    the x and xi of the splines to 1e-10. The speed along the path is the fastest smooth profile within the limits of
    velocity and acceleration, checked in 300 parts of the path. Then time is stretched until the limits hold at 2,000
    instants and at all time stamps.

    Args:
        chart: a fitted chart.
        tool_path: waypoints, or a function of s in [0, 1] that returns one waypoint: task values (N, m) or (m,), or
            poses in a form that `Task.target` accepts.
        xi: "hold" keeps the coordinates of `q_start`. An array (N, r) gives them at the waypoints, a function of s in
            [0, 1] along the path. "objective" chooses them so that the arm stays away from the boundary of the domain,
            from near-singular positions and from contacts, and moves little. If the result of the descent has a contact
            and r = 1, all xi along the path are searched. Circle-valued coordinates take the shorter way between
            waypoints, and count on beyond pi.
        q_start: a joint position (n,) near the start of the path. Default: the centre of the domain.
        period: interval between time stamps [s].
        velocity_limits: (n,) or one number [rad/s] or [m/s]. Default: the limits in the robot's file.
        acceleration_limits: (n,) or one number [rad/s^2] or [m/s^2]. Default: full speed within 0.5 s.
        clearance: smallest allowed distance of the pairs of `collisions` [m].
        collisions: collision model of the chart's robot, such as `robot.collisions.with_scene(scene)`. No pair may come
            nearer than the clearance, at the time stamps and between them. For robots without solids, use rods:
            `Robot.with_rods`.

    Raises:
        PathError: if the path leaves the reach or the domain, or a pair of `collisions` may come nearer than the
            clearance. The message names the waypoint, what stops the motion there, and the range of the coordinates
            before it. For contacts, it names the pair and the time.
        InvalidValueError, ShapeError: for arguments of the wrong value or shape.
        NoExpressionError: for grown charts.

    Source:
        ours.

    Example:
        >>> import numpy as np
        >>> import orthocas as oc
        >>> from orthocas import problems
        >>> chart = oc.fit(problems.get("planar_3r_xy"), oc.Linear()).chart
        >>> start = chart.x([0.6, 0.8, 0.8])
        >>> angle = np.linspace(0.0, 2 * np.pi, 50)
        >>> circle = start + 0.1 * np.column_stack([np.cos(angle) - 1, np.sin(angle)])
        >>> motion = oc.follow(chart, circle, velocity_limits=1.0)
        >>> motion.closed, bool(abs(motion.q[-1] - motion.q[0]).max() < 1e-9)
        (True, True)
    """
    require_kind("chart", chart, Chart)
    require_driven("following a path", chart.problem.robot.tree)
    # Refuse grown charts.
    chart.function("second_derivative")
    require_collisions(collisions, chart.problem.robot.tree)
    start = chart.problem.domain.home if q_start is None else as_point("q_start", q_start, chart.n)
    # Limits of all joints must be finite and > 0.
    most = chart.problem.robot.velocity_limits if velocity_limits is None else velocity_limits
    speeds = _spread_limits(chart, "velocity_limits", most)
    accelerations = speeds / RULES.to_full_speed if acceleration_limits is None else acceleration_limits
    gap = as_number("clearance", clearance)
    if not 0 <= gap < np.inf:
        raise InvalidValueError("clearance", clearance, "a length >= 0 [m]")
    limits = MotionLimits(chart, speeds, _spread_limits(chart, "acceleration_limits", accelerations), collisions, gap)
    stamp = as_number("period", period)
    if not 1e-5 <= stamp <= 10:
        raise InvalidValueError("period", period, "a time from 1e-5 to 10 s")

    # Choose phi(s), and trace q(s) with phi(q(s)) = phi(s).
    if not isinstance(xi, str):
        path = ToolPath.schedule(chart, tool_path, xi)
    elif xi in (HOLD, OBJECTIVE):
        path = ToolPath.hold(chart, tool_path, chart.xi(start))
    else:
        raise InvalidValueError("xi", repr(xi)[:80], f"'{HOLD}', '{OBJECTIVE}', an array or a function")
    solver = PhiSolver(chart)
    if not (isinstance(xi, str) and xi == OBJECTIVE):
        return _move(path, JointCurve.trace(solver, path.phi, start), limits, stamp)
    # Use the first choice of xi that can be followed; otherwise raise the error of the first choice.
    first: PathError | None = None
    for chosen, q in _choose_xi(path, solver, limits, start):
        try:
            return _move(chosen, JointCurve.trace(solver, chosen.phi, q), limits, stamp)
        except PathError as error:
            first = first or error
    assert first is not None
    raise first


def _choose_xi(
    path: ToolPath, solver: PhiSolver, limits: MotionLimits, start: Array
) -> Iterator[tuple[ToolPath, Array]]:
    """Tool paths with chosen coordinates, each with a start (n,): first by descent, then by a search of all xi."""
    chart, costs = solver.chart, Costs(limits)
    choice = XiChoice(path, costs, solver)
    # Start from constant coordinates, or from a walk if these cannot be followed.
    curve = JointCurve.trace(solver, path.phi, start)
    q = walk(chart, costs, path.x(choice.s), start) if isinstance(curve, LostCurve) else curve.q(choice.s)
    yield choice.optimise(q), q[0]
    if limits.collisions is None or chart.r > 1:
        return
    for clearance in (limits.clearance + RULES.away, limits.clearance):
        cost = Costs(replace(limits, collisions=None)).sum_squares
        found = XiSearch(solver, path, limits.collisions, clearance, cost).find()
        if found is None:
            continue
        s, q = found
        near = np.column_stack([np.interp(choice.s, s, column) for column in q.T])
        yield choice.optimise(near), q[0]
        xi = counted_on(chart.xi(q), chart.parts.turns[chart.m :])
        if path.closed:
            xi[-1] = xi[0]
        # Interpolate linearly between stations, as the search has checked; a spline through the stations alone would
        # overshoot.
        places = np.linspace(0.0, 1.0, (len(s) - 1) * (RULES.station_places + 1) + 1)
        straight = np.column_stack([np.interp(places, s, column) for column in xi.T])
        yield path.replace_xi(build_spline(places, straight, path.closed)), q[0]


def _move(path: ToolPath, curve: JointCurve | LostCurve, limits: MotionLimits, period: float) -> JointMotion:
    """The motion along a joint curve, from rest to rest; raises PathError if it cannot be followed."""
    # A curve that ends early or leaves the domain gives an error with the reason.
    if isinstance(curve, LostCurve):
        limits.check_kept(path, curve.s, curve.q)
        raise limits.build_lost_error(path, curve)
    s = path.list_checks()
    limits.check_kept(path, s, curve.q(s))

    # Compute the fastest s(t), then sample it on time stamps.
    _, first, second = curve.evaluate(list_places())
    law = compute_fastest_law(first, second, limits.velocity, limits.acceleration)
    motion = _sample_on_stamps(path, curve, law, limits, period)
    limits.check_contacts(path, motion)
    return motion


def _spread_limits(chart: Chart, name: str, value: ArrayLike) -> Array:
    values = as_float_array(name, value)
    if values.shape not in ((), (chart.n,)):
        raise InvalidValueError(name, f"an array of shape {values.shape}", f"one number, or {chart.n}")
    limits = np.broadcast_to(values, (chart.n,))
    bad = np.flatnonzero(~((limits > 0) & np.isfinite(limits)))
    if bad.size:
        joint = chart.problem.robot.joint_names[bad[0]]
        raise InvalidValueError(f"{name} of joint '{joint}'", limits[bad[0]], "a positive, finite number")
    return limits


def _sample_on_stamps(
    path: ToolPath, curve: JointCurve, law: TimeLaw, limits: MotionLimits, period: float
) -> JointMotion:
    """The motion at multiples of the period, slowed down until the limits hold at these and other instants."""
    law = _slow_down(law, limits, *_evaluate_motion(curve, law, np.linspace(0.0, law.duration, RULES.instants))[2:])
    for _ in range(RULES.stretches):
        stamps = max(4, int(np.ceil(law.duration / period - 1e-9)))
        if stamps > RULES.most_stamps:
            raise InvalidValueError(
                "period", period, f"a period with at most {RULES.most_stamps} time stamps in {law.duration:.3g} s"
            )
        law = law.stretch(stamps * period)
        times = period * np.arange(stamps + 1, dtype=float)
        s, q, dq, ddq = _evaluate_motion(curve, law, times)
        # The largest values may occur at time stamps between the other instants.
        slower = _slow_down(law, limits, dq, ddq)
        if slower is law:
            break
        law = slower
    else:
        raise SolveError("no speed along the path keeps the limits at all time stamps")
    x, xi = path.x(s), path.xi(s)
    names = limits.chart.labels, limits.chart.problem.robot.joint_names
    over = limits.chart.parts.left_over(q[0], q[-1], RULES.returns)
    return JointMotion(*names, times, q, dq, ddq, x, xi, s, over, limits.measure_margins(q, dq, ddq))


def _evaluate_motion(curve: JointCurve, law: TimeLaw, times: Array) -> tuple[Array, Array, Array, Array]:
    """s (N,), and q, dq, ddq (N, n) at times (N,)."""
    s, speed, rate = law.evaluate(times)
    q, first, second = curve.evaluate(s)
    dq, ddq = first * speed[:, None], second * speed[:, None] ** 2 + first * rate[:, None]
    return s, q, np.asarray(dq, dtype=float), np.asarray(ddq, dtype=float)


def _slow_down(law: TimeLaw, limits: MotionLimits, dq: Array, ddq: Array) -> TimeLaw:
    """The law, or a slower one if velocities or accelerations (N, n) exceed their limits."""
    used = max((np.abs(dq) / limits.velocity).max(), np.sqrt((np.abs(ddq) / limits.acceleration).max()))
    return law if used <= 1 else law.stretch(law.duration * float(used) * RULES.stretch_margin)


@dataclass(frozen=True, eq=False)
class MotionLimits:
    """Limits and clearances that a motion must respect."""

    chart: Chart
    velocity: Array  #: (n,) [rad/s] or [m/s]
    acceleration: Array  #: (n,) [rad/s^2] or [m/s^2]
    collisions: Collisions | None
    clearance: float  #: smallest allowed distance of their pairs [m]

    @property
    def rows(self) -> ca.Function:
        """q (n, 1) -> the rows J (m, n) whose singular values measure the distance to singular positions."""
        clear, task = self.chart.problem.domain.singular_bound, self.chart.problem.task
        return task.frame_jacobian_function if clear is None else clear.jacobian_function

    @cached_property
    def scale(self) -> Array:
        """The scale of these rows, (m,); see `orthocas.ClearBox`."""
        domain = self.chart.problem.domain
        if domain.singular_bound is not None:
            return domain.singular_bound.scale
        J = self._compute_jacobian(sample_uniform(domain, RULES.scale_samples, 0))
        return compute_row_scale(J[np.isfinite(J).all(axis=(1, 2))], self.chart.problem.task.units)

    def compute_scaled_jacobian(self, q: Array) -> Array:
        """D^-1 J at joint positions (P, n), (P, m, n)."""
        J: Array = self._compute_jacobian(q) / self.scale[:, None]
        return J

    def _compute_jacobian(self, q: Array) -> Array:
        J: Array = self._batched_jacobian(q)[0].reshape(-1, self.chart.m, self.chart.n)
        return J

    @cached_property
    def _batched_jacobian(self) -> BlockedFunction:
        return BlockedFunction(self.rows)

    def check_kept(self, path: ToolPath, s: Array, q: Array) -> None:
        """Raise PathError at the first parameter (P,) whose joint position (P, n) is not finite or outside."""
        finite = np.flatnonzero(np.isfinite(q).all(axis=1))
        kept = finite[self.chart.problem.domain.contains(q[finite])]
        if len(kept) == len(q):
            return
        # Find the reason at the first bad position.
        k = int(np.setdiff1d(np.arange(len(q)), kept)[0])
        if not np.isfinite(q[k]).all():
            raise self.build_lost_error(path, LostCurve(s[:k], q[:k], float(s[k])))
        where = path.describe_place(float(s[k]), self.chart.labels)
        reason = f"it leaves the domain, stopped by {Walls(self.chart.problem).worst(q[k])}"
        raise PathError(f"the path cannot be followed {where}: {reason}{self._describe_reach(q[max(k - 1, 0)])}")

    def check_contacts(self, path: ToolPath, motion: JointMotion) -> None:
        """Raise PathError where a pair may come nearer than the clearance, at time stamps or between them.

        Between two stamps, a motion is at most a h^2 / 8 from the straight line, with the acceleration limits a.
        """
        if self.collisions is None:
            return
        # Largest deviation from the chord between samples.
        bend = self.acceleration * (motion.times[1] - motion.times[0]) ** 2 / 8
        contact = self.collisions.find_contact(motion.q, self.clearance, bend)
        if contact is None:
            return
        k, (first, second) = contact.segment, contact.pair
        instant = motion.times[k] + contact.fraction * (motion.times[1] - motion.times[0])
        where = path.describe_place(float(motion.s[k]), self.chart.labels)
        near = "touch" if contact.distance <= 0 else f"come to {contact.distance:.3g} m"
        raise PathError(
            f"the path cannot be followed {where}: at {instant:.3f} s '{first}' and '{second}' {near}, "
            f"expected a distance above clearance = {self.clearance:g} m at and between all time stamps"
        )

    def build_lost_error(self, path: ToolPath, end: LostCurve) -> PathError:
        """The error for a curve that ends before s = 1."""
        where = path.describe_place(end.beyond, self.chart.labels)
        return PathError(
            f"the path cannot be reached {where}: no joint position near the one before it has this x and xi, "
            f"so x is out of reach or the chart is singular{self._describe_reach(end.q[-1]) if len(end.q) else ''}"
        )

    def _describe_reach(self, q: Array) -> str:
        """The ranges of the coordinates at the last good joint position, as text; empty outside the domain."""
        try:
            reach = xi_range(self.chart, q)
        except InvalidValueError:
            return ""
        ranges = ", ".join(f"{part.label} in [{part.low:.4g}, {part.high:.4g}]" for part in reach)
        return f"; just before, the coordinates reach {ranges} one at a time"

    def measure_margins(self, q: Array, dq: Array, ddq: Array) -> Margins:
        """Margins of a motion at its time stamps: to limits, to singular positions and to contacts."""
        # Distance to the boundary, relative to the half-widths.
        low, high = self.chart.problem.domain.bounds
        room = np.minimum(q - low, high - q) / self.chart.problem.domain.half_width
        worst = int(np.argmin(room.min(axis=0)))
        bounded = bool(np.isfinite(room).any())
        # Least singular value, and nearest pair.
        values = np.linalg.svd(self.compute_scaled_jacobian(q), compute_uv=False)
        near = None if self.collisions is None else self.collisions.distance(q)
        k = -1 if near is None else int(np.argmin(near.distance))
        return Margins(
            float(room.min()),
            self.chart.problem.robot.joint_names[worst] if bounded else "",
            float((np.abs(dq) / self.velocity).max()),
            float((np.abs(ddq) / self.acceleration).max()),
            float(values[:, -1].min()),
            np.inf if near is None else float(near.distance[k]),
            "" if near is None else f"'{near.pair[k][0]}' and '{near.pair[k][1]}'",
        )
