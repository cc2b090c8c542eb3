"""The loss of any family as one CasADi graph, with its gradient by symbolic differentiation."""

import casadi as ca
import numpy as np

from orthocas.checks import Array
from orthocas.loss import Weights, loss_residuals
from orthocas.parametrisations import Family, joint_derivatives
from orthocas.samples import Samples


def loss_expression(family: Family, samples: Samples, weights: Weights, theta: ca.MX) -> ca.MX:
    """Mean loss (25) over samples as an MX expression in theta (size, 1); samples run side by side as columns."""
    N, m, n = samples.task_jacobian.shape
    q = ca.MX.sym("q", n, N)
    J_xi = ca.vertcat(*joint_derivatives(family.expression(q, theta), q))  # column s: vec(J_xi) of sample s
    data = [ca.DM(_side_by_side(samples.unit_task_gradients))]
    if samples.metric_inverse is not None:
        data.append(ca.DM(_side_by_side(samples.metric_inverse)))
    sample_loss = _sample_loss(n, m, family.outputs, samples.metric_inverse is None, weights)
    losses = sample_loss.map(N)(J_xi, *data)
    mean = ca.sum2(losses) / N
    loss: ca.MX
    (loss,) = ca.graph_substitute([mean], [q], [ca.MX(ca.DM(samples.points.T))])
    return loss


class GraphObjective:
    """Mean loss of any family on fixed samples."""

    def __init__(self, family: Family, samples: Samples, weights: Weights) -> None:
        theta = ca.MX.sym("theta", family.size)
        loss = loss_expression(family, samples, weights, theta)
        self._value = ca.Function("loss", [theta], [loss])
        self._both = ca.Function("loss_and_gradient", [theta], [loss, ca.densify(ca.gradient(loss, theta))])

    def value(self, theta: Array) -> float:
        """L(theta)."""
        return float(self._value(ca.DM(theta)))

    def value_and_gradient(self, theta: Array) -> tuple[float, Array]:
        """L(theta) and dL/dtheta."""
        value, gradient = self._both(ca.DM(theta))
        return float(value), np.asarray(gradient.nonzeros())


def _sample_loss(n: int, m: int, r: int, identity_metric: bool, weights: Weights) -> ca.Function:
    """Loss (24) of one sample from J_xi (column by column), unit task gradients, and A^-1."""
    J, g = ca.SX.sym("J", r, n), ca.SX.sym("g", m, n)
    B = ca.SX.sym("B", n, n)
    rho = loss_residuals(g, J, None if identity_metric else B, weights)
    column = ca.SX.sym("v", r * n)
    loss = ca.substitute(ca.sumsqr(rho) / 2, J, ca.reshape(column, r, n))
    return ca.Function("sample_loss", [column, g] + ([] if identity_metric else [B]), [loss])


def _side_by_side(stack: Array) -> Array:
    """Matrices (N, rows, columns) side by side, (rows, N columns)."""
    return stack.transpose(1, 0, 2).reshape(stack.shape[1], -1)
