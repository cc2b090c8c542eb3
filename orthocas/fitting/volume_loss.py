"""The loss of wide charts: how far volumes of coordinates fall short, and how uneven lengths of gradients are."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from copy import copy
from typing import Self

import numpy as np
import scipy
from numpy.typing import NDArray

from orthocas.bases.family import ArrayFamily, ArrayMemory
from orthocas.fitting.basis_gradients import BasisGradients
from orthocas.fitting.meaning import Wish
from orthocas.tasks.problem import Problem
from orthocas.tools.checks import Array

LEAST_VOLUME = 0.05  #: over r, of the coordinates in domains of wide charts; see `RegularPart`
_BEYOND = 1.2  # over that bound, the volume in the identity metric that is enough beside another metric
_EVENNESS = 0.03  # weight of the mean squared logarithm of lengths of gradients
_TINY = 1e-12  # length of a row
_WATCHED = 5000  # samples on which the loss of a network is watched, and which it takes at a time

Back = Callable[[Array], Array]  #: from derivatives after dxi/dq, (N, r, n), to those after the parameters


class Field(ABC):
    """Samples, with what the volume of coordinates there needs."""

    def __init__(self, problem: Problem, points: Array) -> None:
        self.points = points
        task, metric = problem.task, problem.metric
        J = task.batched_frame_jacobian(points)[0].reshape(len(points), task.m, problem.n)
        #: R with A^-1 = R R^T, (N, n, n); None for the identity
        self.root = None if metric.is_identity else np.linalg.cholesky(np.linalg.inv(metric.evaluate(points)))
        self.judged = _across(J)  #: orthonormal basis across the task's rows, (N, n, r)
        self.own = self.judged if self.root is None else _across(self._in_metric(J))  #: the same in the metric

    @abstractmethod
    def gradients(self, theta: Array) -> tuple[Array, Back]:
        """dxi/dq of parameters, (N, r, n), and the way back."""

    def volumes(self, theta: Array) -> Array:
        """The volumes of `RegularPart`, (N,)."""
        return np.asarray(np.linalg.det(_unit(self.gradients(theta)[0])[0] @ self.judged))

    def lengths(self, theta: Array) -> Array:
        """Root mean square of the lengths of gradients in the metric, (r,)."""
        return np.asarray(np.sqrt((self._in_metric(self.gradients(theta)[0]) ** 2).sum(axis=2).mean(axis=0)))

    def shortfall(self, theta: Array, target: float, sense: float, wanted: Array) -> tuple[float, Array]:
        """Sum of max(0, 1 - sense v / target)^2 + w |log(l / wanted)|^2, and its derivative after the parameters.

        The volumes v and the lengths l (r,) of gradients are those in the metric. In another metric than the identity,
        the sum for the volumes of `RegularPart` and a little more than its bound joins it: coordinates that are
        orthogonal in the inertia may be nearly parallel otherwise.
        """
        J, back = self.gradients(theta)
        unit, lengths = _unit(self._in_metric(J))
        uneven = np.log(lengths / wanted[:, None])
        value, slopes = _shortfall_and_slopes(unit, lengths, self.own, target, sense)
        value, slopes = value + _EVENNESS * float((uneven**2).sum()), slopes + 2 * _EVENNESS * uneven * unit / lengths
        if self.root is not None:
            bound = _BEYOND * LEAST_VOLUME / J.shape[1]
            own, more = _shortfall_and_slopes(*_unit(J), self.judged, bound, sense)
            value, slopes = value + own, slopes @ self.root.transpose(0, 2, 1) + more
        return value, back(slopes)

    def _in_metric(self, rows: Array) -> Array:
        """Rows (N, k, n) times R, which have the products of the metric."""
        return rows if self.root is None else np.asarray(rows @ self.root)


class BasisField(Field):
    """Samples for a family that is linear in its parameters, which are coefficients C (r, K)."""

    def __init__(self, problem: Problem, points: Array, basis: BasisGradients) -> None:
        super().__init__(problem, points)
        self._basis, self._known = basis, basis.at(points)

    def gradients(self, theta: Array) -> tuple[Array, Back]:
        """dxi/dq of coefficients (r, K), and back."""

        def back(slopes: Array) -> Array:
            return self._basis.pullback(self._known, slopes)

        return self._basis.jacobian(self._known, theta, len(self.points)), back

    def along(self, directions: Array) -> Array:
        """dpsi/dq . a for directions a (N, n), (N, K)."""
        return self._basis.along(self._known, directions)

    def energy(self) -> Array:
        """Mean of dpsi_i/dq A^-1 dpsi_j/dq, (K, K)."""
        N, n = self.points.shape
        root = np.broadcast_to(np.eye(n), (N, n, n)) if self.root is None else self.root
        parts = (self.along(root[:, :, i]) for i in range(n))
        return np.asarray(sum((G.T @ G for G in parts), start=np.zeros(())) / N)


class NetworkField(Field):
    """Samples for a family of networks, of parameters theta (size,). Products are computed in single precision."""

    def __init__(self, problem: Problem, points: Array, family: ArrayFamily) -> None:
        super().__init__(problem, points)
        self._family, self._memory = family, ArrayMemory()

    def gradients(self, theta: Array) -> tuple[Array, Back]:
        """dxi/dq, and back."""
        J, pulled = self._family.pullback(self.points, theta.astype(np.float32), self._memory)

        def back(slopes: Array) -> Array:
            return pulled(slopes, np.empty(theta.size, np.float32)).astype(float)

        return J, back

    def volumes(self, theta: Array) -> Array:
        """The volumes of `RegularPart`, (N,), of some samples at a time: arrays of networks are large."""
        parts = (self.part(slice(k, k + _WATCHED)) for k in range(0, len(self.points), _WATCHED))
        return np.concatenate([Field.volumes(part, theta) for part in parts])

    def part(self, rows: NDArray[np.int_] | slice) -> Self:
        """Some of the samples. Parts share the arrays of the network."""
        part = copy(self)
        part.points, part.judged, part.own = self.points[rows], self.judged[rows], self.own[rows]
        part.root = None if self.root is None else self.root[rows]
        return part


def _shortfall_and_slopes(
    unit: Array, lengths: Array, across: Array, target: float, sense: float
) -> tuple[float, Array]:
    """Sum of max(0, 1 - sense v / target)^2 with v = det(unit across), and its derivative after unit * lengths."""
    inner = unit @ across
    volumes = sense * np.linalg.det(inner)
    short = np.maximum(0.0, 1 - volumes / target)
    some = short > 0
    inverse = np.linalg.inv(inner[some] + (volumes[some] == 0)[:, None, None] * _TINY * np.eye(unit.shape[1]))
    G = volumes[some, None, None] * (across[some] @ inverse).transpose(0, 2, 1)  # dv after unit gradients
    G -= np.einsum("sri,sri->sr", G, unit[some])[:, :, None] * unit[some]
    G *= (-2 / target * short[some])[:, None, None] / lengths[some]
    slopes = np.zeros_like(unit)
    slopes[some] = G
    return float(short @ short), slopes


def _unit(rows: Array) -> tuple[Array, Array]:
    """Rows (N, k, n) of length 1, and their lengths (N, k, 1)."""
    lengths = np.maximum(np.linalg.norm(rows, axis=2, keepdims=True), _TINY)
    return rows / lengths, lengths


def _across(rows: Array) -> Array:
    """An orthonormal basis Z (N, n, r) across rows (N, m, n), with det [rows; G] > 0 just where det(G Z) > 0."""
    m = rows.shape[1]
    Q, R = np.linalg.qr(rows.transpose(0, 2, 1), mode="complete")
    Z = Q[:, :, m:]
    Z[:, :, 0] *= np.sign(np.linalg.det(Q) * np.linalg.det(R[:, :m]))[:, None]
    return np.asarray(Z)


class BasisShortfall:
    """Mean of max(0, 1 - v / target)^2 over samples, of uneven lengths, and terms of what coordinates mean.

    Its variables Y are in a basis of functions whose gradients are orthonormal in the mean, C = Y L^-1. Coordinates
    begin with gradients of length 1 in the mean there.

    Args:
        fields: the samples.
        target: the volume beyond which nothing is lost.
        sense: sign of the volumes.
        factor: L (K, K), lower triangular, with the mean L L^T of products of gradients.
        wishes: terms of the first coordinates.
        start: coefficients (r, K) that give the lengths.
    """

    def __init__(
        self, fields: list[BasisField], target: float, sense: float, factor: Array, wishes: list[Wish], start: Array
    ) -> None:
        self._fields, self._target, self._sense, self._factor, self._wishes = fields, target, sense, factor, wishes
        self._lengths = np.linalg.norm(start @ factor, axis=1)[:, None]
        self._count = sum(len(field.points) for field in fields)

    def variables(self, C: Array) -> Array:
        """Y of coefficients (r, K), (r K,)."""
        return np.asarray((C @ self._factor / self._lengths).ravel())

    def coefficients(self, theta: Array) -> Array:
        """C (r, K)."""
        return self._solved((theta.reshape(len(self._lengths), -1) * self._lengths).T, trans="T").T

    def value(self, theta: Array) -> float:
        """The mean and the terms."""
        return self.value_and_gradient(theta)[0]

    def value_and_gradient(self, theta: Array) -> tuple[float, Array]:
        """The mean and the terms, and the derivative (r K,)."""
        C = self.coefficients(theta)
        wanted = self._lengths[:, 0]
        parts = [field.shortfall(C, self._target, self._sense, wanted) for field in self._fields]
        value = sum(part for part, _ in parts) / self._count
        slopes = sum((part for _, part in parts), start=np.zeros(())) / self._count
        for k, (E, g, a) in enumerate(self._wishes):
            value += float(C[k] @ E @ C[k] - 2 * g @ C[k] + a)
            slopes[k] += 2 * (E @ C[k] - g)
        return value, (self._solved(slopes.T).T * self._lengths).ravel()

    def _solved(self, columns: Array, trans: str = "N") -> Array:
        """L^-1 or L^-T times columns."""
        return np.asarray(scipy.linalg.solve_triangular(self._factor, columns, lower=True, trans=trans))


class NetworkShortfall:
    """Mean of max(0, 1 - v / target)^2 over samples, and of uneven lengths, for the parameters of a network.

    Args:
        field: the samples. The loss is watched on some of them, and steps take other parts.
        target: the volume beyond which nothing is lost.
        sense: sign of the volumes.
        wanted: lengths of gradients, (r,).
    """

    def __init__(self, field: NetworkField, target: float, sense: float, wanted: Array) -> None:
        self._all, self._field = field, field.part(slice(None, None, max(1, len(field.points) // _WATCHED)))
        self._target, self._sense, self._wanted = target, sense, wanted

    def value(self, theta: Array) -> float:
        """The mean."""
        return self.value_and_gradient(theta)[0]

    def value_and_gradient(self, theta: Array) -> tuple[float, Array]:
        """The mean and its derivative, (size,)."""
        value, slopes = self._field.shortfall(theta, self._target, self._sense, self._wanted)
        return value / len(self._field.points), slopes / len(self._field.points)

    def batches(self, size: int, count: int, seed: tuple[int, ...]) -> Iterator["NetworkShortfall"]:
        """The same mean over samples drawn from all, `size` each, fewer than are watched."""
        rng = np.random.default_rng(seed)
        for _ in range(count):
            part = self._all.part(rng.integers(len(self._all.points), size=size))
            yield NetworkShortfall(part, self._target, self._sense, self._wanted)
