"""Polynomials on the domain box: products of Legendre polynomials up to a total degree (ours)."""

from dataclasses import dataclass
from math import comb, sqrt
from typing import TYPE_CHECKING, Any, ClassVar

import casadi as ca
import numpy as np

from orthocas.checks import Array, require_count
from orthocas.parametrisations import cyclic as cyclic_choice
from orthocas.parametrisations.cyclic import Cyclic
from orthocas.parametrisations.family import JointSpace
from orthocas.parametrisations.product_basis import ProductFamily, product_family, reduced_terms

if TYPE_CHECKING:
    from orthocas.problem import Problem


@dataclass(frozen=True)
class Polynomial:
    """Products of Legendre polynomials of total degree <= degree, orthonormal for the uniform density on the box.

    Args:
        degree: total degree, >= 1.
        cyclic: joints that appear in one linear term each, by name, or "auto" for all cyclic joints of the problem.
            Charts are then valid for all positions of these joints; see `orthocas.cyclic_joints`.

    Example:
        >>> import orthocas as oc
        >>> polynomial = oc.Polynomial(degree=4)
        >>> polynomial.label, polynomial.term_count(7)
        ('polynomial:4', 329)
        >>> oc.Polynomial(degree=4, cyclic=["A1"]).term_count(7)
        210
    """

    degree: int
    cyclic: Cyclic = ()
    linear: ClassVar[bool] = True
    closed_form: ClassVar[None] = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "degree", require_count("degree", self.degree))
        object.__setattr__(self, "cyclic", cyclic_choice.checked_cyclic(self.cyclic))

    @property
    def label(self) -> str:
        """'polynomial:DEGREE', with the cyclic joints if there are any."""
        return f"polynomial:{self.degree}{cyclic_choice.suffix(self.cyclic)}"

    def for_problem(self, problem: "Problem") -> "Polynomial":
        """The parametrisation with the names of the problem's cyclic joints, if it reduces any."""
        return Polynomial(self.degree, cyclic_choice.resolved(self.cyclic, problem)) if self.cyclic else self

    def of_degree(self, degree: int) -> "Polynomial":
        """The same parametrisation with another degree."""
        return Polynomial(degree, self.cyclic)

    def term_count(self, n: int) -> int:
        """C(n + d, d) - 1, with n the number of joints that are not cyclic, plus one term for each that is."""
        linear = min(n, cyclic_choice.count(self.cyclic))
        return comb(n - linear + self.degree, self.degree) - 1 + linear

    def family(self, space: JointSpace, outputs: int) -> ProductFamily:
        """Polynomials in u_i = (q_i - centre_i) / half_width_i."""

        def legendre(q: Any) -> list[Any]:
            centre, half_width = (ca.repmat(ca.DM(v), 1, q.shape[1]) for v in (space.centre, space.half_width))
            u = (q - centre) / half_width
            P = [1 + 0 * u, u]
            for k in range(2, self.degree + 1):
                P.append(((2 * k - 1) * u * P[k - 1] - (k - 1) * P[k - 2]) / k)
            return [sqrt(2 * k + 1) * P[k] for k in range(1, self.degree + 1)]

        def derivatives(i: int) -> Array:
            """P_a' = sum of (2 b + 1) P_b over b = a - 1, a - 3, ..., here for normalised polynomials."""
            a, b = np.indices((self.degree + 1, self.degree + 1))
            values: Array = np.sqrt((2 * a + 1) * (2 * b + 1)) * ((a > b) & ((a - b) % 2 == 1)) / space.half_width[i]
            return values

        degrees = [list(range(self.degree + 1))] * space.n
        linear = cyclic_choice.indices(self.cyclic, space)
        return product_family(space, outputs, reduced_terms(degrees, self.degree, linear), legendre, derivatives)
