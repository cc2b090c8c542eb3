"""Flows along the task gradients: Dormand-Prince for many points at once, SUNDIALS for the dynamics of one."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any

import casadi as ca
import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from orthocas.errors import NoExpressionError
from orthocas.exact.leaves import LeafChart, LeafValues, remove_turns
from orthocas.tasks.problem import Problem
from orthocas.tasks.samples import Samples
from orthocas.tools.batch import Batched, dense_function
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array, as_point_set
from orthocas.tools.columns import ColumnFunction, arrange_blocks, split_by_sample


@dataclass(frozen=True, slots=True)
class FlowRules:
    """Numbers of the integration of many trajectories."""

    stages: int = 12  #: stages of the method of Dormand and Prince
    few: int = 64  #: up to this number of trajectories, a block of columns does not pay off
    first: float = 0.25  #: first step
    smallest: float = 1e-9  #: a trajectory stops if it needs a smaller step, because the field is singular there
    shrink: float = 0.2  #: smallest ratio of one step to the previous one
    grow: float = 10.0  #: largest ratio of one step to the previous one
    safety: float = 0.9  #: factor on the step size that the error estimate allows
    looser: float = 100.0  #: factor on the tolerance for tangent vectors, which may be less accurate than points
    inverse: float = 1e-12  #: tolerance of the flow from the leaf to a target


RULES = FlowRules()

TOLERANCE = 1e-10  #: default local error of a step [rad] or [m]; end points are then accurate to about 1e-8


class Arrival(IntEnum):
    """How a trajectory ended."""

    REACHED = 0  #: reached the desired task value
    SINGULAR = 1  #: stopped on the way, where the task gradients vanish or become dependent
    OUTSIDE = 2  #: reached the desired task value, but outside the chart of the base leaf


@dataclass(frozen=True, eq=False)
class Moved:
    """End points of trajectories."""

    points: Array  #: (N, n); for SINGULAR, the last point before the singularity
    status: NDArray[np.int_]  #: `Arrival` of each trajectory, (N,)

    @property
    def reached(self) -> NDArray[np.bool_]:
        """Whether each trajectory reached the desired task value, (N,)."""
        return np.asarray(self.status == Arrival.REACHED)


@dataclass(frozen=True, eq=False)
class GrownCoordinates:
    """xi(q) = xi0(q_hat), where q_hat is the point of the base leaf that the flow from q reaches, and xi0 its chart.

    The Jacobian is J_xi = Dxi0(q_hat) dq_hat/dq, with the derivative of the flow from forward sensitivities. ([AS2023]
    Sec. 6 mentions the missing Jacobian as a drawback of growing.) Values are NaN where the flow meets a singularity or
    ends outside the chart of the leaf; `pull` reports which of these happened.
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
        """Number of values that describe the chart of the leaf."""
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
        return Moved(moved.points, self._find_status(moved, self._evaluate_leaf(moved)))

    def xi(self, points: Array) -> Array:
        """Coordinates (N, r) at points (N, n)."""
        moved = self.flow.pull(points, self.leaf.level)
        values = self._evaluate_leaf(moved)
        return self._mask_unknown(moved, values, values.xi)

    def jacobian(self, points: Array) -> Array:
        """J_xi (N, r, n) at points (N, n)."""
        moved, derivative = self.flow.pull_with_derivative(points, self.leaf.level)
        values = self._evaluate_leaf(moved)
        return self._mask_unknown(moved, values, values.gradients @ derivative)

    def inverse(self, phi: Array, q_start: Array) -> Array:
        """Joint positions with given task values and coordinates, (N, n), by the flow from the leaf to the task values.

        The start (N, n) selects the full turns and, if a linear leaf has several sheets, the sheet. Rows without a
        solution are NaN.
        """
        m, n = self.problem.m, self.problem.n
        # Find the point of the leaf with these coordinates, then flow to the task values.
        start = self.flow.pull(q_start, self.leaf.level)
        on_leaf = self.leaf.points(phi[:, m:], np.where(start.reached[:, None], start.points, np.nan))
        rows = np.isfinite(on_leaf).all(axis=1)
        solutions, x = np.full((len(phi), n), np.nan), phi[rows, :m]
        moved = self.flow.move(on_leaf[rows], x - self.leaf.level, RULES.inverse)
        # A second, short flow removes the integration error, which matters for large task values.
        left = x - self.problem.task.batched(moved.points)[0]
        corrected = self.flow.move(moved.points, left, RULES.inverse).points
        solutions[rows] = np.where(moved.reached[:, None], corrected, np.nan)
        return q_start + remove_turns(self.problem, solutions - q_start) if self.leaf.periodic else solutions

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

    def _evaluate_leaf(self, moved: Moved) -> LeafValues:
        """The leaf's chart at end points; for trajectories that did not arrive, at an arbitrary point instead."""
        return self.leaf.values(np.where(moved.reached[:, None], moved.points, self.problem.domain.home))

    @staticmethod
    def _find_status(moved: Moved, values: LeafValues) -> NDArray[np.int_]:
        return np.where(moved.reached & ~values.inside, Arrival.OUTSIDE, moved.status)

    def _mask_unknown(self, moved: Moved, values: LeafValues, results: Array) -> Array:
        reached = self._find_status(moved, values) == Arrival.REACHED
        return np.where(reached.reshape(-1, *[1] * (results.ndim - 1)), results, np.nan)


@dataclass(frozen=True, eq=False)
class TaskFlow:
    """The flow dq/ds = J_x^#A dx, s in [0, 1]; it changes task values by exactly dx, and is A-orthogonal to the leaves.

    For m = 1 it is dq/ds = dx grad_A h / (dh(grad_A h)), the curve of [AS2023] eq. (23) with the task value as its
    parameter. It ends on the desired leaf without a stopping rule (ours,
    docs/explanation/derivations_exact.md#growing). For m >= 2 it follows the straight line in task coordinates. Other
    paths lead to other end points unless the distribution is involutive.
    """

    problem: Problem

    def move(self, points: Array, dx: Array, tolerance: float = TOLERANCE) -> Moved:
        """Change the task values of points (N, n) by dx (N, m).

        Args:
            points: joint positions.
            dx: desired changes of the task values.
            tolerance: local error of a step [rad] or [m].
        """
        ends, arrived = self._positions.find_end_points(points, dx, tolerance)
        return Moved(ends, np.where(arrived, Arrival.REACHED, Arrival.SINGULAR))

    def pull(self, points: Array, level: Array, tolerance: float = TOLERANCE) -> Moved:
        """Move points (N, n) along the flow to the leaf h(q) = level (m,)."""
        return self.move(points, level - self.problem.task.batched(points)[0], tolerance)

    def pull_with_derivative(self, points: Array, level: Array) -> tuple[Moved, Array]:
        """Like `pull`, and return d q_hat / dq, (N, n, n), by forward sensitivities.

        The flow maps leaves to leaves. So r vectors v that start tangent to the leaf of q stay tangent to leaves, with
        dv/ds = (df/dq) v. Each v is stored as a direction and the logarithm of its length: where flow lines converge,
        lengths decrease by many orders of magnitude, and rounding would destroy the directions. Since q_hat is constant
        along the flow, the derivative is [v_1 ... v_r] Z^T A, where Z is an A-orthonormal basis of ker J_x(q).
        """
        n, r = self.problem.n, self.problem.r
        A = self.problem.metric.evaluate(points)
        inverse = np.asarray(np.linalg.inv(A), dtype=float)
        # The initial tangent vectors are an A-orthonormal basis of ker J_x.
        samples = Samples(points, self.problem.task.evaluate_jacobian(points), inverse)
        Z = samples.null_basis
        lengths = np.linalg.norm(Z, axis=1)
        directions = (Z / lengths[:, None, :]).transpose(0, 2, 1).reshape(-1, r * n)
        starts = np.concatenate([points, directions, np.log(lengths)], axis=1)
        dx = level - self.problem.task.batched(points)[0]
        ends, arrived = self._with_tangents.find_end_points(starts, dx, TOLERANCE)
        # Recover the vectors from directions and logarithms of lengths.
        tangents = ends[:, n : n + r * n].reshape(-1, r, n) * np.exp(ends[:, n + r * n :])[:, :, None]
        moved = Moved(ends[:, :n], np.where(arrived, Arrival.REACHED, Arrival.SINGULAR))
        return moved, tangents.transpose(0, 2, 1) @ Z.transpose(0, 2, 1) @ A

    @cached_property
    def field(self) -> ca.Function:
        """q (n, 1), dx (m, 1) -> J_x^#A dx (n, 1)."""
        q, dx = ca.SX.sym("q", self.problem.n), ca.SX.sym("dx", self.problem.m)
        gradients = self.build_gradients(q)
        J = self.problem.task.jacobian_function(q)
        return dense_function("field", [q, dx], [gradients @ _solve_spd(J @ gradients, dx)])

    def build_gradients(self, q: ca.SX) -> ca.SX:
        """Gradients of the task in the metric, A^-1 J_x^T (n, m), for a symbol q ([AS2023] eq. (16))."""
        J = self.problem.task.jacobian_function(q)
        return J.T if self.problem.metric.is_identity else _solve_spd(self.problem.metric.function(q), J.T)

    @cached_property
    def _positions(self) -> BatchedFlow:
        return BatchedFlow(self.field, np.ones(self.problem.n))

    @cached_property
    def _with_tangents(self) -> BatchedFlow:
        """The flow with r tangent vectors, each stored as a unit direction u and the logarithm of its length."""
        # State: q, then r directions, then the logarithms of their lengths.
        n, m, r = self.problem.n, self.problem.m, self.problem.r
        y, dx = ca.SX.sym("y", n + r * (n + 1)), ca.SX.sym("dx", m)
        q, directions = y[:n], ca.reshape(y[n : n + r * n], n, r)
        dq = self.field(q, dx)
        # A vector changes by df/dq v. The component along v stretches it, and the rest turns it.
        turning = ca.jacobian(dq, q) @ directions
        stretching = ca.sum1(directions * turning) / ca.sum1(directions**2)
        rates = turning - directions * ca.repmat(stretching, n, 1)
        field = dense_function("field_with_tangents", [y, dx], [ca.vertcat(dq, ca.vec(rates), stretching.T)])
        return BatchedFlow(field, np.r_[np.ones(n), np.full(r * (n + 1), RULES.looser)])


def _solve_spd(A: ca.SX, B: ca.SX) -> ca.SX:
    """A^-1 B for symmetric positive definite A, with half the operations of `ca.solve`."""
    return ca.ldl_solve(B, *ca.ldl(A))


@dataclass(frozen=True, eq=False)
class BatchedFlow:
    """Integrates dy/ds = f(y, p) from s = 0 to 1 for many y and p, by the 8th-order method of Dormand and Prince.

    Coefficients and error estimate are those of `scipy.integrate.DOP853` ([HNW1993] Sec. II.10); the batching is ours.

    Args:
        field: f, (k, 1) x (l, 1) -> (k, 1).
        scale: factor on the tolerance of each state, (k,).
    """

    field: ca.Function
    scale: Array

    def find_end_points(self, starts: Array, parameters: Array, tolerance: float) -> tuple[Array, NDArray[np.bool_]]:
        """States at s = 1, (N, k), and whether each trajectory reached s = 1, (N,).

        The other trajectories stopped because steps became too short or the field was not finite. Their rows hold the
        last state.

        Args:
            starts: (N, k).
            parameters: (N, l).
            tolerance: tolerance of the local error of a step.
        """
        y, s, step = starts.copy(), np.zeros(len(starts)), np.full(len(starts), RULES.first)
        running = np.arange(len(starts))
        while running.size:
            # Try a step of each running trajectory; many trajectories use blocks of columns.
            tried = np.minimum(step[running], 1 - s[running])
            inputs = y[running], tried[:, None], parameters[running]
            if running.size <= RULES.few:
                moved, error = self._few(*inputs)
            else:
                outputs = self._many(*map(arrange_blocks, inputs))
                moved, error = (split_by_sample(out[:, None], running.size)[:, :, 0] for out in outputs)
            # Accept steps with small errors, and adapt all step sizes.
            ratio = np.nan_to_num(error[:, 0] / tolerance, nan=np.inf)
            good = ratio <= 1
            y[running[good]] = moved[good]
            s[running[good]] += tried[good]
            growth = RULES.safety * np.maximum(ratio, 1e-16) ** (-1 / 8)
            step[running] = tried * np.clip(growth, RULES.shrink, RULES.grow)
            running = running[(s[running] < 1) & (step[running] > RULES.smallest)]
        return y, s >= 1

    @cached_property
    def _few(self) -> Batched:
        return Batched(self._step)

    @cached_property
    def _many(self) -> ColumnFunction:
        return ColumnFunction(self._step)

    @cached_property
    def _step(self) -> ca.Function:
        """One step: y, step size, p -> new y and its estimated error in units of the tolerance."""
        # Slopes at the stages of the method (coefficients from SciPy), then the new state and two error estimates.
        k = self.field.size1_in(0)
        y, step, p = ca.SX.sym("y", k), ca.SX.sym("step"), ca.SX.sym("p", self.field.size1_in(1))
        method, slopes = scipy.integrate.DOP853, list[Any]()
        for i in range(RULES.stages):
            slopes.append(self.field(y + step * _sum_weighted(method.A[i, :i], slopes), p) if i else self.field(y, p))
        moved = y + step * _sum_weighted(method.B, slopes)
        # Combine the error estimates of orders 5 and 3.
        scale = ca.DM(self.scale)
        fifth = ca.sumsqr(_sum_weighted(method.E5[: RULES.stages], slopes) / scale)
        third = ca.sumsqr(_sum_weighted(method.E3[: RULES.stages], slopes) / scale)
        error = step * fifth / ca.sqrt(fifth + 0.01 * third + 1e-300)
        return dense_function("step", [y, step, p], [moved, error])


def _sum_weighted(weights: Array, slopes: list[Any]) -> Any:
    """Weighted sum without the terms of zero weight."""
    return sum(float(w) * slope for w, slope in zip(weights, slopes, strict=True) if w != 0)
