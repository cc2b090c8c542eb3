"""The terms of the loss: cosines between gradients ([AS2023] eq. (24)), angles in the metric, regularity, length."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Literal, Protocol, runtime_checkable

import casadi as ca
import numpy as np

from orthocas.charts.point_quality import pairs
from orthocas.errors import InvalidValueError, ShapeError
from orthocas.tasks.problem import Problem
from orthocas.tools.checks import Array, as_float_array, as_number, require_kind, require_known
from orthocas.tools.expressions import MOST_ROWS, compute_determinant


@dataclass(frozen=True, slots=True)
class LossRules:
    """Numbers of the terms of the loss."""

    least_conditioning: float = 0.2  #: that fits aim at on the whole domain
    regular_volume: float = 0.9  #: volume of the gradients below which the regularity term acts
    fold_volume: float = 1.6 * 0.2  #: the same at the worst points: enough, as det D <= sqrt(e) times the conditioning
    wide_volume: float = 0.5  #: volume that a wide fit asks for at its first samples
    worst_volume: float = 0.3  #: the same once the worst samples have joined, and for networks
    least_volume: float = 0.05  #: over r: bound of the domain of a wide chart, in the identity metric
    least_in_metric: float = 0.02  #: the same for charts in another metric, where orthogonal gradients are oblique here
    beyond: float = 2.0  #: times `least_in_metric`: the volume in the identity metric that wide fits in A = M ask for
    nearly_folded: float = 1e-4  #: volume below which an inverse loses digits
    shortest: float = 1e-12  #: length of a gradient that counts as zero


RULES = LossRules()
Angles = Literal["paper", "metric"]
ANGLES: tuple[Angles, ...] = ("paper", "metric")  #: kinds of angles in the loss


@dataclass(frozen=True)
class Sizes:
    """Sizes of the matrices in the loss of one sample."""

    n: int  #: joints
    m: int  #: task components
    r: int  #: coordinates
    identity_metric: bool  #: whether A = I; then products with A^-1 are omitted


Data = Mapping[str, ca.SX]  #: data of a sample by name; there is no 'metric_inverse' for A = I

SAMPLE_DATA: dict[str, Callable[[Sizes], tuple[int, int]]] = {  #: shapes of the properties of `Samples` a term may need
    "unit_task_gradients": lambda s: (s.m, s.n),
    "task_basis": lambda s: (s.m, s.n),
    "task_jacobian": lambda s: (s.m, s.n),
    "metric_inverse": lambda s: (s.n, s.n),
    "null_basis": lambda s: (s.n, s.r),
    "points": lambda s: (s.n, 1),
}


@runtime_checkable
class LossTerm(Protocol):
    """A sum of squared residuals of the coordinate gradients at a sample. `Weights` holds its weight."""

    @property
    def name(self) -> str:
        """Short name, as used in `Weights`."""
        ...

    @property
    def data(self) -> tuple[str, ...]:
        """Sample data that the term needs: names in `SAMPLE_DATA`."""
        ...

    @property
    def hinge(self) -> bool:
        """Whether the term is zero at most samples of a good fit, and couples all coordinates elsewhere."""
        ...

    def residuals(self, coordinate_jacobian: ca.SX, data: Data, sizes: Sizes) -> ca.SX:
        """J_xi (r, n) -> rho (k, 1), where k may be 0. The term adds weight |rho|^2 / 2 to the loss of a sample."""
        ...


@dataclass(frozen=True, eq=False)
class UnitGradients:
    """Unit gradients of r coordinates at N samples, in the metric."""

    rows: Array  #: u_j = v_xi,j / |v_xi,j|_A^-1, (N, r, n)
    raised: Array  #: g_j = u_j A^-1, (N, r, n)
    lengths: Array  #: |v_xi,j|_A^-1, (N, r, 1)

    @classmethod
    def of(cls, J: Array, metric_inverse: Array | None) -> UnitGradients:
        """The unit gradients of J_xi (N, r, n) with A^-1 (N, n, n); None for the identity."""
        raised = J if metric_inverse is None else J @ metric_inverse
        lengths = np.sqrt(np.einsum("sji,sji->sj", raised, J))[:, :, None]
        rows = J / lengths
        return cls(rows, rows if metric_inverse is None else raised / lengths, lengths)

    def pull_back(self, slopes: Array) -> Array:
        """dL/dJ_xi from dL/du_j, (N, r, n): dL/dv_j = (dL/du_j - (dL/du_j . u_j) g_j) / |v_j|."""
        along: Array = np.einsum("sji,sji->sj", slopes, self.rows)[:, :, None] * self.raised
        np.subtract(slopes, along, out=along)
        along /= self.lengths
        return along


@runtime_checkable
class ArrayTerm(LossTerm, Protocol):
    """A term that NumPy arrays can evaluate too: with many coordinates, that is faster than CasADi expressions."""

    def by_arrays(self, sizes: Sizes) -> bool:
        """Whether arrays evaluate the term for a problem of these sizes."""
        ...

    def differentiate(self, units: UnitGradients, data: Mapping[str, Array]) -> tuple[Array, Array]:
        """|rho|^2 / 2, (N,), and its derivatives with respect to the u_j, (N, r, n), with the data of N samples."""
        ...

    def build_curvatures(self, units: UnitGradients, data: Mapping[str, Array]) -> Iterator[Array]:
        """D_j^T D_j (N, n, n) of every coordinate j, with the derivatives D_j of rho with respect to row j of J_xi."""
        ...


class CosineTerm:
    """Evaluates by arrays a term whose residuals are scaled cosines c_aj = e_a . u_j, with unit gradients u_j.

    d c_aj / dv_j = (e_a - c_aj g_j) / |v_j|, see `UnitGradients`.
    """

    toward: ClassVar[str] = ""  #: name of the sample data with the e_a (N, m, n); if empty, e_a are the other g_k
    in_metric: ClassVar[bool] = True  #: whether lengths are taken in the metric; otherwise they are Euclidean

    def by_arrays(self, sizes: Sizes) -> bool:
        """See `ArrayTerm`."""
        return self.in_metric or sizes.identity_metric

    def _list_directions(self, units: UnitGradients, data: Mapping[str, Array]) -> tuple[Array, float]:
        """The e_a, (N, k, n), and the squared scale 1 / (number of pairs), which makes the sum of squares a mean."""
        if not self.toward:
            return units.raised, 1 / len(pairs(units.rows.shape[1]))
        return data[self.toward], 1 / (data[self.toward].shape[1] * units.rows.shape[1])

    def differentiate(self, units: UnitGradients, data: Mapping[str, Array]) -> tuple[Array, Array]:
        """See `ArrayTerm`."""
        directions, scale = self._list_directions(units, data)
        cosines = units.rows @ directions.transpose(0, 2, 1)  # (N, r, k)
        if not self.toward:
            # A gradient makes no pair with itself
            np.einsum("sjj->sj", cosines)[...] = 0.0
        squares = np.einsum("sja,sja->s", cosines, cosines)
        cosines *= scale
        # The loss is half the sum. Without `toward`, each pair of coordinates occurs twice
        return squares * (scale / (2 if self.toward else 4)), cosines @ directions

    def build_curvatures(self, units: UnitGradients, data: Mapping[str, Array]) -> Iterator[Array]:
        """See `ArrayTerm`."""
        directions, scale = self._list_directions(units, data)
        square = directions.transpose(0, 2, 1) @ directions
        along = (units.rows @ directions.transpose(0, 2, 1)) @ directions  # sum_a c_aj e_a, (N, r, n)
        for j in range(units.rows.shape[1]):
            g, length = units.raised[:, j], units.lengths[:, j, :, None]
            # sum_a (e_a - c g) (e_a - c g)^T = square - x g^T - g x^T with x = sum_a c e_a - g sum_a c^2 / 2
            squares = np.einsum("si,si->s", along[:, j], units.rows[:, j])
            mixed = (along[:, j] - squares[:, None] / 2 * g)[:, :, None] * g[:, None, :]
            yield scale * (square - mixed - mixed.transpose(0, 2, 1)) / length**2


Pairs = tuple[tuple[int, int], ...]  #: rows of J_xi


def coordinates_of(rows: Sequence[Any], exchanged: Pairs) -> list[Any]:
    """Rows of coordinates from those of components: a, b of each pair become (a + b) / sqrt 2, (b - a) / sqrt 2."""
    turned = list(rows)
    for i, j in exchanged:
        turned[i], turned[j] = (rows[i] + rows[j]) * 0.5**0.5, (rows[j] - rows[i]) * 0.5**0.5
    return turned


@dataclass(frozen=True)
class TaskTerm(CosineTerm):
    """Mean of the squared cosines between task component i and coordinate j: [AS2023] eq. (24), first sum.

    c_ij = v_x,i^T A^-1 v_xi,j / (|A^-1 v_x,i| |v_xi,j|), Euclidean norms; NaN where a coordinate gradient vanishes.
    """

    toward: ClassVar[str] = "unit_task_gradients"
    in_metric: ClassVar[bool] = False
    name: str = "task"
    data: tuple[str, ...] = ("unit_task_gradients",)
    hinge: bool = False

    def residuals(self, coordinate_jacobian: ca.SX, data: Data, sizes: Sizes) -> ca.SX:
        """Cosines, coordinate by coordinate, over sqrt(m r), (m r, 1)."""
        lengths = ca.sqrt(ca.sum2(coordinate_jacobian**2))
        cosines = data["unit_task_gradients"] @ coordinate_jacobian.T / ca.repmat(lengths.T, sizes.m, 1)
        rho: ca.SX = (1 / (sizes.m * sizes.r)) ** 0.5 * ca.vec(cosines)
        return rho


@dataclass(frozen=True)
class MutualTerm(CosineTerm):
    """Mean of the squared cosines between coordinates i > j: [AS2023] eq. (24), second sum. It is empty for r = 1.

    c_ij = v_xi,i^T A^-1 v_xi,j / (|A^-1 v_xi,i| |v_xi,j|), Euclidean norms.
    """

    in_metric: ClassVar[bool] = False
    name: str = "mutual"
    data: tuple[str, ...] = ("metric_inverse",)
    hinge: bool = False

    def residuals(self, coordinate_jacobian: ca.SX, data: Data, sizes: Sizes) -> ca.SX:
        """Cosines over the square root of the number of pairs, (r (r - 1) / 2, 1)."""
        J, raised = coordinate_jacobian, raise_gradients(coordinate_jacobian, data.get("metric_inverse"))
        long, own = ca.sqrt(ca.sum2(raised**2)), ca.sqrt(ca.sum2(J**2))
        cosines = [ca.dot(raised[i, :], J[j, :]) / (long[i] * own[j]) for i, j in pairs(sizes.r)]
        return average_pairs(cosines)


@dataclass(frozen=True)
class LengthTerm:
    """Mean over coordinates of log^2 |dxi_j|, Euclidean norms.

    Angles do not fix how fast a coordinate grows along itself: xi^7 is as orthogonal as xi, but flat at 0.

    Source:
        ours, docs/explanation/derivations_meaning.md#lengths.
    """

    name: str = "length"
    data: tuple[str, ...] = ()
    hinge: bool = False

    def residuals(self, coordinate_jacobian: ca.SX, data: Data, sizes: Sizes) -> ca.SX:
        """Logarithms over sqrt(r), (r, 1)."""
        rho: ca.SX = (1 / sizes.r) ** 0.5 * (ca.log(ca.sum2(coordinate_jacobian**2)) / 2)
        return rho


@dataclass(frozen=True)
class MetricLengthTerm:
    """Sum over coordinates of log^2 |dxi_j|, in the metric: a unit of xi is a motion of equal length everywhere."""

    name: str = "metric length"
    data: tuple[str, ...] = ("metric_inverse",)
    hinge: bool = False

    def residuals(self, coordinate_jacobian: ca.SX, data: Data, sizes: Sizes) -> ca.SX:
        """Logarithms, (r, 1)."""
        rho: ca.SX = ca.log(metric_lengths(coordinate_jacobian, data.get("metric_inverse")))
        return rho


@dataclass(frozen=True)
class MetricTaskTerm(CosineTerm):
    """Mean over a basis e_a of the task gradients, and over coordinates, of squared components: sin^2 of leaks over m.

    With an A-orthonormal basis e_1..e_m of span{grad_A h_i}, s_aj = e_a . v_xi,j / |v_xi,j|_A^-1. The squares of column
    j add up to sin^2 of the leak of coordinate j, which depends neither on the basis nor on the task coordinates.

    Source:
        ours, docs/explanation/angles.md.
    """

    toward: ClassVar[str] = "task_basis"
    name: str = "metric task"
    data: tuple[str, ...] = ("metric_inverse", "task_basis")
    hinge: bool = False

    def residuals(self, coordinate_jacobian: ca.SX, data: Data, sizes: Sizes) -> ca.SX:
        """Sines, coordinate by coordinate, over sqrt(m r), (m r, 1)."""
        lengths = metric_lengths(coordinate_jacobian, data.get("metric_inverse"))
        sines = data["task_basis"] @ coordinate_jacobian.T / ca.repmat(lengths.T, sizes.m, 1)
        rho: ca.SX = (1 / (sizes.m * sizes.r)) ** 0.5 * ca.vec(sines)
        return rho


@dataclass(frozen=True)
class SelfMotionTerm:
    """sin^2 of the leak of a single coordinate, 1 - (v . z)^2 / |v|_A^-1^2, with the A-unit self-motion z.

    It equals m times `MetricTaskTerm` for r = 1. With one residual, and without a basis of the task gradients, it takes
    half of the work where no Gauss-Newton matrix is needed.
    """

    name: str = "self-motion"
    data: tuple[str, ...] = ("metric_inverse", "null_basis")
    hinge: bool = False

    def residuals(self, coordinate_jacobian: ca.SX, data: Data, sizes: Sizes) -> ca.SX:
        """The sine, (1, 1)."""
        cosine = (
            coordinate_jacobian @ data["null_basis"] / metric_lengths(coordinate_jacobian, data.get("metric_inverse"))
        )
        rho: ca.SX = ca.sqrt(ca.fmax(1 - cosine**2, RULES.shortest))
        return rho


@dataclass(frozen=True)
class MetricMutualTerm(CosineTerm):
    """Mean over pairs of coordinates of squared cosines in the metric. It is empty for r = 1.

    c_ij = v_xi,i^T A^-1 v_xi,j / (|v_xi,i|_A^-1 |v_xi,j|_A^-1), i > j.

    Source:
        ours, docs/explanation/angles.md.
    """

    name: str = "metric mutual"
    data: tuple[str, ...] = ("metric_inverse",)
    hinge: bool = False

    def residuals(self, coordinate_jacobian: ca.SX, data: Data, sizes: Sizes) -> ca.SX:
        """Cosines over the square root of the number of pairs, (r (r - 1) / 2, 1)."""
        J, inverse = coordinate_jacobian, data.get("metric_inverse")
        raised, lengths = raise_gradients(J, inverse), metric_lengths(J, inverse)
        return average_pairs([ca.dot(raised[i, :], J[j, :]) / (lengths[i] * lengths[j]) for i, j in pairs(sizes.r)])


def raise_gradients(coordinate_jacobian: ca.SX, metric_inverse: ca.SX | None) -> ca.SX:
    """Gradients in the metric, rows v^T A^-1, (r, n)."""
    raised: ca.SX = coordinate_jacobian if metric_inverse is None else coordinate_jacobian @ metric_inverse
    return raised


def metric_lengths(coordinate_jacobian: ca.SX, metric_inverse: ca.SX | None) -> ca.SX:
    """Lengths |v_xi,j|_A^-1 of the coordinate gradients in the metric, (r, 1)."""
    lengths: ca.SX = ca.sqrt(ca.sum2(raise_gradients(coordinate_jacobian, metric_inverse) * coordinate_jacobian))
    return lengths


def average_pairs(cosines: Sequence[ca.SX]) -> ca.SX:
    """Residuals (pairs, 1) whose squares add up to the mean of the squared cosines."""
    rho: ca.SX = (1 / max(1, len(cosines))) ** 0.5 * (ca.vertcat(*cosines) if cosines else ca.SX(0, 1))
    return rho


def gradient_volume(coordinate_jacobian: ca.SX, null_basis: ca.SX, metric_inverse: ca.SX | None) -> ca.SX:
    """Signed volume of the coordinate gradients across the task, det(D) with D_jk = v_xi,j . z_k / |v_xi,j|_A^-1.

    The z_k are an A-orthonormal basis of ker J_x, so D holds the components of the unit gradients that do not change
    the task. |det D| is 1 for perfect coordinates, and the chart phi is regular exactly where det D is not 0.

    Args:
        coordinate_jacobian: J_xi, (r, n).
        null_basis: columns z_1..z_r, (n, r), oriented continuously over the domain.
        metric_inverse: A^-1, (n, n); None for the identity.

    Raises:
        InvalidValueError: for too many coordinates.

    Source:
        ours, docs/explanation/derivations_fits.md#regularity.
    """
    if coordinate_jacobian.shape[0] > MOST_ROWS:
        expected = (
            f"at most {MOST_ROWS} with the terms regularity and folds; weights of 0 leave these out, locked joints help"
        )
        raise InvalidValueError("number of extra coordinates r", coordinate_jacobian.shape[0], expected)
    lengths = metric_lengths(coordinate_jacobian, metric_inverse)
    return compute_determinant((coordinate_jacobian @ null_basis) / ca.repmat(lengths, 1, coordinate_jacobian.shape[0]))


def volume_hinges(units: UnitGradients, null_basis: Array, bound: float) -> tuple[Array, Array]:
    """max(bound - det D, 0) of the `gradient_volume` det D, (N,), and its derivatives by the u_j, (N, r, n).

    With the cofactors C of D, d(det D)/du_j = sum_k C_jk z_k.

    Args:
        units: unit gradients u_j of the coordinates.
        null_basis: columns z_1..z_r, (N, n, r).
        bound: of the volume.
    """
    D = units.rows @ null_basis
    volume = np.linalg.det(D)
    hinges, cofactors = np.maximum(bound - volume, 0.0), np.zeros(D.shape)
    # Where the hinge acts, the cofactors are det D D^-T; next to folds, singular values give them
    near = np.abs(volume) < RULES.nearly_folded
    regular, folded = np.flatnonzero((hinges > 0) & ~near), np.flatnonzero((hinges > 0) & near)
    cofactors[regular] = volume[regular, None, None] * np.linalg.inv(D[regular]).transpose(0, 2, 1)
    if len(folded):
        U, s, Vt = np.linalg.svd(D[folded])
        sign = np.sign(np.linalg.det(U) * np.linalg.det(Vt))
        others = np.stack([np.delete(s, k, axis=1).prod(axis=1) for k in range(D.shape[1])], axis=1)
        cofactors[folded] = sign[:, None, None] * (U * others[:, None, :]) @ Vt
    return hinges, -cofactors @ null_basis.transpose(0, 2, 1)


@dataclass(frozen=True)
class RegularityTerm:
    """max(bound - det D, 0)^2, where det D is the `gradient_volume`.

    Coordinates that are orthogonal in the inertia may be nearly parallel otherwise. A Euclidean term takes the volume
    in the identity metric, and its bound is over r.
    """

    name: str = "regularity"
    bound: float = RULES.regular_volume
    data: tuple[str, ...] = ("metric_inverse", "null_basis")
    hinge: bool = True
    euclidean: bool = False

    def bound_for(self, r: int) -> float:
        """The bound for r coordinates."""
        return self.bound / r if self.euclidean else self.bound

    def residuals(self, coordinate_jacobian: ca.SX, data: Data, sizes: Sizes) -> ca.SX:
        """One residual, (1, 1)."""
        Z, metric_inverse = data["null_basis"], data.get("metric_inverse")
        if self.euclidean and metric_inverse is not None:
            # A basis with the volume of an orthonormal one
            columns = [Z[:, 0] / ca.sqrt(compute_determinant(Z.T @ Z)), *(Z[:, k] for k in range(1, sizes.r))]
            Z, metric_inverse = ca.horzcat(*columns), None
        hinge: ca.SX = ca.fmax(self.bound_for(sizes.r) - gradient_volume(coordinate_jacobian, Z, metric_inverse), 0)
        return hinge

    def by_arrays(self, sizes: Sizes) -> bool:
        """Determinants of more rows would be too large as expressions."""
        return True

    def hinges(self, units: UnitGradients, data: Mapping[str, Array]) -> tuple[Array, Array]:
        """The residual (N,) and its derivatives with respect to the u_j, (N, r, n), by LAPACK; see `volume_hinges`."""
        Z = data["null_basis"]
        if self.euclidean and "metric_inverse" in data:
            Z = Z.copy()
            Z[:, :, 0] /= np.sqrt(np.linalg.det(Z.transpose(0, 2, 1) @ Z))[:, None]
            units = UnitGradients.of(units.rows, None)
            rho, slopes = volume_hinges(units, Z, self.bound_for(Z.shape[2]))
            return rho, units.pull_back(slopes)
        return volume_hinges(units, Z, self.bound_for(Z.shape[2]))

    def differentiate(self, units: UnitGradients, data: Mapping[str, Array]) -> tuple[Array, Array]:
        """See `ArrayTerm`."""
        rho, slopes = self.hinges(units, data)
        slopes *= rho[:, None, None]
        return rho**2 / 2, slopes

    def build_curvatures(self, units: UnitGradients, data: Mapping[str, Array]) -> Iterator[Array]:
        """See `ArrayTerm`."""
        slopes = units.pull_back(self.hinges(units, data)[1])
        return (slopes[:, j, :, None] * slopes[:, j, None, :] for j in range(slopes.shape[1]))


FOLD_TERM = RegularityTerm("folds", RULES.fold_volume)  #: for the worst points of the domain only

_TERMS: dict[str, LossTerm] = {}


def register_loss_term(term: LossTerm) -> None:
    """Register a loss term. `Weights(extra={name: weight})` then adds it to the loss.

    Raises:
        UnknownNameError: if the term needs data that samples do not have.
        InvalidValueError: if the name belongs to another term.

    Example:
        >>> from dataclasses import dataclass
        >>> import orthocas as oc
        >>> from orthocas import problems
        >>> @dataclass(frozen=True)
        ... class FirstJoint:  # coordinates should depend little on joint 1
        ...     name: str = "first joint"
        ...     data: tuple[str, ...] = ()
        ...     hinge: bool = False
        ...
        ...     def residuals(self, coordinate_jacobian, data, sizes):
        ...         return coordinate_jacobian[:, 0]
        >>> oc.register_loss_term(FirstJoint())
        >>> weights = oc.Weights(extra={"first joint": 100.0})
        >>> fit = oc.fit(problems.get("planar_3r_xy"), oc.Polynomial(degree=2), weights=weights, samples=300)
        >>> fit.status.value
        'converged'
    """
    if isinstance(term, type) or not isinstance(term, LossTerm):
        raise InvalidValueError("term", f"a {type(term).__name__}", "an object with the members of LossTerm")
    for name in term.data:
        require_known("data of a sample", name, SAMPLE_DATA)
    if _TERMS.get(term.name, term) != term:
        raise InvalidValueError("name", repr(term.name), "a name that no other term uses")
    _TERMS[term.name] = term


def find_least_volume(problem: Problem) -> float:
    """The bound of the domain of a wide chart: least volume of coordinates in the identity metric."""
    return (RULES.least_volume if problem.metric.is_identity else RULES.least_in_metric) / problem.r


def find_term(name: str) -> LossTerm:
    """The term with this name.

    Raises:
        UnknownNameError: if there is no such term.
    """
    require_known("loss term", name, _TERMS)
    return _TERMS[name]


for _term in (
    *(TaskTerm(), MutualTerm(), MetricTaskTerm(), MetricMutualTerm(), LengthTerm(), RegularityTerm(), FOLD_TERM),
    # Of wide fits
    RegularityTerm("volume", RULES.wide_volume),
    RegularityTerm("volume with the worst", RULES.worst_volume),
    RegularityTerm("euclidean volume", RULES.beyond * RULES.least_in_metric, euclidean=True),
    MetricLengthTerm(),
    SelfMotionTerm(),
):
    register_loss_term(_term)

WeightNumbers = Sequence[float]  #: two to five numbers: task, mutual, regularity, length, folds


@dataclass(frozen=True)
class Weights:
    """lambda1 (task) and lambda2 (mutual) of [AS2023] eq. (24); the others are ours.

    The ratio of the first two selects a point on the Pareto front of task angles and mutual angles. At the paper's
    1000 : 1 the optimum can lose rank. The regularity term prevents the gradients of the coordinates from collapsing
    anywhere. The length term keeps their lengths even, which helps controllers. The fold term acts at the worst points
    of the domain, which a search finds between the stages of a fit, and keeps the conditioning above 0.2 there.

    Args:
        task: lambda1 > 0.
        mutual: lambda2 >= 0.
        regularity: lambda3 >= 0.
        length: lambda4 >= 0.
        folds: lambda5 >= 0. With 0 there is no search.
        extra: weights >= 0 of registered terms, by name; see `orthocas.register_loss_term`.
        angles: what the task and mutual terms measure: 'paper', the cosines of [AS2023] eq. (24) with Euclidean norms;
            'metric', cosines in the metric with an orthonormal basis of the task gradients, which do not depend on the
            choice of task coordinates. Default: 'metric' for A = M, where closed loops are better with it, and for
            tasks with components in rad, where cosines depend on the axes of the orientation; 'paper' otherwise. See
            docs/explanation/angles.md.

    Raises:
        InvalidValueError: if a weight is negative or not finite, or all weights are zero.
        UnknownNameError: if there are no such angles.

    Example:
        >>> import orthocas as oc
        >>> oc.Weights(mutual=300.0).by_name
        {'task': 1000.0, 'mutual': 300.0, 'regularity': 150.0, 'length': 0.0}
        >>> oc.Weights.of([1000.0, 1.0]).regularity
        0.0
    """

    task: float = 1000.0
    mutual: float = 30.0
    regularity: float = 150.0
    length: float = 0.0
    folds: float = 1000.0
    extra: Mapping[str, float] = field(default_factory=dict, hash=False)
    angles: Angles | None = None

    def __post_init__(self) -> None:
        for k, name in enumerate(("task", "mutual", "regularity", "length", "folds")):
            object.__setattr__(self, name, _weight(f"lambda{k + 1}", getattr(self, name)))
        require_kind("extra", self.extra, Mapping)
        if self.angles is not None:
            require_known("angles", self.angles, ANGLES)
        extra = {name: _weight(f"weight of {name}", value) for name, value in self.extra.items()}
        object.__setattr__(self, "extra", extra)
        if not any(self.by_name.values()):
            raise InvalidValueError("weights", "all zero", "at least one positive number")

    @classmethod
    def of(cls, weights: Weights | WeightNumbers) -> Weights:
        """Convert two to five numbers in the order of the fields; missing ones are 0. Weights stay as they are.

        Raises:
            ShapeError, InvalidValueError: if the numbers are invalid, or the task weight is not positive.
        """
        if not isinstance(weights, Weights):
            values = as_float_array("weights", weights)
            if values.shape not in ((2,), (3,), (4,), (5,)):
                raise ShapeError("weights", values.shape, (5,))
            weights = cls(*values.tolist(), *[0.0] * (5 - len(values)))
        if weights.task == 0:
            raise InvalidValueError("lambda1", weights.task, "a positive number")
        return weights

    def for_problem(self, problem: Problem) -> Weights:
        """The same weights with the default angles of a problem, unless angles are given."""
        if self.angles is not None:
            return self
        turns = "rad" in problem.task.units
        return replace(self, angles="metric" if turns or problem.metric.is_inertia else "paper")

    @property
    def label(self) -> str:
        """The numbers without the last zeros, and terms by name, as commands take them: '1000,30,quiet=5'."""
        numbers = [self.task, self.mutual, self.regularity, self.length, self.folds]
        while len(numbers) > 2 and numbers[-1] == 0:
            numbers.pop()
        return ",".join([f"{number:g}" for number in numbers] + [f"{name}={w:g}" for name, w in self.extra.items()])

    @property
    def by_name(self) -> dict[str, float]:
        """The weights by the names of their terms, without the fold term; without angles, those of the paper."""
        kind = "metric " if self.angles == "metric" else ""
        angles = {f"{kind}task": self.task, f"{kind}mutual": self.mutual}
        return angles | {"regularity": self.regularity, "length": self.length} | dict(self.extra)


def _weight(name: str, value: float) -> float:
    if not 0 <= as_number(name, value) < float("inf"):
        raise InvalidValueError(name, value, "a finite number >= 0")
    return float(value)


DEFAULT_WEIGHTS = Weights()  #: weights of a fit by default
