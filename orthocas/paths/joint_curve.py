"""Joint curves of a tool path, and the fastest law of time along one."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np
from scipy.interpolate import BSpline, CubicHermiteSpline
from scipy.optimize import linprog
from scipy.sparse import coo_array, vstack

from orthocas.charts.newton import Newton
from orthocas.charts.phi import largest
from orthocas.errors import PathError, SolveError
from orthocas.tools.batch import Batched
from orthocas.tools.cached import building
from orthocas.tools.checks import Array, Indices
from orthocas.tools.interrupts import deferred

if TYPE_CHECKING:
    from orthocas.charts.chart import Chart

_ACCEPTED = 1e-10  # of phi, relative to `Chart.phi_sizes`
_LONGEST = 0.15  # of a step of q on the way [rad] or [m]
_FIRST = 0.01  # first step of s
_SHORTEST = 1e-6  # of s
_DEGREE = 3
_PIECES = 60  # of the spline
_BINS, _PLACES = 300, 8  # parts of the path, and places of each; limits count where a joint turns most within a part
_TURNS = 0.01  # share of its largest slope that a joint counts with where the path turns back
_FINE = 6000  # steps of the integration of time
_LEAST = 1e-9  # smallest z inside the path, relative to its largest value


class Solver:
    """Solves phi(q) = phi near given joint positions, and evaluates derivatives of phi."""

    def __init__(self, chart: "Chart") -> None:
        self.chart = chart
        self._newton = Newton(chart.parts.phi_map)
        with deferred(), building:  # threads share the chart
            q, v, w = (ca.MX.sym(name, chart.n) for name in ("q", "v", "w"))
            bends = (
                chart.problem.task.rates_derivative_function(q, v, w),
                chart.coordinates.functions["second_derivative"](q, v, w),
            )
            turning = ca.Function("turning", [q, v, w], [ca.densify(ca.vertcat(*bends))])
        self._turning = Batched(chart.runnable(turning))

    def jacobian(self, q: Array) -> Array:
        """J (N, n, n) at joint positions (N, n), with the rates of orientations."""
        return self.chart.parts.phi_map.jacobian(q)

    def turning(self, q: Array, v: Array, w: Array) -> Array:
        """The derivative of J w along v, (N, n)."""
        return self._turning(q, v, w)[0]

    def solve(self, starts: Array, goals: Array) -> Array:
        """Solutions q (N, n) of phi(q) = goal near starts (N, n); NaN where Newton's method fails."""
        found = self._newton(goals, starts)
        return np.where((largest(found.residual) < _ACCEPTED)[:, None], found.q, np.nan)


def solved(J: Array, right: Array) -> Array:
    """J^-1 right for stacks (N, n, n) and (N, n); least squares where J is singular, NaN where it is not finite."""
    try:
        return np.asarray(np.linalg.solve(J, right[..., None])[..., 0], dtype=float)
    except np.linalg.LinAlgError:
        known = np.isfinite(J).all(axis=(1, 2))
        found = np.full_like(right, np.nan)
        found[known] = (np.linalg.pinv(J[known]) @ right[known][..., None])[..., 0]
        return found


Goal = Callable[..., Array]  #: s, order of the derivative -> phi or its rates, (n,) or (N, n)


@dataclass(frozen=True, eq=False)
class Lost:
    """A curve that ends early."""

    s: Array  #: (N,) parameters that were reached
    q: Array  #: (N, n) their joint positions
    beyond: float  #: the first parameter that was not reached


@dataclass(frozen=True, eq=False)
class JointCurve:
    """q(s) with phi(q(s)) = phi(s), for s in [0, 1]."""

    solver: Solver
    goal: Goal
    near: CubicHermiteSpline  #: s -> q, close enough for Newton's method

    @classmethod
    def along(cls, solver: Solver, goal: Goal, q_start: Array) -> "JointCurve | Lost":
        """Follow phi(s) from s = 0, where q_start (n,) is the guess, by Euler steps and Newton's method."""
        q = solver.solve(q_start[None], goal(np.zeros(1)))[0]
        if not np.isfinite(q).all():
            return Lost(np.empty(0), np.empty((0, len(q_start))), 0.0)
        s, h = [0.0], _FIRST
        points, slopes = [q], [_slope(solver, q, goal(0.0, 1))]
        while s[-1] < 1:
            h = min(h, 1 - s[-1], _LONGEST / max(float(np.abs(slopes[-1]).max()), 1e-12))
            new, q = s[-1] + h if s[-1] + h < 1 - 1e-12 else 1.0, points[-1]
            found = solver.solve((q + h * slopes[-1])[None], goal(np.array([new])))[0]
            slope = _slope(solver, found, goal(new, 1))
            if not np.isfinite(slope).all() or np.abs(found - q).max() > 2 * _LONGEST:
                h /= 2
                if h < _SHORTEST:
                    return Lost(np.array(s), np.array(points), new)
                continue
            s.append(new)
            points.append(found)
            slopes.append(slope)
            h *= 1.5
        return cls(solver, goal, CubicHermiteSpline(np.array(s), np.array(points), np.array(slopes)))

    def q(self, s: Array) -> Array:
        """Joint positions at parameters (N,), (N, n); NaN where Newton's method fails."""
        return self.solver.solve(np.asarray(self.near(s)), np.asarray(self.goal(s)))

    def at(self, s: Array) -> tuple[Array, Array, Array]:
        """q(s), dq/ds and d2q/ds2 at parameters (N,), (N, n) each.

        J q' = phi' and J q'' = phi'' - d2phi(q)[q', q'].

        Raises:
            PathError: if Newton's method fails at one of them.
        """
        q = self.q(s)
        bad = np.flatnonzero(np.isnan(q).any(axis=1))
        if bad.size:
            raise PathError(f"the path cannot be followed at s = {s[bad[0]]:.6g}: the chart is nearly singular there")
        J = self.solver.jacobian(q)
        first = solved(J, self.goal(s, 1))
        return q, first, solved(J, self.goal(s, 2) - self.solver.turning(q, first, first))


def _slope(solver: Solver, q: Array, rate: Array) -> Array:
    """dq/ds (n,) for dphi/ds (n,); NaN where q is not finite."""
    if not np.isfinite(q).all():
        return np.full(len(q), np.nan)
    return np.asarray(solved(solver.jacobian(q[None]), rate[None])[0])


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

    def stretched(self, duration: float) -> "TimeLaw":
        """The same motion in another time."""
        factor = duration / self.duration
        return TimeLaw(self.times * factor, self.s, self.speed / factor)

    def at(self, times: Array) -> tuple[Array, Array, Array]:
        """s, ds/dt and d2s/dt2 at times (N,): parts of constant acceleration."""
        k = np.clip(np.searchsorted(self.times, times, side="right") - 1, 0, len(self.times) - 2)
        since, length = times - self.times[k], self.times[k + 1] - self.times[k]
        acceleration = (self.speed[k + 1] - self.speed[k]) / length
        s = self.s[k] + self.speed[k] * since + acceleration * since**2 / 2
        return np.clip(s, 0.0, 1.0), np.maximum(self.speed[k] + acceleration * since, 0.0), acceleration


def list_places() -> Array:
    """The parameters s at which `fastest` wants q' and q'', (P,)."""
    return np.linspace(0.0, 1.0, _BINS * _PLACES)


def fastest(first: Array, second: Array, velocity: Array, acceleration: Array) -> TimeLaw:
    """The fastest profile.

    Args:
        first: q' at `checked_places()`, (P, n).
        second: q'' there, (P, n).
        velocity: limits (n,) [rad/s] or [m/s].
        acceleration: limits (n,) [rad/s^2] or [m/s^2].

    Raises:
        SolveError: if the linear program fails.
    """
    knots = _knots()
    moves = np.maximum(np.abs(first), _TURNS * np.abs(first).max(axis=0) + 1e-12)
    speeds = ((velocity / moves) ** 2).min(axis=1)
    slowest = _worst(-speeds)
    rows, bounds = [_basis(slowest, knots)[0]], [speeds[slowest]]
    for i in range(first.shape[1]):
        if np.abs(first[:, i]).max() > 1e-12:
            k = _worst(np.abs(second[:, i]))
            values, slopes = _basis(k, knots)
            forces = values.multiply(second[k, i : i + 1]) + slopes.multiply(first[k, i : i + 1] / 2)
            rows += [forces, -forces]
            bounds += [np.full(_BINS, acceleration[i])] * 2
    limits, matrix = np.concatenate(bounds), vstack(rows).tocsr()
    scale = float(limits[:_BINS].min())
    size = len(knots) - _DEGREE - 1
    ends = [(0.0, 0.0), *[(0.0, None)] * (size - 2), (0.0, 0.0)]
    gain = -np.asarray(rows[0].sum(axis=0)).ravel()
    found = linprog(gain, matrix, limits / scale, bounds=ends, method="highs")
    if found.x is None or found.x.max() <= 0:
        raise SolveError(f"the speed profile of a path was not found: {found.message}")
    return _integrated(BSpline(knots, found.x * scale, _DEGREE))


def _integrated(z: BSpline) -> TimeLaw:
    """Time along the path: steps of constant acceleration take 2 ds / (speed before + speed after)."""
    s = (1 - np.cos(np.linspace(0.0, np.pi, _FINE + 1))) / 2  # finer near the ends, where the speed changes most
    squares = z(s)
    squares = np.maximum(squares, _LEAST * squares.max())
    squares[[0, -1]] = 0.0
    speed = np.sqrt(squares)
    times = np.concatenate([[0.0], np.cumsum(2 * np.diff(s) / (speed[1:] + speed[:-1]))])
    return TimeLaw(times, s, speed)


def _knots() -> Array:
    inner = np.linspace(0.0, 1.0, _PIECES + 1)
    return np.concatenate([np.zeros(_DEGREE), inner, np.ones(_DEGREE)])


def _worst(values: Array) -> Indices:
    """The place with the largest value (P,) in each part of the path, (_BINS,)."""
    parts = values.reshape(_BINS, _PLACES)
    return np.asarray(np.arange(_BINS) * _PLACES + parts.argmax(axis=1), dtype=np.int64)


def _basis(k: Indices, knots: Array) -> tuple[coo_array, coo_array]:
    """Values and derivatives of the basis at places k (P,), (P, size) each."""
    basis = BSpline(knots, np.eye(len(knots) - _DEGREE - 1), _DEGREE)
    s = list_places()[k]
    return coo_array(np.asarray(basis(s))), coo_array(np.asarray(basis.derivative()(s)))
