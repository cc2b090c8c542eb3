"""The interface of a chart of the base leaf S0 = {h(q) = x0}; neighbouring modules implement it."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from orthocas.errors import InvalidValueError
from orthocas.tasks.domains import Box
from orthocas.tasks.problem import Problem, task_jacobians
from orthocas.tools.checks import Array, Indices

_ON_LEAF = 1e-6  # [rad] or [m]


@dataclass(frozen=True, eq=False)
class LeafValues:
    """Coordinates of points on the base leaf."""

    xi: Array  #: (N, r)
    gradients: Array  #: d xi0 / dq along the leaf, (N, r, n)
    inside: NDArray[np.bool_]  #: which points the chart covers, (N,); the other rows are meaningless


class LeafChart(Protocol):
    """A chart xi0 of the base leaf."""

    @property
    def kind(self) -> str:
        """Short name: 'linear', 'circle' or 'disk'."""
        ...

    @property
    def level(self) -> Array:
        """Task value x0 of the leaf, (m,)."""
        ...

    def values(self, points: Array) -> LeafValues:
        """Coordinates of points on the leaf, (N, n)."""
        ...

    @property
    def turn(self) -> float:
        """Period of the coordinates: 2 pi on a circle, otherwise 0 (none)."""
        ...

    @property
    def periodic(self) -> bool:
        """Whether the coordinates stay the same under whole turns of the joints."""
        ...

    def points(self, xi: Array, near: Array | None = None) -> Array:
        """Points of the leaf (N, n) with coordinates xi (N, r); NaN where no such point exists.

        Args:
            xi: coordinates.
            near: points of the leaf, (N, n), NaN if unknown; they select one of several solutions.
        """
        ...

    def to_arrays(self) -> Mapping[str, Array | Indices]:
        """All arrays, for chart files."""
        ...


def turning_joints(problem: Problem) -> NDArray[np.bool_]:
    """Which joint positions are angles, (n,)."""
    return ~np.array(problem.robot.tree.prismatic, dtype=np.bool_)


def without_turns(problem: Problem, differences: Array) -> Array:
    """Differences of joint positions, (..., n), with angles within half a turn of 0."""
    return np.asarray(differences - 2 * np.pi * np.round(differences / (2 * np.pi)) * turning_joints(problem))


def covers(region: Box, points: Array) -> NDArray[np.bool_]:
    """Which points lie in the region, up to rounding, (N,)."""
    return np.asarray((np.abs(points - region.centre) <= region.half_width + 1e-9).all(axis=1))


def require_on_leaf(problem: Problem, level: Array, points: Array) -> None:
    """Raise InvalidValueError unless points (N, n) lie on the leaf h(q) = level (m,), relative to the size of J_x."""
    J = task_jacobians(problem, points)
    off = np.abs(problem.task.batched(points)[0] - level).max(axis=1)
    size = np.sqrt((J**2).sum(axis=(1, 2)).mean())
    if not off.max() <= _ON_LEAF * size:
        what = f"error of the task on the base leaf h(q) = {level.tolist()}"
        raise InvalidValueError(what, f"{off.max():.3g}", f"at most {_ON_LEAF * size:.3g}")
