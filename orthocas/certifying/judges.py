"""Tests of boxes: what can be proved on each of them, and which joint to halve where it is not enough."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from orthocas.casadi_tools.threads import one_blas_thread
from orthocas.certifying.chart_rows import ChartRows
from orthocas.certifying.elimination import in_singular_basis, lower_bound, pivots
from orthocas.certifying.monomials import Variables
from orthocas.certifying.taylor import TaylorModel
from orthocas.certifying.volume import conditioning_bound
from orthocas.checks import Array

UNKNOWN = -1
_AT_ONCE = 64  # boxes whose models fit into the cache of a processor


@dataclass(frozen=True, slots=True, eq=False)
class Verdicts:
    """What was found on each box."""

    proved: Array  #: (boxes,) bool
    regular: Array  #: (boxes,) bool: det J has the sign below on the whole box
    sign: Array  #: (boxes,) of det J at the middle of the box: +1, -1, or 0 where it is unclear
    conditioning: Array  #: (boxes,) lower bounds; 0 where none is known
    widest: Array  #: (boxes,) the joint to halve; `UNKNOWN` where bounds are infinite, so none is known to help most


class Judge(Protocol):
    """A test of boxes. Judges can be pickled, so that processes and machines can share the work."""

    @property
    def joints(self) -> Variables:
        """The joints on which the verdict depends: halving others is of no use."""
        ...

    def __call__(self, low: Array, high: Array) -> Verdicts:
        """Judge boxes between corners (boxes, n)."""
        ...


@dataclass(frozen=True, eq=False)
class RegularityJudge:
    """Proves det J != 0, and, for a bound above 0, conditioning >= bound."""

    rows: ChartRows
    bound: float

    @property
    def joints(self) -> Variables:
        """The joints that J depends on."""
        return self.rows.variables

    def __call__(self, low: Array, high: Array) -> Verdicts:
        """Judge boxes between corners (boxes, n)."""
        with one_blas_thread():  # small products, and the same rounding everywhere
            J = self.rows(low, high)
            return _joined([self._few(part) for part in _parts(J)], J.variables)

    def _few(self, J: TaylorModel) -> tuple[Array, ...]:
        with np.errstate(invalid="ignore", over="ignore", divide="ignore"):  # boxes where bounds are infinite
            turned, signs = in_singular_basis(J)
            regular = all_positive(pivots(turned)) & (signs != 0)
        conditioning = np.zeros(len(signs))
        if self.bound > 0 and regular.any():
            conditioning[regular] = conditioning_bound(chosen(J, regular), self.rows.m)
        proved = regular & (conditioning >= self.bound)
        return proved, regular, signs, conditioning, influences(turned)


def all_positive(found: list[TaylorModel]) -> NDArray[np.bool_]:
    """Whether all pivots have one sign on the box and the pivots of the middle are positive."""
    return np.asarray(np.all([lower_bound(pivot) > 0 for pivot in found], axis=0))


def influences(turned: TaylorModel) -> Array:
    """How much halving each variable narrows the matrix, relative to its singular values, (boxes, variables)."""
    middle = np.sqrt(np.abs(np.stack([turned.centre[k, k] for k in range(len(turned.remainder))])) + 1e-300)
    influences: Array = (turned.gains() / (middle[:, None] * middle[None])).sum(axis=(1, 2)).T
    return influences


def most_influential(influences: Array, joints: Variables) -> Array:
    """The joint of the largest influence on each box, (boxes,); `UNKNOWN` where they are not finite."""
    known = np.isfinite(influences).all(axis=1)
    return np.where(known, np.array(joints)[np.argmax(np.nan_to_num(influences), axis=1)], UNKNOWN)


def _parts(J: TaylorModel) -> list[TaylorModel]:
    return [chosen(J, slice(k, k + _AT_ONCE)) for k in range(0, J.remainder.shape[-1], _AT_ONCE)]


def chosen(J: TaylorModel, boxes: slice | NDArray[np.bool_]) -> TaylorModel:
    """The models of some of the boxes."""
    return TaylorModel(J.variables, J.coefficients[..., boxes], J.remainder[..., boxes])


def _joined(parts: list[tuple[Array, ...]], variables: Variables) -> Verdicts:
    proved, regular, sign, conditioning, influences = (np.concatenate(each) for each in zip(*parts, strict=True))
    return Verdicts(proved, regular, sign, conditioning, most_influential(influences, variables))
