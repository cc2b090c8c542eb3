"""The worst points of a chart: a search of the domain for the least conditioning and for folds."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from orthocas.charts.coordinates import CoordinateMap
from orthocas.charts.point_quality import Judged
from orthocas.tasks.domains import Domain, contains, sample_heavily
from orthocas.tasks.problem import Problem
from orthocas.tools.checks import Array

CANDIDATES = 6000
_DESCENTS, _STEPS = 300, 15  # of the worst candidates
_KEPT, _MORE_STEPS = 60, 150  # the worst of them go on, if the result is to be printed
_FIRST_STEP, _LAST_STEP = 0.3, 1e-4  # of the half-widths
_MOVED = 0.4  # share of the joints that move in a step

Value = Callable[[Array], Array]  #: u (N, n) -> (N,), NaN where there is no value


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
    def explained(self) -> str:
        """The least conditioning and how it was searched."""
        found = f"{self.least:.3f}" if self.least >= 0 else "0, the chart FOLDS OVER"
        return f"{found} ({len(self.points)} descents from {CANDIDATES} points, many in corners)"

    def below(self, bound: float) -> Array:
        """Points with less conditioning than that, (l, n)."""
        return self.points[self.conditioning < bound]


def worst_points(problem: Problem, coordinates: CoordinateMap, seed: int = 0, *, thorough: bool = False) -> WorstPoints:
    """Search the domain: uniform candidates, others near faces and corners, then descent from the worst (`descended`).

    Folds of charts lie in corners and in thin wedges, which uniform samples miss. Points where a gradient vanishes, or
    a grown coordinate has no value, are left out.

    Args:
        problem: problem of the coordinates.
        coordinates: the coordinates.
        seed: seed of candidates and steps.
        thorough: follow the worst descents to their ends, for a least value that is printed; fits need bad points only.
    """
    points = sample_heavily(problem.domain, CANDIDATES, (seed, CANDIDATES, 1))
    u = (points - problem.domain.centre) / problem.domain.half_width
    found = _signed_conditioning(problem, coordinates, u)
    orientation = 1.0 if np.sum(found >= 0) >= np.isfinite(found).sum() / 2 else -1.0
    u, found = descended(
        lambda u: orientation * _signed_conditioning(problem, coordinates, u), u, orientation * found, seed, thorough
    )
    return WorstPoints(_joint_positions(problem, u), found)


def least_in_domain(value: Value, domain: Domain, seed: int = 0) -> Array:
    """Where a function of the joint position is least, as far as a search of the domain finds it, q (n,).

    Candidates as in `worst_points`, then thorough descents.

    Args:
        value: q (N, n) -> (N,); NaN where it has none.
        domain: the domain.
        seed: seed of candidates and steps.

    Source:
        ours.
    """
    points = sample_heavily(domain, CANDIDATES, (seed, CANDIDATES, 1))

    def inside(u: Array) -> Array:
        q = domain.centre + domain.half_width * u
        return np.where(contains(domain, q), value(q), np.nan)

    u, _ = descended(inside, (points - domain.centre) / domain.half_width, value(points), seed, thorough=True)
    best: Array = domain.centre + domain.half_width * u[0]
    return best


def descended(value: Value, u: Array, found: Array, seed: int, thorough: bool) -> tuple[Array, Array]:
    """Descents from the least of many points of the cube [-1, 1]^n; points and values, the least first.

    Each is a random search that keeps what is less: a step moves some joints at a time, so that faces and corners are
    reached, and its size follows success. In 8 joints, gradients by differences cost more.

    Args:
        value: the function; NaN where it has none.
        u: points (N, n).
        found: its values there, (N,).
        seed: of the steps.
        thorough: whether the least descents go on until they gain nothing.
    """
    rng = np.random.default_rng((seed, CANDIDATES))
    order = np.argsort(found)[: min(_DESCENTS, int(np.isfinite(found).sum()))]
    u, found, step = u[order], found[order], np.full(len(order), _FIRST_STEP)
    for _ in range(_STEPS):
        _step(value, u, found, step, rng)
    order = np.argsort(found)
    u, found, step = u[order], found[order], step[order]
    for _ in range(_MORE_STEPS * thorough):
        _step(value, u[:_KEPT], found[:_KEPT], step[:_KEPT], rng)
    order = np.argsort(found)
    return u[order], found[order]


def _step(value: Value, u: Array, found: Array, step: Array, rng: np.random.Generator) -> None:
    """One step of all descents, in place."""
    moves = rng.normal(size=u.shape) * (rng.uniform(size=u.shape) < _MOVED)
    tried = np.clip(u + step[:, None] * moves, -1, 1)
    values = value(tried)
    less = values < found
    u[less], found[less] = tried[less], values[less]
    step[:] = np.maximum(_LAST_STEP, step * np.where(less, 1.5, 0.8))


def _signed_conditioning(problem: Problem, coordinates: CoordinateMap, u: Array) -> Array:
    """Conditioning times the sign of det J at points of the cube, (N,); NaN outside the domain."""
    points, values = _joint_positions(problem, u), np.full(len(u), np.nan)
    inside = np.flatnonzero(contains(problem.domain, points))
    J = problem.task.batched_jacobian(points[inside])[0]
    inside = inside[
        np.isfinite(J.reshape(len(inside), problem.m * problem.n)).all(axis=1)
    ]  # not half a turn from the reference
    judged = Judged.at(problem, coordinates, points[inside])
    values[inside[judged.kept]] = judged.signs * judged.conditioning
    return values


def _joint_positions(problem: Problem, u: Array) -> Array:
    """q of points u of the cube [-1, 1]^n."""
    q: Array = problem.domain.centre + problem.domain.half_width * u
    return q
