"""Choice of xi along a tool path: by descent on costs, or by a search of all xi if the descent ends in a contact."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np
from scipy.interpolate import CubicSpline

from orthocas.charts.chart import Chart
from orthocas.charts.curve_tracer import without_turns
from orthocas.charts.self_motion import counted_on
from orthocas.paths.joint_curve import PhiSolver
from orthocas.paths.tool_path import RULES, ToolPath
from orthocas.robots.collisions import Collisions
from orthocas.tools.batch import Batched, dense_function
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array, Flags, Indices

if TYPE_CHECKING:
    from orthocas.paths.follow import MotionLimits


@dataclass(frozen=True, eq=False)
class XiSearch:
    """Searches all xi along a tool path for a motion without contacts, for r = 1.

    Each station on the path has candidate postures: points of its self-motions, 0.05 rad or m apart, in the domain and
    clear of contacts, thinned evenly to at most `RULES.station_postures`. Dynamic programming chooses one posture per
    station that minimises the sum of the costs of postures and of the squared steps between them. Between stations, no
    joint moves by more than `RULES.station_step`, and det J keeps its sign. If the motion between two chosen postures
    has a contact or leaves the domain, all edges between these stations are checked, and the next best solution is
    sought. Closed paths end at their first posture.

    Source:
        ours; the recursion is Viterbi's, and edges are checked late as in lazy planners.
    """

    solver: PhiSolver
    path: ToolPath
    collisions: Collisions  #: collision model of the chart's robot
    clearance: float  #: smallest allowed distance of its pairs [m]
    cost: Callable[[Array], Array]  #: costs (N,) of postures (N, n)

    def find(self) -> tuple[Array, Array] | None:
        """Stations s (S,) and postures there (S, n); None if no such motion is found."""
        s, closed = np.linspace(0.0, 1.0, RULES.stations), self.path.closed
        stations = [self._list_postures(x) for x in self.path.x(s[:-1] if closed else s)]
        stations += stations[:1] if closed else []
        if not all(len(q) for q in stations):
            return None
        # Squared steps between postures plus costs of the later ones, (K, L); infinite where there is no edge.
        costs, edges = self.cost(stations[0]), list[Array]()
        for q, later in pairwise(stations):
            steps = without_turns(later[None] - q[:, None], self._endless)
            signs, signs_later = (np.sign(np.linalg.det(self.solver.jacobian(points))) for points in (q, later))
            kept = (np.abs(steps).max(axis=2) < RULES.station_step) & (signs[:, None] == signs_later)
            edges.append(np.where(kept, (steps**2).sum(axis=2) * RULES.stations + self.cost(later), np.inf))
        checked = set[int]()
        while (chosen := _find_cheapest(costs, edges, closed)) is not None:
            way = np.array([q[k] for q, k in zip(stations, chosen, strict=True)])
            blocked = np.flatnonzero(~self._check_between(s[:-1], s[1:], way[:-1], way[1:]))
            if not len(blocked):
                # Unwrap endless joints from one station to the next.
                way[:, self._endless] = np.unwrap(way[:, self._endless], axis=0)
                return s, way
            for k in blocked:
                if k in checked:
                    # Rounding can block an edge that was clear, so exclude this one.
                    edges[k][chosen[k], chosen[k + 1]] = np.inf
                    continue
                i, j = np.nonzero(np.isfinite(edges[k]))
                bad = ~self._check_between(
                    np.full(len(i), s[k]), np.full(len(i), s[k + 1]), stations[k][i], stations[k + 1][j]
                )
                edges[k][i[bad], j[bad]] = np.inf
                checked.add(int(k))
        return None

    @cached_property
    def _endless(self) -> Flags:
        """Whether each joint turns endlessly, (n,)."""
        problem = self.solver.chart.problem
        return np.isin(np.arange(problem.robot.n), problem.turning)

    def _list_postures(self, x: Array) -> Array:
        """Postures (K, n) with a task value in the domain and clear of contacts."""
        chart = self.solver.chart
        curves = chart.parts.inverse.curves
        assert curves is not None
        home = chart.problem.domain.home
        q = curves.list_points(np.append(x, chart.xi(home)), RULES.station_parts)
        # Count endless joints once. Limit the number of postures, because memory grows with its square or cube.
        q = q[(np.abs(q - home)[:, self._endless] <= np.pi).all(axis=1)]
        q = q[self._check_clear(q)]
        kept: Array = q[np.linspace(0, len(q) - 1, min(len(q), RULES.station_postures)).astype(int)]
        return kept

    def _check_clear(self, q: Array) -> Flags:
        return np.asarray(self.collisions.distance(q).distance > self.clearance, dtype=bool)

    def _check_between(self, s: Array, s_later: Array, q: Array, later: Array) -> Flags:
        """Whether motions between postures (E, n) at stations (E,), with xi changing linearly, are clear, (E,)."""
        chart, kept = self.solver.chart, np.ones(len(q), dtype=bool)
        steps = without_turns(later - q, self._endless)
        xi = chart.xi(q)
        change = chart.parts.phi_map.difference(chart.phi(q + steps), chart.phi(q))[:, chart.m :]
        for share in np.arange(1, RULES.station_places + 1) / (RULES.station_places + 1):
            rows = np.flatnonzero(kept)
            x = self.path.x((1 - share) * s[rows] + share * s_later[rows])
            goals = np.hstack([x, xi[rows] + share * change[rows]])
            found = self.solver.solve(q[rows] + share * steps[rows], goals)
            good = np.asarray(np.isfinite(found).all(axis=1))
            good[good] = chart.problem.domain.contains(found[good])
            good[good] = self._check_clear(found[good])
            kept[rows[~good]] = False
        return kept


def _find_cheapest(costs: Array, edges: list[Array], closed: bool) -> list[int] | None:
    """The posture of each station on the cheapest path, from costs of first postures (K,) and of edges; or None."""
    # least[i, j]: cost to posture j of this station, from posture i of the first one (closed) or from any (open).
    least, before = np.where(np.eye(len(costs), dtype=bool), costs, np.inf) if closed else costs[None], list[Indices]()
    for edge in edges:
        totals = least[:, :, None] + edge
        before.append(np.argmin(totals, axis=1))
        least = np.take_along_axis(totals, before[-1][:, None, :], axis=1)[:, 0]
    # Go back from the best end.
    ends = np.where(np.eye(len(least), dtype=bool), least, np.inf) if closed else least
    first, last = np.unravel_index(int(np.argmin(ends)), ends.shape)
    if not np.isfinite(ends[first, last]):
        return None
    chosen = [int(last)]
    for back in reversed(before):
        chosen.append(int(back[first, chosen[-1]]))
    return chosen[::-1]


@dataclass(frozen=True, eq=False)
class Costs:
    """Residuals of joint positions, with their gradients."""

    limits: MotionLimits

    def __call__(self, q: Array) -> tuple[Array, Array]:
        """Residuals (P, k) and gradients (P, k, n) at joint positions (P, n)."""
        parts = [self._evaluate_boundaries(q), self._evaluate_task(q)]
        if self.limits.collisions is not None:
            values, gradients = self.limits.collisions.measure_nearest(q, RULES.nearest)
            residuals, slopes = _evaluate_inverse(values - self.limits.clearance, RULES.away, RULES.too_near)
            parts.append((residuals, slopes[..., None] * gradients))
        return np.concatenate([part[0] for part in parts], axis=1), np.concatenate([part[1] for part in parts], axis=1)

    def sum_squares(self, q: Array) -> Array:
        """Sums of squares of the residuals at joint positions (P, n), (P,)."""
        return np.asarray((self(q)[0] ** 2).sum(axis=1))

    def _evaluate_boundaries(self, q: Array) -> tuple[Array, Array]:
        domain = self.limits.chart.problem.domain
        bounded = np.flatnonzero(np.isfinite(domain.bounds[0]))
        u = ((q - domain.centre) / domain.half_width)[:, bounded]
        # Use u / sqrt(1 - u^2) in half-widths, continued as a straight line near the boundary.
        near = np.clip(u, -RULES.inside, RULES.inside)
        slopes = (1 - near**2) ** -1.5
        residuals = near / np.sqrt(1 - near**2) + (u - near) * slopes
        gradients = np.zeros((len(q), len(bounded), q.shape[1]))
        gradients[:, np.arange(len(bounded)), bounded] = slopes / domain.half_width[bounded]
        return residuals, gradients

    def _evaluate_task(self, q: Array) -> tuple[Array, Array]:
        left, values, right = np.linalg.svd(self.limits.compute_scaled_jacobian(q), full_matrices=False)
        clear = self.limits.chart.problem.domain.singular_bound
        bound = 0.0 if clear is None else clear.least_singular_value
        residuals, slopes = _evaluate_inverse(values[:, -1:] - bound, RULES.regular, RULES.nearly_singular)
        gradients = self._turning(q, left[:, :, -1] / self.limits.scale, right[:, -1])[0]
        return residuals, slopes[..., None] * gradients[:, None]

    @cached_property
    def _turning(self) -> Batched:
        """q, u, v -> gradient (n, 1) of u^T J(q) v; with singular vectors u, v, it is that of the singular value."""
        chart = self.limits.chart
        q, v, u = ca.SX.sym("q", chart.n), ca.SX.sym("v", chart.n), ca.SX.sym("u", chart.m)
        product = ca.dot(u, self.limits.rows(q) @ v)
        return Batched(dense_function("turning", [q, u, v], [ca.cse(ca.gradient(product, q))]))


def _evaluate_inverse(room: Array, scale: float, least: float) -> tuple[Array, Array]:
    """scale / room and its derivative, continued as a straight line where room is below `least`."""
    far = np.maximum(room, least)
    slopes = -scale / far**2
    return scale / far + (room - far) * slopes, slopes


def walk(chart: Chart, costs: Costs, x: Array, q: Array) -> Array:
    """Joint positions (P, n) near task values x (P, m), starting at q (n,).

    At every place it takes steps of least norm towards x, and Gauss-Newton steps in the null space of J_x that lower
    the costs, as in resolved-rate control with gradient projection.
    """
    points = []
    for target in x:
        for _ in range(RULES.walk_steps):
            J = chart.parts.relative.batched_rates(q[None])[0].reshape(chart.m, chart.n)
            # Towards x, take the step of least norm; in the null space (n, r), a damped Gauss-Newton step.
            toward = np.linalg.pinv(J, rcond=1e-3) @ chart.parts.relative.difference(target, chart.x(q))
            inner = np.linalg.svd(J)[2][chart.m :].T
            residuals, gradients = (part[0] for part in costs(q[None]))
            G = gradients @ inner
            along = -inner @ np.linalg.solve(G.T @ G + RULES.walk_damping * np.eye(chart.r), G.T @ residuals)
            q = q + _limit_step(toward) + _limit_step(along)
        points.append(q)
    return np.array(points)


def _limit_step(step: Array) -> Array:
    return np.asarray(step * min(1.0, RULES.walk_step / max(float(np.abs(step).max()), 1e-300)))


@dataclass(frozen=True, eq=False)
class _State:
    """Values of the spline, and quantities that follow from them."""

    values: Array  #: (K, r)
    q: Array  #: (P, n)
    residuals: Array  #: (P, k)
    gradients: Array  #: (P, k, n)
    cost: float


class XiChoice:
    """The optimisation problem for one tool path.

    Args:
        plan: the tool path.
        costs: costs of joint positions.
        solver: solver for joint positions.
    """

    def __init__(self, path: ToolPath, costs: Costs, solver: PhiSolver) -> None:
        self.path, self.costs, self.solver, self.chart = path, costs, solver, solver.chart
        # Longer paths get more pieces of the spline.
        length = np.linalg.norm(path.steps, axis=1).sum()
        pieces = int(np.clip(np.ceil(RULES.piece_density * length), RULES.fewest_pieces, RULES.most_pieces))
        self.s = np.linspace(0.0, 1.0, RULES.cost_places * pieces + 1)
        self.nodes = np.linspace(0.0, 1.0, pieces + 1)
        # Closed paths have equal values at both ends.
        unit = np.eye(pieces + 1)
        if path.closed:
            unit = np.vstack([unit[:pieces, :pieces], unit[:1, :pieces]])
        self._unit = unit
        basis = self._build_spline(unit)
        self._basis = basis(self.s)
        # The squares of xi' and xi'', as a quadratic form of the values, penalise motion.
        slopes, bends = basis(self.s, 1), basis(self.s, 2)
        self._smooth = (RULES.speed_weight * slopes.T @ slopes + RULES.bend_weight * bends.T @ bends) / len(self.s)

    def optimise(self, first: Array) -> ToolPath:
        """The tool path with optimised coordinates, from initial joint positions (P, n) at the places `s`."""
        # Fit the spline to the coordinates of these positions; use their mean if Newton's method fails on it.
        xi = counted_on(self.chart.xi(first), self.chart.parts.turns[self.chart.m :])
        values = np.linalg.lstsq(self._basis, xi, rcond=None)[0]
        means = np.tile(xi.mean(axis=0), (len(values), 1))
        state = self._evaluate_state(values, first) or self._evaluate_state(means, first)
        if state is None:
            return self.path
        damping = RULES.damping
        for _ in range(RULES.iterations):
            hessian, gradient = self._build_model(state)
            # Levenberg-Marquardt: increase the damping until a step lowers the cost.
            better = None
            while better is None and damping < RULES.most_damping:
                scaled = hessian + damping * np.diag(np.diag(hessian) + 1e-9)
                change = -np.linalg.solve(scaled, gradient).reshape(state.values.shape)
                new = self._evaluate_state(state.values + change, state.q)
                better = new if new is not None and new.cost < state.cost else None
                damping *= 8 if better is None else 0.3
            if better is None:
                break
            gain, state = state.cost - better.cost, better
            if gain < RULES.least_gain * state.cost:
                break
        return self.path.replace_xi(self._build_spline(self._unit @ state.values))

    def _build_spline(self, values: Array) -> CubicSpline:
        return CubicSpline(self.nodes, values, bc_type="periodic" if self.path.closed else "not-a-knot")

    def _evaluate_state(self, values: Array, near: Array) -> _State | None:
        """The state of values (K, r), with joint positions near given ones; None if Newton's method fails."""
        goals = np.hstack([self.path.x(self.s), self._basis @ values])
        q = self.solver.solve(near, goals)
        if not np.isfinite(q).all():
            return None
        smooth = float(np.einsum("kr,kl,lr->", values, self._smooth, values))
        residuals, gradients = self.costs(q)
        return _State(values, q, residuals, gradients, float((residuals**2).sum() / len(q)) + smooth)

    def _build_model(self, state: _State) -> tuple[Array, Array]:
        """Gauss-Newton Hessian (K r, K r) and half the gradient (K r,) of the cost."""
        r, m, B = self.chart.r, self.chart.m, self._basis
        # Gradients by xi: q moves by J^-1 [0; dxi].
        G = state.gradients @ np.linalg.inv(self.solver.jacobian(state.q))[:, :, m:] / np.sqrt(len(B))
        squares = np.einsum("pka,pkb->pab", G, G)
        hessian = np.einsum("pi,pj,pab->iajb", B, B, squares, optimize=True)
        hessian += np.einsum("ij,ab->iajb", self._smooth, np.eye(r))
        slope = np.einsum("pi,pka,pk->ia", B, G, state.residuals / np.sqrt(len(B)), optimize=True)
        slope += self._smooth @ state.values
        size = B.shape[1] * r
        return hessian.reshape(size, size), slope.ravel()
