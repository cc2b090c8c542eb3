"""Linear coordinates on the base leaf, available for any number of joints."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from orthocas.casadi_tools.cached import cached_property
from orthocas.checks import Array, frozen_array
from orthocas.errors import InvalidValueError
from orthocas.growing.leaf import LeafValues, require_on_leaf
from orthocas.metrics import metric_matrices
from orthocas.problem import Problem, task_jacobians
from orthocas.samples import samples_at

_STAGES = 8  # intermediate points on the way to the desired coordinates
_ITERATIONS = 10  # Newton steps at each point
_SOLVED = 1e-12


@dataclass(frozen=True, eq=False)
class LinearLeaf:
    """xi0(q) = N^T (q - q0) for q on the leaf of q0, as in [AS2023] eq. (21).

    It is a chart where the leaf is a graph over its tangent space at q0. Its values are defined everywhere on the leaf.
    Where the leaf folds over, the Jacobian of the grown chart loses rank, which `evaluate` shows.
    """

    problem: Problem = field(repr=False)
    level: Array  #: x0 = h(q0), (m,)
    centre: Array  #: q0, (n,)
    normals: Array = field(repr=False)  #: N, (n, r), unit columns with J_x(q0) A^-1(q0) N = 0
    kind = "linear"
    turn = 0.0
    periodic = False

    def __post_init__(self) -> None:
        n, m, r = self.problem.n, self.problem.m, self.problem.r
        for name, shape in (("level", (m,)), ("centre", (n,)), ("normals", (n, r))):
            object.__setattr__(self, name, frozen_array(name, getattr(self, name), shape))
        require_on_leaf(self.problem, self.level, self.centre[None])
        if np.abs(np.linalg.norm(self.normals, axis=0) - 1).max() > 1e-9:
            raise InvalidValueError("normals", self.normals.tolist(), "columns of length 1")

    def values(self, points: Array) -> LeafValues:
        """Coordinates of points on the leaf, (N, n)."""
        gradients = np.broadcast_to(self.normals.T, (len(points), *self.normals.T.shape))
        return LeafValues((points - self.centre) @ self.normals, gradients, np.ones(len(points), dtype=bool))

    def points(self, xi: Array, near: Array | None = None) -> Array:
        """Points of the leaf (N, n) with coordinates xi (N, r); NaN where no such point exists.

        Newton's method follows the straight line from the coordinates of `near`, or of q0, to xi, and so stays on one
        sheet.
        """
        q = np.broadcast_to(self.centre, (len(xi), len(self.centre)))
        q = q if near is None else np.where(np.isfinite(near), near, q)
        start = (q - self.centre) @ self.normals
        N = np.broadcast_to(self.normals.T, (len(xi), *self.normals.T.shape))
        for share in np.linspace(0.0, 1.0, _STAGES + 1)[1:]:
            for _ in range(_ITERATIONS):
                residual = self._residual(q, start + share * (xi - start))
                if np.abs(residual).max(initial=0.0) < _SOLVED:
                    break
                J = np.concatenate([task_jacobians(self.problem, q) / self._scale, N], axis=1)
                q = q - (np.linalg.pinv(J) @ residual[:, :, None])[:, :, 0]
        solved = np.abs(self._residual(q, xi)).max(axis=1) < 1e3 * _SOLVED
        return np.where(solved[:, None], q, np.nan)

    def to_arrays(self) -> Mapping[str, Array]:
        """All arrays, for chart files."""
        return {"level": self.level, "centre": self.centre, "normals": self.normals}

    def _residual(self, q: Array, xi: Array) -> Array:
        x = self.problem.task.batched(q)[0]
        return np.concatenate([(x - self.level) / self._scale, (q - self.centre) @ self.normals - xi], axis=1)

    @cached_property
    def _scale(self) -> float:
        """Size of J_x at q0, which makes the units of the task irrelevant."""
        return float(np.linalg.norm(task_jacobians(self.problem, self.centre[None])))


def linear_leaf(problem: Problem, centre: Array) -> LinearLeaf:
    """The leaf through a joint position (n,), with coordinates along its tangent space there."""
    points = centre[None]
    normals = (metric_matrices(problem.metric, points) @ samples_at(problem, points).null_basis)[0]
    level = problem.task.batched(points)[0][0]
    return LinearLeaf(problem, level, centre, normals / np.linalg.norm(normals, axis=0))
