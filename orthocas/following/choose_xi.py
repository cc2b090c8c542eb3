"""Coordinates xi(s) along a tool path that keep joints inside, the task regular, and links away from obstacles (ours).

A small optimal control problem in xi alone. The unknowns are the values of a cubic spline xi(s) at a few places,

    minimise  mean over s of  sum of squares of the costs of q(x(s), xi(s)) + a |xi'|^2 + b |xi''|^2.

q is solved for by Newton's method in every iteration, at all places at once, and dq/dxi are the last r columns of J^-1.
So the problem has no constraints, and the Levenberg-Marquardt method solves it.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.interpolate import CubicSpline

from orthocas.checks import Array
from orthocas.coordinates.turns import counted_on
from orthocas.following.costs import Costs
from orthocas.following.plan import Plan
from orthocas.following.solver import Solver

if TYPE_CHECKING:
    pass

_LEAST, _MOST = 20, 60  # pieces of the spline
_DENSITY = 10  # pieces on a path as long as x moves over the domain
_PLACES = 8  # where costs count, on every piece
_SPEED, _BEND = 2e-2, 1e-4  # weights of the squares of xi' and xi''
_ITERATIONS = 40
_GAIN = 1e-3  # relative decrease of the cost that ends the iterations
_DAMPING = 1e-2  # at first
_MOST_DAMPING = 1e8


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
        pieces = _pieces(plan, self.chart.phi_sizes[: self.chart.m])
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


def _pieces(plan: Plan, sizes: Array) -> int:
    """Pieces of the spline: more on longer paths."""
    length = np.linalg.norm(np.diff(plan.waypoints / sizes, axis=0), axis=1).sum()
    return int(np.clip(np.ceil(_DENSITY * length), _LEAST, _MOST))
