"""Statistics of angles and leaks in reports."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Self

import numpy as np

from orthocas.casadi_tools.threads import in_threads
from orthocas.checks import Array
from orthocas.judging.gradients import Judged

_BIN = 0.1  # [deg]; 90 degrees lies in the middle of its bin
_PIECE = 2**16  # angles that a thread takes at once


def _degrees(inverse: Callable[[Array], Array], values: Array, most: int) -> tuple[Array, Array]:
    """Angles of all values [deg] in one row, and their counts in bins around 0.0, 0.1, ..., `most` degrees."""
    flat = values.ravel()
    angles = np.empty_like(flat)
    bins, ends = round(most / _BIN) + 1, (-_BIN / 2, most + _BIN / 2)

    def one_piece(start: int) -> Array:
        part = slice(start, start + _PIECE)
        angles[part] = np.degrees(inverse(flat[part]))
        return np.histogram(angles[part], bins, ends)[0].astype(float)

    return angles, sum(in_threads(one_piece, range(0, len(flat), _PIECE)), np.zeros(bins))


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
        angles, counts = _degrees(np.arccos, np.clip(cosines, -1.0, 1.0), 180)
        if angles.size == 0:
            return cls(np.nan, np.nan, np.nan, counts)
        return cls(float(angles.mean()), float(angles.std()), float(np.abs(angles - 90).max()), counts)

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
    def of_sines(cls, sines: Array) -> Self:
        """Statistics of the leaks arcsin(sines), in degrees, for sines (N, r)."""
        flat, counts = _degrees(np.arcsin, np.clip(sines, 0.0, 1.0), 90)
        leaks = flat.reshape(sines.shape)
        if leaks.size == 0:
            return cls(np.nan, np.nan, np.nan, (), counts)
        squares = (leaks**2).mean(axis=0)
        each = tuple(np.sqrt(squares).tolist())
        return cls(float(leaks.mean()), float(np.sqrt(squares.mean())), float(leaks.max()), each, counts)

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
    def of(cls, judged: Judged) -> Self:
        """The angles of all coordinates of `judged`."""
        return cls(
            AngleStatistics.of_cosines(judged.task_cosines),
            AngleStatistics.of_cosines(judged.mutual_cosines),
            LeakStatistics.of_sines(judged.leak_sines),
            AngleStatistics.of_cosines(judged.metric_mutual_cosines),
        )

    def as_dict(self) -> dict[str, dict[str, object]]:
        """Plain data: the four angles in degrees."""
        return {
            "task_angle_deg": dict(self.task_angle.as_dict()),
            "mutual_angle_deg": dict(self.mutual_angle.as_dict()),
            "leak_deg": self.leak.as_dict(),
            "metric_mutual_angle_deg": dict(self.metric_mutual_angle.as_dict()),
        }
