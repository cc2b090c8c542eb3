"""The nearest coordinates in a box at given task values, for many rows at once (ours).

    minimise |xi(q) - xi|^2 / 2   subject to   h(q) = x,  q in the box,

from points with h(q) = x. A step is the minimum of a quadratic model, with a damped Gauss-Newton matrix, on the tangent
of h(q) = x and within the box. `solve_in_box` then leads back to h(q) = x, while the joints at their borders stay
there. Steps that do not reduce the distance are tried again with more damping.
"""

import numpy as np
from numpy.typing import NDArray

from orthocas.checks import Array, Indices
from orthocas.inverting.box_programs import Minimum, Programs, minimum
from orthocas.inverting.boxed import BoxedPhi
from orthocas.inverting.solve_in_box import KEPT, solve_in_box

_MOST, _RETURN = 40, 8  # iterations, and those of a return to h(q) = x
_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-3, 1e-8, 1e6  # relative to the mean eigenvalue
_DECREASE = 1e-4  # of the squared distance, relative to what the model promises
_CONVERGED = 1e-12  # promised decrease, relative to the squared distance
_ZERO = 1e-26  # squared distance that is rounding


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
        if missed.size:  # the joints at the border are needed
            u[missed], error[missed] = solve_in_box(self._boxed.task_equations, x[missed], start[missed], most=_RETURN)
        return u, np.asarray(error <= KEPT)


def _slopes(programs: Programs, found: Minimum) -> Array:
    """g^T d, corrected for A d = 0 being missed by a little, (rows,)."""
    missed = np.einsum("nm,nmi,ni->n", found.multipliers, programs.A, found.d)
    slopes: Array = np.einsum("ni,ni->n", programs.g, found.d) + missed
    return slopes
