"""A damped descent in a box for many rows at once, to phi(q) = phi or to h(q) = x, and the search that uses it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise, product

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from orthocas.charts.newton import PhiMap, Starts, largest
from orthocas.tasks.domains import Domain
from orthocas.tasks.relative import Relative
from orthocas.tasks.samples import sample_uniform
from orthocas.tasks.task import Task
from orthocas.tools.batch import dense_function
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array, Indices
from orthocas.tools.columns import BlockedFunction
from orthocas.tools.expressions import wrap_shortest

Flags = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class DescentRules:
    """Numbers of the descent. Joints are in half-widths, errors relative to component sizes.

    Chosen on panda-wide and pr2-left-wide, held on all ready charts (benchmarks/round_trips.py).
    """

    goal: float = 1e-13  #: error at which a row ends
    kept: float = 1e-11  #: error of x up to which h(q) = x counts as met
    most: int = 64  #: largest number of iterations
    patience: int = 8  #: iterations within which the error must halve
    damping: float = 1e-6  #: damping of the first step, relative to the mean eigenvalue of J^T J
    least_damping: float = 1e-12  #: smallest damping, relative to the same
    most_damping: float = 1e6  #: a row that needs more damping, relative to the same, ends
    foreseen: float = 0.75  #: actual over predicted decrease above which the damping shrinks
    missed: float = 0.25  #: actual over predicted decrease below which the damping doubles
    shrinks: float = 0.1  #: factor of the damping after a well predicted step
    grows: float = 10.0  #: factor of the damping after a rejected step
    decrease: float = 1e-4  #: least decrease of the squared error for acceptance, relative to the predicted one
    converged: float = 1e-12  #: predicted decrease, relative to the squared error, below which a point is a minimum
    rounded: float = 1e-26  #: squared error that is rounding
    rounds: int = 24  #: largest number of active sets that a quadratic program tries
    slack: float = 1e-13  #: tolerance of bounds
    probes: int = 32  #: number of positions at which full turns of joints are evaluated
    same: float = 1e-9  #: change of xi that is rounding
    stored: tuple[int, ...] = (4, 16, 64)  #: `search`: stored positions tried in all, after each of its stages
    all: int = 64  #: `find_all`: stored positions near phi, and as many near x
    stored_most: int = 32  #: largest number of iterations from a stored position
    stored_patience: int = 3  #: iterations within which the error must halve, from a stored position
    rows: int = 1024  #: rows searched at once, to bound memory


RULES = DescentRules()


def descend(
    boxed: BoxedPhi,
    targets: Array,
    start: Array,
    whole: bool,
    most: int = RULES.most,
    patience: int = RULES.patience,
) -> tuple[Array, Array]:
    """Minimise |e(u)|^2 over points u of the box from a start, for N rows, where e is the error of phi or of x alone.

    Each step d solves a quadratic program,

        minimise |J d - e|^2 / 2 + damping |d|^2 / 2    subject to    low <= u + d <= high,

    with Levenberg and Marquardt's damping.

    Args:
        boxed: phi in the box.
        targets: values of phi, (N, n).
        start: points u of the box, (N, n).
        whole: True to solve phi(q) = phi; False to solve h(q) = x alone.
        most: largest number of iterations.
        patience: iterations within which the error must halve.

    Returns:
        u (N, n), and the largest errors there, (N,).

    Source:
        Levenberg and Marquardt's method with an active set; ours.
    """
    with np.errstate(all="ignore"):
        run = _Run(boxed, targets, start, whole)
        rows, before = np.flatnonzero(np.isfinite(run.square)), run.error.copy()
        for k in range(1, most + 1):
            # rows whose error has not halved within `patience` iterations end
            if k % patience == 0:
                rows = rows[run.error[rows] <= before[rows] / 2]
                before[rows] = run.error[rows]
            rows = rows[(run.error[rows] > RULES.goal) & (run.damping[rows] < RULES.most_damping) & ~run.minimal[rows]]
            if not rows.size:
                break
            run.advance(rows)
    return run.u, run.error


class _Run:
    """The state of `descend` for all rows."""

    def __init__(self, boxed: BoxedPhi, targets: Array, start: Array, whole: bool) -> None:
        N, n = start.shape
        self._boxed, self._targets, self._whole = boxed, targets, whole
        self.u = start.copy()
        self._errors = boxed.errors(targets, self.u, whole)
        self.error, self.square = largest(self._errors), (self._errors**2).sum(axis=1)
        self.minimal = np.zeros(N, dtype=bool)
        self.damping = np.full(N, RULES.damping)
        self._J = np.zeros((N, self._errors.shape[1], n))
        # rows whose J was evaluated at the present u
        self._fresh = np.zeros(N, dtype=bool)
        # active bounds of the last step: -1 low, 1 high, 0 inactive
        self._at = np.zeros((N, n), dtype=np.int8)

    def advance(self, rows: Indices) -> None:
        """Try a step in the given rows."""
        stale = rows[~self._fresh[rows]]
        if stale.size:
            self._J[stale] = self._boxed.jacobians(self._targets[stale], self.u[stale], self._whole)
            self._fresh[stale] = True
        undefined = ~np.isfinite(self._J[rows]).all(axis=(1, 2))
        self.damping[rows[undefined]] = np.inf
        rows = rows[~undefined]
        # the quadratic program of each row: Hessian J^T J with damping, gradient -J^T e
        G, n = self._J[rows], self.u.shape[1]
        H = G.transpose(0, 2, 1) @ G
        mean = np.trace(H, axis1=1, axis2=2) / n + np.finfo(float).tiny
        H += (self.damping[rows] * mean)[:, None, None] * np.eye(n)
        g = -np.matmul(self._errors[rows, None], G)[:, 0]
        programs = Programs(H, g, self._boxed.low - self.u[rows], self._boxed.high - self.u[rows])
        d, self._at[rows], solved = solve_programs(programs, self._at[rows])
        slope, bend = (programs.g * d).sum(axis=1), (d * (programs.H @ d[:, :, None])[:, :, 0]).sum(axis=1)
        promised = -slope - bend / 2
        ended = promised * (1 + self.damping[rows]) <= RULES.converged * self.square[rows] + RULES.rounded
        self.minimal[rows] = ended & solved
        u = np.clip(self.u[rows] + d, self._boxed.low, self._boxed.high)
        errors = self._boxed.errors(self._targets[rows], u, self._whole)
        square = (errors**2).sum(axis=1)
        gain = (self.square[rows] - square) / (2 * promised)
        better = (gain > RULES.decrease) & (promised > 0)
        moved = rows[better]
        self.u[moved], self._errors[moved], self.square[moved] = u[better], errors[better], square[better]
        self.error[moved], self._fresh[moved] = largest(errors[better]), False
        slower = np.where(gain > RULES.foreseen, RULES.shrinks, np.where(gain < RULES.missed, 2.0, 1.0))
        self.damping[rows] *= np.where(better, slower, RULES.grows)
        np.maximum(self.damping, RULES.least_damping, out=self.damping)


@dataclass(frozen=True, eq=False)
class Programs:
    """N quadratic programs: minimise g d + d H d / 2 subject to low <= d <= high, where low <= 0 <= high."""

    H: Array  #: (N, n, n), positive definite
    g: Array  #: (N, n)
    low: Array  #: (N, n)
    high: Array  #: (N, n)

    def part(self, rows: Indices) -> Programs:
        """The programs of some rows."""
        return Programs(*(array[rows] for array in vars(self).values()))


def solve_programs(programs: Programs, at: NDArray[np.int8]) -> tuple[Array, NDArray[np.int8], Flags]:
    """Solve quadratic programs by a primal-dual active-set method, from a guess `at` (N, n) of the active bounds.

    Each round solves with the present active set. Then violated bounds become active, and active bounds with
    multipliers of the wrong sign become inactive, until nothing changes.

    Returns:
        Minima d (N, n); the active bounds (N, n): -1 low, 1 high, 0 inactive; and whether each row is solved, (N,):
        False if its active set still changes after `RULES.rounds`.
    """
    N = len(programs.g)
    d, held, left = np.zeros_like(programs.g), at.copy(), np.arange(N)
    for k in range(RULES.rounds):
        part, on = programs if len(left) == N else programs.part(left), held[left]
        # joints with an active bound get the equation d = bound
        K, joint = part.H.copy(), on != 0
        here, j = np.nonzero(joint)
        K[here, j], K[here, j, j] = 0.0, 1.0
        bounds = np.where(on < 0, part.low, part.high)
        d[left] = step = np.linalg.solve(K, np.where(joint, bounds, -part.g)[:, :, None])[:, :, 0]
        # a bound stays active while the gradient pushes against it; it becomes active when d violates it
        slope = (part.H @ step[:, :, None])[:, :, 0] + part.g
        now = np.where(joint, on * (slope * on < 0), 0)
        now += ~joint * ((step > part.high + RULES.slack) * 1 - (step < part.low - RULES.slack) * 1)
        changes = now != on
        # later change only the first bound in each round, so that the active set does not cycle
        if k >= RULES.rounds // 3:
            changes &= np.cumsum(changes, axis=1) == 1
        held[left] = np.where(changes, now, on)
        left = left[changes.any(axis=1)]
        if not left.size:
            break
    solved = np.ones(N, dtype=bool)
    solved[left] = False
    return np.clip(d, programs.low, programs.high), held, solved


@dataclass(frozen=True, eq=False)
class BoxedPhi:
    """phi in the box of a domain, with points given as u = (q - centre) / half_width, and its errors and derivatives.

    Where phi is not finite, errors are infinite, and derivatives are 0 or NaN.
    """

    task: Task
    domain: Domain
    phi_map: PhiMap
    xi: Callable[[Array], Array]  #: coordinates (N, r) of points (N, n)

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
        """Highest u, (n,): 1, or inf for joints without boundaries."""
        return (self.domain.bounds[1] - self.domain.centre) / self.domain.half_width

    def points(self, u: Array) -> Array:
        """q of points u (N, n), clipped to the box, (N, n)."""
        domain = self.domain
        return np.clip(domain.centre + domain.half_width * u, *domain.bounds)

    def of_points(self, q: Array) -> Array:
        """u of joint positions q (N, n), clipped to the box, (N, n)."""
        u = (q - self.domain.centre) / self.domain.half_width
        return np.clip(u, self.low, self.high)

    def errors(self, targets: Array, u: Array, whole: bool) -> Array:
        """Errors for targets phi (N, n), divided by `PhiMap.scale`: of phi, (N, n), if `whole`; else of x, (N, m)."""
        if whole:
            errors = self.phi_map.residual(targets, self.points(u))
        else:
            x = targets[:, : self.m]
            errors = self._task_gaps(self.points(u), x)[0] / self.phi_map.scale(targets)[:, : self.m]
        return np.where(np.isfinite(errors), errors, np.inf)

    def jacobians(self, targets: Array, u: Array, whole: bool) -> Array:
        """Negative derivatives of the scaled errors by u, (N, n, n) if `whole`, else (N, m, n); 0 where undefined."""
        if whole:
            J = self.phi_map.jacobian(self.points(u))
        else:
            assert self.phi_map.difference.task is not None
            J = self.phi_map.difference.task.batched_rates(self.points(u))[0].reshape(len(u), self.m, -1)
        J = J * self.domain.half_width / self.phi_map.scale(targets)[:, : J.shape[1], None]
        return np.where(np.isfinite(J), J, 0.0)

    def gaps(self, targets: Array, u: Array) -> Array:
        """phi - phi(q), (N, n), for targets phi (N, n), by the shorter way around."""
        q, gaps = self.points(u), np.empty_like(u)
        self._task_gaps.into(gaps[:, : self.m], q, targets[:, : self.m])
        gaps[:, self.m :] = self.xi_gaps(targets, q)
        return gaps

    def xi_gaps(self, targets: Array, q: Array) -> Array:
        """xi - xi(q), (N, r), for targets phi (N, n), by the shorter way around."""
        return np.asarray(wrap_shortest(targets[:, self.m :] - self.xi(q), self.phi_map.difference.turns[self.m :]))

    @cached_property
    def _task_gaps(self) -> BlockedFunction:
        """Function of q and x for many points: x - h(q), (m, 1), by the shorter way around for orientations."""
        q, x = ca.SX.sym("q", len(self.domain.centre)), ca.SX.sym("x", self.m)
        gap = Relative(self.task).difference(x, self.task.function(q))
        return BlockedFunction(dense_function("gap", [q, x], [gap]))

    @cached_property
    def turned(self) -> Array:
        """Change of xi by a full turn of each joint without boundaries, at some positions, (probes, n, r).

        It is 0 for all other joints.
        """
        n, endless = len(self.low), ~np.array(self.task.robot.tree.prismatic) & ~np.isfinite(self.low)
        q = sample_uniform(self.domain, RULES.probes, 0)
        turned = (q + 2 * np.pi * np.diag(endless)[:, None]).reshape(-1, n)
        moved = self.xi_gaps(self.phi_map.phi(turned), np.tile(q, (n, 1)))
        return np.asarray(moved.reshape(n, len(q), -1).transpose(1, 0, 2))

    @property
    def winding(self) -> Flags:
        """Whether each joint has no boundaries and its full turns change xi, (n,)."""
        return np.asarray(np.abs(self.turned).max(axis=(0, 2)) > RULES.same)

    @property
    def even(self) -> Flags:
        """Whether a full turn of each joint adds the same to xi at all positions, (n,); True for all other joints."""
        return np.asarray(np.ptp(self.turned, axis=0).max(axis=1) < RULES.same)

    @property
    def has_rooms(self) -> bool:
        """Whether the domain has conditions beyond its box that are CasADi expressions, so that `rooms` exist."""
        return self.domain.known_condition is not None

    def rooms(self, u: Array) -> Array:
        """Margins to the k conditions of the domain at points u (N, n), (N, k); positive inside. See `rooms_of`."""
        found: Array = self._rooms[0](self.points(u))[0]
        return found

    def room_slopes(self, u: Array) -> Array:
        """Derivatives of `rooms` by u, (N, k, n)."""
        found: Array = self._rooms[1](self.points(u))[0].reshape(len(u), -1, len(self.low))
        return found * self.domain.half_width

    @cached_property
    def _rooms(self) -> tuple[BlockedFunction, BlockedFunction]:
        """Functions of q for many points: the margins (k, 1), and their derivatives by q, row by row (k n, 1)."""
        q, x = ca.SX.sym("q", len(self.low)), ca.MX.sym("q", len(self.low))
        rooms = ca.Function("rooms", [x], [rooms_of(self.domain, x)])(q)
        slopes = ca.vec(ca.jacobian(rooms, q).T)
        return (
            BlockedFunction(dense_function("rooms", [q], [ca.cse(rooms)])),
            BlockedFunction(dense_function("slopes", [q], [ca.cse(slopes)])),
        )


def rooms_of(domain: Domain, q: ca.MX) -> ca.MX:
    """Margins (k, 1) to the conditions of a domain beyond its box, as smooth expressions of q (n, 1).

    Each is 0 where its condition ends, and positive just inside. k is 0 for a box.
    """
    clear = domain.singular_bound
    if clear is None:
        return ca.MX(0, 1) if domain.condition is None else domain.condition.pivots(q)
    # The product of 1 - bound^2 / sigma_i^2 over the singular values is 0 where the least of them equals the bound. It
    # is det(G - bound^2 I) / det G with the Gram matrix G of the task Jacobian's scaled rows, computed by pivots.
    gram, bound = clear.gram(q), clear.least_singular_value
    m = gram.shape[0]
    G, clearance = ca.SX.sym("G", m, m), ca.SX(1)
    for pivot, whole in zip(_pivots(G - bound**2 * ca.SX.eye(m)), _pivots(G), strict=True):
        clearance *= pivot / whole
    rooms = ca.Function("clearance", [G], [ca.cse(clearance)])(gram)
    return rooms if domain.room_to_fold is None else ca.vertcat(rooms, domain.room_to_fold(q))


def _pivots(A: ca.SX) -> list[ca.SX]:
    """Elimination pivots of a square matrix."""
    found = []
    while True:
        found.append(A[0, 0])
        if A.shape[0] == 1:
            return found
        A = A[1:, 1:] - A[1:, 0] @ A[0, 1:] / A[0, 0]


@dataclass(frozen=True, eq=False)
class InDomain:
    """Searches the whole domain, for r > 1, by descents in its box from stored positions."""

    boxed: BoxedPhi
    starts: Starts

    def search(self, targets: Array, tolerance: float) -> Array:
        """For targets phi (N, n), the points (N, n) of the box with the least error that descents find.

        Solutions outside the domain do not count. Descents start at the stored positions whose phi is nearest, and at
        more of them for rows without a solution.
        """
        best, error = np.empty_like(targets), np.full(len(targets), np.inf)
        for first in range(0, len(targets), RULES.rows):
            rows = np.arange(first, min(first + RULES.rows, len(targets)))
            stored = self.starts.nearest(targets[rows], RULES.stored[-1], targets.shape[1])
            best[rows] = stored[0]
            # few starts for all rows, then more starts for rows without a solution
            for begin, end in pairwise((0, *RULES.stored)):
                left = np.flatnonzero(error[rows] > tolerance)
                of = np.tile(rows[left], end - begin)
                q, found = self._descend(targets[of], stored[begin:end, left].reshape(-1, targets.shape[1]), tolerance)
                # the best last, because the last assignment to a row stays
                worst_first = np.argsort(-found, kind="stable")
                better = worst_first[found[worst_first] < error[of[worst_first]]]
                best[of[better]], error[of[better]] = q[better], found[better]
        return best

    def find_all(self, target: Array, near: Array, tolerance: float) -> Array:
        """Solutions inside the domain for a target phi (n,), (k, n); a solution may occur several times.

        Descents start at stored positions and at `near` (S, n), positions near solutions.
        """
        n = len(target)
        stored = [self.starts.nearest(target[None], RULES.all, count)[:, 0] for count in (n, self.boxed.m)]
        # if turns of a joint without boundaries change xi, also start one turn away to both sides
        turns = list(product(*((-1, 0, 1) if winds else (0,) for winds in self.boxed.winding)))
        starts = (np.concatenate([near, *stored])[:, None] + 2 * np.pi * np.array(turns)).reshape(-1, n)
        q, error = self._descend(np.broadcast_to(target, starts.shape), starts, tolerance)
        return q[error <= tolerance]

    def _descend(self, targets: Array, starts: Array, tolerance: float) -> tuple[Array, Array]:
        """Descend from starts (N, n); return the ends (N, n) and their errors (N,), infinite for solutions outside."""
        with np.errstate(all="ignore"):
            most, patience, u = RULES.stored_most, RULES.stored_patience, self.boxed.of_points(starts)
            u, error = descend(self.boxed, targets, u, whole=True, most=most, patience=patience)
        q = self.boxed.points(u)
        solved = np.flatnonzero(error <= tolerance)
        error[solved[~self.boxed.domain.contains(q[solved])]] = np.inf
        return q, error
