"""The loss of [AS2023] (24) and (25) as CasADi expressions and least squares, and a regularity term (ours)."""

from dataclasses import dataclass
from functools import cache
from itertools import combinations

import casadi as ca

from orthocas.casadi_tools.columns import ColumnFunction
from orthocas.checks import as_float_array, require_shape
from orthocas.errors import InvalidValueError, ShapeError

DEFAULT_WEIGHTS = (1000.0, 30.0, 150.0)  #: lambda1, lambda2, lambda3; at the paper's 1000 : 1 the optimum can lose rank
WeightNumbers = tuple[float, float] | tuple[float, float, float] | tuple[float, float, float, float]
REGULAR_VOLUME = 0.9  #: volume of the gradients below which the regularity term acts


@dataclass(frozen=True)
class Weights:
    """lambda1 (task term) and lambda2 (mutual term) of (24); lambda3 (regularity) and lambda4 (lengths) are ours."""

    task: float
    mutual: float
    regularity: float = 0.0
    length: float = 0.0

    def __post_init__(self) -> None:
        for k, name in enumerate(("task", "mutual", "regularity", "length")):
            value = getattr(self, name)
            if not 0 <= value < float("inf"):
                raise InvalidValueError(f"lambda{k + 1}", value, "a finite number >= 0")
            object.__setattr__(self, name, float(value))
        if self.task == 0 and self.mutual == 0:
            raise InvalidValueError("lambda1 and lambda2", self.task, "at least one positive number")

    @classmethod
    def of(cls, numbers: "Weights | WeightNumbers") -> "Weights":
        """Weights as they are, or from two to four numbers in the order of the fields."""
        if isinstance(numbers, Weights):
            return numbers
        values = as_float_array("weights", numbers)
        if values.shape not in ((2,), (3,), (4,)):
            raise ShapeError("weights", values.shape, (4,))
        weights = cls(*values.tolist())
        if weights.task == 0:
            raise InvalidValueError("lambda1", weights.task, "a positive number")
        return weights


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


def gradient_volume(coordinate_jacobian: ca.SX, null_basis: ca.SX, metric_inverse: ca.SX | None) -> ca.SX:
    """Signed volume of the coordinate gradients across the task, det(D) with D_jk = v_xi,j . z_k / |v_xi,j|_A^-1.

    The z_k are an A-orthonormal basis of ker J_x, so D holds the parts of the unit gradients that the task does not
    see. |det D| is 1 for perfect coordinates, and the chart phi is regular exactly where det D is not 0.

    Args:
        coordinate_jacobian: J_xi, (r, n).
        null_basis: columns z_1..z_r, (n, r), oriented continuously over the domain.
        metric_inverse: A^-1, (n, n); None for the identity.

    Source:
        ours, docs/derivations.md#regularity.
    """
    J = coordinate_jacobian
    raised = J if metric_inverse is None else J @ metric_inverse
    lengths = ca.sqrt(ca.sum2(raised * J))
    return ca.det((J @ null_basis) / ca.repmat(lengths, 1, J.shape[0]))


def log_lengths(coordinate_jacobian: ca.SX) -> ca.SX:
    """Logarithms of the lengths of the coordinate gradients, (r, 1).

    Angles leave free how fast a coordinate grows along itself: xi^7 is as orthogonal as xi, and flat at 0.

    Source:
        ours, docs/derivations.md#lengths.
    """
    return ca.log(ca.sum2(coordinate_jacobian**2)) / 2


@dataclass(frozen=True)
class LossShape:
    """Sizes and weights that fix the residuals of one sample."""

    n: int
    m: int
    r: int
    identity_metric: bool
    weights: Weights

    @property
    def regular(self) -> bool:
        """Whether there is a regularity residual (the last one)."""
        return self.weights.regularity > 0

    def symbols(self) -> list[ca.SX]:
        """Symbols of the data of one sample: unit task gradients (m, n); A^-1 (n, n) and null basis (n, r) if used."""
        data = [ca.SX.sym("g", self.m, self.n)]
        data += [] if self.identity_metric else [ca.SX.sym("B", self.n, self.n)]
        return data + ([ca.SX.sym("Z", self.n, self.r)] if self.regular else [])

    def residuals(self, coordinate_jacobian: ca.SX, data: list[ca.SX]) -> ca.SX:
        """Residuals rho of one sample with L(q, theta) = |rho|^2 / 2.

        First the task cosines, coordinate by coordinate, times sqrt(lambda1 / (m r)); then the mutual cosines times
        sqrt(lambda2 / C(r, 2)); then sqrt(lambda4 / r) log |v_xi,j| of each coordinate, if lambda4 > 0; last
        sqrt(lambda3) max(v0 - det D, 0), if lambda3 > 0.

        Source:
            [AS2023] eq. (24), written as least squares; the last two residuals are ours.
        """
        inverse = None if self.identity_metric else data[1]
        count = len(pairs(self.r))
        task: ca.SX = ca.vec(task_cosines(data[0], coordinate_jacobian))
        rows = [(self.weights.task / (self.m * self.r)) ** 0.5 * task]
        if count:
            rows.append((self.weights.mutual / count) ** 0.5 * mutual_cosines(coordinate_jacobian, inverse))
        if self.weights.length:
            rows.append((self.weights.length / self.r) ** 0.5 * log_lengths(coordinate_jacobian))
        if self.regular:
            volume = gradient_volume(coordinate_jacobian, data[-1], inverse)
            rows.append(self.weights.regularity**0.5 * ca.fmax(REGULAR_VOLUME - volume, 0))
        rho: ca.SX = ca.vertcat(*rows)
        return rho

    def rows_of(self, j: int) -> list[int]:
        """Residuals that depend on coordinate j: its task cosines, the pairs it is part of, and its length."""
        cosines = self.m * self.r + len(pairs(self.r))
        return [
            *range(j * self.m, (j + 1) * self.m),
            *(self.m * self.r + p for p, pair in enumerate(pairs(self.r)) if j in pair),
            *([cosines + j] if self.weights.length else []),
        ]


@cache
def loss_columns(shape: LossShape) -> ColumnFunction:
    """Loss of one sample and its slopes dL/dJ_xi.

    Inputs: J_xi (r, n), then the data of `LossShape.symbols`. Outputs: loss (1, 1), slopes (r, n).
    """
    J, data = ca.SX.sym("J", shape.r, shape.n), shape.symbols()
    loss = ca.sumsqr(shape.residuals(J, data)) / 2
    return ColumnFunction(ca.Function("loss", [J, *data], [loss, ca.gradient(loss, J)]))


@cache
def value_columns(shape: LossShape) -> ColumnFunction:
    """Loss of one sample; inputs as for `loss_columns`."""
    J, data = ca.SX.sym("J", shape.r, shape.n), shape.symbols()
    return ColumnFunction(ca.Function("value", [J, *data], [ca.sumsqr(shape.residuals(J, data)) / 2]))


@cache
def residual_columns(shape: LossShape) -> ColumnFunction:
    """Derivatives of the residuals of one sample with respect to J_xi, for the Gauss-Newton matrix.

    Inputs as for `loss_columns`. Outputs: for every coordinate j the derivative of the residuals `rows_of(j)` with
    respect to row j of J_xi, (rows, n); then, with a regularity residual, that residual (1, 1) and its derivative with
    respect to J_xi, (r, n).
    """
    J, data = ca.SX.sym("J", shape.r, shape.n), shape.symbols()
    rho = shape.residuals(J, data)
    by_entry = ca.jacobian(rho, ca.vec(J))  # columns: J_xi column by column
    outputs = [by_entry[shape.rows_of(j), j :: shape.r] for j in range(shape.r)]
    if shape.regular:
        outputs += [rho[-1], ca.reshape(by_entry[-1, :], shape.r, shape.n)]
    return ColumnFunction(ca.Function("residuals", [J, *data], outputs))


@cache
def curvature_columns(shape: LossShape) -> ColumnFunction:
    """Second derivatives of the loss of one sample with respect to J_xi column by column, (n r, n r).

    Inputs as for `loss_columns`.
    """
    J, data = ca.SX.sym("J", shape.r, shape.n), shape.symbols()
    column = ca.SX.sym("v", shape.r * shape.n)
    loss = ca.sumsqr(shape.residuals(ca.reshape(column, shape.r, shape.n), data)) / 2
    second = ca.Function("second", [column, *data], [ca.hessian(loss, column)[0]])
    return ColumnFunction(ca.Function("curvature", [J, *data], [second(ca.vec(J), *data)]))
