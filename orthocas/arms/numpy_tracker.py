"""The tracker of arms without a compiler: exact in charts, and x first everywhere else, by NumPy and CasADi."""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum
from typing import Any

import casadi as ca
import numpy as np

from orthocas.arms.chart_kernel import RULES
from orthocas.arms.kernel import build_curvature, build_equations
from orthocas.arms.maps import ArmMaps
from orthocas.arms.self_motion import find_motions
from orthocas.charts.chart import Chart
from orthocas.charts.clearance import Clearance
from orthocas.charts.newton import Bound
from orthocas.charts.trackers import Tracker, TrackerStatus
from orthocas.errors import InvalidValueError
from orthocas.tools.batch import dense_function
from orthocas.tools.cached import building
from orthocas.tools.checks import Array
from orthocas.tools.interrupts import deferred


class TrackStatus(IntEnum):
    """How the last call of an arm's tracker ended."""

    OK = 0  #: x is met, and xi if one was given
    YIELDING = 1  #: x is met; xi is another one: a limit, a border of the chart or the speed of joints is in its way
    BEHIND = 2  #: x is not met: the arm moves towards it as fast as its joints may, or goes another way to it
    NEAREST = 3  #: x is out of reach from here: a local minimum of its error within the limits, at rest
    BAD_INPUT = 4  #: a number of x or xi is not finite; the arm stays
    BRAKED = 5  #: a part of the way, or none: all of it would come nearer to a contact than `margin` allows


class NumpyTracker:
    """As `orthocas.arms.tracker.ArmTracker`, which checks arguments, without limits of acceleration.

    Where xi is not reached although a posture has it, it does not look for that posture. Where it is stuck without x,
    all curves of x are traced, which may take longer than a period.
    """

    def __init__(
        self,
        maps: ArmMaps,
        charts: Sequence[Chart],
        q: Array,
        period: float,
        speed: Array,
        detours: bool,
        clearance: Clearance | None,
    ) -> None:
        n = maps.robot.n
        self._maps, self._charts, self._period, self._speed = maps, tuple(charts), period, speed
        self._clearance = clearance
        self._detours, self._patience = detours, max(2, int(RULES.window / period))
        self._at, self._to = np.empty(n), np.empty(len(maps.targets_of(np.zeros((1, n)))[0]))
        self._e, self._J = np.empty(maps.task.m), np.empty((n, maps.task.m))
        with deferred(), building:  # CasADi's expressions are not for several threads at a time
            equations = build_equations(maps.task, maps.scale)
            curvature = build_curvature(equations)
        self._equations = Bound(equations, [self._at, self._to], [self._e, self._J])
        self._H = np.empty((n, n))
        self._curvature = Bound(curvature, [self._at, self._to], [self._H])
        if detours:  # compiled now rather than in a call
            assert maps.kernel is not None
            assert maps.stored is not None
        self.reset(q)

    @property
    def q(self) -> Array:
        """The last posture, (n,)."""
        return self._q.copy()

    @property
    def xi(self) -> float:
        """xi of the last posture; NaN outside the domain of the tracker's chart."""
        return self._measure_xi()[0] if self._inside else float("nan")

    @property
    def chart(self) -> int:
        """Number of the chart that gives xi; -1 before there is one."""
        return -1 if self._chart is None else self._charts.index(self._chart)

    @property
    def memory(self) -> Any:
        """What another tracker needs to go on here, but for detours under way."""
        return self._q.copy(), self._wish, self._near.copy(), self._last.copy(), self.status

    @memory.setter
    def memory(self, memory: Any) -> None:
        self.reset(memory[0])
        _, self._wish, self._near, self._last, self.status = memory

    def reset(self, q: Array) -> None:
        """Continue from another posture (n,)."""
        if self._clearance is not None:
            self._clearance.start(q)
        self._q, self._last = np.array(q, dtype=float), np.array(q, dtype=float)
        self._chart: Chart | None = None
        self._inside, self._wish, self._near = False, float("nan"), np.full(len(q), np.nan)
        self._goal: Array | None = None  # of a detour
        self._ticks, self._error = 0, np.inf  # since x was met or the error fell, and the error then
        self.status = TrackStatus.OK  #: how the last call ended
        self._look_for_chart()

    def stay_near(self, posture: Array) -> None:
        """Instead of holding xi, until it is given."""
        self._near = posture

    def step(self, vector: Array | None, target: Array | None, xi: float | None) -> Array:
        """The next posture (n,), clear of contacts, for x as the task's vector or as a target."""
        before = self._q
        q = self._move(vector, target, xi)
        if self._clearance is None:
            return q
        self._q, fraction = self._clearance.limit(before, self._q)
        if fraction < 1:
            self.status = TrackStatus.BRAKED
            self._look_for_chart()
        return self._q.copy()

    def _move(self, vector: Array | None, target: Array | None, xi: float | None) -> Array:
        """The next posture for x as the task's vector or as a target, of which the chart takes the one."""
        parts = [np.atleast_1d(part) for part in (vector, target, xi) if part is not None]
        if not np.isfinite(np.concatenate(parts)).all():
            self.status = TrackStatus.BAD_INPUT
            return self._q.copy()
        if xi is not None:
            self._wish, self._near = xi, np.full(len(self._q), np.nan)
        targets = self._maps.targets
        if self._holds_xi:
            x = targets.vector(np.asarray(target)[None])[0] if vector is None else vector
            if self._step_in_chart(x):
                self._ticks, self._goal = 0, None
                yields = self._exact.status == TrackerStatus.YIELDING
                self.status = TrackStatus.YIELDING if yields else TrackStatus.OK
                return self._q.copy()
        aim = targets.build(np.asarray(vector)[None])[0] if target is None else target
        rests = self.status == TrackStatus.NEAREST and np.array_equal(aim, self._to)
        self._to[:] = aim
        if not rests or self._ticks % self._patience == 0:  # what rests would rest again
            self.status = self._step_anywhere(asked=xi is not None)
        if self.status in (TrackStatus.OK, TrackStatus.YIELDING):
            self._ticks, self._goal = 0, None
        elif self._detours:
            self._watch_error()
        self._look_for_chart()
        return self._q.copy()

    def _watch_error(self) -> None:
        """Start a search for a detour if the error of x has not fallen for a while."""
        e, _ = self._look(self._q)
        error = float(np.linalg.norm(e))
        if self._ticks % self._patience == 0:
            if self._ticks and self._goal is None and error > RULES.falls * self._error:
                self._goal = self._find_goal()
            self._error = error
        self._ticks += 1

    def _find_goal(self) -> Array | None:
        """The nearest posture within the limits that has x, in the tracker's chart if that has one; None for none."""
        motions = find_motions(self._maps, self._to.copy(), self._q[None])
        if not motions.components:
            return None
        if self._chart is not None:
            q = np.vstack([arc.q for arc in motions])
            q = self._q + motions.measure_away(q, self._q)
            q = q[np.asarray(self._chart.problem.domain.contains(q))]
            if len(q):
                return np.asarray(q[np.argmin(np.linalg.norm(q - self._q, axis=1))])
        return motions.nearest(self._q).q

    def _step_to_goal(self) -> TrackStatus | None:
        """A step of a detour; None if it has no end any more."""
        robot = self._maps.robot
        met, goal = self._descend(np.array(self._goal), robot.lower, robot.upper)
        if not met:
            self._goal = None
            return None
        self._goal = goal
        way = goal - self._q
        share = float((self._speed * self._period / np.maximum(np.abs(way), 1e-300)).min())
        self._q = goal if share >= 1 else self._q + share * way
        return TrackStatus.YIELDING if share >= 1 else TrackStatus.BEHIND

    def _step_in_chart(self, vector: Array) -> bool:
        """Whether the chart has x and xi within the bounds of this step; then the arm goes there."""
        assert self._chart is not None
        exact = self._exact
        if not np.array_equal(exact.q, self._q):
            try:
                exact.reset(self._q)
            except InvalidValueError:  # within rounding of its boundary
                return False
        q = exact.step(np.append(vector, self._wish))
        low, high = self._bounds()
        if exact.status not in (TrackerStatus.OK, TrackerStatus.YIELDING) or not ((q >= low) & (q <= high)).all():
            return False
        self._q, self._last = q, q.copy()
        return True

    def _step_anywhere(self, asked: bool) -> TrackStatus:
        """A step that puts x before xi."""
        if self._goal is not None and (status := self._step_to_goal()) is not None:
            return status
        low, high = self._bounds()
        q = self._q
        e, J = self._look(q)
        error = float(e @ e)
        if self.status in (TrackStatus.BEHIND, TrackStatus.NEAREST) and np.abs(e).max() > RULES.near:
            met, ahead = self._descend(q, low, high)
        else:  # first with the wishes, then towards x alone
            rows, wishes, weight = self._find_wishes()
            damping = RULES.step_damping + RULES.error_damping * error
            H = J.T @ J + weight**2 * rows.T @ rows + damping * np.eye(len(q))
            g = -J.T @ e - weight**2 * rows.T @ wishes
            met, ahead = self._descend(np.clip(q + solve_in_box(H, g, low - q, high - q), low, high), low, high)
            if not met:  # wishes may be in the way
                met, other = self._descend(q, low, high)
                ahead = other if met or self._cost_of(other) < self._cost_of(ahead) else ahead
        if not met and self._cost_of(ahead) >= self._cost_of(q) * (1 - RULES.gain):
            ahead = q
        moved = ahead - q
        fast = (np.abs(moved) >= (1 - 1e-9) * self._period * self._speed).any()
        self._q = ahead
        if not met:
            return TrackStatus.BEHIND if fast or moved.any() else TrackStatus.NEAREST
        if np.isfinite(self._near).all() or not (asked or np.isfinite(self._wish)):
            return TrackStatus.OK
        return TrackStatus.YIELDING

    def _descend(self, q: Array, low: Array, high: Array) -> tuple[bool, Array]:
        """Where damped Newton steps in a box lead from q (n,), and whether x is met there.

        They lower |e|^2 + w^2 |q - p|^2 with the last posture p that had a chart, and a tiny w: at a border of reach,
        where two postures meet, that is the side to go back to.
        """
        e, J = self._look(q)
        weight, damping = RULES.posture_weight**2, RULES.step_damping
        away = q - self._last
        cost = float(e @ e) + weight * float(away @ away)
        for _ in range(RULES.rounds):
            far = np.abs(e).max() > RULES.near
            if np.abs(e).max() < RULES.met:
                return True, q
            pull = weight if far else 0.0
            g = pull * away - J.T @ e
            H = (self._bend(q) if far else J.T @ J) + (damping + pull) * np.eye(len(q))
            d = solve_in_box(H, g, low - q, high - q)
            promised = -float(2 * g @ d + d @ H @ d)
            if promised <= RULES.gain * cost:
                break
            new = np.clip(q + d, low, high)
            e_new, J_new = self._look(new)
            away_new = new - self._last
            before, after = (float(a @ a) + pull * float(b @ b) for a, b in ((e, away), (e_new, away_new)))
            if (before - after) / promised > RULES.decrease:
                q, e, J, away = new, e_new, J_new, away_new
                cost = float(e @ e) + weight * float(away @ away)
                damping = max(RULES.step_damping, damping / RULES.grows)
                if far and before - after < RULES.enough * before:
                    break
            else:
                damping = max(RULES.grows * damping, RULES.damping)
        return bool(np.abs(e).max() < RULES.met), q

    def _bend(self, q: Array) -> Array:
        """The second derivative of |e|^2 / 2 at q (n,), with the signs of its eigenvalues made positive, (n, n)."""
        self._at[:] = q
        self._curvature.run()
        values, vectors = np.linalg.eigh(self._H)
        return np.asarray((vectors * np.abs(values)) @ vectors.T)

    def _find_wishes(self) -> tuple[Array, Array, float]:
        """Rows, values and weight of what else the step is to do: xi, or the way back to a posture with a chart.

        Pairs nearer than `avoid` come on top: each is to be that far.
        """
        rows, wishes, weight = self._find_own_wishes()
        if self._clearance is not None and self._clearance.avoid is not None:
            near = self._clearance.collisions.find_near(self._q, self._clearance.avoid)
            scale = RULES.avoid_weight / weight
            rows = np.vstack([rows, scale * near.gradient])
            wishes = np.append(wishes, scale * (self._clearance.avoid - near.distance))
        return rows, wishes, weight

    def _find_own_wishes(self) -> tuple[Array, Array, float]:
        """Without a collision model."""
        n = len(self._q)
        if self._holds_xi:
            value, gradient = self._measure_xi()
            left = self._wish - value
            period = float(self._chart.parts.turns[-1]) if self._chart is not None else 0.0
            left -= period * np.round(left / period) if period else 0.0
            return gradient[None], np.array([left]), RULES.xi_weight
        end = self._near if np.isfinite(self._near).all() else self._last
        return np.eye(n), end - self._q, RULES.posture_weight

    @property
    def _holds_xi(self) -> bool:
        return self._inside and bool(np.isfinite(self._wish)) and not np.isfinite(self._near).all()

    def _look_for_chart(self) -> None:
        """Whether the posture is in the domain of the tracker's chart; without one, the first that holds it."""
        for chart in self._charts if self._chart is None else (self._chart,):
            if bool(chart.problem.domain.contains(self._q)):
                if self._chart is None:
                    self._chart = chart
                    parts = chart.parts.point_functions, chart.problem.domain, self._q, self._speed * self._period
                    clearance = None if self._clearance is None else self._clearance.copy()
                    self._exact = Tracker(*parts, chart.m, clearance)
                    self._values = chart.coordinates.functions
                    q = ca.MX.sym("q", len(self._q))
                    rows = [chart.parts.runnable(self._values[name])(q) for name in ("xi", "jacobian")]
                    self._point, self._value, self._slope = self._q.copy(), np.empty(1), np.empty(len(self._q))
                    function = dense_function("xi_rows", [q], rows)
                    self._xi = Bound(function, [self._point], [self._value, self._slope])
                    self._wish = self._measure_xi()[0]
                self._inside, self._last = True, self._q.copy()
                return
        self._inside = False

    def _measure_xi(self) -> tuple[float, Array]:
        """xi of the posture, and its gradient (n,)."""
        self._point[:] = self._q
        self._xi.run()
        return float(self._value[0]), self._slope.copy()

    def _bounds(self) -> tuple[Array, Array]:
        """Lowest and highest posture of the next step, (n,) each."""
        robot, most = self._maps.robot, self._speed * self._period
        return np.maximum(robot.lower, self._q - most), np.minimum(robot.upper, self._q + most)

    def _look(self, q: Array) -> tuple[Array, Array]:
        """Errors (m,) and rates (m, n) at q (n,)."""
        self._at[:] = q
        self._equations.run()
        return self._e.copy(), self._J.T.copy()

    def _cost_of(self, q: Array) -> float:
        """What `_descend` lowers, at q (n,)."""
        e, _ = self._look(q)
        away = q - self._last
        return float(e @ e) + RULES.posture_weight**2 * float(away @ away)


def solve_in_box(H: Array, g: Array, low: Array, high: Array) -> Array:
    """The d (n,) with the least g d + d H d / 2 of those with low <= d <= high.

    By a primal-dual active set, which changes many bounds at a time, and if that does not end soon, by a primal one
    from d = 0, which changes one.

    Args:
        H: (n, n), positive definite.
        g: (n,).
        low: (n,), <= 0.
        high: (n,), >= 0.
    """
    d = np.linalg.solve(H, -g)
    below, above = d < low, d > high
    if not (below.any() or above.any()):
        return np.asarray(d)
    for _ in range(RULES.guesses):
        free = ~(below | above)
        d = np.where(below, low, np.where(above, high, 0.0))
        d[free] = np.linalg.solve(H[free][:, free], -(g + H @ d)[free])
        pull = g + H @ d  # at a bound: positive where the cost falls beyond the lowest, negative beyond the highest
        under, over = np.where(below, pull > 0, d < low), np.where(above, pull < 0, d > high)
        if (under == below).all() and (over == above).all():
            return np.asarray(d)
        below, above = under, over
    return _solve_by_steps(H, g, low, high)


def _solve_by_steps(H: Array, g: Array, low: Array, high: Array) -> Array:
    """As `solve_in_box`, by a primal active set."""
    d, held = np.zeros(len(g)), np.zeros(len(g))
    for _ in range(RULES.changes):
        free, way = held == 0, np.zeros(len(g))
        way[free] = np.linalg.solve(H[free][:, free], -(g + H @ d)[free])
        with np.errstate(all="ignore"):
            shares = np.where(way > 0, (high - d) / way, np.where(way < 0, (low - d) / way, np.inf))
        k = int(np.argmin(shares))
        if shares[k] < 1:
            d = d + max(0.0, float(shares[k])) * way
            held[k] = np.sign(way[k])
            d[k] = high[k] if way[k] > 0 else low[k]
            continue
        d = d + way
        # What a bound holds back: the cost would fall on the other side.
        pull = (g + H @ d) * held
        worst = int(np.argmax(pull))
        if pull[worst] <= RULES.rounding:
            break
        held[worst] = 0.0
    return np.asarray(np.clip(d, low, high))
