"""Angles, leaks, conditioning and orientation of coordinate gradients at joint positions."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from orthocas.casadi_tools.threads import in_threads
from orthocas.checks import Array
from orthocas.coordinates.map import CoordinateMap
from orthocas.fitting.loss import pairs
from orthocas.problem import Problem, task_jacobians
from orthocas.samples import Samples, samples_at

_CHUNK = 40_000  # joint positions evaluated at once
_PIECE = 2500  # of these, judged by a thread at once
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
        return cls(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))

    def of_coordinates(self, chosen: Sequence[int]) -> Self:
        """The same without the other coordinates. Conditioning and signs are still those of all."""
        columns = list(chosen)
        kept = [k for k, pair in enumerate(pairs(self.jacobian.shape[1])) if set(pair) <= set(columns)]
        shortened = {
            "jacobian": self.jacobian[:, columns],
            "task_cosines": self.task_cosines[:, :, columns],
            "leak_sines": self.leak_sines[:, columns],
            "mutual_cosines": self.mutual_cosines[:, kept],
            "metric_mutual_cosines": self.metric_mutual_cosines[:, kept],
        }
        return type(self)(**({part.name: getattr(self, part.name) for part in fields(self)} | shortened))


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
    lengths = _lengths(J)
    measured = (lengths > 0) & (lengths < _LONGEST)  # false for NaN, as grown coordinates have it
    alive: NDArray[np.bool_] = np.asarray(measured.all(axis=1))
    kept[kept] = alive
    if not alive.all():
        samples, J, lengths = samples[alive], J[alive], lengths[alive]
    raised = samples.raised(J)
    first, second = (np.array([pair[k] for pair in pairs(J.shape[1])], dtype=int) for k in (0, 1))
    products = np.einsum("spn,spn->sp", raised[:, first], J[:, second])
    metric_lengths = _metric_lengths(J, raised)
    leak_sines, conditioning, signs = in_the_metric(samples, J)
    return (
        kept,
        samples.points,
        J,
        samples.unit_task_gradients @ (J / lengths[:, :, None]).transpose(0, 2, 1),
        products / (_lengths(raised)[:, first] * lengths[:, second]),
        leak_sines,
        products / (metric_lengths[:, first] * metric_lengths[:, second]),
        conditioning,
        signs,
    )


def _lengths(vectors: Array) -> Array:
    """Euclidean norms of vectors (N, k, n), (N, k)."""
    squares: Array = np.einsum("skn,skn->sk", vectors, vectors)
    if squares.size and not (squares.max() < _LONGEST and squares.min() > 1 / _LONGEST):  # or with NaN
        return np.asarray(np.linalg.norm(vectors, axis=2))
    return np.asarray(np.sqrt(squares))


def in_the_metric(samples: Samples, J: Array) -> tuple[Array, Array, Array]:
    """Sines of the leaks (N, r), conditioning (N,) and signs of det J (N,), for gradients J (N, r, n) without zeros."""
    raised = samples.raised(J)
    lengths = _metric_lengths(J, raised)[:, :, None]
    along = samples.task_basis @ (J / lengths).transpose(0, 2, 1)  # (N, m, r)
    return (
        np.sqrt((along**2).sum(axis=1)),
        _smallest_singular_values(J / lengths, raised / lengths, along),
        np.sign(np.linalg.det(np.concatenate([samples.task_jacobian, J], axis=1))),
    )


def _metric_lengths(J: Array, raised: Array) -> Array:
    """|v|_A^-1 of the gradients v, (N, r)."""
    lengths: Array = np.sqrt(np.einsum("sjn,sjn->sj", J, raised))
    return lengths


def _smallest_singular_values(unit: Array, raised: Array, along: Array) -> Array:
    """Roots of the smallest eigenvalues of the Gram matrix [[I, E v], [v^T E^T, v^T A^-1 v]], (N,).

    Args:
        unit: gradients v of unit length in the metric, (N, r, n).
        raised: A^-1 v, (N, r, n).
        along: E v, components along an A-orthonormal basis E of the task gradients, (N, m, r).
    """
    m = along.shape[1]
    identity = np.broadcast_to(np.eye(m), (len(unit), m, m))
    above = np.concatenate([identity, along], axis=2)
    below = np.concatenate([along.transpose(0, 2, 1), raised @ unit.transpose(0, 2, 1)], axis=2)
    gram = np.concatenate([above, below], axis=1)
    return np.sqrt(np.maximum(np.linalg.eigvalsh(gram)[:, 0], 0.0))
