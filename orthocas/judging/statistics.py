"""Statistics of angles and leaks in reports."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Self

import numpy as np

from orthocas.casadi_tools.threads import in_threads
from orthocas.checks import Array, Indices
from orthocas.judging.gradients import Judged
from orthocas.judging.pairs import pairs

_BIN = 0.1  # [deg]; the middle angle lies in the middle of its bin
_PIECE = 2**13  # samples that a thread takes at once


@dataclass(frozen=True, eq=False)
class _Sums:
    """Sums over the samples of some angles in degrees, each angle a column."""

    count: int  #: of samples
    middle: float  #: 90 or 0
    first: Array  #: sum of deviations from the middle, (k,)
    second: Array  #: sum of their squares, (k,)
    largest: Array  #: largest absolute deviation, (k,)
    counts: Array  #: in bins around 0.0, 0.1, ... degrees, (k, bins)

    @classmethod
    def of(cls, inverse: Callable[[Array], Array], values: Array, middle: float, most: int) -> Self:
        """Of inverse(values), for values (N, k); angles are at most `most` degrees."""
        N, k = values.shape
        bins = round(most / _BIN) + 1
        first_bins = bins * np.arange(k)[:, None]

        def one_piece(start: int) -> tuple[Array, Array, Array, Indices]:
            angles = np.degrees(inverse(np.ascontiguousarray(values[start : start + _PIECE].T)))
            places = (angles / _BIN + 0.5).astype(np.intp) + first_bins
            counts = np.bincount(places.ravel(), minlength=k * bins).reshape(k, bins)
            angles -= middle
            return angles.sum(axis=1), (angles * angles).sum(axis=1), np.abs(angles).max(axis=1), counts

        first, second, largest, counts = np.zeros(k), np.zeros(k), np.zeros(k), np.zeros((k, bins))
        for part in in_threads(one_piece, range(0, N, _PIECE) if k else ()):
            first, second, counts = first + part[0], second + part[1], counts + part[3]
            largest = np.maximum(largest, part[2])
        return cls(N, middle, first, second, largest, counts)

    def __getitem__(self, columns: Sequence[int]) -> "_Sums":
        """Those of some of the angles."""
        chosen = list(columns)
        parts = (self.first[chosen], self.second[chosen], self.largest[chosen], self.counts[chosen])
        return _Sums(self.count, self.middle, *parts)

    @property
    def empty(self) -> bool:
        """Whether there are no angles."""
        return self.count * len(self.first) == 0

    @property
    def mean(self) -> float:
        """Mean deviation."""
        return float(self.first.sum() / (self.count * len(self.first)))

    @property
    def mean_square(self) -> float:
        """Mean squared deviation."""
        return float(self.second.sum() / (self.count * len(self.first)))


def _sums_of_cosines(cosines: Array) -> _Sums:
    """Of arccos(cosines), for cosines (N, k)."""
    return _Sums.of(np.arccos, np.clip(cosines, -1.0, 1.0), 90.0, 180)


@dataclass(frozen=True, eq=False)
class AngleStatistics:
    """Angles between gradients over all samples and pairs, in degrees. 90 is perfect; NaN if there are no pairs."""

    mean: float
    std: float
    max: float  #: largest deviation from 90 degrees
    histogram: Array = field(repr=False)  #: counts in bins of 0.1 degree, centred at 0.0, 0.1, ..., 180.0

    @classmethod
    def of_cosines(cls, cosines: Array) -> Self:
        """Statistics of the angles arccos(cosines), in degrees."""
        return cls.of_sums(_sums_of_cosines(cosines.reshape(-1, 1)))

    @classmethod
    def of_sums(cls, sums: _Sums) -> Self:
        """Statistics of all angles of some sums."""
        counts = sums.counts.sum(axis=0)
        if sums.empty:
            return cls(np.nan, np.nan, np.nan, counts)
        spread = np.sqrt(max(sums.mean_square - sums.mean**2, 0.0))
        return cls(sums.middle + sums.mean, float(spread), float(sums.largest.max()), counts)

    def as_dict(self) -> dict[str, float]:
        """Mean, standard deviation and largest deviation [deg]."""
        return {"mean": self.mean, "std": self.std, "max": self.max}


@dataclass(frozen=True, eq=False)
class LeakStatistics:
    """Leaks of coordinates over all samples, in degrees. 0 is perfect; NaN if there are no coordinates.

    The leak of a coordinate is the angle in the metric between its gradient and the space orthogonal to the task:
    sin(leak_j) = |Pi_x grad_A xi_j|_A / |grad_A xi_j|_A with the A-orthogonal projector Pi_x on the task gradients. It
    does not depend on the choice of task coordinates.

    Source:
        ours, docs/angles.md.
    """

    mean: float
    rms: float
    max: float
    rms_of_each: tuple[float, ...]  #: root mean square of each coordinate
    histogram: Array = field(repr=False)  #: counts in bins of 0.1 degree, centred at 0.0, 0.1, ..., 90.0

    @classmethod
    def of_sums(cls, sums: _Sums) -> Self:
        """Statistics of the leaks of some coordinates, each a column of the sums."""
        counts = sums.counts.sum(axis=0)
        if sums.empty:
            return cls(np.nan, np.nan, np.nan, (), counts)
        each = tuple(np.sqrt(sums.second / sums.count).tolist())
        return cls(sums.mean, float(np.sqrt(sums.mean_square)), float(sums.largest.max()), each, counts)

    def as_dict(self) -> dict[str, object]:
        """Mean, root mean square and largest leak, and the root mean square of each coordinate [deg]."""
        return {"mean": self.mean, "rms": self.rms, "max": self.max, "rms_of_each": list(self.rms_of_each)}


@dataclass(frozen=True, eq=False)
class Angles:
    """Angles of some coordinates: those of [AS2023] eq. (24), with Euclidean norms, and ours, in the metric."""

    task_angle: AngleStatistics  #: between each dxi_j and grad_A h_i, in the paper's cosines
    mutual_angle: AngleStatistics  #: between two coordinates, in the paper's cosines
    leak: LeakStatistics  #: in the metric
    metric_mutual_angle: AngleStatistics  #: between two coordinates, in the metric

    @classmethod
    def of(cls, judged: Judged, chosen: Sequence[Sequence[int]]) -> "list[Angles]":
        """The angles of each of some sets of coordinates of `judged`."""
        N, m, r = judged.task_cosines.shape
        task = _sums_of_cosines(judged.task_cosines.reshape(N, m * r))
        mutual = _sums_of_cosines(judged.mutual_cosines)
        same = judged.metric_mutual_cosines is judged.mutual_cosines
        in_metric = mutual if same else _sums_of_cosines(judged.metric_mutual_cosines)
        leak = _Sums.of(np.arcsin, np.clip(judged.leak_sines, 0.0, 1.0), 0.0, 90)
        found = []
        for some in chosen:
            together = [k for k, pair in enumerate(pairs(r)) if set(pair) <= set(some)]
            found.append(
                cls(
                    AngleStatistics.of_sums(task[[i * r + j for i in range(m) for j in some]]),
                    AngleStatistics.of_sums(mutual[together]),
                    LeakStatistics.of_sums(leak[some]),
                    AngleStatistics.of_sums(in_metric[together]),
                )
            )
        return found

    def as_dict(self) -> dict[str, dict[str, object]]:
        """Plain data: the four angles in degrees."""
        return {
            "task_angle_deg": dict(self.task_angle.as_dict()),
            "mutual_angle_deg": dict(self.mutual_angle.as_dict()),
            "leak_deg": self.leak.as_dict(),
            "metric_mutual_angle_deg": dict(self.metric_mutual_angle.as_dict()),
        }
