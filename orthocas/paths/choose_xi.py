"""The choice of xi along a tool path: a small optimal control problem in xi alone."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np
from scipy.interpolate import CubicSpline

from orthocas.charts.phi import counted_on
from orthocas.paths.checks import Limits
from orthocas.paths.joint_curve import Solver
from orthocas.paths.plan import Plan
from orthocas.tasks.domains import bounds_of
from orthocas.tools.batch import Batched, dense_function
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array

if TYPE_CHECKING:
    from orthocas.charts.chart import Chart

if TYPE_CHECKING:
    pass

_INSIDE = 0.97  # share of the half-width beyond which the residual of a joint is a straight line
_REGULAR, _NEARLY_SINGULAR = 0.1, 0.02  # relative singular values: scale of the residual, and where its line begins
_AWAY, _TOO_NEAR = 0.02, 0.004  # the same for distances from obstacles [m]
_STEPS = 3  # at each place
_LONGEST = 0.1  # of a step [rad] or [m]
_WALK_DAMPING = 1e-2
_LEAST, _MOST = 20, 60  # pieces of the spline
_DENSITY = 10  # pieces on a path as long as x moves over the domain
_PLACES = 8  # where costs count, on every piece
_SPEED, _BEND = 2e-2, 1e-4  # weights of the squares of xi' and xi''
_ITERATIONS = 40
_GAIN = 1e-3  # relative decrease of the cost that ends the iterations
_DAMPING = 1e-2  # at first
_MOST_DAMPING = 1e8


@dataclass(frozen=True, eq=False)
class Costs:
    """Residuals of joint positions, and their gradients."""

    limits: Limits

    def __call__(self, q: Array) -> tuple[Array, Array]:
        """Residuals (P, k) and gradients (P, k, n) at joint positions (P, n)."""
        parts = [self._of_boundaries(q), self._of_task(q)]
        if self.limits.distances.obstacles:
            values, gradients = self.limits.distances.with_gradients(q)
            residuals, slopes = _inverse(values - self.limits.clearance, _AWAY, _TOO_NEAR)
            parts.append((residuals, slopes[..., None] * gradients))
        return np.concatenate([part[0] for part in parts], axis=1), np.concatenate([part[1] for part in parts], axis=1)

    def _of_boundaries(self, q: Array) -> tuple[Array, Array]:
        domain = self.limits.chart.problem.domain
        bounded = np.flatnonzero(np.isfinite(bounds_of(domain)[0]))
        u = ((q - domain.centre) / domain.half_width)[:, bounded]
        near = np.clip(u, -_INSIDE, _INSIDE)
        slopes = (1 - near**2) ** -1.5
        residuals = near / np.sqrt(1 - near**2) + (u - near) * slopes
        gradients = np.zeros((len(q), len(bounded), q.shape[1]))
        gradients[:, np.arange(len(bounded)), bounded] = slopes / domain.half_width[bounded]
        return residuals, gradients

    def _of_task(self, q: Array) -> tuple[Array, Array]:
        left, values, right = np.linalg.svd(self.limits.scaled_rows(q), full_matrices=False)
        clear = self.limits.chart.problem.domain.singular_bound
        bound = 0.0 if clear is None else clear.least_singular_value
        residuals, slopes = _inverse(values[:, -1:] - bound, _REGULAR, _NEARLY_SINGULAR)
        gradients = self._turning(q, left[:, :, -1] / self.limits.scale, right[:, -1])[0]
        return residuals, slopes[..., None] * gradients[:, None]

    @cached_property
    def _turning(self) -> Batched:
        """q, u, v -> the gradient (n, 1) of u^T J(q) v: with singular vectors, that of the singular value."""
        chart = self.limits.chart
        q, v, u = ca.SX.sym("q", chart.n), ca.SX.sym("v", chart.n), ca.SX.sym("u", chart.m)
        product = ca.dot(u, self.limits.rows(q) @ v)
        return Batched(dense_function("turning", [q, u, v], [ca.cse(ca.gradient(product, q))]))


def _inverse(room: Array, scale: float, least: float) -> tuple[Array, Array]:
    """scale / room and its derivative; a straight line where room is below `least`."""
    far = np.maximum(room, least)
    slopes = -scale / far**2
    return scale / far + (room - far) * slopes, slopes


def walk(chart: "Chart", costs: Costs, x: Array, q: Array) -> Array:
    """Joint positions (P, n) near task values x (P, m), from q (n,).

    At every place, steps of least norm towards x, and Gauss-Newton steps within the null space of J_x that lower the
    costs, as in resolved-rate control with gradient projection.
    """
    points = []
    for wanted in x:
        for _ in range(_STEPS):
            q = q + _step(chart, costs, wanted, q)
        points.append(q)
    return np.array(points)


def _step(chart: "Chart", costs: Costs, x: Array, q: Array) -> Array:
    J = chart.relative.batched_rates(q[None])[0].reshape(chart.m, chart.n)
    inner = np.linalg.svd(J)[2][chart.m :].T  # (n, r)
    residuals, gradients = (part[0] for part in costs(q[None]))
    G = gradients @ inner
    along = -inner @ np.linalg.solve(G.T @ G + _WALK_DAMPING * np.eye(chart.r), G.T @ residuals)
    task = np.linalg.pinv(J, rcond=1e-3) @ chart.relative.difference(x, chart.task(q))
    return _cut(task) + _cut(along)


def _cut(step: Array) -> Array:
    return np.asarray(step * min(1.0, _LONGEST / max(float(np.abs(step).max()), 1e-300)))


@dataclass(frozen=True, eq=False)
class _State:
    """Values of the spline, and what follows from them."""

    values: Array  #: (K, r)
    q: Array  #: (P, n)
    residuals: Array  #: (P, k)
    gradients: Array  #: (P, k, n)
    cost: float


class XiChoice:
    """The problem for one tool path.

    Args:
        plan: the tool path.
        costs: of joint positions.
        solver: solves for them.
    """

    def __init__(self, plan: Plan, costs: Costs, solver: Solver) -> None:
        self.plan, self.costs, self.solver, self.chart = plan, costs, solver, solver.chart
        pieces = _pieces(plan)
        self.s = np.linspace(0.0, 1.0, _PLACES * pieces + 1)
        self.nodes = np.linspace(0.0, 1.0, pieces + 1)
        unit = np.eye(pieces + 1)
        if plan.closed:
            unit = np.vstack([unit[:pieces, :pieces], unit[:1, :pieces]])
        self._unit = unit
        basis = self._spline(unit)
        self._basis = basis(self.s)
        slopes, bends = basis(self.s, 1), basis(self.s, 2)
        self._smooth = (_SPEED * slopes.T @ slopes + _BEND * bends.T @ bends) / len(self.s)

    def best(self, first: Array) -> Plan:
        """The tool path with chosen coordinates, from joint positions near it at the places `s`, (P, n)."""
        state = self._first(first)
        if state is None:
            return self.plan
        damping = _DAMPING
        for _ in range(_ITERATIONS):
            hessian, gradient = self._model(state)
            better = None
            while better is None and damping < _MOST_DAMPING:
                better = self._stepped(state, hessian, gradient, damping)
                damping *= 8 if better is None else 0.3
            if better is None:
                break
            gain, state = state.cost - better.cost, better
            if gain < _GAIN * state.cost:
                break
        return self.plan.with_xi(self._spline(self._unit @ state.values))

    def _first(self, q: Array) -> _State | None:
        """The spline through the coordinates of joint positions, or through their mean where that has no solution."""
        xi = counted_on(self.chart.xi(q), self.chart.turns[self.chart.m :])
        values = np.linalg.lstsq(self._basis, xi, rcond=None)[0]
        return self._state(values, q) or self._state(np.tile(xi.mean(axis=0), (len(values), 1)), q)

    def _spline(self, values: Array) -> CubicSpline:
        return CubicSpline(self.nodes, values, bc_type="periodic" if self.plan.closed else "not-a-knot")

    def _state(self, values: Array, near: Array) -> _State | None:
        """The state of values (K, r), with joint positions near others; None where Newton's method fails."""
        goals = np.hstack([self.plan.x(self.s), self._basis @ values])
        q = self.solver.solve(near, goals)
        if not np.isfinite(q).all():
            return None
        smooth = float(np.einsum("kr,kl,lr->", values, self._smooth, values))
        residuals, gradients = self.costs(q)
        return _State(values, q, residuals, gradients, float((residuals**2).sum() / len(q)) + smooth)

    def _model(self, state: _State) -> tuple[Array, Array]:
        """Gauss-Newton Hessian (K r, K r) and half the gradient (K r,) of the cost."""
        r, m, B = self.chart.r, self.chart.m, self._basis
        G = state.gradients @ np.linalg.inv(self.solver.jacobian(state.q))[:, :, m:] / np.sqrt(len(B))
        squares = np.einsum("pka,pkb->pab", G, G)
        hessian = np.einsum("pi,pj,pab->iajb", B, B, squares, optimize=True)
        hessian += np.einsum("ij,ab->iajb", self._smooth, np.eye(r))
        slope = np.einsum("pi,pka,pk->ia", B, G, state.residuals / np.sqrt(len(B)), optimize=True)
        slope += self._smooth @ state.values
        size = B.shape[1] * r
        return hessian.reshape(size, size), slope.ravel()

    def _stepped(self, state: _State, hessian: Array, gradient: Array, damping: float) -> _State | None:
        """A damped step, if it lowers the cost."""
        scaled = hessian + damping * np.diag(np.diag(hessian) + 1e-9)
        change = -np.linalg.solve(scaled, gradient).reshape(state.values.shape)
        new = self._state(state.values + change, state.q)
        return new if new is not None and new.cost < state.cost else None


def _pieces(plan: Plan) -> int:
    """Pieces of the spline: more on longer paths."""
    length = np.linalg.norm(plan.steps, axis=1).sum()
    return int(np.clip(np.ceil(_DENSITY * length), _LEAST, _MOST))
