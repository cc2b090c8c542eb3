"""Flows along the task gradients, which carry coordinates from leaf to leaf ([AS2023] Sec. 5)."""

from dataclasses import dataclass
from enum import IntEnum

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from orthocas.casadi_tools.batch import dense_function
from orthocas.casadi_tools.cached import cached_property
from orthocas.checks import Array
from orthocas.growing.dormand_prince import BatchedFlow
from orthocas.metrics import metric_matrices
from orthocas.problem import Problem, task_jacobians
from orthocas.samples import Samples

TOLERANCE = 1e-10  #: default local error of a step [rad] or [m]; end points are then accurate to about 1e-8
_LOOSER = 100.0  # factor on the tolerance of tangent vectors, which need fewer digits than points


class Arrival(IntEnum):
    """How a trajectory ended."""

    REACHED = 0  #: reached the desired task value
    SINGULAR = 1  #: stopped on the way, where the task gradients vanish or become dependent
    OUTSIDE = 2  #: reached the desired task value, but outside the chart of the base leaf


@dataclass(frozen=True, eq=False)
class Moved:
    """End points of trajectories."""

    points: Array  #: (N, n); for SINGULAR, the last point before the singularity
    status: NDArray[np.int_]  #: `Arrival` of each trajectory, (N,), int

    @property
    def reached(self) -> NDArray[np.bool_]:
        """Which trajectories reached the desired task value, (N,)."""
        return np.asarray(self.status == Arrival.REACHED)


@dataclass(frozen=True, eq=False)
class TaskFlow:
    """The flow dq/ds = J_x^#A dx, s in [0, 1], which changes task values by exactly dx, A-orthogonally to the leaves.

    For m = 1 it is dq/ds = dx grad_A h / (dh(grad_A h)), the curve of [AS2023] eq. (23) with the task value as its
    parameter. It ends on the desired leaf without a stopping rule (ours, docs/derivations.md#growing). For m >= 2 it
    follows the straight line in task coordinates; other paths end elsewhere unless the distribution is involutive.
    """

    problem: Problem

    def move(self, points: Array, dx: Array, tolerance: float = TOLERANCE) -> Moved:
        """Change the task values of points (N, n) by dx (N, m).

        Args:
            points: joint positions.
            dx: desired changes of the task values.
            tolerance: local error of a step [rad] or [m].
        """
        ends, arrived = self._positions.end_points(points, dx, tolerance)
        return Moved(ends, np.where(arrived, Arrival.REACHED, Arrival.SINGULAR))

    def pull(self, points: Array, level: Array, tolerance: float = TOLERANCE) -> Moved:
        """Pull points (N, n) to the leaf h(q) = level (m,)."""
        return self.move(points, level - self.problem.task.batched(points)[0], tolerance)

    def pull_with_derivative(self, points: Array, level: Array, tolerance: float = TOLERANCE) -> tuple[Moved, Array]:
        """Do the same as `pull`, and return d q_hat / dq, (N, n, n), by forward sensitivities.

        The flow maps leaves to leaves, so r vectors v that start tangent to the leaf of q stay tangent to leaves, with
        dv/ds = (df/dq) v. The code stores each v as a direction and the logarithm of its length. Where flow lines
        converge, lengths fall by many orders of magnitude, and rounding would destroy the directions of v itself. Since
        q_hat is constant along the flow, the derivative is [v_1 ... v_r] Z^T A, where Z is an A-orthonormal basis of
        ker J_x(q).
        """
        n, r = self.problem.n, self.problem.r
        A = metric_matrices(self.problem.metric, points)
        inverse = np.asarray(np.linalg.inv(A), dtype=float)
        samples = Samples(points, task_jacobians(self.problem, points), inverse)
        Z = samples.null_basis
        lengths = np.linalg.norm(Z, axis=1)
        directions = (Z / lengths[:, None, :]).transpose(0, 2, 1).reshape(-1, r * n)
        starts = np.concatenate([points, directions, np.log(lengths)], axis=1)
        dx = level - self.problem.task.batched(points)[0]
        ends, arrived = self._with_tangents.end_points(starts, dx, tolerance)
        tangents = ends[:, n : n + r * n].reshape(-1, r, n) * np.exp(ends[:, n + r * n :])[:, :, None]
        moved = Moved(ends[:, :n], np.where(arrived, Arrival.REACHED, Arrival.SINGULAR))
        return moved, tangents.transpose(0, 2, 1) @ Z.transpose(0, 2, 1) @ A

    @cached_property
    def field(self) -> ca.Function:
        """q (n, 1), dx (m, 1) -> J_x^#A dx (n, 1)."""
        q, dx = ca.SX.sym("q", self.problem.n), ca.SX.sym("dx", self.problem.m)
        gradients = self.gradients(q)
        J = self.problem.task.jacobian_function(q)
        return dense_function("field", [q, dx], [gradients @ _spd_solve(J @ gradients, dx)])

    def gradients(self, q: ca.SX) -> ca.SX:
        """Gradients of the task in the metric, A^-1 J_x^T (n, m), for a symbol q ([AS2023] eq. (16))."""
        J = self.problem.task.jacobian_function(q)
        return J.T if self.problem.metric.is_identity else _spd_solve(self.problem.metric.function(q), J.T)

    @cached_property
    def _positions(self) -> BatchedFlow:
        return BatchedFlow(self.field, np.ones(self.problem.n))

    @cached_property
    def _with_tangents(self) -> BatchedFlow:
        """The flow with r tangent vectors, stored as directions u with |u| = 1 and logarithms of lengths."""
        n, m, r = self.problem.n, self.problem.m, self.problem.r
        y, dx = ca.SX.sym("y", n + r * (n + 1)), ca.SX.sym("dx", m)
        q, directions = y[:n], ca.reshape(y[n : n + r * n], n, r)
        dq = self.field(q, dx)
        turning = ca.jacobian(dq, q) @ directions
        stretching = ca.sum1(directions * turning) / ca.sum1(directions**2)
        rates = turning - directions * ca.repmat(stretching, n, 1)
        field = dense_function("field_with_tangents", [y, dx], [ca.vertcat(dq, ca.vec(rates), stretching.T)])
        return BatchedFlow(field, np.r_[np.ones(n), np.full(r * (n + 1), _LOOSER)])


def _spd_solve(A: ca.SX, B: ca.SX) -> ca.SX:
    """A^-1 B for symmetric positive definite A, with half the operations of `ca.solve`."""
    return ca.ldl_solve(B, *ca.ldl(A))
