"""Newton's method for phi(q) = phi: many rows at once, few rows one by one, its starts, and its derivatives."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from math import comb
from typing import Any, Protocol

import casadi as ca
import numpy as np
import scipy
from numpy.typing import NDArray

from orthocas.charts.coordinates import InvertibleMap
from orthocas.charts.phi import ROUNDING, Differences, PhiMap, largest
from orthocas.errors import SingularTaskError
from orthocas.tasks.domains import Domain
from orthocas.tasks.samples import sample_boundary_weighted
from orthocas.tools.batch import dense_function, run_in_threads
from orthocas.tools.cached import BuiltOnUse, cached_property
from orthocas.tools.checks import Array, Indices
from orthocas.tools.interrupts import deferred

MAX_ITERATIONS = 50
_PATIENCE = 8  # iterations after which the error must have halved
GOAL = 1e-12  #: error at which the iteration stops
_KEEP = 0.1  # J is evaluated again if a step leaves more of the error
_DECREASE = 1e-4  # of the error, relative to the part of the step taken
HALVINGS, BRIEF = 10, 3  #: of a step, and where another search follows
_SOLVED = 1e-10  # below this error only rounding stops the decrease
_PIECE = 2048  # matrices that a thread inverts at once
SUSPICIOUS = 1e6  #: |J| |J^-1| above which singular values are computed
_FEW = 4  # rows that are solved one by one
STEPS = 3  #: with the same Jacobian
REFRESHES = 4
_TOLERANCE = 1e-9  # the largest relative error of a solution
_OPTIONS: dict[str, Any] = {
    "error_on_fail": False,  # an exception would end an optimisation
    "abstol": 1e-12,
    "max_iter": 50,
    "line_search": True,
    "linear_solver": "symbolicqr",
}
_POINTS, _SEED = 4096, 0  # of the table
_DEGREES, _MOST_TERMS = (3, 2, 1), 500  # of the rough inverse: the first degree with so few terms
_OVERSHOOT = 1.2  # beyond the values of the table, polynomials are not trusted


@dataclass(frozen=True)
class Attempt:
    """Where a search from given starts ended."""

    q: Array  #: (N, n), finite
    residual: Array  #: (phi - phi(q)) / scale, (N, n)
    iterations: Indices  #: (N,)
    suspicious: NDArray[np.bool_]  #: whether J may be singular there, (N,)

    @classmethod
    def empty(cls, N: int, n: int) -> "Attempt":
        """Room for N rows."""
        return cls(np.empty((N, n)), np.empty((N, n)), np.zeros(N, dtype=np.int64), np.zeros(N, dtype=bool))

    def replace(self, rows: Indices, other: "Attempt") -> None:
        """Put the results of another search in some rows."""
        self.q[rows], self.residual[rows] = other.q, other.residual
        self.iterations[rows], self.suspicious[rows] = other.iterations, other.suspicious


class LocalSolver(Protocol):
    """Solves phi(q) = phi near given starts."""

    def __call__(self, targets: Array, starts: Array) -> Attempt:
        """Search from starts (N, n)."""
        ...


class Newton:
    """Newton's method with line search, which starts at finite points.

    Args:
        phi_map: phi and J.
        halvings: of a step whose error does not decrease, before a row is given up.
    """

    def __init__(self, phi_map: PhiMap, halvings: int = HALVINGS) -> None:
        self._map, self._halvings = phi_map, halvings

    def __call__(self, targets: Array, starts: Array) -> Attempt:
        """Search from starts (N, n)."""
        with np.errstate(all="ignore"):  # steps of nearly singular J may overflow
            run = _Run(self._map, targets, starts)
            rows = np.flatnonzero(np.isfinite(run.error))
            run.refresh(rows)
            before = run.error.copy()
            for k in range(1, MAX_ITERATIONS + 1):
                if k % _PATIENCE == 0:
                    rows = rows[run.error[rows] < before[rows] / 2]
                    before[rows] = run.error[rows]
                rows = rows[run.error[rows] > GOAL]
                if not rows.size:
                    break
                run.refresh(rows[run.stale[rows]])
                rows = rows[run.advance(rows, self._halvings)]
            return Attempt(run.q, run.residual, run.iterations, run.suspicious)


class _Run:
    """The state of all rows."""

    def __init__(self, phi_map: PhiMap, targets: Array, starts: Array) -> None:
        N, n = targets.shape
        self._map, self._targets = phi_map, targets
        self.q = starts.copy()
        self.residual = phi_map.residual(targets, self.q)
        self.error = largest(self.residual)
        self.iterations = np.zeros(N, dtype=np.int64)
        self.stale = np.zeros(N, dtype=bool)  #: rows that need J anew
        self._fresh = np.zeros(N, dtype=bool)  # rows whose J belongs to q
        self._inverse = np.full((N, n, n), np.nan)  # of J / scale
        self._condition = np.full(N, np.inf)

    def refresh(self, rows: Indices) -> None:
        """Evaluate J at the points of some rows."""
        if rows.size:
            J = self._map.jacobian(self.q[rows]) / self._map.scale(self._targets[rows])[:, :, None]
            inverse, singular = inverses(J)
            self._inverse[rows] = inverse
            self._condition[rows] = np.where(singular, np.inf, _norm(J) * _norm(inverse))
            self.stale[rows], self._fresh[rows] = False, True

    def advance(self, rows: Indices, most: int) -> NDArray[np.bool_]:
        """Take a step in some rows, halved up to so many times until the error decreases. Returns which can go on.

        A row whose J is from an earlier point waits for a new one instead.
        """
        inverse = self._inverse if len(rows) == len(self._inverse) else self._inverse[rows]  # copies take time
        steps = np.matmul(inverse, self.residual[rows, :, None])[:, :, 0]
        goes_on = np.zeros(len(rows), dtype=bool)
        left = np.flatnonzero(np.isfinite(steps).all(axis=1))
        for halvings in range(most + 1):
            moved = self._try(rows[left], steps[left], 0.5**halvings)
            goes_on[left[moved]] = True
            left = left[~moved]
            if halvings == 0:
                waiting = ~self._fresh[rows[left]]
                self.stale[rows[left[waiting]]] = goes_on[left[waiting]] = True
                left = left[~waiting & (self.error[rows[left]] > _SOLVED)]
            if not left.size:
                break
        self._fresh[rows] = False
        return goes_on

    def _try(self, rows: Indices, steps: Array, share: float) -> NDArray[np.bool_]:
        """Take parts of steps where they reduce the error; returns where."""
        q = self.q[rows] + share * steps
        residual = self._map.residual(self._targets[rows], q)
        before, error = self.error[rows], largest(residual)
        better = error < (1 - _DECREASE * share) * before
        moved = rows[better]
        self.q[moved], self.residual[moved], self.error[moved] = q[better], residual[better], error[better]
        self.iterations[moved] += 1
        self.stale[moved] = error[better] > _KEEP * before[better]
        return better

    @property
    def suspicious(self) -> NDArray[np.bool_]:
        """Rows whose last J may be singular: |J| |J^-1| is not less than its condition number."""
        return np.asarray(~(self._condition < SUSPICIOUS))


def inverses(matrices: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Inverses (N, n, n), and which matrices are singular, (N,): those get their pseudo-inverses.

    The inverse of a matrix that is not finite is not finite either.
    """
    singular: NDArray[np.bool_] = np.zeros(len(matrices), dtype=bool)
    try:
        found = np.empty_like(matrices)
        pieces = [slice(first, first + _PIECE) for first in range(0, len(matrices), _PIECE)]
        for piece, inverse in zip(
            pieces, run_in_threads(lambda piece: np.linalg.inv(matrices[piece]), pieces), strict=True
        ):
            found[piece] = inverse
    except np.linalg.LinAlgError:  # it does not say which
        with np.errstate(invalid="ignore"):
            singular = np.asarray(np.linalg.slogdet(matrices)[0] == 0)
        found = np.empty_like(matrices)
        found[~singular] = np.linalg.inv(matrices[~singular])
        found[singular] = np.linalg.pinv(matrices[singular])
    return found, singular


def _norm(matrices: Array) -> Array:
    """Frobenius norms, (N,)."""
    norms: Array = np.sqrt(np.einsum("nij,nij->n", matrices, matrices))
    return norms


@dataclass(frozen=True)
class OwnInverse:
    """The inverse map that belongs to the coordinates; the start selects turns and sheets."""

    coordinates: InvertibleMap
    phi_map: PhiMap

    def __call__(self, targets: Array, starts: Array) -> Attempt:
        """Search from starts (N, n)."""
        q = self.coordinates.inverse(targets, starts).reshape(targets.shape)
        known = np.asarray(np.isfinite(q).all(axis=1))
        q = np.where(known[:, None], q, starts)
        residual = self.phi_map.residual(targets, q)
        residual[~known] = np.inf
        return Attempt(q, residual, np.zeros(len(q), dtype=np.int64), known)


@dataclass(frozen=True)
class PointFunctions:
    """The two functions of a chart that `PointSolver` calls."""

    inverted: ca.Function  #: q -> phi, H = J^-1, and |D^-1 J| |H D| with the sizes D of the components
    chord: ca.Function  #: q, phi, H, target -> q and phi after 3 steps, and |residual| at each of the 4 points
    turning: tuple[int, ...] = ()  #: joints that turn without end, as in `Problem.turning`

    @classmethod
    def of(
        cls, phi: ca.Function, jacobian: ca.Function, sizes: Array, difference: Differences, turning: tuple[int, ...]
    ) -> "PointFunctions":
        """For phi and J of a column q (n, 1), and the sizes and differences of phi, as in `PhiMap`."""
        n = len(sizes)
        q, known, target = (ca.MX.sym(name, n) for name in ("q", "phi", "target"))
        H = ca.MX.sym("H", n, n)
        inverted = dense_function("inverted", [q], [phi(q), *_inversion(sizes).call([jacobian(q)])])
        scale = ca.DM(sizes) + ROUNDING * ca.fabs(target)
        now, value, left = q, known, difference(target, known)
        errors = [ca.norm_2(left / scale)]  # norm_inf drops NaN
        for _ in range(STEPS):
            now = now + H @ left
            value = phi(now)
            left = difference(target, value)
            errors.append(ca.norm_2(left / scale))
        chord = dense_function("chord", [q, known, H, target], [now, value, ca.vertcat(*errors)])
        return cls(inverted, chord, turning)

    def distance(self, phi: Array, target: Array) -> float:
        """|target - phi| relative to the sizes of the components, by the shorter way around."""
        n = len(phi)
        return float(self.chord(np.zeros(n), phi, np.zeros((n, n)), target)[2][0])


class PointSolver:
    """Solves phi(q) = target near a start; each solver has its own scratch memory, and belongs to one thread.

    `q` and `target` are its inputs, (n,), and `phi` is that of q. After steps, `reached` and `errors` tell where they
    ended.
    """

    def __init__(self, functions: PointFunctions) -> None:
        n = functions.chord.numel_out(0)
        self.q, self.phi, self.target, self.reached, self._phi_reached = np.empty((5, n))
        self.errors, self.condition = np.empty(STEPS + 1), np.empty(1)
        self.iterations = 0  #: of the last solution
        H = np.empty(n * n)
        self._refresh = Bound(functions.inverted, [self.q], [self.phi, H, self.condition])
        results = [self.reached, self._phi_reached, self.errors]
        self._step = Bound(functions.chord, [self.q, self.phi, H, self.target], results)

    def refresh(self) -> bool:
        """Evaluate phi and J at q. Returns whether J is regular."""
        self._refresh.run()
        return bool(self.condition[0] < SUSPICIOUS)

    def step(self) -> bool:
        """Take steps from q with the last J. Returns whether all of them reduced the error; q stays."""
        self._step.run()
        return decreasing(self.errors.tolist())

    def accept(self) -> None:
        """Move q to where the last steps ended."""
        self.q[:], self.phi[:] = self.reached, self._phi_reached

    def solve(self) -> bool:
        """Solve for the target from q. Returns whether the error fell to rounding; then q is the solution."""
        self.iterations = 0
        for _ in range(REFRESHES):
            if not self.refresh() or not self.step():
                return False
            self.accept()
            self.iterations += STEPS
            if self.errors[-1] <= GOAL:
                return True
        return False


class FewRows:
    """A local solver that takes few rows one by one, and the others, or those that fail, to another solver."""

    def __init__(self, phi_map: PhiMap, functions: PointFunctions, other: LocalSolver) -> None:
        self._map, self._functions, self._other = phi_map, functions, other

    def __call__(self, targets: Array, starts: Array) -> Attempt:
        """Search from starts (N, n)."""
        if len(targets) > _FEW:
            return self._other(targets, starts)
        attempt = Attempt.empty(*targets.shape)
        with deferred():  # otherwise CasADi turns Ctrl-C into a RuntimeError, or swallows it
            solver = PointSolver(self._functions)
            done = [_solved(solver, attempt, k, targets[k], starts[k]) for k in range(len(targets))]
        attempt.residual[:] = self._map.difference(targets, attempt.residual) / self._map.scale(targets)
        failed = np.flatnonzero(~np.array(done, dtype=bool))
        if failed.size:
            attempt.replace(failed, self._other(targets[failed], starts[failed]))
        return attempt


def decreasing(errors: list[float]) -> bool:
    """Whether errors fall until they are rounding."""
    return all(after < before or after <= GOAL for before, after in pairwise(errors))


class Bound:
    """A function on arrays that stay in place: `run()` evaluates it."""

    def __init__(self, function: ca.Function, inputs: list[Array], outputs: list[Array]) -> None:
        buffer: Any  # the stubs of set_arg and set_res ask for a size, the methods take none
        buffer, run = function.buffer()
        for i, array in enumerate(inputs):
            buffer.set_arg(i, array.data)
        for i, array in enumerate(outputs):
            buffer.set_res(i, array.data)
        self.run: Callable[[], Any] = run
        self._alive = buffer, inputs, outputs


def _solved(solver: PointSolver, attempt: Attempt, k: int, target: Array, start: Array) -> bool:
    """Put q and phi for row k into `attempt`. Returns whether that succeeded, which it does not near singular J."""
    solver.q[:], solver.target[:] = start, target
    done = solver.solve()
    attempt.q[k], attempt.residual[k], attempt.iterations[k] = solver.q, solver.phi, solver.iterations
    return done


def _inversion(sizes: Array) -> ca.Function:
    """J -> J^-1, and the product of the norms of D^-1 J and its inverse; by QR, so NaN for singular J."""
    n = len(sizes)
    J, D = ca.SX.sym("J", n, n), ca.repmat(ca.DM(sizes), 1, n)
    inverse = ca.solve(J, ca.SX.eye(n))
    return ca.Function("inversion", [J], [inverse, ca.norm_fro(J / D) * ca.norm_fro(inverse * D.T)])


def inverse_function(phi: ca.Function, sizes: Array, difference: Differences) -> ca.Function:
    """phi (n, 1), q_start (n, 1) -> q (n, 1) with phi(q) = phi, NaN where Newton's method finds none from q_start."""
    n = len(sizes)
    q, target, start = (ca.MX.sym(name, n) for name in ("q", "phi", "q_start"))

    def residual(at: ca.MX) -> Any:
        return -difference(target, phi(at)) / (ca.DM(sizes) + ROUNDING * ca.fabs(target))

    solve = ca.rootfinder("solve", "newton", {"x": q, "p": target, "g": residual(q)}, _OPTIONS)
    found = solve(start, target)
    failed = ca.if_else(ca.norm_2(residual(found)) <= _TOLERANCE, 0.0, np.nan)  # a constant, so without derivatives
    return ca.Function("inverse", [target, start], [found + failed], ["phi", "q_start"], ["q"])


class Starts:
    """Joint positions from which Newton's method may reach phi(q) = phi.

    The rough inverse is a polynomial q(phi), fitted to 4,096 points of the domain by least squares. Both coordinates
    and task are smooth, so it is much closer than the centre of the domain. It takes 0.1 s once for each chart.
    """

    def __init__(self, phi_map: PhiMap, domain: Domain) -> None:
        self._map, self._domain = phi_map, domain

    def guess(self, targets: Array) -> Array:
        """The rough inverse at targets (N, n), moved into the box of the domain, (N, n)."""
        centre, half_width = self._domain.centre, self._domain.half_width
        q = _terms(self._normalised(targets), self._degree) @ self._coefficients
        guess: Array = np.clip(q, centre - half_width, centre + half_width)
        return guess

    def nearest(self, targets: Array, count: int, components: int) -> Array:
        """The points of the table whose phi is nearest to targets (N, n), nearest first, (count or fewer, N, n).

        Args:
            targets: values of phi.
            count: points for each target.
            components: how many components of phi count, the first ones.
        """
        points = self._table[0]
        order = self._trees[components].query(self._places(targets, components), range(1, min(count, len(points)) + 1))[
            1
        ]
        nearest: Array = points[order.T]
        return nearest

    @cached_property
    def _trees(self) -> BuiltOnUse[int, Any]:
        """Search trees of places of the table, by the number of components that count."""
        return BuiltOnUse(lambda components: scipy.spatial.cKDTree(self._places(self._table[1], components)))

    def _places(self, phi: Array, components: int) -> Array:
        """Numbers (N, k) that are near one another where the first components of phi (N, n) are."""
        normalised, relative = self._normalised(phi)[:, :components], self._map.difference.task
        if relative is None or not relative.turned:
            return normalised
        first, last = relative.first, relative.task.m
        orientations = relative.embed(phi[:, :last]) / self._range[1][first:last].mean()
        return np.concatenate([normalised[:, :first], orientations, normalised[:, last:]], axis=1)

    @cached_property
    def _table(self) -> tuple[Array, Array]:
        """Points of the domain where phi is defined, and phi, (K, n) each."""
        return where_known(self._map, sample_boundary_weighted(self._domain, _POINTS, _SEED))

    @cached_property
    def _range(self) -> tuple[Array, Array]:
        """Middle and half of the range of phi over the domain, (n,) each."""
        low, high = self._table[1].min(axis=0), self._table[1].max(axis=0)
        return (low + high) / 2, np.where(high > low, (high - low) / 2, 1.0)

    @cached_property
    def _coefficients(self) -> Array:
        """Of the rough inverse, (terms, n)."""
        points, phi = self._table
        found = np.linalg.lstsq(_terms(self._normalised(phi), self._degree), points, rcond=None)[0]
        return np.asarray(found, dtype=float)

    @property
    def _degree(self) -> int:
        n = len(self._domain.centre)
        return next((degree for degree in _DEGREES if comb(n + degree, degree) <= _MOST_TERMS), 1)

    def _normalised(self, phi: Array) -> Array:
        """Values of phi (N, n) in the range [-1, 1], or a little beyond."""
        middle, half = self._range
        return np.clip((phi - middle) / half, -_OVERSHOOT, _OVERSHOOT)


def where_known(phi_map: PhiMap, points: Array) -> tuple[Array, Array]:
    """The points (N, n) at which phi is finite, and phi there, (K, n) each.

    Raises:
        SingularTaskError: if there are none.
    """
    phi = phi_map.phi(points)
    known = np.isfinite(phi).all(axis=1)
    if not known.any():
        raise SingularTaskError(f"phi is not finite at any of {len(points)} samples of the domain")
    return points[known], phi[known]


def _terms(u: Array, degree: int) -> Array:
    """All monomials of the columns of u (N, n) up to a degree, (N, terms)."""
    columns = np.ascontiguousarray(u.T)
    level = [(0, np.ones(len(u)))]  # index of the last factor, product
    terms = [level[0][1]]
    for _ in range(degree):
        level = [(j, product * columns[j]) for i, product in level for j in range(i, len(columns))]
        terms += [product for _, product in level]
    return np.array(terms).T
