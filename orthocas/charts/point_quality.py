"""How good coordinates are at given joint positions."""

from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from orthocas.charts.angles import MOST_JOINTS, judge_by_columns, judge_by_lapack
from orthocas.charts.coordinates import CoordinateMap
from orthocas.tasks.domains import bounds_of, contains
from orthocas.tasks.problem import Problem, distance_from_half_a_turn, task_jacobians
from orthocas.tasks.samples import Samples, samples_at
from orthocas.tools.batch import in_threads
from orthocas.tools.checks import Array
from orthocas.tools.columns import MANY
from orthocas.tools.display import Shown, number_list

_CHUNK = 40_000  # joint positions evaluated at once
_NEAR_THE_END = 0.1  # cos(angle / 2) of turns beyond which rounding of J_x shows
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
    found = judge(samples, J)
    ends = distance_from_half_a_turn(problem, samples.points) < _NEAR_THE_END
    if ends.any():
        for name, values in zip(
            ("leak_sines", "conditioning", "signs"), _by_frame(problem, samples[ends], J[ends]), strict=True
        ):
            found[name][ends] = values
    return {"kept": kept, "points": samples.points, "jacobian": J, **found}


def _by_frame(problem: Problem, samples: Samples, J: Array) -> tuple[Array, Array, Array]:
    """`in_the_metric` by the frame Jacobian, whose rows span the same and keep their rank where J_x loses it."""
    rows = problem.task.batched_frame_jacobian(samples.points)[0].reshape(samples.task_jacobian.shape)
    return in_the_metric(replace(samples, task_jacobian=rows), J)


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


@dataclass(frozen=True, eq=False, repr=False)
class PointQuality(Shown):
    """Quality of a chart at one joint position, or at each of N. NaN where a gradient vanishes or has no value."""

    leak_deg: Array  #: leak of each coordinate [deg], (r,) or (N, r); 0 is perfect
    conditioning: Array  #: smallest singular value of the normalised gradients, () or (N,); 1 perfect, 0 singular
    boundary_distance: (
        Array  #: to the nearest face of the domain, () or (N,), <= 0 outside, inf for a torus [rad] or [m]
    )

    def facts(self) -> dict[str, str]:
        """The worst values of the set, or those of the one position."""
        leak, conditioning, distance = np.atleast_2d(self.leak_deg), np.ravel(self.conditioning), self.boundary_distance
        known = np.isfinite(conditioning)
        single = np.ndim(self.conditioning) == 0
        facts = {"quality": "at one joint position" if single else f"at {len(leak)} joint positions"}
        if known.any():
            facts["leak"] = f"{'' if single else 'at most '}{number_list(leak[known].max(axis=0))} deg"
            facts["conditioning"] = f"{'' if single else 'at least '}{conditioning[known].min():.3g}"
        if np.size(distance):
            facts["boundary"] = f"{'' if single else 'at least '}{np.min(distance):.3g} away, in rad or m; < 0 outside"
        if not known.all():
            facts["left out"] = f"{int((~known).sum())}, where a gradient vanishes or has no value"
        return facts

    def as_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return {
            "leak_deg": self.leak_deg.tolist(),
            "conditioning": self.conditioning.tolist(),
            "boundary_distance": self.boundary_distance.tolist(),
        }


def point_quality(problem: Problem, coordinates: CoordinateMap, points: Array) -> PointQuality:
    """Quality at each joint position (N, n)."""
    judged = Judged.at(problem, coordinates, points)
    leak, conditioning = np.full((len(points), coordinates.r), np.nan), np.full(len(points), np.nan)
    leak[judged.kept] = np.degrees(np.arcsin(np.clip(judged.leak_sines, 0.0, 1.0)))
    conditioning[judged.kept] = judged.conditioning
    lower, upper = bounds_of(problem.domain)
    distance = np.minimum(points - lower, upper - points).min(axis=1)
    distance = np.where(contains(problem.domain, points), distance, np.minimum(distance, 0.0))  # too near a singularity
    return PointQuality(leak, conditioning, distance)
