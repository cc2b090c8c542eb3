"""Fourier terms on the torus: products of sines and cosines up to a total degree (ours)."""

from dataclasses import dataclass
from math import comb, sqrt
from typing import TYPE_CHECKING, Any, ClassVar

import casadi as ca
import numpy as np

from orthocas.checks import Array, require_count
from orthocas.errors import InvalidValueError
from orthocas.parametrisations import cyclic as cyclic_choice
from orthocas.parametrisations.cyclic import Cyclic
from orthocas.parametrisations.family import JointSpace
from orthocas.parametrisations.product_basis import ProductFamily, product_family, reduced_terms

if TYPE_CHECKING:
    from orthocas.problem import Problem


@dataclass(frozen=True)
class Fourier:
    """Products of sqrt(2) cos(k q_i) and sqrt(2) sin(k q_i) of total degree <= degree, periodic in every joint.

    Args:
        degree: total degree, >= 1.
        cyclic: joints that appear in one linear term each instead of sines and cosines, by name, or "auto" for all
            cyclic joints of the problem; see `orthocas.cyclic_joints`.

    Example:
        >>> import orthocas as oc
        >>> fourier = oc.Fourier(degree=2)
        >>> fourier.label, fourier.term_count(3)
        ('fourier:2', 24)
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
        """'fourier:DEGREE', with the cyclic joints if there are any."""
        return f"fourier:{self.degree}{cyclic_choice.suffix(self.cyclic)}"

    def for_problem(self, problem: "Problem") -> "Fourier":
        """The parametrisation with the names of the problem's cyclic joints, if it reduces any."""
        return Fourier(self.degree, cyclic_choice.resolved(self.cyclic, problem)) if self.cyclic else self

    def of_degree(self, degree: int) -> "Fourier":
        """The same parametrisation with another degree."""
        return Fourier(degree, self.cyclic)

    def term_count(self, n: int) -> int:
        """Sum over j of C(n, j) C(d, j) 2^j, without the constant. Cyclic joints do not count in n, but add a term."""
        linear = min(n, cyclic_choice.count(self.cyclic))
        n, d = n - linear, self.degree
        terms: int = sum(comb(n, j) * comb(d, j) * 2**j for j in range(1, min(n, d) + 1))
        return terms + linear

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
        linear = cyclic_choice.indices(self.cyclic, space)

        def waves(q: Any) -> list[Any]:
            out = [sqrt(2) * wave(k * q) for k in range(1, self.degree + 1) for wave in (ca.cos, ca.sin)]
            rows = (q[i, :] - space.centre[i] if i in linear else out[0][i, :] for i in range(space.n))
            return [ca.vertcat(*rows), *out[1:]]

        def derivatives(i: int) -> Array:
            """cos(k q)' = -k sin(k q), sin(k q)' = k cos(k q); a linear function has the derivative 1."""
            if i in linear:
                return np.array([[0.0, 0.0], [1.0, 0.0]])
            D = np.zeros((2 * self.degree + 1,) * 2)
            for k in range(1, self.degree + 1):
                D[2 * k - 1, 2 * k], D[2 * k, 2 * k - 1] = -k, k
            return D

        degrees = [[0] + [k for k in range(1, self.degree + 1) for _ in range(2)]] * space.n
        return product_family(space, outputs, reduced_terms(degrees, self.degree, linear), waves, derivatives)
