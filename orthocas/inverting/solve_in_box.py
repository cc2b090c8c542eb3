"""Equations in a box, for many rows at once: points with given task values, or with given phi (ours).

Each row minimises the squared error over the box by the Levenberg-Marquardt method. Joints that a step would move out
of the box stop at its border, and the others make up for it. A step solves systems of as many unknowns as there are
equations, so task values are cheaper than phi. A row that ends at a local minimum above 0 has no solution near its
start.
"""

import numpy as np
from numpy.typing import NDArray

from orthocas.checks import Array, Indices
from orthocas.inverting.boxed import Equations
from orthocas.inverting.phi_map import largest

KEPT = 1e-11  #: error, relative to the sizes of the components, at which the equations count as solved
_GOAL = 1e-13  # error at which the search stops
_MOST, _PATIENCE = 64, 8  # iterations; after so many, the error must have halved
_ROUNDS = 4  # of a step: joints that leave the box are held, and the others step again
_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-6, 1e-12, 1e6  # relative to |J|^2
_DECREASE = 1e-9  # of the squared error


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
        """Damped steps that stop at the border, (rows, n)."""
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
