"""Points inside the domain where there is no solution: the nearest ones in phi and in xi."""

from dataclasses import dataclass
from threading import Lock
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from orthocas.charts.in_domain import KEPT, BoxedPhi, solve_in_box
from orthocas.charts.newton import Starts
from orthocas.charts.phi import PhiMap, largest
from orthocas.tasks.domains import Domain
from orthocas.tools.batch import evaluate_columns
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array, Indices

_ROUNDS = 12
_SLACK = 1e-13  # of bounds
_SOFTNESS = 1e-12  # A d = softness * multipliers, so that bounds that leave no room for A d = 0 do no harm
_MOST, _RETURN = 40, 8  # iterations, and those of a return to h(q) = x
_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-3, 1e-8, 1e6  # relative to the mean eigenvalue
_DECREASE = 1e-4  # of the squared distance, relative to what the model promises
_CONVERGED = 1e-12  # promised decrease, relative to the squared distance
_ZERO = 1e-26  # squared distance that is rounding
_OPTIONS: dict[str, Any] = {
    "print_time": False,
    "error_on_fail": False,
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "ipopt.tol": 1e-9,
    "ipopt.constr_viol_tol": 1e-12,
    "ipopt.bound_relax_factor": 0.0,
    "ipopt.max_iter": 200,
}
_CLEAR = 1e-6  # least pivot over its bound: the domain is open there
_STARTS = 8  # of the table, after a given one
_NEAR_PHI, _NEAR_X, _DESCENTS = 8, 120, 5  # stored positions near phi and near x, and the best of them to go on from
_AT_ONCE = 256  # rows whose starts are held in memory
_FARTHEST = 1e300  # a distance that is finite
_REACHED = 1e-9  # distance in xi up to which no other start is tried


@dataclass(frozen=True)
class Programs:
    """The programs of N rows; low <= 0 <= high."""

    H: Array  #: (N, n, n), positive definite
    g: Array  #: (N, n)
    A: Array  #: (N, m, n)
    low: Array  #: (N, n)
    high: Array  #: (N, n)


@dataclass(frozen=True)
class Minimum:
    """Where N programs have their minimum."""

    d: Array  #: (N, n), within the bounds
    multipliers: Array  #: of A d = 0, (N, m)
    at_low: NDArray[np.bool_]  #: (N, n)
    at_high: NDArray[np.bool_]  #: (N, n)
    solved: NDArray[np.bool_]  #: whether d is the minimum, (N,)


def minimum(programs: Programs, at_low: NDArray[np.bool_], at_high: NDArray[np.bool_]) -> Minimum:
    """Minima of programs, from a guess of which bounds hold, (N, n) each."""
    N, n = programs.g.shape
    d, multipliers, left = np.zeros((N, n)), np.zeros((N, programs.A.shape[1])), np.arange(N)
    at_low, at_high = at_low.copy(), at_high.copy()
    for _ in range(_ROUNDS):
        part = Programs(*(getattr(programs, name)[left] for name in ("H", "g", "A", "low", "high")))
        d[left], multipliers[left] = _solved(part, at_low[left], at_high[left])
        low, high = _guess(part, d[left], multipliers[left], at_low[left], at_high[left])
        changed = ((low != at_low[left]) | (high != at_high[left])).any(axis=1)
        at_low[left], at_high[left] = low, high
        left = left[changed]
        if not left.size:
            break
    solved = np.ones(N, dtype=bool)
    solved[left] = False
    return Minimum(np.clip(d, programs.low, programs.high), multipliers, at_low, at_high, solved)


def _solved(programs: Programs, at_low: NDArray[np.bool_], at_high: NDArray[np.bool_]) -> tuple[Array, Array]:
    """d (N, n) and multipliers (N, m) where the guessed bounds hold with equality, and no others."""
    (N, m, n), held = programs.A.shape, at_low | at_high
    K = np.zeros((N, n + m, n + m))
    K[:, :n, :n], K[:, :n, n:], K[:, n:, :n] = programs.H, programs.A.transpose(0, 2, 1), programs.A
    K[:, n:, n:] = -_SOFTNESS * np.eye(m)
    rows, joints = np.nonzero(held)
    K[rows, joints], K[rows, joints, joints] = 0.0, 1.0
    bounds = np.where(at_low, programs.low, programs.high)
    right = np.concatenate([np.where(held, bounds, -programs.g), np.zeros((N, m))], axis=1)
    solution = np.linalg.solve(K, right[:, :, None])[:, :, 0]
    return solution[:, :n], solution[:, n:]


def _guess(
    programs: Programs, d: Array, multipliers: Array, at_low: NDArray[np.bool_], at_high: NDArray[np.bool_]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which bounds hold by what the last guess led to, (N, n) each."""
    slope = (programs.H @ d[:, :, None] + programs.g[:, :, None])[:, :, 0]
    slope = slope + np.einsum("nmi,nm->ni", programs.A, multipliers)
    free = ~(at_low | at_high)
    low = np.where(free, d < programs.low - _SLACK, at_low & (slope > 0))
    high = np.where(free, d > programs.high + _SLACK, at_high & (slope < 0))
    return low, high


def nearest_xi(boxed: BoxedPhi, targets: Array, start: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Points u of the box that keep x and have the nearest xi.

    Args:
        boxed: task and coordinates.
        targets: values of phi, (N, n).
        start: points of the box with these task values, (N, n).

    Returns:
        u (N, n), no further than the start, and which of them are local minima, (N,).
    """
    run = _Run(boxed, targets, start)
    with np.errstate(all="ignore"):
        rows = np.flatnonzero(np.isfinite(run.square))
        for _ in range(_MOST):
            rows = run.advance(rows)
            if not rows.size:
                break
    return run.u, run.done


class _Run:
    """The state of all rows."""

    def __init__(self, boxed: BoxedPhi, targets: Array, start: Array) -> None:
        self._boxed, self._targets = boxed, targets
        self.u, self.done = start.copy(), np.zeros(len(start), dtype=bool)
        self._errors = boxed.xi_errors(targets, self.u)
        self.square = (self._errors**2).sum(axis=1)
        self._damping = np.full(len(start), _DAMPING)
        self._fresh = np.zeros(len(start), dtype=bool)  # rows whose derivatives belong to u
        self._A, self._G = (
            np.zeros((len(start), boxed.m, start.shape[1])),
            np.zeros((*self._errors.shape, start.shape[1])),
        )
        self._at_low, self._at_high = np.zeros((2, *start.shape), dtype=bool)

    def advance(self, rows: Indices) -> Indices:
        """Try a step in some rows. Returns which go on."""
        rows = self._refreshed(rows)
        if not rows.size:
            return rows
        programs = self._programs(rows)
        found = minimum(programs, self._at_low[rows], self._at_high[rows])
        promised = -_slopes(programs, found)  # without what A d = 0 is missed by
        undamped = promised * (1 + self._damping[rows])
        self.done[rows] = found.solved & (undamped <= _CONVERGED * self.square[rows] + _ZERO)
        u, kept = self._returned(rows, found)
        errors = self._boxed.xi_errors(self._targets[rows], u)
        square = (errors**2).sum(axis=1)
        better = kept & (promised > 0) & (square < self.square[rows] - 2 * _DECREASE * promised)
        moved = rows[better]
        self.u[moved], self._errors[moved], self.square[moved] = u[better], errors[better], square[better]
        self._at_low[moved], self._at_high[moved] = found.at_low[better], found.at_high[better]
        self._fresh[moved] = False
        self._damping[rows] *= np.where(better, 0.2, 8.0)
        np.maximum(self._damping, _LEAST_DAMPING, out=self._damping)
        return rows[~self.done[rows] & (self._damping[rows] < _MOST_DAMPING)]

    def _refreshed(self, rows: Indices) -> Indices:
        """Evaluate derivatives where they belong to other points. Returns the rows where they are finite."""
        stale = rows[~self._fresh[rows]]
        if stale.size:
            self._A[stale], self._G[stale] = self._boxed.jacobians(self._targets[stale], self.u[stale])
            self._fresh[stale] = True
        finite = np.isfinite(self._A[rows]).all(axis=(1, 2)) & np.isfinite(self._G[rows]).all(axis=(1, 2))
        return np.asarray(rows[finite], dtype=np.int64)

    def _programs(self, rows: Indices) -> Programs:
        """The quadratic models of some rows."""
        G, n = self._G[rows], self.u.shape[1]
        H = G.transpose(0, 2, 1) @ G
        mean = np.trace(H, axis1=1, axis2=2) / n + np.finfo(float).tiny
        H += (self._damping[rows] * mean)[:, None, None] * np.eye(n)
        g = -np.einsum("nri,nr->ni", G, self._errors[rows])
        return Programs(H, g, self._A[rows], self._boxed.low - self.u[rows], self._boxed.high - self.u[rows])

    def _returned(self, rows: Indices, found: Minimum) -> tuple[Array, NDArray[np.bool_]]:
        """Points with h(q) = x after steps, (rows, n), and whether they were found, (rows,)."""
        x, start = self._targets[rows, : self._boxed.m], self.u[rows] + found.d
        u, error = solve_in_box(self._boxed.task_equations, x, start, found.at_low | found.at_high, _RETURN)
        missed = np.flatnonzero(error > KEPT)
        if missed.size:  # the joints at the boundary are needed
            u[missed], error[missed] = solve_in_box(self._boxed.task_equations, x[missed], start[missed], most=_RETURN)
        return u, np.asarray(error <= KEPT)


def _slopes(programs: Programs, found: Minimum) -> Array:
    """g^T d, corrected for A d = 0 being missed by a little, (rows,)."""
    missed = np.einsum("nm,nmi,ni->n", found.multipliers, programs.A, found.d)
    slopes: Array = np.einsum("ni,ni->n", programs.g, found.d) + missed
    return slopes


_one_at_a_time = Lock()  # Ipopt's linear solver is not made for threads


@dataclass(frozen=True, eq=False)
class Nearest:
    """Finds the nearest coordinates in the domain that keep the task."""

    domain: Domain
    m: int  #: number of task components
    phi: ca.Function  #: of a column q (n, 1)
    phi_map: PhiMap

    def search(self, targets: Array, starts: Array) -> Array:
        """Where the search from starts (N, n) ends, (N, n); see `keeps_task`."""
        low, high = self.domain.bounds
        with _one_at_a_time:
            q = evaluate_columns(self._search, 1, np.clip(starts, low, high), targets)[0]
        q = np.clip(q, low, high)  # NaN stays
        known = np.asarray(np.isfinite(q).all(axis=1))
        return np.where(known[:, None], q, np.clip(starts, low, high))

    def keeps_task(self, targets: Array, q: Array, tolerance: float) -> NDArray[np.bool_]:
        """Whether points (N, n) lie in the domain and have the task values of the targets, (N,)."""
        error = largest(self.phi_map.residual(targets, q)[:, : self.m])
        return np.asarray((error <= tolerance) & self.domain.contains(q))

    @cached_property
    def _search(self) -> ca.Function:
        """start (n, 1), target (n, 1) -> q (n, 1); outside the domain if only its `contains` knows where it ends."""
        m, domain, n = self.m, self.domain, len(self.domain.centre)
        q, target = ca.MX.sym("q", n), ca.MX.sym("phi", n)
        difference = -self.phi_map.difference(target, self.phi(q))
        constraints = [difference[:m] / ca.DM(self.phi_map.sizes[:m])]
        upper = np.zeros(m)
        clear = domain.singular_bound
        if clear is not None:
            pivots = clear.pivots(q)[: clear.gram.size1_out(0)] / clear.least_singular_value**2
            constraints += [_CLEAR - _products(pivots)]  # the pivots themselves have poles
            upper = np.zeros(m + m)
            if domain.room_to_fold is not None:
                constraints += [_CLEAR - domain.room_to_fold(q)]
                upper = np.zeros(m + m + 1)
        elif (condition := domain.known_condition) is not None:
            constraints += [-condition.pivots(q)]
            upper = np.zeros(m + condition.pivots.size1_out(0))
        lower = np.where(np.arange(len(upper)) < m, 0.0, -np.inf)
        equations: dict[str, Any] = {
            "x": q,
            "p": target,
            "f": ca.sumsqr(difference[m:]) / 2,
            "g": ca.vertcat(*constraints),
        }
        solver = ca.nlpsol("nearest", "ipopt", equations, _OPTIONS)
        low, high = (ca.DM(bound) for bound in domain.bounds)
        start = ca.MX.sym("start", n)
        found = solver(x0=start, p=target, lbx=low, ubx=high, lbg=ca.DM(lower), ubg=ca.DM(upper))
        return ca.Function("nearest", [start, target], [found["x"]])


def _products(pivots: ca.MX) -> ca.MX:
    """The products of the first 1, 2, ... pivots: leading minors, which are > 0 just where the pivots are."""
    found = [pivots[0]]
    for k in range(1, pivots.shape[0]):
        found.append(found[-1] * pivots[k])
    return ca.vertcat(*found)


@dataclass(frozen=True, eq=False)
class Inside:
    """Finds points of the domain that keep the task."""

    boxed: BoxedPhi
    starts: Starts
    by_ipopt: Nearest

    def with_task(self, targets: Array, q: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Points of the box with the task values of targets (N, n), or near them, from q (N, n) and other starts.

        Returns:
            q (N, n), and which of them have the task values, (N,).
        """
        x, u, error = targets[:, : self.boxed.m], self.boxed.of_points(q), np.full(len(q), np.inf)
        left = np.arange(len(q))
        for start in self._starts(targets, q):
            found, missed = solve_in_box(self.boxed.task_equations, x[left], self.boxed.of_points(start[left]))
            better = missed < error[left]
            u[left[better]], error[left[better]] = found[better], missed[better]
            left = left[error[left] > KEPT]
            if not left.size:
                break
        return self.boxed.points(u), np.asarray(error <= KEPT)

    def nearest(self, targets: Array, q: Array) -> Array:
        """Points of the domain with task values as in targets (N, n), as q (N, n), and the nearest xi, (N, n).

        They are the nearest of those that searches from q and from stored positions find.
        """
        pieces = [slice(first, first + _AT_ONCE) for first in range(0, len(q), _AT_ONCE)]
        return np.concatenate([q[:0], *(self._nearest(targets[rows], q[rows]) for rows in pieces)])

    def _nearest(self, targets: Array, q: Array) -> Array:
        N, n = q.shape
        near_phi = self.starts.nearest(targets, _NEAR_PHI, n)
        starts = np.concatenate([q[None], near_phi, self.starts.nearest(targets, _NEAR_X, self.boxed.m)])
        wanted = np.tile(targets, (len(starts), 1))
        u, error = solve_in_box(
            self.boxed.task_equations, wanted[:, : self.boxed.m], self.boxed.of_points(starts.reshape(-1, n))
        )
        points = self.boxed.points(u)
        away = np.where((error <= KEPT) & self.boxed.domain.contains(points), self._distance(wanted, points), np.inf)
        away[:N] = np.minimum(away[:N], _FARTHEST)  # q itself has the task values
        away, u, points = away.reshape(-1, N), u.reshape(-1, N, n), points.reshape(-1, N, n)
        order, every = np.argsort(away, axis=0)[:_DESCENTS], np.arange(N)
        best, distance, minimal = q.copy(), np.full(N, np.inf), np.zeros(N, dtype=bool)
        for which in order:
            rows = np.flatnonzero(np.isfinite(away[which, every]) & (distance > _REACHED))
            start = u[which[rows], rows]
            end, done = nearest_xi(self.boxed, targets[rows], start)
            for at, ended in ((start, np.zeros(len(rows), dtype=bool)), (end, done)):
                found = self.boxed.points(at)
                gap = np.where(self.boxed.domain.contains(found), self._distance(targets[rows], found), np.inf)
                better = gap < distance[rows]
                best[rows[better]], minimal[rows[better]] = found[better], ended[better]
                distance[rows[better]] = gap[better]
        undecided = np.flatnonzero(~minimal)
        if undecided.size:
            allowed = np.isfinite(distance[undecided])
            best[undecided] = self._searched_by_ipopt(targets[undecided], best[undecided], allowed)
        return best

    def nearer(self, targets: Array, q: Array) -> Array:
        """Points of the domain as near to xi as those that steps from q (N, n), inside, lead to, (N, n)."""
        found = self.boxed.points(nearest_xi(self.boxed, targets, self.boxed.of_points(q))[0])
        return np.where(self.boxed.domain.contains(found)[:, None], found, q)

    def _searched_by_ipopt(self, targets: Array, q: Array, allowed: NDArray[np.bool_]) -> Array:
        """Better points than q (N, n), from q; where q is not allowed, any, and from other starts as well."""
        best, distance = q.copy(), np.where(allowed, self._distance(targets, q), np.inf)
        left = np.arange(len(q))
        for start in self._starts(targets, q):
            found = self.by_ipopt.search(targets[left], start[left])
            kept = self.by_ipopt.keeps_task(targets[left], found, KEPT)
            away = np.where(kept, self._distance(targets[left], found), np.inf)
            better = away < distance[left]
            best[left[better]], distance[left[better]] = found[better], away[better]
            left = left[~np.isfinite(distance[left])]
            if not left.size:
                break
        return best

    def _starts(self, targets: Array, q: Array) -> list[Array]:
        return [q, *self.starts.nearest(targets, _STARTS, self.boxed.m)] if len(q) else []

    def _distance(self, targets: Array, q: Array) -> Array:
        """|xi - xi(q)|, (N,)."""
        errors = self.boxed.xi_errors(targets, self.boxed.of_points(q))
        return np.asarray(np.linalg.norm(errors, axis=1))
