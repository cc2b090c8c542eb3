"""The task term and the mutual term: cosines between gradients ([AS2023] eq. (24))."""

from dataclasses import dataclass

import casadi as ca

from orthocas.checks import require_shape
from orthocas.fitting.loss.term import Data, Sizes
from orthocas.judging.pairs import pairs


def task_cosines(unit_task_gradients: ca.SX, coordinate_jacobian: ca.SX) -> ca.SX:
    """Cosines between task gradients and coordinate gradients, (m, r).

    c_ij = v_x,i^T A^-1 v_xi,j / (|A^-1 v_x,i| |v_xi,j|), Euclidean norms.

    Args:
        unit_task_gradients: rows A^-1 v_x,i / |A^-1 v_x,i|, (m, n).
        coordinate_jacobian: J_xi with rows v_xi,j, (r, n).

    Returns:
        Cosines in [-1, 1]; NaN where a coordinate gradient vanishes.

    Source:
        [AS2023] eq. (24), first sum.
    """
    n = unit_task_gradients.shape[1]
    require_shape("coordinate_jacobian", coordinate_jacobian.shape, (None, n))
    lengths = ca.sqrt(ca.sum2(coordinate_jacobian**2))
    products: ca.SX = unit_task_gradients @ coordinate_jacobian.T
    return products / ca.repmat(lengths.T, unit_task_gradients.shape[0], 1)


def mutual_cosines(coordinate_jacobian: ca.SX, metric_inverse: ca.SX | None) -> ca.SX:
    """Cosines between the gradients of two coordinates, one per pair i > j of `pairs(r)`, (r (r - 1) / 2, 1).

    c_ij = v_xi,i^T A^-1 v_xi,j / (|A^-1 v_xi,i| |v_xi,j|), Euclidean norms.

    Args:
        coordinate_jacobian: J_xi, (r, n).
        metric_inverse: A^-1, (n, n); None for the identity.

    Source:
        [AS2023] eq. (24), second sum.
    """
    J = coordinate_jacobian
    raised = J if metric_inverse is None else J @ metric_inverse
    lengths, raised_lengths = ca.sqrt(ca.sum2(J**2)), ca.sqrt(ca.sum2(raised**2))
    cosines = [ca.dot(raised[i, :], J[j, :]) / (raised_lengths[i] * lengths[j]) for i, j in pairs(J.shape[0])]
    return ca.vertcat(*cosines) if cosines else ca.SX(0, 1)


@dataclass(frozen=True)
class TaskTerm:
    """Mean over task components and coordinates of the squared `task_cosines`."""

    name: str = "task"
    data: tuple[str, ...] = ("unit_task_gradients",)
    hinge: bool = False

    def residuals(self, coordinate_jacobian: ca.SX, data: Data, sizes: Sizes) -> ca.SX:
        """Cosines, coordinate by coordinate, over sqrt(m r), (m r, 1)."""
        cosines = ca.vec(task_cosines(data["unit_task_gradients"], coordinate_jacobian))
        rho: ca.SX = (1 / (sizes.m * sizes.r)) ** 0.5 * cosines
        return rho


@dataclass(frozen=True)
class MutualTerm:
    """Mean over pairs of coordinates of the squared `mutual_cosines`. It is empty for r = 1."""

    name: str = "mutual"
    data: tuple[str, ...] = ("metric_inverse",)
    hinge: bool = False

    def residuals(self, coordinate_jacobian: ca.SX, data: Data, sizes: Sizes) -> ca.SX:
        """Cosines over the square root of the number of pairs, (r (r - 1) / 2, 1)."""
        count = max(1, len(pairs(sizes.r)))
        rho: ca.SX = (1 / count) ** 0.5 * mutual_cosines(coordinate_jacobian, data.get("metric_inverse"))
        return rho
