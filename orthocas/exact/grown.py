"""Exact coordinates grown from a base leaf, evaluated by following a flow ([AS2023] Sec. 5)."""

from dataclasses import dataclass, field

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthocas.errors import NoExpressionError
from orthocas.exact.flow import TOLERANCE, Arrival, Moved, TaskFlow
from orthocas.exact.leaf import LeafChart, LeafValues, without_turns
from orthocas.tasks.problem import Problem
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array, as_point_set

_INVERSE_TOLERANCE = 1e-12  # tolerance of the flow back from the leaf


@dataclass(frozen=True, eq=False)
class GrownCoordinates:
    """xi(q) = xi0(q_hat), where the flow along the task gradients meets the base leaf in q_hat and xi0 charts the leaf.

    J_xi = Dxi0(q_hat) dq_hat/dq, with the derivative of the flow from forward sensitivities. ([AS2023] Sec. 6 names the
    missing Jacobian as a drawback of growing.) Values are NaN where the flow runs into a singularity or ends outside
    the chart of the leaf; `pull` reports them.
    """

    problem: Problem = field(repr=False)
    leaf: LeafChart

    @property
    def r(self) -> int:
        """Number of coordinates."""
        return self.problem.r

    @property
    def label(self) -> str:
        """Short name."""
        return f"grown:{self.leaf.kind}"

    @property
    def size(self) -> int:
        """Count of the numbers that describe the chart of the leaf."""
        return sum(array.size for array in self.leaf.to_arrays().values())

    @property
    def turn(self) -> float:
        """Period of the coordinates: 2 pi on a circle, otherwise 0 (none)."""
        return self.leaf.turn

    def pull(self, points: ArrayLike, tolerance: float = TOLERANCE) -> Moved:
        """Pull points to the base leaf; the result holds the end points and the status of each.

        Args:
            points: joint positions, (N, n) or (n,) for N = 1.
            tolerance: local error of a step of the flow.
        """
        points = as_point_set("points", points, self.problem.n)[0]
        moved = self.flow.pull(points, self.leaf.level, tolerance)
        return Moved(moved.points, self._status(moved, self._on_leaf(moved)))

    def xi(self, points: Array) -> Array:
        """Coordinates (N, r) at points (N, n)."""
        moved = self.flow.pull(points, self.leaf.level)
        values = self._on_leaf(moved)
        return self._where_known(moved, values, values.xi)

    def jacobian(self, points: Array) -> Array:
        """J_xi (N, r, n) at points (N, n)."""
        moved, derivative = self.flow.pull_with_derivative(points, self.leaf.level)
        values = self._on_leaf(moved)
        return self._where_known(moved, values, values.gradients @ derivative)

    def inverse(self, phi: Array, q_start: Array) -> Array:
        """Joint positions with given task values and coordinates, (N, n), by the flow back from the leaf.

        The start (N, n) selects the whole turns and, if a linear leaf has several sheets, the sheet. Rows without a
        solution are NaN.
        """
        m, n = self.problem.m, self.problem.n
        start = self.flow.pull(q_start, self.leaf.level)
        on_leaf = self.leaf.points(phi[:, m:], np.where(start.reached[:, None], start.points, np.nan))
        found = np.isfinite(on_leaf).all(axis=1)
        solutions = np.full((len(phi), n), np.nan)
        moved = self.flow.move(on_leaf[found], phi[found, :m] - self.leaf.level, _INVERSE_TOLERANCE)
        solutions[found] = np.where(moved.reached[:, None], self._onto_task(moved.points, phi[found, :m]), np.nan)
        return q_start + without_turns(self.problem, solutions - q_start) if self.leaf.periodic else solutions

    def _onto_task(self, points: Array, x: Array) -> Array:
        """Points (N, n) after a Newton step along the task gradients to the task values x (N, m).

        The step removes the integration error, which matters if task values are large numbers.
        """
        dx = x - self.problem.task.batched(points)[0]
        return self.flow.move(points, dx, _INVERSE_TOLERANCE).points

    @property
    def functions(self) -> dict[str, ca.Function]:
        """Not available, because grown coordinates have no CasADi expression.

        Raises:
            NoExpressionError: always.
        """
        raise NoExpressionError(
            "grown coordinates are computed by integration and have no CasADi expression: "
            "evaluate them with chart.xi and chart.jacobian, or fit an expression to them with orthocas.distil"
        )

    @cached_property
    def flow(self) -> TaskFlow:
        """The flow along the task gradients."""
        return TaskFlow(self.problem)

    def _on_leaf(self, moved: Moved) -> LeafValues:
        """The leaf's chart at end points; an arbitrary point replaces those of trajectories that did not arrive."""
        return self.leaf.values(np.where(moved.reached[:, None], moved.points, self.problem.domain.centre))

    @staticmethod
    def _status(moved: Moved, values: LeafValues) -> NDArray[np.int_]:
        return np.where(moved.reached & ~values.inside, Arrival.OUTSIDE, moved.status)

    def _where_known(self, moved: Moved, values: LeafValues, results: Array) -> Array:
        known = self._status(moved, values) == Arrival.REACHED
        return np.where(known.reshape(-1, *[1] * (results.ndim - 1)), results, np.nan)
