"""Newton's method with line search for many targets at once (ours).

All rows share the evaluations of phi and J, and those that are done drop out. A row keeps its Jacobian as long as
steps with it reduce the error tenfold: evaluating J takes several times as long as evaluating phi.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from orthocas.casadi_tools.threads import in_threads
from orthocas.checks import Array, Indices
from orthocas.inverting.phi_map import PhiMap, largest

MAX_ITERATIONS = 50
_PATIENCE = 8  # iterations after which the error must have halved
GOAL = 1e-12  #: error at which the iteration stops
_KEEP = 0.1  # J is evaluated again if a step leaves more of the error
_DECREASE = 1e-4  # of the error, relative to the part of the step taken
_HALVINGS, _SOLVED = 10, 1e-10  # of a step; below this error only rounding stops the decrease
_PIECE = 2048  # matrices that a thread inverts at once
SUSPICIOUS = 1e6  #: |J| |J^-1| above which singular values are computed


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
    """Newton's method with line search, which starts at finite points."""

    def __init__(self, phi_map: PhiMap) -> None:
        self._map = phi_map

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
                rows = rows[run.advance(rows)]
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

    def advance(self, rows: Indices) -> NDArray[np.bool_]:
        """Take a step in some rows, halved until the error decreases. Returns which can go on, (rows,).

        A row whose J is from an earlier point waits for a new one instead.
        """
        inverse = self._inverse if len(rows) == len(self._inverse) else self._inverse[rows]  # copies take time
        steps = np.matmul(inverse, self.residual[rows, :, None])[:, :, 0]
        goes_on = np.zeros(len(rows), dtype=bool)
        left = np.flatnonzero(np.isfinite(steps).all(axis=1))
        for halvings in range(_HALVINGS + 1):
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
            pieces, in_threads(lambda piece: np.linalg.inv(matrices[piece]), pieces), strict=True
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
