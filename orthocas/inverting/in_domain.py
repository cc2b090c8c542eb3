"""Solutions of phi(q) = phi inside the domain, wherever they lie in it, for many rows at once (ours).

A row starts in the cells of the domain that may hold a solution, the likeliest first. Searches stop at the borders
(`solve_in_box`), so they do not lose a solution that lies next to one.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthocas.checks import Array, Indices
from orthocas.inverting.boxed import BoxedPhi
from orthocas.inverting.cells import CORE, MARGIN, Cells, Places
from orthocas.inverting.solve_in_box import solve_in_box

_ROUNDS = (1, 3, 12)  # cells of a row that has no solution yet, searched at once; then all that are left
_AGAIN = 3  # further starts in each of the likeliest cells, at last
_ALL = 16  # further starts in each cell, for all solutions of one target
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
        for count in (*_ROUNDS, order.shape[1]):
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
            u, error = solve_in_box(self.boxed.phi_equations, targets, starts, most=_MOST, patience=_PATIENCE)
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
