"""The loss of [AS2023] eqs. (24) and (25) as CasADi expressions, and as least squares."""

from dataclasses import dataclass
from itertools import combinations

import casadi as ca

from orthocas.batch import dense_function
from orthocas.checks import require_shape
from orthocas.errors import InvalidValueError

DEFAULT_WEIGHTS = (1000.0, 30.0)  #: (lambda1, lambda2); at the paper's 1000 : 1 the optimum can lose rank


@dataclass(frozen=True)
class Weights:
    """lambda1 and lambda2 of the loss: task term against mutual term."""

    task: float = DEFAULT_WEIGHTS[0]
    mutual: float = DEFAULT_WEIGHTS[1]

    def __post_init__(self) -> None:
        for name, value in (("lambda1", self.task), ("lambda2", self.mutual)):
            if not 0 <= value < float("inf"):
                raise InvalidValueError(name, value, "a finite number >= 0")
        if self.task == 0:
            raise InvalidValueError("lambda1", self.task, "a positive number")


def pairs(r: int) -> list[tuple[int, int]]:
    """The pairs (i, j), i > j, of r coordinates in the order of the mutual cosines."""
    return [(i, j) for j, i in combinations(range(r), 2)]


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


def loss_residuals(
    unit_task_gradients: ca.SX, coordinate_jacobian: ca.SX, metric_inverse: ca.SX | None, weights: Weights
) -> ca.SX:
    """Residuals rho of one sample with L(q, theta) = |rho|^2 / 2, (m r + r (r - 1) / 2, 1).

    First the task cosines, coordinate by coordinate, times sqrt(lambda1 / (m r)); then the mutual cosines times
    sqrt(lambda2 / C(r, 2)).

    Source:
        [AS2023] eq. (24), written as least squares (ours).
    """
    m, r = unit_task_gradients.shape[0], coordinate_jacobian.shape[0]
    task_weight = (weights.task / (m * r)) ** 0.5
    task: ca.SX = task_weight * ca.vec(task_cosines(unit_task_gradients, coordinate_jacobian))
    if r == 1:
        return task
    mutual_weight = (weights.mutual / len(pairs(r))) ** 0.5
    return ca.vertcat(task, mutual_weight * mutual_cosines(coordinate_jacobian, metric_inverse))


def residual_function(n: int, m: int, r: int, identity_metric: bool, weights: Weights) -> ca.Function:
    """The residuals of one sample and their derivative with respect to J_xi.

    Inputs: J_xi (r, n), unit task gradients (m, n), and A^-1 (n, n) unless the metric is the identity.
    Outputs: rho (p, 1) and d rho / d J_xi, (p, r n), with J_xi read row by row.
    """
    Jt = ca.SX.sym("Jt", n, r)
    gradients = ca.SX.sym("g", m, n)
    inverse = None if identity_metric else ca.SX.sym("B", n, n)
    rho = loss_residuals(gradients, Jt.T, inverse, weights)
    derivative = ca.jacobian(rho, ca.vec(Jt))
    J = ca.SX.sym("J", r, n)
    rho, derivative = ca.substitute([rho, derivative], [Jt], [J.T])
    inputs = [J, gradients] + ([] if inverse is None else [inverse])
    return dense_function("residuals", inputs, [rho, derivative])
