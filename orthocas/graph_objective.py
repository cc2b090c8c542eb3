"""The loss of any family as one CasADi graph, with its gradient by symbolic differentiation."""

import casadi as ca
import numpy as np

from orthocas.checks import Array
from orthocas.loss import LossShape, Weights
from orthocas.parametrisations import Family, joint_derivatives
from orthocas.samples import Samples


class GraphObjective:
    """Mean loss (25) of any family on fixed samples, as an MX graph with samples side by side as columns.

    Args:
        family: the coordinates.
        samples: fixed samples of the family's joints.
        weights: of the loss.
        start: parameters, (size,), whose orientation the regularity term keeps.
    """

    def __init__(self, family: Family, samples: Samples, weights: Weights, start: Array) -> None:
        N, m, n = samples.task_jacobian.shape
        theta, q = ca.MX.sym("theta", family.size), ca.MX.sym("q", n, N)
        derivatives = ca.vertcat(*joint_derivatives(family.expression(q, theta), q))
        (J_xi,) = ca.graph_substitute([derivatives], [q], [ca.MX(ca.DM(samples.points.T))])  # column s: vec(J_xi)
        at_start = ca.Function("J_xi", [theta], [J_xi])(ca.DM(start)).full().T.reshape(N, n, -1).transpose(0, 2, 1)
        shape = LossShape(n, m, family.outputs, samples.metric_inverse is None, weights)
        data = samples.loss_data(at_start if shape.regular else None)
        losses = _sample_loss(shape).map(N)(J_xi, *(ca.DM(_side_by_side(part)) for part in data))
        loss = ca.sum2(losses) / N
        self._value = ca.Function("loss", [theta], [loss])
        self._both = ca.Function("loss_and_gradient", [theta], [loss, ca.densify(ca.gradient(loss, theta))])

    def value(self, theta: Array) -> float:
        """L(theta)."""
        return float(self._value(ca.DM(theta)))

    def value_and_gradient(self, theta: Array) -> tuple[float, Array]:
        """L(theta) and dL/dtheta."""
        value, gradient = self._both(ca.DM(theta))
        return float(value), np.asarray(gradient.nonzeros())


def _sample_loss(shape: LossShape) -> ca.Function:
    """Loss of one sample from J_xi (column by column) and the sample's data."""
    J, data = ca.SX.sym("J", shape.r, shape.n), shape.symbols()
    column = ca.SX.sym("v", shape.r * shape.n)
    loss = ca.substitute(ca.sumsqr(shape.residuals(J, data)) / 2, J, ca.reshape(column, shape.r, shape.n))
    return ca.Function("sample_loss", [column, *data], [loss])


def _side_by_side(stack: Array) -> Array:
    """Matrices (N, rows, columns) side by side, (rows, N columns)."""
    return stack.transpose(1, 0, 2).reshape(stack.shape[1], -1)
