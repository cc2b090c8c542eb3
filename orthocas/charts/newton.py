"""Solvers of phi(q) = phi from a start: Newton's method for many rows, for few rows and in CasADi, and continuation."""

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
from orthocas.errors import SingularTaskError
from orthocas.tasks.domains import Domain
from orthocas.tasks.relative import Relative
from orthocas.tasks.samples import sample_boundary_weighted
from orthocas.tools.batch import dense_function, run_in_threads
from orthocas.tools.cached import BuiltOnUse, cached_property
from orthocas.tools.checks import Array, Indices
from orthocas.tools.expressions import wrap_shortest
from orthocas.tools.interrupts import deferred

ROUNDING = 1e-5  #: share of |phi| in the scale of errors; an error of 1e-9 in that scale is 45 units in the last place
_SINGULAR = 1e-8  # ratio of least to largest singular value up to which J counts as singular


@dataclass(frozen=True)
class Differences:
    """Differences of two values of phi, by the shorter way around for periodic components and orientations."""

    turns: Array  #: periods of the components, (n,); 0 for components without a period
    task: Relative | None = None  #: differences of task values, in the first m components; None: plain differences

    def __call__(self, targets: Any, values: Any) -> Any:
        """Targets - values, as NumPy rows (..., n) or CasADi columns (n, 1)."""
        if self.task is None or not self.task.turned:
            return wrap_shortest(targets - values, self.turns)
        # task values with an orientation by `Relative`, coordinates by wrapped differences
        m, symbolic = self.task.task.m, isinstance(values, ca.SX | ca.MX)
        pair = (targets[:m], values[:m]) if symbolic else (targets[..., :m], values[..., :m])
        first = self.task.difference(*pair)
        if symbolic:
            return ca.vertcat(first, wrap_shortest(targets[m:] - values[m:], self.turns[m:]))
        rest = wrap_shortest(targets[..., m:] - values[..., m:], self.turns[m:])
        return np.concatenate([first, rest], axis=-1)


@dataclass(frozen=True)
class PhiMap:
    """phi and J at many points, with scaled errors. Points must be finite; values may be NaN."""

    phi: Callable[[Array], Array]  #: (N, n) -> (N, n)
    jacobian: Callable[[Array], Array]  #: (N, n) -> (N, n, n), with d(difference) = -J dq at difference 0
    sizes: Array  #: component sizes, (n,), see `ChartParts.phi_sizes`
    difference: Differences  #: targets (..., n) - values (..., n)

    def scale(self, targets: Array) -> Array:
        """Scale of errors (N, n): the component sizes, plus a share of |target| so that rounding of large phi fits."""
        scale: Array = self.sizes + ROUNDING * np.abs(targets)
        return scale

    def residual(self, targets: Array, q: Array) -> Array:
        """Scaled errors (phi - phi(q)) / scale, (N, n), by the shorter way around."""
        residual: Array = self.difference(targets, self.phi(q)) / self.scale(targets)
        return residual

    def is_singular(self, q: Array) -> NDArray[np.bool_]:
        """Whether J is singular or undefined at points (N, n), (N,)."""
        J = self.jacobian(q) / self.sizes[:, None]
        known = np.asarray(np.isfinite(J).all(axis=(1, 2)))
        J[~known] = 0.0
        values = np.linalg.svd(J, compute_uv=False)
        return np.asarray(~known | (values[:, -1] <= _SINGULAR * values[:, 0]))


def largest(residual: Array) -> Array:
    """The largest absolute entry of each residual (N, n), (N,); infinite where phi is undefined."""
    error = np.abs(residual).max(axis=1)
    return np.where(np.isfinite(error), error, np.inf)


@dataclass(frozen=True, slots=True)
class NewtonRules:
    """Numbers of Newton's method. Errors are relative to the component sizes."""

    iterations: int = 50  #: largest number of iterations
    patience: int = 8  #: iterations within which the error must halve
    goal: float = 1e-12  #: error at which the iteration stops
    keep: float = 0.1  #: J is evaluated again after a step that leaves more than this part of the error
    decrease: float = 1e-4  #: least relative decrease of the error for a full step; in proportion for shorter steps
    halvings: int = 10  #: largest number of halvings of a step
    brief: int = 3  #: the same if another search follows
    solved: float = 1e-10  #: error below which a failed step means rounding, not divergence
    piece: int = 2048  #: matrices that a thread inverts at once
    suspicious: float = 1e6  #: |J| |J^-1| above which singular values are computed
    few: int = 4  #: number of rows up to which they are solved one by one
    steps: int = 3  #: steps with the same Jacobian, for one row
    refreshes: int = 4  #: largest number of Jacobians, for one row
    tolerance: float = 1e-9  #: largest error of a solution in CasADi


NEWTON = NewtonRules()
_OPTIONS: dict[str, Any] = {
    "error_on_fail": False,  # an exception would end an optimisation
    "abstol": 1e-12,
    "max_iter": 50,
    "line_search": True,
    "linear_solver": "symbolicqr",
}


@dataclass(frozen=True)
class Attempt:
    """The points at which a search from N starts ended."""

    q: Array  #: (N, n), finite
    residual: Array  #: (phi - phi(q)) / scale, (N, n)
    iterations: Indices  #: (N,)
    suspicious: NDArray[np.bool_]  #: whether J may be singular at q, (N,)
    inside: NDArray[np.bool_] | None = None  #: rows known to lie inside the domain, (N,); None: not checked

    def replace(self, rows: Indices, other: "Attempt") -> None:
        """Replace the given rows by the results of another search."""
        self.q[rows], self.residual[rows] = other.q, other.residual
        self.iterations[rows], self.suspicious[rows] = other.iterations, other.suspicious


class LocalSolver(Protocol):
    """Solves phi(q) = phi near given starts."""

    def __call__(self, targets: Array, starts: Array) -> Attempt:
        """Search from starts (N, n)."""
        ...


class Newton:
    """Newton's method with line search, for many rows at once.

    A row keeps its J^-1 while steps with it reduce the error tenfold, because J costs more than phi.

    Args:
        phi_map: phi and J.
        halvings: largest number of halvings of a step whose error does not decrease; then the row is given up.
    """

    def __init__(self, phi_map: PhiMap, halvings: int = NEWTON.halvings) -> None:
        self._map, self._halvings = phi_map, halvings

    def __call__(self, targets: Array, starts: Array) -> Attempt:
        """Search from starts (N, n)."""
        # steps with a nearly singular J may overflow
        with np.errstate(all="ignore"):
            run = _Run(self._map, targets, starts)
            rows = np.flatnonzero(np.isfinite(run.error))
            run.refresh(rows)
            before = run.error.copy()
            for k in range(1, NEWTON.iterations + 1):
                if k % NEWTON.patience == 0:
                    rows = rows[run.error[rows] < before[rows] / 2]
                    before[rows] = run.error[rows]
                rows = rows[run.error[rows] > NEWTON.goal]
                if not rows.size:
                    break
                run.refresh(rows[run.stale[rows]])
                rows = rows[run.advance(rows, self._halvings)]
            return Attempt(run.q, run.residual, run.iterations, run.suspicious)


class _Run:
    """The state of `Newton` for all rows."""

    def __init__(self, phi_map: PhiMap, targets: Array, starts: Array) -> None:
        N, n = targets.shape
        self._map, self._targets = phi_map, targets
        self.q = starts.copy()
        self.residual = phi_map.residual(targets, self.q)
        self.error = largest(self.residual)
        self.iterations = np.zeros(N, dtype=np.int64)
        self.stale = np.zeros(N, dtype=bool)  #: rows that need a new J
        # rows whose J was evaluated at the present q
        self._fresh = np.zeros(N, dtype=bool)
        self._inverse = np.full((N, n, n), np.nan)  # inverses of J / scale
        self._condition = np.full(N, np.inf)

    def refresh(self, rows: Indices) -> None:
        """Evaluate J at the points of the given rows."""
        if rows.size:
            J = self._map.jacobian(self.q[rows]) / self._map.scale(self._targets[rows])[:, :, None]
            inverse, singular = inverses(J)
            self._inverse[rows] = inverse
            self._condition[rows] = np.where(singular, np.inf, _norm(J) * _norm(inverse))
            self.stale[rows], self._fresh[rows] = False, True

    def advance(self, rows: Indices, most: int) -> NDArray[np.bool_]:
        """Take a step in the given rows, with up to `most` halvings until the error decreases.

        If the full step fails with a J from an earlier point, the row is not halved, but waits for a new J.

        Returns:
            Whether each row can go on, (rows,).
        """
        inverse = self._inverse if len(rows) == len(self._inverse) else self._inverse[rows]  # copies take time
        steps = np.matmul(inverse, self.residual[rows, :, None])[:, :, 0]
        goes_on = np.zeros(len(rows), dtype=bool)
        # halve the steps of rows whose error does not decrease
        left = np.flatnonzero(np.isfinite(steps).all(axis=1))
        for halvings in range(most + 1):
            tried, share = rows[left], 0.5**halvings
            q = self.q[tried] + share * steps[left]
            residual = self._map.residual(self._targets[tried], q)
            before, error = self.error[tried], largest(residual)
            # accept a sufficient decrease (Armijo); rows that converge slowly get a new J
            better = error < (1 - NEWTON.decrease * share) * before
            moved = tried[better]
            self.q[moved], self.residual[moved], self.error[moved] = q[better], residual[better], error[better]
            self.iterations[moved] += 1
            self.stale[moved] = error[better] > NEWTON.keep * before[better]
            goes_on[left[better]] = True
            left = left[~better]
            # before the first halving: rows with an old J request a new one, and rows at rounding level end
            if halvings == 0:
                waiting = ~self._fresh[rows[left]]
                self.stale[rows[left[waiting]]] = goes_on[left[waiting]] = True
                left = left[~waiting & (self.error[rows[left]] > NEWTON.solved)]
            if not left.size:
                break
        self._fresh[rows] = False
        return goes_on

    @property
    def suspicious(self) -> NDArray[np.bool_]:
        """Whether the last J of each row may be singular, (N,): |J| |J^-1| >= its condition number is large."""
        return np.asarray(~(self._condition < NEWTON.suspicious))


def inverses(matrices: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Inverses of matrices (N, n, n), and whether each matrix is singular, (N,).

    Singular matrices get their pseudo-inverses. The inverse of a matrix with NaN is NaN.
    """
    singular: NDArray[np.bool_] = np.zeros(len(matrices), dtype=bool)
    try:
        found = np.empty_like(matrices)
        pieces = [slice(first, first + NEWTON.piece) for first in range(0, len(matrices), NEWTON.piece)]
        for piece, inverse in zip(
            pieces, run_in_threads(lambda piece: np.linalg.inv(matrices[piece]), pieces), strict=True
        ):
            found[piece] = inverse
    except np.linalg.LinAlgError:
        # LAPACK does not say which matrix is singular: find them by their determinants
        with np.errstate(invalid="ignore"):
            singular = np.asarray(np.linalg.slogdet(matrices)[0] == 0)
        found = np.empty_like(matrices)
        found[~singular] = np.linalg.inv(matrices[~singular])
        found[singular] = np.linalg.pinv(matrices[singular])
    return found, singular


def _norm(matrices: Array) -> Array:
    """Frobenius norms of matrices (N, n, n), (N,)."""
    norms: Array = np.sqrt(np.einsum("nij,nij->n", matrices, matrices))
    return norms


@dataclass(frozen=True, slots=True)
class ContinuationRules:
    """Numbers of the continuation. Chosen on panda-wide, held on five arms (tests/charts/test_continuation.py)."""

    first: float = 0.1  #: [rad] or [m] largest change of a joint in the first step
    longest: float = 0.3  #: [rad] or [m] largest change of a joint in any step
    shortest: float = 1e-5  #: [rad] or [m] a row that needs shorter steps ends, at a fold
    bent: float = 0.3  #: largest error of the linear prediction, relative to the predicted change
    straight: float = 0.1  #: relative error of the prediction up to which the next step may be longer
    rounding: float = 1e-9  #: error of phi below which a failed step means rounding
    most: int = 400  #: largest number of steps


CONTINUATION = ContinuationRules()


class Continuation:
    """Follows the straight line phi(q(s)) = phi - (1 - s) e from a start at s = 0, with e = phi - phi(start), to s = 1.

    Errors of orientations and of periodic coordinates go the shorter way around. Each step goes along J^-1 e. It is
    halved until phi follows the line and det J keeps its sign, so q does not cross a fold. No solution is found if the
    line meets a fold before s = 1, or if the arm can only go the longer way around.
    """

    def __init__(self, phi_map: PhiMap) -> None:
        self._map = phi_map

    def __call__(self, targets: Array, starts: Array) -> Attempt:
        """Follow the lines to targets (N, n) from starts (N, n)."""
        with np.errstate(all="ignore"):
            q, residual = starts.copy(), self._map.residual(targets, starts)
            error = largest(residual)
            step, sign = self._steps(targets, q, residual)
            h, iterations = np.full(len(q), CONTINUATION.first), np.zeros(len(q), dtype=np.int64)
            left = np.flatnonzero(np.isfinite(error) & np.isfinite(step).all(axis=1))
            for _ in range(CONTINUATION.most):
                # rows end at the target, or when steps get too short
                left = left[(error[left] > NEWTON.goal) & (h[left] > CONTINUATION.shortest)]
                if not left.size:
                    break
                # a step towards the target, as long as the trust region allows
                share = np.minimum(1.0, h[left] / np.abs(step[left]).max(axis=1))
                new = q[left] + share[:, None] * step[left]
                after = self._map.residual(targets[left], new)
                # accept it if phi moved along the line and det J kept its sign
                miss = largest(after - (1 - share[:, None]) * residual[left]) / (share * error[left])
                onward, side = self._steps(targets[left], new, after)
                rounded = (share == 1) & (error[left] < CONTINUATION.rounding)
                good = (miss <= CONTINUATION.bent) & (side == sign[left]) & np.isfinite(onward).all(axis=1)
                good &= ~rounded | (largest(after) < error[left])
                moved = left[good]
                q[moved], residual[moved], step[moved] = new[good], after[good], onward[good]
                error[moved] = largest(after[good])
                iterations[moved] += 1
                # longer steps if the prediction was good, half the step if it failed
                longer = miss[good] <= CONTINUATION.straight
                h[moved] = np.where(longer, np.minimum(1.5 * h[moved], CONTINUATION.longest), h[moved])
                h[left[~good]] /= 2
                left = left[good | ~rounded]
            return Attempt(q, residual, iterations, np.ones(len(q), dtype=bool))

    def _steps(self, targets: Array, q: Array, residual: Array) -> tuple[Array, Indices]:
        """Steps J^-1 e at points q (N, n) with scaled errors `residual`, (N, n), and the signs of det J, (N,)."""
        J = self._map.jacobian(q) / self._map.scale(targets)[:, :, None]
        steps = (inverses(J)[0] @ residual[:, :, None])[:, :, 0]
        return steps, np.sign(np.linalg.slogdet(J)[0]).astype(np.int64)


@dataclass(frozen=True)
class OwnInverse:
    """Solver for grown coordinates, by their own inverse map.

    If several q have the same phi, the start selects the number of full turns and the sheet of the leaf.
    """

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

    inverted: ca.Function  #: q -> phi, H = J^-1, and |D^-1 J| |H D| with the component sizes D
    chord: ca.Function  #: q, phi, H, target -> q and phi after 3 steps with H, and |residual| at each of the 4 points
    turning: tuple[int, ...] = ()  #: indices of joints without boundaries that turn, as in `Problem.turning`
    turns: tuple[float, ...] = ()  #: periods of the components of phi, as in `Differences`

    @classmethod
    def of(
        cls, phi: ca.Function, jacobian: ca.Function, sizes: Array, difference: Differences, turning: tuple[int, ...]
    ) -> "PointFunctions":
        """Build the functions from phi and J of a column q (n, 1), and from sizes and differences as in `PhiMap`."""
        n = len(sizes)
        # J^-1, and the product of the norms of D^-1 J and its inverse; a singular J gives NaN
        J, D = ca.SX.sym("J", n, n), ca.repmat(ca.DM(sizes), 1, n)
        own = ca.solve(J, ca.SX.eye(n))
        inversion = ca.Function("inversion", [J], [own, ca.norm_fro(J / D) * ca.norm_fro(own * D.T)])
        q, known, target = (ca.MX.sym(name, n) for name in ("q", "phi", "target"))
        inverted = dense_function("inverted", [q], [phi(q), *inversion.call([jacobian(q)])])
        # chord steps: several steps with the same J^-1
        H = ca.MX.sym("H", n, n)
        scale = ca.DM(sizes) + ROUNDING * ca.fabs(target)
        now, value, left = q, known, difference(target, known)
        # the 2-norm, because CasADi's norm_inf ignores NaN
        errors = [ca.norm_2(left / scale)]
        for _ in range(NEWTON.steps):
            now = now + H @ left
            value = phi(now)
            left = difference(target, value)
            errors.append(ca.norm_2(left / scale))
        chord = dense_function("chord", [q, known, H, target], [now, value, ca.vertcat(*errors)])
        return cls(inverted, chord, turning, tuple(np.asarray(difference.turns, dtype=float).tolist()))

    def distance(self, phi: Array, target: Array) -> float:
        """|target - phi| relative to the component sizes, by the shorter way around, a number."""
        n = len(phi)
        return float(self.chord(np.zeros(n), phi, np.zeros((n, n)), target)[2][0])


class PointSolver:
    """Solves phi(q) = target from a start, for one row at a time.

    The caller writes `q` and `target`, (n,), in place. `phi` is phi(q) of the last refresh. `step` writes its end to
    `reached`, and the errors along the way to `errors`. A solver has its own buffers, so it belongs to one thread.
    """

    def __init__(self, functions: PointFunctions) -> None:
        n = functions.chord.numel_out(0)
        self.q, self.phi, self.target, self.reached, self._phi_reached = np.empty((5, n))
        self.errors, self.condition = np.empty(NEWTON.steps + 1), np.empty(1)
        self.iterations = 0  #: number of steps of the last `solve`
        self._H = np.empty(n * n)
        self._refresh = Bound(functions.inverted, [self.q], [self.phi, self._H, self.condition])
        results = [self.reached, self._phi_reached, self.errors]
        self._step = Bound(functions.chord, [self.q, self.phi, self._H, self.target], results)

    @property
    def inverse(self) -> Array:
        """dq/dphi at the last refresh, (n, n)."""
        n = len(self.q)
        return self._H.reshape(n, n).T.copy()

    def refresh(self) -> bool:
        """Evaluate phi and J at q; return whether J is regular."""
        self._refresh.run()
        return bool(self.condition[0] < NEWTON.suspicious)

    def step(self) -> bool:
        """Compute chord steps from q with the last J, without moving q; return whether each reduced the error."""
        self._step.run()
        # at rounding level, the error need not fall any more
        errors = self.errors.tolist()
        return all(after < before or after <= NEWTON.goal for before, after in pairwise(errors))

    def shorten(self) -> bool:
        """Halve H until steps with it reduce the error; return whether they do. To be called with a fresh J."""
        for _ in range(NEWTON.halvings):
            self._H *= 0.5
            if self.step():
                return True
        return False

    def accept(self) -> None:
        """Move q to the end of the last steps."""
        self.q[:], self.phi[:] = self.reached, self._phi_reached

    def solve(self) -> bool:
        """Solve for the target from q; return whether the error fell to rounding, so that q is a solution."""
        self.iterations = 0
        # `NEWTON.steps` chord steps with each Jacobian
        for _ in range(NEWTON.refreshes):
            if not self.refresh() or not self.step():
                return False
            self.accept()
            self.iterations += NEWTON.steps
            if self.errors[-1] <= NEWTON.goal:
                return True
        return False


class FewRows:
    """A local solver for few rows, one by one. It passes many rows, and rows that fail, to another solver."""

    def __init__(self, phi_map: PhiMap, functions: PointFunctions, other: LocalSolver) -> None:
        self._map, self._functions, self._other = phi_map, functions, other
        self._spare: list[PointSolver] = []  # solvers that no thread uses now

    def __call__(self, targets: Array, starts: Array) -> Attempt:
        """Search from starts (N, n)."""
        if len(targets) > NEWTON.few:
            return self._other(targets, starts)
        steps, sure = np.zeros(len(targets), dtype=np.int64), np.zeros(len(targets), dtype=bool)
        attempt = Attempt(np.empty(targets.shape), np.empty(targets.shape), steps, sure)
        # defer Ctrl-C, because CasADi turns it into a RuntimeError or loses it
        with deferred():
            try:
                solver = self._spare.pop()
            except IndexError:
                solver = PointSolver(self._functions)
            done = np.zeros(len(targets), dtype=bool)
            for k in range(len(targets)):
                solver.q[:], solver.target[:] = starts[k], targets[k]
                done[k] = solver.solve()
                attempt.q[k], attempt.residual[k], attempt.iterations[k] = solver.q, solver.phi, solver.iterations
            self._spare.append(solver)
        attempt.residual[:] = self._map.difference(targets, attempt.residual) / self._map.scale(targets)
        failed = np.flatnonzero(~done)
        if failed.size:
            attempt.replace(failed, self._other(targets[failed], starts[failed]))
        return attempt


class Bound:
    """A CasADi function bound to fixed input and output arrays; `run()` evaluates it without copies."""

    def __init__(self, function: ca.Function, inputs: list[Array], outputs: list[Array]) -> None:
        # `Any`, because the type stubs of set_arg and set_res require a size, which the methods do not take
        buffer: Any
        buffer, run = function.buffer()
        for i, array in enumerate(inputs):
            buffer.set_arg(i, array.data)
        for i, array in enumerate(outputs):
            buffer.set_res(i, array.data)
        self.run: Callable[[], Any] = run
        self._alive = buffer, inputs, outputs


def inverse_function(phi: ca.Function, sizes: Array, difference: Differences) -> ca.Function:
    """CasADi function phi, q_start (n, 1) -> q (n, 1) with phi(q) = phi, or NaN if Newton's method finds none."""
    n = len(sizes)
    q, target, start = (ca.MX.sym(name, n) for name in ("q", "phi", "q_start"))

    def residual(at: ca.MX) -> Any:
        return -difference(target, phi(at)) / (ca.DM(sizes) + ROUNDING * ca.fabs(target))

    solve = ca.rootfinder("solve", "newton", {"x": q, "p": target, "g": residual(q)}, _OPTIONS)
    found = solve(start, target)
    # adding 0 or NaN marks failures without changing the derivatives
    failed = ca.if_else(ca.norm_2(residual(found)) <= NEWTON.tolerance, 0.0, np.nan)
    return ca.Function("inverse", [target, start], [found + failed], ["phi", "q_start"], ["q"])


@dataclass(frozen=True, slots=True)
class StartRules:
    """Numbers of `Starts`. Chosen on the ready charts, held there with other seeds (benchmarks/round_trips.py)."""

    points: int = 4096  #: number of stored positions
    seed: int = 0  #: seed of the stored positions
    degrees: tuple[int, ...] = (3, 2, 1)  #: degrees of the polynomial inverse; the first with few enough terms is used
    most_terms: int = 500  #: largest number of its terms
    overshoot: float = 1.2  #: values of phi are clipped to this multiple of their stored range


STARTS = StartRules()


class Starts:
    """Starts for Newton's method: a polynomial approximation of the inverse, and stored positions.

    The polynomial q(phi) is fitted by least squares to 4,096 stored positions of the domain, once for each chart in
    0.1 s. Task and coordinates are smooth, so it is much closer to a solution than the centre of the domain.
    """

    def __init__(self, phi_map: PhiMap, domain: Domain) -> None:
        self._map, self._domain = phi_map, domain

    def guess(self, targets: Array) -> Array:
        """The polynomial inverse at targets (N, n), clipped to the box of the domain, (N, n)."""
        centre, half_width = self._domain.centre, self._domain.half_width
        q = _terms(self._normalised(targets), self._degree) @ self._coefficients
        guess: Array = np.clip(q, centre - half_width, centre + half_width)
        return guess

    def nearest(self, targets: Array, count: int, components: int) -> Array:
        """The stored positions whose phi is nearest to targets (N, n), nearest first, (count or fewer, N, n).

        Args:
            targets: values of phi.
            count: number of positions for each target.
            components: number of components of phi that are compared: m for x alone, n for phi.
        """
        points = self._table[0]
        order = self._trees[components].query(self._places(targets, components), range(1, min(count, len(points)) + 1))[
            1
        ]
        nearest: Array = points[order.T]
        return nearest

    @cached_property
    def _trees(self) -> BuiltOnUse[int, Any]:
        """k-d trees of the stored values of phi, by the number of components that are compared."""
        return BuiltOnUse(lambda components: scipy.spatial.cKDTree(self._places(self._table[1], components)))

    def _places(self, phi: Array, components: int) -> Array:
        """Vectors (N, k) whose distances measure how near the first components of phi (N, n) are.

        Components are normalised by their ranges. Orientations are embedded without a seam, see `Relative.embed`.
        """
        normalised, relative = self._normalised(phi)[:, :components], self._map.difference.task
        if relative is None or not relative.turned:
            return normalised
        first, last = relative.first, relative.task.m
        orientations = relative.embed(phi[:, :last]) / self._range[1][first:last].mean()
        return np.concatenate([normalised[:, :first], orientations, normalised[:, last:]], axis=1)

    @cached_property
    def _table(self) -> tuple[Array, Array]:
        """The stored positions: points of the domain where phi is defined, and phi there, (K, n) each."""
        points = sample_boundary_weighted(self._domain, STARTS.points, STARTS.seed)
        phi = self._map.phi(points)
        known = np.isfinite(phi).all(axis=1)
        if not known.any():
            raise SingularTaskError(f"phi is not finite at any of {len(points)} samples of the domain")
        return points[known], phi[known]

    @cached_property
    def _range(self) -> tuple[Array, Array]:
        """Centre and half-width of the range of phi over the stored positions, (n,) each."""
        low, high = self._table[1].min(axis=0), self._table[1].max(axis=0)
        return (low + high) / 2, np.where(high > low, (high - low) / 2, 1.0)

    @cached_property
    def _coefficients(self) -> Array:
        """Coefficients of the polynomial inverse, (terms, n)."""
        points, phi = self._table
        found = np.linalg.lstsq(_terms(self._normalised(phi), self._degree), points, rcond=None)[0]
        return np.asarray(found, dtype=float)

    @property
    def _degree(self) -> int:
        """Degree of the polynomial inverse."""
        n = len(self._domain.centre)
        return next((degree for degree in STARTS.degrees if comb(n + degree, degree) <= STARTS.most_terms), 1)

    def _normalised(self, phi: Array) -> Array:
        """Scale phi (N, n) to [-1, 1] over the stored range, and clip it a little beyond."""
        middle, half = self._range
        return np.clip((phi - middle) / half, -STARTS.overshoot, STARTS.overshoot)


def _terms(u: Array, degree: int) -> Array:
    """All monomials of the columns of u (N, n) up to a degree, (N, terms)."""
    columns = np.ascontiguousarray(u.T)
    # monomials of one degree, each with the index of its last factor
    level = [(0, np.ones(len(u)))]
    terms = [level[0][1]]
    for _ in range(degree):
        level = [(j, product * columns[j]) for i, product in level for j in range(i, len(columns))]
        terms += [product for _, product in level]
    return np.array(terms).T
