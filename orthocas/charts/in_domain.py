"""The search of a whole domain for solutions of phi(q) = phi, by cells that may hold one."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthocas.charts.newton import inverses
from orthocas.charts.phi import ROUNDING, PhiMap, largest
from orthocas.tasks.domains import Domain
from orthocas.tasks.relative import Relative
from orthocas.tasks.task import Task
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array, Indices

MARGIN = 0.75  #: how far outside its range y may lie, relative to half of the range
CORE = 0.25  #: the same, for cells that most probably hold a solution if there is one
_HALVINGS = 10  # so many cells as 2 to the power of it
_PROBES, _SAMPLES, _SEED = 64, 32, 1  # points that measure how phi bends, and points in each cell
_NEAR = 1.25  # starts may leave their cell by so much, relative to its half-widths
KEPT = 1e-11  #: error, relative to the sizes of the components, at which the equations count as solved
_GOAL = 1e-13  # error at which the search stops
_MOST, _PATIENCE = 64, 8  # iterations; after so many, the error must have halved
_ROUNDS = 4  # of a step: joints that leave the box are held, and the others step again
_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-6, 1e-12, 1e6  # relative to |J|^2
_DECREASE = 1e-9  # of the squared error
_CELLS_AT_ONCE = (1, 3, 12)  # cells of a row that has no solution yet, searched at once; then all that are left
_AGAIN = 3  # further starts in each of the likeliest cells, at last
_ALL = 16  # further starts in each cell, for all solutions of one target
_MOST_FROM_CELLS, _PATIENCE_FROM_CELLS = 32, 3  # iterations; after so many, the error must have halved
_AT_ONCE = 1024  # rows whose starts are held in memory
_SAME = 1e-6  # of the half-widths: distance up to which two solutions count as one


@dataclass(frozen=True, eq=False)
class Equations:
    """k equations g(u) = target in a box, of many rows."""

    errors: Callable[[Array, Array], Array]  #: targets (N, k), u (N, n) -> (target - g(u)) / scale, (N, k)
    jacobians: Callable[[Array, Array], Array]  #: targets (N, k), u (N, n) -> d(g / scale)/du, (N, k, n)
    low: Array  #: lowest u, (n,)
    high: Array  #: highest u, (n,)


@dataclass(frozen=True, eq=False)
class BoxedPhi:
    """Task values and phi of points u = (q - centre) / half_width, and their errors.

    Values need not be finite: errors are infinite there, and derivatives 0 or NaN; those of equations are 0.
    """

    task: Task
    domain: Domain
    phi_map: PhiMap

    @property
    def m(self) -> int:
        """Number of task components."""
        return self.task.m

    @cached_property
    def low(self) -> Array:
        """Lowest u, (n,): -1, or -inf for joints without boundaries."""
        return (self.domain.bounds[0] - self.domain.centre) / self.domain.half_width

    @cached_property
    def high(self) -> Array:
        """Highest u, (n,)."""
        return (self.domain.bounds[1] - self.domain.centre) / self.domain.half_width

    def points(self, u: Array) -> Array:
        """q at u (N, n), within the boundaries, (N, n)."""
        domain = self.domain
        return np.clip(domain.centre + domain.half_width * u, *domain.bounds)

    def of_points(self, q: Array) -> Array:
        """u of the points of the box nearest to q (N, n), (N, n)."""
        u = (q - self.domain.centre) / self.domain.half_width
        return np.clip(u, self.low, self.high)

    @cached_property
    def task_equations(self) -> Equations:
        """h(q) = x, with task values x (N, m); scale as in `PhiMap`."""
        return Equations(self._task_errors, self._task_jacobians, self.low, self.high)

    @cached_property
    def phi_equations(self) -> Equations:
        """phi(q) = phi, with targets (N, n)."""
        return Equations(self._phi_errors, self._phi_jacobians, self.low, self.high)

    def xi_errors(self, targets: Array, u: Array) -> Array:
        """xi - xi(q), (N, r), for targets (N, n) of phi."""
        errors: Array = self.phi_map.difference(targets, self.phi_map.phi(self.points(u)))[:, self.m :]
        return errors

    def jacobians(self, targets: Array, u: Array) -> tuple[Array, Array]:
        """d(h / scale)/du (N, m, n) and dxi/du (N, r, n)."""
        J = self.phi_map.jacobian(self.points(u)) * self.domain.half_width
        return J[:, : self.m] / self._scale(targets[:, : self.m])[:, :, None], J[:, self.m :]

    def _task_errors(self, x: Array, u: Array) -> Array:
        errors = self._relative.difference(x, self.task.batched(self.points(u))[0]) / self._scale(x)
        return np.where(np.isfinite(errors), errors, np.inf)

    def _task_jacobians(self, x: Array, u: Array) -> Array:
        J = self._relative.batched_rates(self.points(u))[0].reshape(len(u), self.m, -1)
        J = J * self.domain.half_width / self._scale(x)[:, :, None]
        return np.where(np.isfinite(J), J, 0.0)

    def _phi_errors(self, targets: Array, u: Array) -> Array:
        errors = self.phi_map.residual(targets, self.points(u))
        return np.where(np.isfinite(errors), errors, np.inf)

    def _phi_jacobians(self, targets: Array, u: Array) -> Array:
        J = self.phi_map.jacobian(self.points(u)) * self.domain.half_width / self.phi_map.scale(targets)[:, :, None]
        return np.where(np.isfinite(J), J, 0.0)

    @cached_property
    def _relative(self) -> Relative:
        return Relative(self.task)

    def _scale(self, x: Array) -> Array:
        scale: Array = self.phi_map.sizes[: self.m] + ROUNDING * np.abs(x)
        return scale


class Places(NamedTuple):
    """What N targets would be in G cells."""

    overshoot: Array  #: how far y lies outside its range, relative to half of the range, (N, G)
    start: Array  #: where phi would be the target if it were linear in the cell, (N, G, n)


@dataclass(frozen=True)
class _Linear:
    """phi in each of G cells."""

    phi: Array  #: in the middle, (G, n)
    inverse: Array  #: J^-1 in the middle, (G, n, n); 0 where it is not finite
    y: Array  #: of samples of the cell, (G, samples, n)
    low: Array  #: least y of the cell, (G, n)
    high: Array  #: greatest y of the cell, (G, n)
    known: NDArray[np.bool_]  #: cells where all this is finite, (G,)


class Cells:
    """The cells of a domain, in half-widths from its centre. They are measured once for each chart, in 0.1 s."""

    def __init__(self, boxed: BoxedPhi) -> None:
        self._boxed = boxed

    def places(self, targets: Array) -> Places:
        """Where targets (N, n) of phi would be in each cell."""
        linear, middles = self._linear, self._middles
        y = np.einsum("gij,ngj->ngi", linear.inverse, self._difference(targets[:, None], linear.phi))
        half = (linear.high - linear.low) / 2
        outside = np.maximum(linear.low - y, y - linear.high) / np.where(half > 0, half, 1.0)
        overshoot = np.where(linear.known, outside.max(axis=2), 0.0)
        width = _NEAR * self._half_width
        return Places(overshoot, np.clip(middles + np.clip(y, -width, width), -1.0, 1.0))

    def samples(self, targets: Array, cells: Indices, count: int) -> Array:
        """The samples of given cells (N,) that are nearest to targets (N, n), (N, count, n)."""
        linear = self._linear
        y = np.einsum("kij,kj->ki", linear.inverse[cells], self._difference(targets, linear.phi[cells]))
        away = np.abs((linear.y[cells] - y[:, None]) / self._half_width).max(axis=2)
        nearest = self._unit[np.argsort(away, axis=1)[:, :count]]
        points: Array = self._middles[cells][:, None] + self._half_width * nearest
        return points

    def _difference(self, targets: Array, phi: Array) -> Array:
        difference: Array = self._boxed.phi_map.difference(targets, phi)
        return difference

    @cached_property
    def _halved(self) -> tuple[int, ...]:
        """How often each joint's range is halved, (n,): again and again where phi bends most."""
        n = len(self._boxed.low)
        halved = np.zeros(n, dtype=int)
        for _ in range(_HALVINGS):
            halved[int(np.argmax(self._bends(0.5**halved)))] += 1
        return tuple(int(times) for times in halved)

    def _bends(self, width: Array) -> Array:
        """Median |J^-1 (phi(u + t w e_j) - phi(u)) - t w e_j|, (n,), for cells with half-widths w, and random t, u."""
        boxed, n = self._boxed, len(width)
        rng, found = np.random.default_rng(_SEED), np.empty(n)
        for j in range(n):
            u, steps = rng.uniform(-1, 1, (_PROBES, n)), np.zeros((_PROBES, n))
            u[:, j] *= 1 - width[j]
            steps[:, j] = width[j] * rng.uniform(-1, 1, _PROBES)
            here, there = (boxed.phi_map.phi(boxed.points(at)) for at in (u, u + steps))
            inverse = _finite(inverses(self._jacobian(u))[0])
            y = np.einsum("kij,kj->ki", inverse, boxed.phi_map.difference(there, here))
            size = np.linalg.norm(y - steps, axis=1)
            found[j] = np.median(np.where(np.isfinite(size), size, 0.0))
        return found

    @cached_property
    def _middles(self) -> Array:
        """Middles of the cells, (G, n)."""
        along = [(2.0 * np.arange(2**times) + 1) / 2**times - 1 for times in self._halved]
        return np.asarray(np.stack(np.meshgrid(*along, indexing="ij"), axis=-1).reshape(-1, len(along)))

    @cached_property
    def _half_width(self) -> Array:
        """Of each cell, (n,)."""
        return np.asarray(0.5 ** np.array(self._halved))

    @cached_property
    def _unit(self) -> Array:
        """Points of [-1, 1]^n, uniform, near faces, and corners, (samples, n)."""
        rng = np.random.default_rng(_SEED)
        unit = rng.uniform(-1, 1, (_SAMPLES, len(self._half_width)))
        return np.asarray(np.sign(unit) * np.abs(unit) ** rng.choice([1.0, 0.25, 0.0], (_SAMPLES, 1)))

    @cached_property
    def _linear(self) -> _Linear:
        boxed, middles = self._boxed, self._middles
        phi = boxed.phi_map.phi(boxed.points(middles))
        inverse = inverses(self._jacobian(middles))[0]
        points = (middles[:, None] + self._half_width * self._unit).reshape(-1, middles.shape[1])
        values = boxed.phi_map.phi(boxed.points(points)).reshape(len(middles), -1, middles.shape[1])
        with np.errstate(invalid="ignore"):
            y = np.einsum("gij,gkj->gki", inverse, boxed.phi_map.difference(values, phi[:, None]))
        known = np.isfinite(y).all(axis=(1, 2))
        phi, inverse, y = _finite(phi), _finite(inverse), _finite(y)
        return _Linear(phi, inverse, y, y.min(axis=1), y.max(axis=1), known)

    def _jacobian(self, u: Array) -> Array:
        """dphi/du, (N, n, n)."""
        return self._boxed.phi_map.jacobian(self._boxed.points(u)) * self._boxed.domain.half_width


def _finite(values: Array) -> Array:
    return np.nan_to_num(values, nan=0.0, posinf=0.0, neginf=0.0)


def solve_in_box(
    equations: Equations,
    targets: Array,
    start: Array,
    held: NDArray[np.bool_] | None = None,
    most: int = _MOST,
    patience: int = _PATIENCE,
) -> tuple[Array, Array]:
    """Points u of the box that solve the equations, or where the search from start ends.

    Args:
        equations: k equations.
        targets: their right-hand sides, (N, k).
        start: points of the box, (N, n).
        held: joints that stay at their start, (N, n).
        most: iterations.
        patience: iterations within which the error must halve.

    Returns:
        u (N, n), and the largest errors (N,).
    """
    run = _Run(equations, targets, start, np.zeros(start.shape, dtype=bool) if held is None else held)
    rows, before = np.flatnonzero(np.isfinite(run.error)), run.error.copy()
    for k in range(1, most + 1):
        if k % patience == 0:
            rows = rows[run.error[rows] <= before[rows] / 2]
            before[rows] = run.error[rows]
        rows = rows[(run.error[rows] > _GOAL) & (run.damping[rows] < _MOST_DAMPING)]
        if not rows.size:
            break
        run.advance(rows)
    return run.u, run.error


class _Run:
    """The state of all rows."""

    def __init__(self, equations: Equations, targets: Array, start: Array, held: NDArray[np.bool_]) -> None:
        self._equations, self._targets, self._held = equations, targets, held
        self.u = start.copy()
        self._errors = equations.errors(targets, self.u)
        self.error = largest(self._errors)
        self.damping = np.full(len(targets), _DAMPING)
        self._J = np.zeros((*targets.shape, start.shape[1]))
        self._fresh = np.zeros(len(targets), dtype=bool)  # rows whose J belongs to u

    def advance(self, rows: Indices) -> None:
        """Try a step in some rows."""
        stale = rows[~self._fresh[rows]]
        if stale.size:
            self._J[stale], self._fresh[stale] = self._equations.jacobians(self._targets[stale], self.u[stale]), True
        u = np.clip(self.u[rows] + self._steps(rows), self._equations.low, self._equations.high)
        errors = self._equations.errors(self._targets[rows], u)
        better = (errors**2).sum(axis=1) < (1 - _DECREASE) * (self._errors[rows] ** 2).sum(axis=1)
        moved = rows[better]
        self.u[moved], self._errors[moved], self.error[moved] = u[better], errors[better], largest(errors[better])
        self._fresh[moved] = False
        self.damping[rows] *= np.where(better, 0.1, 10.0)
        np.maximum(self.damping, _LEAST_DAMPING, out=self.damping)

    def _steps(self, rows: Indices) -> Array:
        """Damped steps that stop at the boundary, (rows, n)."""
        J, errors = self._J[rows], self._errors[rows]
        low, high = self._equations.low - self.u[rows], self._equations.high - self.u[rows]
        wanted = np.einsum("nmi,nm->ni", J, errors)
        held = self._held[rows] | ((low >= 0) & (wanted < 0)) | ((high <= 0) & (wanted > 0))
        damping = self.damping[rows] * np.einsum("nmi,nmi->n", J, J) + np.finfo(float).tiny
        steps: Array = np.zeros_like(wanted)
        for _ in range(_ROUNDS):
            free = J * ~held[:, None, :]
            left = errors - np.einsum("nmi,ni->nm", J, np.where(held, steps, 0.0))
            gram = free @ free.transpose(0, 2, 1) + damping[:, None, None] * np.eye(errors.shape[1])
            solved = np.einsum("nmi,nm->ni", free, np.linalg.solve(gram, left[:, :, None])[:, :, 0])
            steps = np.where(held, steps, np.clip(solved, low, high))
            leaving = ~held & ((solved < low) | (solved > high))
            if not leaving.any():
                break
            held |= leaving
        return steps


@dataclass(frozen=True, eq=False)
class InDomain:
    """Searches all of the domain."""

    boxed: BoxedPhi
    cells: Cells

    def search(self, targets: Array, tolerance: float) -> tuple[Array, NDArray[np.bool_]]:
        """The points of the domain with the least error that are found for targets (N, n).

        Returns:
            q (N, n), and which of them are solutions, (N,).
        """
        u, error = np.zeros_like(targets), np.full(len(targets), np.inf)
        for first in range(0, len(targets), _AT_ONCE):
            rows = slice(first, first + _AT_ONCE)
            u[rows], error[rows] = self._searched(targets[rows], tolerance)
        return self.boxed.points(u), np.asarray(error <= tolerance)

    def all_solutions(self, target: Array, tolerance: float) -> Array:
        """Different solutions for a target (n,), that nearest to the centre first, (k, n)."""
        places = self.cells.places(target[None])
        likely = np.flatnonzero(places.overshoot[0] <= MARGIN)
        more = self.cells.samples(np.broadcast_to(target, (len(likely), len(target))), likely, _ALL)
        starts = np.vstack([places.start[0, likely], more.reshape(-1, len(target))])
        u, error = self._solved(np.broadcast_to(target, starts.shape), starts, tolerance)
        u = u[error <= tolerance]
        different: list[Array] = []
        for row in u[np.argsort(np.linalg.norm(u, axis=1))]:
            if all(np.abs(row - other).max() > _SAME for other in different):
                different.append(row)
        return self.boxed.points(np.array(different).reshape(-1, len(target)))

    def _searched(self, targets: Array, tolerance: float) -> tuple[Array, Array]:
        """The best points u (N, n), and their errors (N,)."""
        places, best = self.cells.places(targets), _Best(np.zeros_like(targets), np.full(len(targets), np.inf))
        order, done = np.argsort(places.overshoot, axis=1), 0
        likely = np.maximum((places.overshoot <= MARGIN).sum(axis=1), 1)  # cells to search, in this order
        for count in (*_CELLS_AT_ONCE, order.shape[1]):
            rows = np.flatnonzero((best.error > tolerance) & (likely > done))
            rank = np.arange(done, min(done + count, order.shape[1]))
            row, place = np.nonzero(rank < likely[rows, None])
            row, cell = rows[row], order[rows[row], rank[place]]
            best.take(row, *self._solved(targets[row], places.start[row, cell], tolerance))
            done += count
        self._search_again(targets, places, best, tolerance)
        return best.u, best.error

    def _search_again(self, targets: Array, places: Places, best: "_Best", tolerance: float) -> None:
        """Search from other starts in the likeliest cells."""
        row, cell = np.nonzero((places.overshoot <= CORE) & (best.error > tolerance)[:, None])
        starts = self.cells.samples(targets[row], cell, _AGAIN).reshape(-1, targets.shape[1])
        row = np.repeat(row, _AGAIN)
        best.take(row, *self._solved(targets[row], starts, tolerance))

    def _solved(self, targets: Array, starts: Array, tolerance: float) -> tuple[Array, Array]:
        """Where searches end, (N, n), and the errors (N,): infinite for solutions that a condition forbids."""
        with np.errstate(all="ignore"):
            u, error = solve_in_box(
                self.boxed.phi_equations, targets, starts, most=_MOST_FROM_CELLS, patience=_PATIENCE_FROM_CELLS
            )
        solved = np.flatnonzero(error <= tolerance)
        error[solved[~self.boxed.domain.contains(self.boxed.points(u[solved]))]] = np.inf
        return u, error


@dataclass(frozen=True, eq=False)
class _Best:
    """The best points so far."""

    u: Array  #: (N, n)
    error: Array  #: (N,)

    def take(self, rows: Indices, u: Array, error: Array) -> None:
        """Take over what searches (M,) found for some rows (M,), which may occur several times."""
        worst_first = np.argsort(-error, kind="stable")  # what is written last stays
        better = worst_first[error[worst_first] < self.error[rows[worst_first]]]
        self.u[rows[better]], self.error[rows[better]] = u[better], error[better]
