"""Joint curves of tool paths, and the fastest time law along a curve."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np
from scipy.interpolate import BSpline, CubicHermiteSpline
from scipy.optimize import linprog
from scipy.sparse import coo_array, vstack

from orthocas.charts.curve_tracer import solutions_of
from orthocas.charts.newton import Newton, largest
from orthocas.errors import PathError, SolveError
from orthocas.paths.tool_path import RULES
from orthocas.tools.batch import Batched
from orthocas.tools.cached import building
from orthocas.tools.checks import Array, Indices
from orthocas.tools.interrupts import deferred

if TYPE_CHECKING:
    from orthocas.charts.chart import Chart


class PhiSolver:
    """Solves phi(q) = phi near given joint positions, and evaluates derivatives of phi."""

    def __init__(self, chart: "Chart") -> None:
        self.chart = chart
        self._newton = Newton(chart.parts.phi_map)
        # Threads share the chart.
        with deferred(), building:
            q, v, w = (ca.MX.sym(name, chart.n) for name in ("q", "v", "w"))
            bends = (
                chart.problem.task.rates_derivative_function(q, v, w),
                chart.coordinates.functions["second_derivative"](q, v, w),
            )
            turning = ca.Function("turning", [q, v, w], [ca.densify(ca.vertcat(*bends))])
        self._turning = Batched(chart.parts.runnable(turning))

    def jacobian(self, q: Array) -> Array:
        """J (N, n, n) at joint positions (N, n), with the rates of orientations."""
        return self.chart.parts.phi_map.jacobian(q)

    def compute_turning(self, q: Array, v: Array, w: Array) -> Array:
        """The derivative of J w along v, (N, n)."""
        return self._turning(q, v, w)[0]

    def solve(self, starts: Array, goals: Array) -> Array:
        """Solutions q (N, n) of phi(q) = goal near starts (N, n); NaN where Newton's method fails."""
        result = self._newton(goals, starts)
        return np.where((largest(result.residual) < RULES.residual)[:, None], result.q, np.nan)


Goal = Callable[..., Array]  #: s, order of the derivative -> phi or its rates, (n,) or (N, n)


@dataclass(frozen=True, eq=False)
class LostCurve:
    """The part of a curve before it is lost."""

    s: Array  #: (N,) parameters reached
    q: Array  #: (N, n) their joint positions
    beyond: float  #: the first parameter not reached


@dataclass(frozen=True, eq=False)
class JointCurve:
    """q(s) with phi(q(s)) = phi(s), for s in [0, 1]."""

    solver: PhiSolver
    goal: Goal
    near: CubicHermiteSpline  #: s -> q, close enough for Newton's method

    @classmethod
    def trace(cls, solver: PhiSolver, goal: Goal, q_start: Array) -> "JointCurve | LostCurve":
        """Follow phi(s) from s = 0, starting near q_start (n,), by Euler steps and Newton's method."""
        q = solver.solve(q_start[None], goal(np.zeros(1)))[0]
        if not np.isfinite(q).all():
            return LostCurve(np.empty(0), np.empty((0, len(q_start))), 0.0)
        s, h = [0.0], RULES.first_step
        points, slopes = [q], [_compute_slope(solver, q, goal(0.0, 1))]
        # Take Euler steps while Newton's method finds the curve nearby, and shorter ones where it fails.
        while s[-1] < 1:
            h = min(h, 1 - s[-1], RULES.curve_step / max(float(np.abs(slopes[-1]).max()), 1e-12))
            new, q = s[-1] + h if s[-1] + h < 1 - 1e-12 else 1.0, points[-1]
            solution = solver.solve((q + h * slopes[-1])[None], goal(np.array([new])))[0]
            slope = _compute_slope(solver, solution, goal(new, 1))
            if not np.isfinite(slope).all() or np.abs(solution - q).max() > 2 * RULES.curve_step:
                h /= 2
                if h < RULES.shortest_step:
                    return LostCurve(np.array(s), np.array(points), new)
                continue
            s.append(new)
            points.append(solution)
            slopes.append(slope)
            h *= 1.5
        return cls(solver, goal, CubicHermiteSpline(np.array(s), np.array(points), np.array(slopes)))

    def q(self, s: Array) -> Array:
        """Joint positions at parameters (N,), (N, n); NaN where Newton's method fails."""
        return self.solver.solve(np.asarray(self.near(s)), np.asarray(self.goal(s)))

    def evaluate(self, s: Array) -> tuple[Array, Array, Array]:
        """q(s), dq/ds and d2q/ds2 at parameters (N,), (N, n) each.

        J q' = phi' and J q'' = phi'' - d2phi(q)[q', q'].

        Raises:
            PathError: if Newton's method fails at a parameter.
        """
        q = self.q(s)
        bad = np.flatnonzero(np.isnan(q).any(axis=1))
        if bad.size:
            raise PathError(f"the path cannot be followed at s = {s[bad[0]]:.6g}: the chart is nearly singular there")
        # J q' = phi', and J q'' = phi'' - d2phi(q)[q', q'].
        J = self.solver.jacobian(q)
        first = solutions_of(J, self.goal(s, 1)[..., None])[..., 0]
        bend = self.goal(s, 2) - self.solver.compute_turning(q, first, first)
        return q, first, solutions_of(J, bend[..., None])[..., 0]


def _compute_slope(solver: PhiSolver, q: Array, rate: Array) -> Array:
    """dq/ds (n,) for dphi/ds (n,); NaN where q is not finite."""
    if not np.isfinite(q).all():
        return np.full(len(q), np.nan)
    return np.asarray(solutions_of(solver.jacobian(q[None]), rate[None, :, None])[0, :, 0])


@dataclass(frozen=True, eq=False)
class TimeLaw:
    """s(t) from rest to rest, with ds/dt and d2s/dt2."""

    times: Array  #: (M,) fine grid [s]
    s: Array  #: (M,)
    speed: Array  #: (M,) ds/dt

    @property
    def duration(self) -> float:
        """Length of the motion [s]."""
        return float(self.times[-1])

    def stretch(self, duration: float) -> "TimeLaw":
        """The same motion with another duration."""
        factor = duration / self.duration
        return TimeLaw(self.times * factor, self.s, self.speed / factor)

    def evaluate(self, times: Array) -> tuple[Array, Array, Array]:
        """s, ds/dt and d2s/dt2 at times (N,); the acceleration is piecewise constant."""
        k = np.clip(np.searchsorted(self.times, times, side="right") - 1, 0, len(self.times) - 2)
        since, length = times - self.times[k], self.times[k + 1] - self.times[k]
        acceleration = (self.speed[k + 1] - self.speed[k]) / length
        s = self.s[k] + self.speed[k] * since + acceleration * since**2 / 2
        return np.clip(s, 0.0, 1.0), np.maximum(self.speed[k] + acceleration * since, 0.0), acceleration


def list_places() -> Array:
    """The parameters s at which `compute_fastest_law` needs q' and q'', (P,)."""
    return np.linspace(0.0, 1.0, RULES.parts * RULES.part_places)


def compute_fastest_law(first: Array, second: Array, velocity: Array, acceleration: Array) -> TimeLaw:
    """The fastest time law within the limits, from rest to rest.

    Args:
        first: q' at `list_places()`, (P, n).
        second: q'' there, (P, n).
        velocity: limits (n,) [rad/s] or [m/s].
        acceleration: limits (n,) [rad/s^2] or [m/s^2].

    Raises:
        SolveError: if the linear program fails.
    """
    # Let z(s) = (ds/dt)^2 be a spline. The joint acceleration q'' z + q' z' / 2 is linear in its coefficients.
    inner = np.linspace(0.0, 1.0, RULES.law_pieces + 1)
    knots = np.concatenate([np.zeros(RULES.law_degree), inner, np.ones(RULES.law_degree)])
    moves = np.maximum(np.abs(first), RULES.turning_slope * np.abs(first).max(axis=0) + 1e-12)
    speeds = ((velocity / moves) ** 2).min(axis=1)
    slowest = _find_worst(-speeds)
    # Velocity limits: z <= (velocity / q')^2 at the tightest place in each part of the path.
    rows, bounds = [_evaluate_basis(slowest, knots)[0]], [speeds[slowest]]
    # Acceleration limits of each joint, at the sharpest turn in each part.
    for i in range(first.shape[1]):
        if np.abs(first[:, i]).max() > 1e-12:
            k = _find_worst(np.abs(second[:, i]))
            values, slopes = _evaluate_basis(k, knots)
            forces = values.multiply(second[k, i : i + 1]) + slopes.multiply(first[k, i : i + 1] / 2)
            rows += [forces, -forces]
            bounds += [np.full(RULES.parts, acceleration[i])] * 2
    limits, matrix = np.concatenate(bounds), vstack(rows).tocsr()
    scale = float(limits[: RULES.parts].min())
    size = len(knots) - RULES.law_degree - 1
    # Maximise the speed, with rest at both ends.
    ends = [(0.0, 0.0), *[(0.0, None)] * (size - 2), (0.0, 0.0)]
    gain = -np.asarray(rows[0].sum(axis=0)).ravel()
    solution = linprog(gain, matrix, limits / scale, bounds=ends, method="highs")
    if solution.x is None or solution.x.max() <= 0:
        raise SolveError(f"no speed profile was found for the path: {solution.message}")
    # Integrate time: steps of constant acceleration take 2 ds / (speed before + speed after).
    z = BSpline(knots, solution.x * scale, RULES.law_degree)
    # Use a finer grid near the ends, where the speed changes most.
    s = (1 - np.cos(np.linspace(0.0, np.pi, RULES.time_steps + 1))) / 2
    squares = z(s)
    squares = np.maximum(squares, RULES.least_square * squares.max())
    squares[[0, -1]] = 0.0
    speed = np.sqrt(squares)
    times = np.concatenate([[0.0], np.cumsum(2 * np.diff(s) / (speed[1:] + speed[:-1]))])
    return TimeLaw(times, s, speed)


def _find_worst(values: Array) -> Indices:
    """The index of the largest value (P,) in each part of the path, (_BINS,)."""
    parts = values.reshape(RULES.parts, RULES.part_places)
    return np.asarray(np.arange(RULES.parts) * RULES.part_places + parts.argmax(axis=1), dtype=np.int64)


def _evaluate_basis(k: Indices, knots: Array) -> tuple[coo_array, coo_array]:
    """Values and derivatives of the basis at indices k (P,), (P, size) each."""
    basis = BSpline(knots, np.eye(len(knots) - RULES.law_degree - 1), RULES.law_degree)
    s = list_places()[k]
    return coo_array(np.asarray(basis(s))), coo_array(np.asarray(basis.derivative()(s)))
