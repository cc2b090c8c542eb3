"""The worst points of a chart: a search of the domain for the least conditioning and for folds (ours)."""

from dataclasses import dataclass

import numpy as np

from orthocas.checks import Array
from orthocas.coordinates.map import CoordinateMap
from orthocas.domains import contains, sample_heavily
from orthocas.judging.gradients import Judged
from orthocas.problem import Problem

CANDIDATES = 6000
_DESCENTS = 300  # of the worst candidates
_STEPS = 15
_FIRST_STEP = 0.3  # of the half-widths
_MOVED = 0.4  # share of the joints that move in a step


@dataclass(frozen=True, eq=False)
class WorstPoints:
    """Points of least conditioning, the worst one first."""

    points: Array  #: q, (k, n)
    conditioning: Array  #: signed conditioning, (k,), < 0 where the chart folds over

    @property
    def least(self) -> float:
        """Least conditioning found; NaN if it has no value anywhere."""
        return float(self.conditioning[0]) if len(self.conditioning) else float("nan")

    @property
    def told(self) -> str:
        """The least conditioning and how it was searched."""
        found = f"{self.least:.3f}" if self.least >= 0 else "0, the chart FOLDS OVER"
        return f"{found} ({len(self.points)} descents from {CANDIDATES} points, many in corners)"

    def below(self, bound: float) -> Array:
        """Points with less conditioning than that, (l, n)."""
        return self.points[self.conditioning < bound]


def worst_points(problem: Problem, coordinates: CoordinateMap, seed: int = 0) -> WorstPoints:
    """Search the domain: uniform candidates, others near faces and corners, then local descent from the worst.

    Folds of charts lie in corners and in thin wedges, which uniform samples miss. Descent is a random search that keeps
    what is worse and in the domain. Points where a gradient vanishes, or a grown coordinate has no value, are left out.

    Args:
        problem: problem of the coordinates.
        coordinates: the coordinates.
        seed: seed of candidates and steps.
    """
    rng = np.random.default_rng((seed, CANDIDATES))
    points = sample_heavily(problem.domain, CANDIDATES, (seed, CANDIDATES, 1))
    u = (points - problem.domain.centre) / problem.domain.half_width
    found = _signed_conditioning(problem, coordinates, u)
    u, found = u[np.isfinite(found)], found[np.isfinite(found)]
    orientation = 1.0 if np.sum(found >= 0) >= len(found) / 2 else -1.0
    order = np.argsort(orientation * found)[:_DESCENTS]
    u, found = u[order], orientation * found[order]
    step = np.full(len(u), _FIRST_STEP)
    for _ in range(_STEPS):
        moves = rng.normal(size=u.shape) * (rng.uniform(size=u.shape) < _MOVED)
        tried = np.clip(u + step[:, None] * moves, -1, 1)
        values = orientation * _signed_conditioning(problem, coordinates, tried)
        worse = values < found
        u[worse], found[worse] = tried[worse], values[worse]
        step *= np.where(worse, 1.5, 0.8)
    order = np.argsort(found)
    return WorstPoints(_joint_positions(problem, u[order]), found[order])


def _signed_conditioning(problem: Problem, coordinates: CoordinateMap, u: Array) -> Array:
    """Conditioning times the sign of det J at points of the cube, (N,); NaN outside the domain."""
    points = _joint_positions(problem, u)
    judged = Judged.at(problem, coordinates, points)
    values = np.full(len(u), np.nan)
    values[judged.kept] = judged.signs * judged.conditioning
    return np.where(contains(problem.domain, points), values, np.nan)


def _joint_positions(problem: Problem, u: Array) -> Array:
    """q of points u of the cube [-1, 1]^n."""
    q: Array = problem.domain.centre + problem.domain.half_width * u
    return q
