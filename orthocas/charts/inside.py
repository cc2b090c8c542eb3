"""Points inside the domain where there is no solution: those with the same x and the nearest xi."""

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from orthocas.charts.descent import RULES as DESCENT
from orthocas.charts.descent import BoxedPhi, descend
from orthocas.charts.newton import Starts
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array, Indices


@dataclass(frozen=True, slots=True)
class InsideRules:
    """Numbers of the search for the nearest xi with r > 1. Chosen and held on pr2-left-wide, other seeds."""

    starts: int = 8  #: stored positions near x, where no q with x is known
    near_phi: int = 100  #: stored positions near phi, from which x is sought
    near_x: int = 100  #: the same near x
    most: int = 12  #: iterations to x from each
    patience: int = 2  #: of these, within which the error must halve
    short: int = 16  #: descents to the nearest xi of a few steps
    steps: int = 4  #: so many
    long: int = 2  #: descents to the end, from the best of these
    apart: float = 0.4  #: least distance of their starts, in half-widths
    at_once: int = 256  #: rows whose starts are held in memory


RULES = InsideRules()


@dataclass(frozen=True, eq=False)
class Inside:
    """Finds points of the domain that keep the task."""

    boxed: BoxedPhi
    starts: Starts

    def with_task(self, targets: Array, q: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Points of the box with the task values of targets (N, n), or near them, from q (N, n) and other starts.

        Returns:
            q (N, n), and which of them have the task values, (N,).
        """
        u, error = self.boxed.of_points(q), np.full(len(q), np.inf)
        left = np.arange(len(q))
        for start in [q, *self.starts.nearest(targets, RULES.starts, self.boxed.m)] if len(q) else []:
            end = descend(self.boxed.task_equations, targets[left], self.boxed.of_points(start[left]))
            better = end.error < error[left]
            u[left[better]], error[left[better]] = end.u[better], end.error[better]
            left = left[error[left] > DESCENT.kept]
            if not left.size:
                break
        return self.boxed.points(u), np.asarray(error <= DESCENT.kept)

    def nearest(self, targets: Array, q: Array) -> tuple[Array, Array]:
        """Points of the domain with task values as in targets (N, n), and the nearest xi.

        They are the nearest of those that descents from q (N, n) and from stored positions find.

        Returns:
            q (N, n), and |xi - xi(q)|, (N,), infinite where none was found.
        """
        best, distance = q.copy(), np.full(len(q), np.inf)
        for first in range(0, len(q), RULES.at_once):
            rows = slice(first, first + RULES.at_once)
            best[rows], distance[rows] = self._nearest(targets[rows], q[rows])
        return best, distance

    def nearer(self, targets: Array, q: Array) -> Array:
        """Points of the domain as near to xi as those that steps from q (N, n), inside, lead to, (N, n)."""
        end = descend(self.boxed.nearest_equations, targets, self.boxed.of_points(q))
        points = self.boxed.points(end.u)
        return np.where(self.boxed.domain.contains(points)[:, None], points, q)

    def _nearest(self, targets: Array, q: Array) -> tuple[Array, Array]:
        """The same for few rows: short descents from many points, long ones from the best of their ends."""
        N, n = q.shape
        u, away = self._with_task_from_all(targets, q)
        for count, most in ((RULES.short, RULES.steps), (RULES.long, DESCENT.most)):
            chosen = self._choose(u, away, count)
            row, place = np.nonzero(chosen >= 0)
            end = descend(self.boxed.nearest_equations, targets[row], u[row, chosen[row, place]], most=most)
            gap = np.linalg.norm(self.boxed.xi_errors(targets[row], end.u), axis=1)
            gap[~self.boxed.domain.contains(self.boxed.points(end.u))] = np.inf
            u, away = np.zeros((N, count, n)), np.full((N, count), np.inf)
            u[row, place], away[row, place] = end.u, gap
        best = np.argmin(away, axis=1)
        return self.boxed.points(u[np.arange(N), best]), away[np.arange(N), best]

    def _with_task_from_all(self, targets: Array, q: Array) -> tuple[Array, Array]:
        """Points (N, S, n) with x from q and stored positions, and their distances in xi, (N, S), infinite for none."""
        N, n = q.shape
        near_phi = self.starts.nearest(targets, RULES.near_phi, n)
        starts = np.concatenate([q[None], near_phi, self.starts.nearest(targets, RULES.near_x, self.boxed.m)])
        S, own = len(starts), self.boxed.of_points(q)
        start = self.boxed.of_points(starts.swapaxes(0, 1).reshape(-1, n))
        end = descend(
            self.boxed.task_equations, np.repeat(targets, S, axis=0), start, most=RULES.most, patience=RULES.patience
        )
        kept = np.flatnonzero(end.error <= DESCENT.kept)
        kept = kept[self.boxed.domain.contains(self.boxed.points(end.u[kept]))]
        shifts = self._shifts
        T = len(shifts)
        row = kept // S
        u, away = np.repeat(end.u[:, None], T, axis=1), np.full((N * S, T), np.inf)
        turn = 2 * np.pi / self.boxed.domain.half_width
        u[kept] -= np.where(self.boxed.winding, turn * np.round((end.u[kept] - own[row]) / turn), 0.0)[:, None]
        u[kept] += turn * shifts
        errors = self.boxed.xi_errors(np.repeat(targets[row], T, axis=0), u[kept].reshape(-1, n))
        away[kept] = np.linalg.norm(errors, axis=1).reshape(-1, T)
        return u.reshape(N, S * T, n), away.reshape(N, S * T)

    @cached_property
    def _shifts(self) -> Array:
        """Full turns that joints without boundaries may take where these change xi, (T, n)."""
        return np.array(list(product(*((-1, 0, 1) if winds else (0,) for winds in self.boxed.winding))), dtype=float)

    def _choose(self, u: Array, away: Array, count: int) -> Indices:
        """Up to so many of the nearest points (N, S, n) of each row that lie apart, (N, count); -1 for none."""
        N, open_to = len(u), away.copy()
        chosen = np.full((N, count), -1)
        for k in range(count):
            which = np.argmin(open_to, axis=1)
            good = np.isfinite(open_to[np.arange(N), which])
            chosen[good, k] = which[good]
            gap = np.abs(u - u[np.arange(N), which][:, None]).max(axis=2)
            open_to[gap < RULES.apart] = np.inf
        return chosen
