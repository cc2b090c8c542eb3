"""Angles, leaks, conditioning and orientation of coordinate gradients at joint positions."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from orthocas.casadi_tools.blocks import MANY
from orthocas.casadi_tools.threads import in_threads
from orthocas.checks import Array
from orthocas.coordinates.map import CoordinateMap
from orthocas.judging.by_lapack import judge_by_lapack
from orthocas.judging.formulas import MOST_JOINTS, judge_by_columns
from orthocas.problem import Problem, task_jacobians
from orthocas.samples import Samples, samples_at

_CHUNK = 40_000  # joint positions evaluated at once
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
        starts = range(0, max(len(points), 1), _CHUNK)
        parts = [_judged(problem, coordinates, points[start : start + _CHUNK]) for start in starts]
        together = in_threads(lambda name: np.concatenate([part[name] for part in parts]), list(parts[0]))
        found = dict(zip(parts[0], together, strict=True))
        return cls(**{"metric_mutual_cosines": found["mutual_cosines"], **found})


def _judged(problem: Problem, coordinates: CoordinateMap, points: Array) -> dict[str, Array]:
    """The fields of `Judged` by name, for so few joint positions that all intermediate values have room in memory."""
    samples = samples_at(problem, points)
    kept = np.ones(len(points), dtype=bool)
    if len(samples) < len(points):
        kept = np.asarray((task_jacobians(problem, points) != 0).any(axis=2).all(axis=1))
    J = coordinates.jacobian(samples.points)
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        squares = np.einsum("sij,sij->si", J, J)
    alive = ((squares > 0) & (squares < _LONGEST**2)).all(axis=1)  # false for NaN, as grown coordinates have it
    kept[kept] = alive
    if not alive.all():
        samples, J = samples[alive], J[alive]
    return {"kept": kept, "points": samples.points, "jacobian": J, **judge(samples, J)}


def judge(samples: Samples, J: Array) -> dict[str, Array]:
    """Judge gradients J (N, r, n) at N samples, none of them zero.

    Returns:
        task_cosines, mutual_cosines, metric_mutual_cosines, leak_sines, conditioning and signs, see `Judged`; without
        metric_mutual_cosines if A is the identity, where they are the others.
    """
    few = len(J) < MANY or J.shape[2] > MOST_JOINTS
    return judge_by_lapack(samples, J) if few else judge_by_columns(samples, J)


def in_the_metric(samples: Samples, J: Array) -> tuple[Array, Array, Array]:
    """Sines of the leaks (N, r), conditioning (N,) and signs of det J (N,), for gradients J (N, r, n) without zeros."""
    found = judge(samples, J)
    return found["leak_sines"], found["conditioning"], found["signs"]
