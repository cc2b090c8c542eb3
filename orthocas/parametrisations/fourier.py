"""Fourier terms on the torus: products of sines and cosines up to a total degree (ours)."""

from dataclasses import dataclass
from math import comb, sqrt
from typing import TYPE_CHECKING, ClassVar

import casadi as ca
import numpy as np

from orthocas.checks import Array, require_count
from orthocas.errors import InvalidValueError
from orthocas.parametrisations.family import JointSpace
from orthocas.parametrisations.product_basis import ProductFamily, product_family, terms_up_to

if TYPE_CHECKING:
    from orthocas.problem import Problem


@dataclass(frozen=True)
class Fourier:
    """Products of sqrt(2) cos(k q_i) and sqrt(2) sin(k q_i) of total degree <= degree, periodic in every joint.

    Args:
        degree: total degree, >= 1.

    Example:
        >>> import orthocas as oc
        >>> fourier = oc.Fourier(degree=2)
        >>> fourier.label, fourier.term_count(3)
        ('fourier:2', 24)
    """

    degree: int
    linear: ClassVar[bool] = True
    closed_form: ClassVar[None] = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "degree", require_count("degree", self.degree))

    @property
    def label(self) -> str:
        """'fourier:DEGREE'."""
        return f"fourier:{self.degree}"

    def for_problem(self, problem: "Problem") -> "Fourier":
        """The object itself: it does not depend on the problem."""
        return self

    def of_degree(self, degree: int) -> "Fourier":
        """The same parametrisation with another degree."""
        return Fourier(degree)

    def term_count(self, n: int) -> int:
        """Sum over j of C(n, j) C(d, j) 2^j, without the constant."""
        return sum(comb(n, j) * comb(self.degree, j) * 2**j for j in range(1, min(n, self.degree) + 1))

    def family(self, space: JointSpace, outputs: int) -> ProductFamily:
        """Fourier terms of the joint angles.

        Raises:
            InvalidValueError: if a joint is prismatic. The message names it.
        """
        if any(space.prismatic):
            name = space.joint_names[space.prismatic.index(True)]
            raise InvalidValueError(
                f"joint '{name}' of a Fourier basis", "prismatic", "a revolute joint; use polynomial instead"
            )

        def waves(i: int, q: ca.SX) -> list[ca.SX]:
            out = [1 + 0 * q]
            for k in range(1, self.degree + 1):
                out += [sqrt(2) * ca.cos(k * q), sqrt(2) * ca.sin(k * q)]
            return out

        def derivatives(i: int) -> Array:
            """cos(k q)' = -k sin(k q), sin(k q)' = k cos(k q)."""
            D = np.zeros((2 * self.degree + 1,) * 2)
            for k in range(1, self.degree + 1):
                D[2 * k - 1, 2 * k], D[2 * k, 2 * k - 1] = -k, k
            return D

        degrees = [[0] + [k for k in range(1, self.degree + 1) for _ in range(2)]] * space.n
        return product_family(space, outputs, tuple(terms_up_to(degrees, self.degree)), waves, derivatives)
