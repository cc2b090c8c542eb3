"""Angles, leaks, conditioning and orientation of coordinate gradients at joint positions."""

from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from orthocas.casadi_tools.threads import in_threads
from orthocas.checks import Array
from orthocas.coordinates.map import CoordinateMap
from orthocas.fitting.loss import pairs
from orthocas.judging.small_matrices import by_entry, by_sample, products, smallest_eigenvalues, whitened
from orthocas.problem import Problem, task_jacobians
from orthocas.samples import Samples, samples_at

_CHUNK = 40_000  # joint positions evaluated at once
_PIECE = 5000  # of these, judged by a thread at once
_SMALLEST_PIVOT = 1e-14  # keeps singular samples finite
_LONGEST = 1e100  # squares of longer gradients overflow: they have no value


@dataclass(frozen=True, eq=False)
class Judged:
    """The gradients at N joint positions. Positions where a gradient vanishes or has no value are left out."""

    kept: NDArray[np.bool_]  #: which of the given positions are not left out, (given,)
    points: Array  #: q, (N, n)
    jacobian: Array  #: J_xi, (N, r, n)
    task_cosines: Array  #: of [AS2023] eq. (24), Euclidean norms, (N, m, r)
    mutual_cosines: Array  #: of [AS2023] eq. (24), Euclidean norms, (N, pairs)
    leak_sines: Array  #: sin(leak_j) = |Pi_x grad_A xi_j|_A / |grad_A xi_j|_A, (N, r)
    metric_mutual_cosines: Array  #: cosines between coordinate gradients in the metric, (N, pairs)
    conditioning: Array  #: smallest singular value of [A-orthonormal task basis; unit coordinate gradients], (N,)
    signs: Array  #: of det J, (N,)

    @classmethod
    def at(cls, problem: Problem, coordinates: CoordinateMap, points: Array) -> Self:
        """Judge coordinates at joint positions (N, n)."""
        parts: list[tuple[Any, ...]] = []
        for start in range(0, max(len(points), 1), _CHUNK):
            sampled = _Sampled.at(problem, coordinates, points[start : start + _CHUNK])
            parts += in_threads(sampled.judged, range(0, max(len(sampled.points), 1), _PIECE))
        found = cls(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))
        return replace(found, metric_mutual_cosines=found.mutual_cosines) if problem.metric.is_identity else found


@dataclass(frozen=True, eq=False)
class _Sampled:
    """What CasADi evaluates at joint positions. The rest is NumPy, which threads share."""

    points: Array  #: (N, n)
    samples: Samples  #: at those positions where no task gradient vanishes
    jacobian: Array  #: J_xi there
    kept: NDArray[np.bool_]  #: which positions these are, (N,)

    @classmethod
    def at(cls, problem: Problem, coordinates: CoordinateMap, points: Array) -> Self:
        """Evaluate at points (N, n)."""
        samples = samples_at(problem, points)
        kept = np.ones(len(points), dtype=bool)
        if len(samples) < len(points):
            kept = np.asarray((task_jacobians(problem, points) != 0).any(axis=2).all(axis=1))
        return cls(points, samples, coordinates.jacobian(samples.points), kept)

    def judged(self, start: int) -> tuple[Any, ...]:
        """The fields of `Judged` for one piece of the positions."""
        kept = self.kept[start : start + _PIECE].copy()
        first = int(np.count_nonzero(self.kept[:start]))
        part = slice(first, first + int(np.count_nonzero(kept)))
        return _judged(self.samples[part], self.jacobian[part], kept)


def _judged(samples: Samples, J: Array, kept: NDArray[np.bool_]) -> tuple[Any, ...]:
    """The fields of `Judged` for samples with coordinate gradients J (N, r, n). `kept` tells which positions remain."""
    lengths = _lengths(by_entry(J))
    measured = (lengths > 0) & (lengths < _LONGEST)  # false for NaN, as grown coordinates have it
    alive: NDArray[np.bool_] = np.asarray(measured.all(axis=0))
    kept[kept] = alive
    if not alive.all():
        samples, J, lengths = samples[alive], J[alive], lengths[:, alive]
    metric = _InTheMetric.of(samples, J)
    unit_task = metric.task_gradients / _lengths(metric.task_gradients)[:, None]
    first, second = (np.array([pair[k] for pair in pairs(J.shape[1])], dtype=int) for k in (0, 1))
    mutual = (metric.gradients[first] * metric.covectors[second]).sum(axis=1)
    return (
        kept,
        samples.points,
        J,
        by_sample(products(unit_task, metric.covectors / lengths[:, None])),
        by_sample(mutual / (_lengths(metric.gradients)[first] * lengths[second])),
        by_sample(metric.leak_sines),
        by_sample(mutual / (metric.lengths[first] * metric.lengths[second])),
        metric.conditioning,
        signs(samples.task_jacobian, J),
    )


def _lengths(vectors: Array) -> Array:
    """Euclidean norms of vectors (k, n, N), (k, N)."""
    with np.errstate(over="ignore", under="ignore"):
        squares: Array = (vectors * vectors).sum(axis=1)
    if squares.size and not (squares.max() < _LONGEST and squares.min() > 1 / _LONGEST):  # or with NaN
        return np.asarray(np.linalg.norm(vectors, axis=1))
    return np.asarray(np.sqrt(squares))


def in_the_metric(samples: Samples, J: Array) -> tuple[Array, Array, Array]:
    """Sines of the leaks (N, r), conditioning (N,) and signs of det J (N,), for gradients J (N, r, n) without zeros."""
    metric = _InTheMetric.of(samples, J)
    return by_sample(metric.leak_sines), metric.conditioning, signs(samples.task_jacobian, J)


def signs(task_jacobian: Array, J: Array) -> Array:
    """Signs of det [J_x; J_xi], (N,)."""
    return np.asarray(np.sign(np.linalg.det(np.concatenate([task_jacobian, J], axis=1))))


@dataclass(frozen=True, eq=False)
class _InTheMetric:
    """Gradients of task and coordinates at N samples, entry by entry."""

    task_gradients: Array  #: A^-1 v of the task's rows v, (m, n, N)
    covectors: Array  #: rows of J_xi, (r, n, N)
    gradients: Array  #: A^-1 v of them, (r, n, N)
    lengths: Array  #: |v|_A^-1 of them, (r, N)
    along: Array  #: components of the unit gradients along an A-orthonormal basis of the task's, (m, r, N)

    @classmethod
    def of(cls, samples: Samples, J: Array) -> Self:
        """For coordinate gradients J (N, r, n)."""
        task, covectors = by_entry(samples.task_jacobian), by_entry(J)
        raised, gradients = task, covectors
        if samples.metric_inverse is not None:
            inverse = by_entry(samples.metric_inverse)
            raised, gradients = products(task, inverse), products(covectors, inverse)  # A^-1 is symmetric
        gram = products(raised, task)
        scale = np.sqrt(np.einsum("iic->ic", gram))  # normalise rows first, so that units do not matter
        lengths = np.sqrt((covectors * gradients).sum(axis=1))
        shares = products(raised, covectors) / scale[:, None] / lengths
        along = whitened(gram / scale[:, None] / scale, shares, _SMALLEST_PIVOT)
        return cls(raised, covectors, gradients, lengths, along)

    @property
    def leak_sines(self) -> Array:
        """Sin(leak_j), (r, N)."""
        return np.asarray(np.sqrt((self.along**2).sum(axis=0)))

    @property
    def conditioning(self) -> Array:
        """Roots of the smallest eigenvalues of the Gram matrix [[I, E v], [v^T E^T, v^T A^-1 v]], (N,)."""
        m, r, N = self.along.shape
        gram = np.empty((m + r, m + r, N))
        gram[:m, :m] = np.eye(m)[:, :, None]
        gram[:m, m:], gram[m:, :m] = self.along, self.along.transpose(1, 0, 2)
        gram[m:, m:] = products(self.gradients, self.covectors) / self.lengths[:, None] / self.lengths
        return np.asarray(np.sqrt(smallest_eigenvalues(gram)))
