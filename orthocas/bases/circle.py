"""Circle-valued coordinates, angles of pairs of functions: xi on SO(2) ([AS2023] Sec. 5.1.1; fitting them is ours)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from orthocas.bases.family import TURN, CombinableFamily, Expression, Family, JointSpace, LinearFamily, Parametrisation
from orthocas.errors import InvalidValueError
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array

if TYPE_CHECKING:
    from orthocas.tasks.problem import Problem


@dataclass(frozen=True)
class Circle:
    """xi_j = atan2(v_j, u_j) in (-pi, pi], with pairs (u_j, v_j) from another parametrisation.

    (u_j, v_j) / |(u_j, v_j)| is a point of the unit circle, smooth wherever the pair is not zero, so a closed leaf can
    have one coordinate without a fold and without a cut. The angle passes from pi to -pi at no particular place.

    Args:
        pairs: the parametrisation of the pairs: networks, polynomials or Fourier terms, without cyclic joints.

    Raises:
        InvalidValueError: if the pairs cannot be fitted, or are circle-valued themselves.

    Example:
        >>> import orthocas as oc
        >>> oc.Circle(oc.Fourier(3)).label
        'circle:fourier:3'
    """

    pairs: Parametrisation
    linear = False
    closed_form = None

    def __post_init__(self) -> None:
        fitted = isinstance(self.pairs, Parametrisation) and not isinstance(self.pairs, type)
        if not fitted or self.pairs.closed_form is not None or isinstance(self.pairs, Circle):
            raise InvalidValueError("pairs", repr(self.pairs)[:80], "a parametrisation to fit, such as Fourier(3)")
        if getattr(self.pairs, "cyclic", ()):
            raise InvalidValueError("pairs", self.pairs.label, "a parametrisation without cyclic joints")

    @property
    def label(self) -> str:
        """'circle:' and the label of the pairs."""
        return f"circle:{self.pairs.label}"

    def for_problem(self, problem: Problem) -> Circle:
        """The parametrisation with pairs for this problem."""
        return Circle(self.pairs.for_problem(problem))

    def family(self, space: JointSpace, outputs: int) -> CircleFamily:
        """The family on the given joints.

        Raises:
            InvalidValueError: if linear combinations of the functions of the pairs are not in their family.
        """
        pairs = self.pairs.family(space, 2 * outputs)
        if not isinstance(pairs, CombinableFamily):
            raise InvalidValueError("pairs", self.pairs.label, "a family with `combined`, see CombinableFamily")
        return CircleFamily(pairs, outputs)


@dataclass(frozen=True, eq=False)
class CircleFamily:
    """Angles of pairs. theta holds the parameters of the pairs u_1..u_r, v_1..v_r, and a constant for each of them.

    The constants are left out for families that have them, such as networks.
    """

    pairs: Family
    outputs: int

    @cached_property
    def constants(self) -> int:
        """Number of constants: bases have none of their own."""
        return 2 * self.outputs if isinstance(self.pairs, LinearFamily) else 0

    @property
    def size(self) -> int:
        """Number of parameters."""
        return self.pairs.size + self.constants

    @property
    def periods(self) -> Array:
        """2 pi for all, (r,)."""
        return np.full(self.outputs, TURN)

    @property
    def as_matrices(self) -> bool:
        """What the pairs say."""
        return self.pairs.as_matrices

    @property
    def width(self) -> int:
        """What the pairs say."""
        return self.pairs.width

    def expression(self, q: Expression, theta: Expression) -> Expression:
        """Angles in (-pi, pi], (r, N), for q (n, N)."""
        u, v = self._pairs(q, theta)
        angles: Expression = ca.atan2(v, u)
        return angles

    def jacobian(self, q: Expression, theta: Expression) -> list[Expression]:
        """Gradients (u dv - v du) / (u^2 + v^2), r matrices (n, N)."""
        # Those of u and v, row by row over |(u, v)|^2.
        u, v = self._pairs(q, theta)
        slopes = self.pairs.jacobian(q, theta[: self.pairs.size])
        squared, n = u**2 + v**2, q.shape[0]
        gradients: list[Any] = []
        for j in range(self.outputs):
            along_u, along_v = (ca.repmat(part[j, :] / squared[j, :], n, 1) for part in (u, v))
            gradients.append(along_u * slopes[self.outputs + j] - along_v * slopes[j])
        return gradients

    def initial(self, seed: int) -> Array:
        """A start of the pairs, with constants of zero, (size,)."""
        return np.concatenate([self.pairs.initial(seed), np.zeros(self.constants)])

    def reordered(self, theta: Array, order: Sequence[int]) -> Array:
        """Parameters of the coordinates in another order, (size,)."""
        pick, none = np.eye(self.outputs)[list(order)], np.zeros((self.outputs, self.outputs))
        return self._combine(theta, np.block([[pick, none], [none, pick]]))

    def turned(self, theta: Array, angles: Array) -> Array:
        """Parameters of xi - angles, (size,): every pair is turned back by its angle (r,) [rad]."""
        # A turn of the plane of each pair.
        c, s = np.diag(np.cos(angles)), np.diag(np.sin(angles))
        return self._combine(theta, np.block([[c, s], [-s, c]]))

    def _combine(self, theta: Array, B: Array) -> Array:
        """Parameters of the pairs B (u, v), for a matrix B (2 r, 2 r)."""
        own, rest = theta[: self.pairs.size], theta[self.pairs.size :]
        assert isinstance(self.pairs, CombinableFamily)
        return np.concatenate([self.pairs.combined(own, B), B @ rest if self.constants else rest])

    def _pairs(self, q: Expression, theta: Expression) -> tuple[Expression, Expression]:
        """u and v, (r, N) each."""
        values = self.pairs.expression(q, theta[: self.pairs.size])
        if self.constants:
            values = values + ca.repmat(theta[self.pairs.size :], 1, q.shape[1])
        return values[: self.outputs, :], values[self.outputs :, :]
