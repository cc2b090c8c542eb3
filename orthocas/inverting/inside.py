"""Solutions inside the domain where phi(q) = phi has none: the same task values, and the nearest coordinates (ours).

The search works on all rows at once, in the box of the domain. First it looks for any q of the box with h(q) = x, from
several starts; where there is none, x is out of reach. Then it moves along h(q) = x to the nearest xi. Ipopt takes over
where that does not end, and where a condition on the domain forbids the result.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthocas.checks import Array
from orthocas.inverting.boxed import BoxedPhi
from orthocas.inverting.nearest import Nearest
from orthocas.inverting.nearest_xi import nearest_xi
from orthocas.inverting.solve_in_box import KEPT, solve_in_box
from orthocas.inverting.starts import Starts

_STARTS = 3  # of the table, after a given one


@dataclass(frozen=True, eq=False)
class Inside:
    """Finds points of the domain that keep the task."""

    boxed: BoxedPhi
    starts: Starts
    by_ipopt: Nearest

    def with_task(self, targets: Array, q: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Points of the box with the task values of targets (N, n), or near them, from q (N, n) and other starts.

        Returns:
            q (N, n), and which of them have the task values, (N,).
        """
        x, u, error = targets[:, : self.boxed.m], self.boxed.of_points(q), np.full(len(q), np.inf)
        left = np.arange(len(q))
        for start in self._starts(targets, q):
            found, missed = solve_in_box(self.boxed.task_equations, x[left], self.boxed.of_points(start[left]))
            better = missed < error[left]
            u[left[better]], error[left[better]] = found[better], missed[better]
            left = left[error[left] > KEPT]
            if not left.size:
                break
        return self.boxed.points(u), np.asarray(error <= KEPT)

    def nearest(self, targets: Array, q: Array) -> Array:
        """Points of the domain with task values as in targets (N, n), as q (N, n), and the nearest xi, (N, n)."""
        u, minimal = nearest_xi(self.boxed, targets, self.boxed.of_points(q))
        found = self.boxed.points(u)
        allowed = self.boxed.domain.contains(found)
        undecided = np.flatnonzero(~(minimal & allowed))
        if undecided.size:
            found[undecided] = self._searched_by_ipopt(targets[undecided], found[undecided], allowed[undecided])
        return found

    def _searched_by_ipopt(self, targets: Array, q: Array, allowed: NDArray[np.bool_]) -> Array:
        """Better points than q (N, n), from q; where q is not allowed, any, and from other starts as well."""
        best, distance = q.copy(), np.where(allowed, self._distance(targets, q), np.inf)
        left = np.arange(len(q))
        for start in self._starts(targets, q):
            found = self.by_ipopt.search(targets[left], start[left])
            kept = self.by_ipopt.keeps_task(targets[left], found, KEPT)
            away = np.where(kept, self._distance(targets[left], found), np.inf)
            better = away < distance[left]
            best[left[better]], distance[left[better]] = found[better], away[better]
            left = left[~np.isfinite(distance[left])]
            if not left.size:
                break
        return best

    def _starts(self, targets: Array, q: Array) -> list[Array]:
        return [q, *self.starts.nearest(targets, _STARTS, self.boxed.m)] if len(q) else []

    def _distance(self, targets: Array, q: Array) -> Array:
        """|xi - xi(q)|, (N,)."""
        errors = self.boxed.xi_errors(targets, self.boxed.of_points(q))
        return np.asarray(np.linalg.norm(errors, axis=1))
