"""Points of a box with given task values, for many rows at once (ours).

Each row minimises |h(q) - x|^2 over the box by the Levenberg-Marquardt method. Joints that a step would move out of the
box stop at its border, and the others make up for it. Since tasks have fewer components than joints, a step solves
systems of size m. A row that ends at a local minimum above 0 has no point with this x near its start.
"""

import numpy as np
from numpy.typing import NDArray

from orthocas.checks import Array, Indices
from orthocas.inverting.boxed import BoxedPhi
from orthocas.inverting.phi_map import largest

KEPT = 1e-11  #: task error, relative to the sizes of the components, at which x counts as reached
_GOAL = 1e-13  # task error at which the search stops
_MOST, _PATIENCE = 64, 8  # iterations; after so many, the error must have halved
_ROUNDS = 4  # of a step: joints that leave the box are held, and the others step again
_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-6, 1e-12, 1e6  # relative to |J|^2
_DECREASE = 1e-9  # of the squared error


def reach_task(
    boxed: BoxedPhi, x: Array, start: Array, held: NDArray[np.bool_] | None = None, most: int = _MOST
) -> tuple[Array, Array]:
    """Points u of the box with task values x, or where the search from start ends.

    Args:
        boxed: the task.
        x: task values, (N, m).
        start: points of the box, (N, n).
        held: joints that stay at their start, (N, n).
        most: iterations.

    Returns:
        u (N, n), and the largest task errors (N,).
    """
    run = _Run(boxed, x, start, np.zeros(start.shape, dtype=bool) if held is None else held)
    rows, before = np.flatnonzero(np.isfinite(run.error)), run.error.copy()
    for k in range(1, most + 1):
        if k % _PATIENCE == 0:
            rows = rows[run.error[rows] <= before[rows] / 2]
            before[rows] = run.error[rows]
        rows = rows[(run.error[rows] > _GOAL) & (run.damping[rows] < _MOST_DAMPING)]
        if not rows.size:
            break
        run.advance(rows)
    return run.u, run.error


class _Run:
    """The state of all rows."""

    def __init__(self, boxed: BoxedPhi, x: Array, start: Array, held: NDArray[np.bool_]) -> None:
        self._boxed, self._x, self._held = boxed, x, held
        self.u = start.copy()
        self._errors = boxed.task_errors(x, self.u)
        self.error = largest(self._errors)
        self.damping = np.full(len(x), _DAMPING)
        self._J = np.zeros((len(x), boxed.m, start.shape[1]))
        self._fresh = np.zeros(len(x), dtype=bool)  # rows whose J belongs to u

    def advance(self, rows: Indices) -> None:
        """Try a step in some rows."""
        stale = rows[~self._fresh[rows]]
        if stale.size:
            self._J[stale], self._fresh[stale] = self._boxed.task_jacobians(self._x[stale], self.u[stale]), True
        u = np.clip(self.u[rows] + self._steps(rows), self._boxed.low, self._boxed.high)
        errors = self._boxed.task_errors(self._x[rows], u)
        better = (errors**2).sum(axis=1) < (1 - _DECREASE) * (self._errors[rows] ** 2).sum(axis=1)
        moved = rows[better]
        self.u[moved], self._errors[moved], self.error[moved] = u[better], errors[better], largest(errors[better])
        self._fresh[moved] = False
        self.damping[rows] *= np.where(better, 0.1, 10.0)
        np.maximum(self.damping, _LEAST_DAMPING, out=self.damping)

    def _steps(self, rows: Indices) -> Array:
        """Damped steps that stop at the border, (rows, n)."""
        J, errors, m = self._J[rows], self._errors[rows], self._boxed.m
        low, high = self._boxed.low - self.u[rows], self._boxed.high - self.u[rows]
        wanted = np.einsum("nmi,nm->ni", J, errors)
        held = self._held[rows] | ((low >= 0) & (wanted < 0)) | ((high <= 0) & (wanted > 0))
        damping = self.damping[rows] * np.einsum("nmi,nmi->n", J, J) + np.finfo(float).tiny
        steps: Array = np.zeros_like(wanted)
        for _ in range(_ROUNDS):
            free = J * ~held[:, None, :]
            left = errors - np.einsum("nmi,ni->nm", J, np.where(held, steps, 0.0))
            gram = free @ free.transpose(0, 2, 1) + damping[:, None, None] * np.eye(m)
            solved = np.einsum("nmi,nm->ni", free, np.linalg.solve(gram, left[:, :, None])[:, :, 0])
            steps = np.where(held, steps, np.clip(solved, low, high))
            leaving = ~held & ((solved < low) | (solved > high))
            if not leaving.any():
                break
            held |= leaving
        return steps
