"""What a parametrisation is: a choice of family, and the family itself once the joints are known."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar, runtime_checkable

import casadi as ca
import numpy as np

from orthocas.checks import Array

Expression = TypeVar("Expression", ca.SX, ca.MX)


@dataclass(frozen=True, eq=False)
class JointSpace:
    """The joints a family is a function of: the box it is scaled to, and which joints slide."""

    centre: Array  #: (n,)
    half_width: Array  #: (n,), > 0
    prismatic: tuple[bool, ...]
    joint_names: tuple[str, ...]

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.centre)

    def restricted_to(self, joints: list[int]) -> "JointSpace":
        """The same space with only some of the joints."""
        return JointSpace(
            self.centre[joints],
            self.half_width[joints],
            tuple(self.prismatic[i] for i in joints),
            tuple(self.joint_names[i] for i in joints),
        )


class Family(Protocol):
    """Functions xi_theta of n joints with r components and `size` explicit parameters theta."""

    @property
    def size(self) -> int:
        """Number of parameters."""
        ...

    @property
    def outputs(self) -> int:
        """Number r of components."""
        ...

    @property
    def as_matrices(self) -> bool:
        """Whether the family is made of dense products: MX graphs with samples as columns suit it, SX does not."""
        ...

    @property
    def width(self) -> int:
        """Largest number of intermediate values of one sample: how many samples fit side by side into the cache."""
        ...

    def expression(self, q: Expression, theta: Expression) -> Expression:
        """xi_theta(q), (r, N), for N joint positions side by side as columns (n, N); theta (size, 1)."""
        ...

    def jacobian(self, q: Expression, theta: Expression) -> list[Expression]:
        """Gradients of the components, r matrices (n, N): column s of the j-th is dxi_j/dq at joint position s."""
        ...

    def initial(self, seed: int) -> Array:
        """A seeded starting point, (size,)."""
        ...


@runtime_checkable
class Parametrisation(Protocol):
    """A choice of family, before the joints are known; plain settings only."""

    @property
    def label(self) -> str:
        """Short name that the command line understands, for example 'polynomial:4'."""
        ...

    def family(self, space: JointSpace, outputs: int) -> Family:
        """The family of functions of the given joints with `outputs` components."""
        ...


def component_gradients(xi: Expression, q: Expression) -> list[Expression]:
    """dxi_j/dq of every component j by reverse automatic differentiation, r matrices (n, N).

    Args:
        xi: (r, N), whose column s depends on column s of q only.
        q: symbols (n, N).
    """
    gradients = []
    for j in range(xi.shape[0]):
        seed = type(q)(*xi.shape)
        seed[j, :] = 1
        gradients.append(ca.jtimes(xi, q, seed, True))
    return gradients


def embed(theta: Array, outputs: int, coarse: Sequence[tuple[int, ...]], fine: Sequence[tuple[int, ...]]) -> Array:
    """Coefficients of a coarse basis written in a finer one that contains it, (outputs * len(fine),)."""
    place = {term: k for k, term in enumerate(fine)}
    wide = np.zeros((outputs, len(fine)))
    wide[:, [place[term] for term in coarse]] = theta.reshape(outputs, len(coarse))
    return wide.ravel()
