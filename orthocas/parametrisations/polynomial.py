"""Polynomials on the domain box: products of Legendre polynomials up to a total degree (ours)."""

from dataclasses import dataclass
from math import comb, sqrt
from typing import TYPE_CHECKING, ClassVar

import casadi as ca
import numpy as np

from orthocas.checks import Array, require_count
from orthocas.parametrisations.family import JointSpace
from orthocas.parametrisations.product_basis import ProductFamily, product_family, terms_up_to

if TYPE_CHECKING:
    from orthocas.problem import Problem


@dataclass(frozen=True)
class Polynomial:
    """Products of Legendre polynomials of total degree <= degree, orthonormal for the uniform density on the box.

    Args:
        degree: total degree, >= 1.

    Example:
        >>> import orthocas as oc
        >>> polynomial = oc.Polynomial(degree=4)
        >>> polynomial.label, polynomial.term_count(7)
        ('polynomial:4', 329)
    """

    degree: int
    linear: ClassVar[bool] = True
    closed_form: ClassVar[None] = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "degree", require_count("degree", self.degree))

    @property
    def label(self) -> str:
        """'polynomial:DEGREE'."""
        return f"polynomial:{self.degree}"

    def for_problem(self, problem: "Problem") -> "Polynomial":
        """The object itself: it does not depend on the problem."""
        return self

    def of_degree(self, degree: int) -> "Polynomial":
        """The same parametrisation with another degree."""
        return Polynomial(degree)

    def term_count(self, n: int) -> int:
        """C(n + d, d) - 1."""
        return comb(n + self.degree, self.degree) - 1

    def family(self, space: JointSpace, outputs: int) -> ProductFamily:
        """Polynomials in u_i = (q_i - centre_i) / half_width_i."""

        def legendre(i: int, q: ca.SX) -> list[ca.SX]:
            u = (q - space.centre[i]) / space.half_width[i]
            P = [1 + 0 * u, u]
            for k in range(2, self.degree + 1):
                P.append(((2 * k - 1) * u * P[k - 1] - (k - 1) * P[k - 2]) / k)
            return [sqrt(2 * k + 1) * p for k, p in enumerate(P[: self.degree + 1])]

        def derivatives(i: int) -> Array:
            """P_a' = sum of (2 b + 1) P_b over b = a - 1, a - 3, ..., here for normalised polynomials."""
            a, b = np.indices((self.degree + 1, self.degree + 1))
            values: Array = np.sqrt((2 * a + 1) * (2 * b + 1)) * ((a > b) & ((a - b) % 2 == 1)) / space.half_width[i]
            return values

        degrees = [list(range(self.degree + 1))] * space.n
        return product_family(space, outputs, tuple(terms_up_to(degrees, self.degree)), legendre, derivatives)
