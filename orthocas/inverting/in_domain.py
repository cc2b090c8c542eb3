"""Solutions of phi(q) = phi inside the domain, wherever they lie in it, for many rows at once (ours).

A row starts in the cells of the domain that may hold a solution, the likeliest first. Searches stop at the borders
(`solve_in_box`), so they do not lose a solution that lies next to one.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthocas.checks import Array
from orthocas.inverting.boxed import BoxedPhi
from orthocas.inverting.cells import MARGIN, Cells
from orthocas.inverting.solve_in_box import solve_in_box

_ROUNDS = (1, 3, 12, 48)  # searches of a row that has no solution yet, at once; then all that are left
_MORE = 7  # further starts in each cell, for all solutions of one target
_MOST, _PATIENCE = 32, 3  # iterations; after so many, the error must have halved
_AT_ONCE = 1024  # rows whose starts are held in memory
_SAME = 1e-6  # of the half-widths: distance up to which two solutions count as one


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
        starts = np.vstack([places.start[0, likely], *(self.cells.samples(cell, _MORE) for cell in likely)])
        u, error = self._solved(np.broadcast_to(target, starts.shape), starts, tolerance)
        u = u[error <= tolerance]
        different: list[Array] = []
        for row in u[np.argsort(np.linalg.norm(u, axis=1))]:
            if all(np.abs(row - other).max() > _SAME for other in different):
                different.append(row)
        return self.boxed.points(np.array(different).reshape(-1, len(target)))

    def _searched(self, targets: Array, tolerance: float) -> tuple[Array, Array]:
        """The best points u (N, n), and their errors (N,)."""
        places = self.cells.places(targets)
        order = np.argsort(places.overshoot, axis=1)
        likely = np.maximum((places.overshoot <= MARGIN).sum(axis=1), 1)  # cells to search, in this order
        best, error = np.zeros_like(targets), np.full(len(targets), np.inf)
        done = 0
        for count in (*_ROUNDS, order.shape[1]):
            rows = np.flatnonzero((error > tolerance) & (likely > done))
            if not rows.size:
                break
            rank = np.arange(done, min(done + count, order.shape[1]))
            row, place = np.nonzero(rank < likely[rows, None])
            row, cell = rows[row], order[rows[row], rank[place]]
            u, found = self._solved(targets[row], places.start[row, cell], tolerance)
            worst_first = np.argsort(-found, kind="stable")  # the last one that is written stays
            row, u, found = row[worst_first], u[worst_first], found[worst_first]
            better = found < error[row]
            best[row[better]], error[row[better]] = u[better], found[better]
            done += count
        return best, error

    def _solved(self, targets: Array, starts: Array, tolerance: float) -> tuple[Array, Array]:
        """Where searches end, (N, n), and the errors (N,): infinite for solutions that a condition forbids."""
        with np.errstate(all="ignore"):
            u, error = solve_in_box(self.boxed.phi_equations, targets, starts, most=_MOST, patience=_PATIENCE)
        solved = np.flatnonzero(error <= tolerance)
        error[solved[~self.boxed.domain.contains(self.boxed.points(u[solved]))]] = np.inf
        return u, error
