"""The task term and the mutual term with all lengths and angles taken in the metric (ours)."""

from dataclasses import dataclass

import casadi as ca

from orthocas.checks import require_shape
from orthocas.fitting.loss.angles import pairs
from orthocas.fitting.loss.term import Data, Sizes


def leak_sines(task_basis: ca.SX, coordinate_jacobian: ca.SX, metric_inverse: ca.SX | None) -> ca.SX:
    """Components of the unit coordinate gradients along an orthonormal basis of the task gradients, (m, r).

    s_aj = e_a . v_xi,j / |v_xi,j|_A^-1. The squares of column j add up to sin^2 of the leak of coordinate j, which
    depends neither on the basis nor on the task coordinates.

    Args:
        task_basis: rows e_1..e_m, an A-orthonormal basis of span{grad_A h_i}, (m, n).
        coordinate_jacobian: J_xi with rows v_xi,j, (r, n).
        metric_inverse: A^-1, (n, n); None for the identity.

    Returns:
        Components in [-1, 1]; NaN where a coordinate gradient vanishes.

    Source:
        ours, docs/angles.md.
    """
    J = coordinate_jacobian
    require_shape("coordinate_jacobian", J.shape, (None, task_basis.shape[1]))
    lengths = metric_lengths(J, metric_inverse)
    products: ca.SX = task_basis @ J.T
    return products / ca.repmat(lengths.T, task_basis.shape[0], 1)


def metric_mutual_cosines(coordinate_jacobian: ca.SX, metric_inverse: ca.SX | None) -> ca.SX:
    """Cosines in the metric between the gradients of two coordinates, in the order of `pairs(r)`, (r (r - 1) / 2, 1).

    c_ij = v_xi,i^T A^-1 v_xi,j / (|v_xi,i|_A^-1 |v_xi,j|_A^-1).

    Args:
        coordinate_jacobian: J_xi, (r, n).
        metric_inverse: A^-1, (n, n); None for the identity.

    Source:
        ours, docs/angles.md.
    """
    J = coordinate_jacobian
    raised = J if metric_inverse is None else J @ metric_inverse
    lengths = metric_lengths(J, metric_inverse)
    cosines = [ca.dot(raised[i, :], J[j, :]) / (lengths[i] * lengths[j]) for i, j in pairs(J.shape[0])]
    return ca.vertcat(*cosines) if cosines else ca.SX(0, 1)


def metric_lengths(coordinate_jacobian: ca.SX, metric_inverse: ca.SX | None) -> ca.SX:
    """Lengths |v_xi,j|_A^-1 of the coordinate gradients in the metric, (r, 1)."""
    raised = coordinate_jacobian if metric_inverse is None else coordinate_jacobian @ metric_inverse
    lengths: ca.SX = ca.sqrt(ca.sum2(raised * coordinate_jacobian))
    return lengths


@dataclass(frozen=True)
class MetricTaskTerm:
    """Mean over basis vectors and coordinates of the squared `leak_sines`."""

    name: str = "metric task"
    data: tuple[str, ...] = ("metric_inverse", "task_basis")
    hinge: bool = False

    def residuals(self, coordinate_jacobian: ca.SX, data: Data, sizes: Sizes) -> ca.SX:
        """Sines, coordinate by coordinate, over sqrt(m r), (m r, 1)."""
        sines = ca.vec(leak_sines(data["task_basis"], coordinate_jacobian, data.get("metric_inverse")))
        rho: ca.SX = (1 / (sizes.m * sizes.r)) ** 0.5 * sines
        return rho


@dataclass(frozen=True)
class MetricMutualTerm:
    """Mean over pairs of coordinates of the squared `metric_mutual_cosines`. It is empty for r = 1."""

    name: str = "metric mutual"
    data: tuple[str, ...] = ("metric_inverse",)
    hinge: bool = False

    def residuals(self, coordinate_jacobian: ca.SX, data: Data, sizes: Sizes) -> ca.SX:
        """Cosines over the square root of the number of pairs, (r (r - 1) / 2, 1)."""
        count = max(1, len(pairs(sizes.r)))
        rho: ca.SX = (1 / count) ** 0.5 * metric_mutual_cosines(coordinate_jacobian, data.get("metric_inverse"))
        return rho
