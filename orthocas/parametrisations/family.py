"""What a parametrisation is: a choice of family, and the family itself once the joints are known."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol, Self, TypeVar, runtime_checkable

import casadi as ca

from orthocas.checks import Array

if TYPE_CHECKING:
    from orthocas.problem import Problem

Expression = TypeVar("Expression", ca.SX, ca.MX)


@dataclass(frozen=True, eq=False)
class JointSpace:
    """The joints a family is a function of: the box it is scaled to, and which joints slide."""

    centre: Array  #: (n,)
    half_width: Array  #: (n,), > 0
    prismatic: tuple[bool, ...]
    joint_names: tuple[str, ...]

    @classmethod
    def of(cls, problem: "Problem") -> "JointSpace":
        """All joints of a problem."""
        robot, domain = problem.robot, problem.domain
        return cls(domain.centre, domain.half_width, robot.tree.prismatic, robot.joint_names)

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
class ReorderableFamily(Family, Protocol):
    """A family whose components can change places."""

    def reordered(self, theta: Array, order: Sequence[int]) -> Array:
        """Parameters of the same components in another order, (size,)."""
        ...


@runtime_checkable
class LinearFamily(Family, Protocol):
    """A family linear in its parameters: xi_theta(q) = C psi(q), with theta the rows of C (r, K) one after the other.

    No basis function is constant: a constant does not change J_xi. `BasisFamily` makes one of any basis.
    """

    def basis(self, q: Expression) -> Expression:
        """psi(q), (K, N), for q (n, N); K is the `width` of the family."""
        ...


@runtime_checkable
class GradedFamily(LinearFamily, Protocol):
    """A linear family whose basis contains the bases of lower degrees."""

    def embed(self, theta: Array, coarser: Self) -> Array:
        """Parameters of a family of lower degree, written in this one, (size,)."""
        ...


@runtime_checkable
class SelfDerivativeFamily(LinearFamily, Protocol):
    """A linear family whose derivatives are sums of its own functions: controllers and C then need no other basis."""

    def derivative_tables(self, theta: Array) -> Array:
        """C_i with d xi / d q_i = C_i (1, psi), (n, r, 1 + K)."""
        ...


@dataclass(frozen=True, eq=False)
class ClosedForm:
    """Coordinates that follow from the problem without a fit."""

    theta: Array  #: parameters of the family, (size,)
    origin: Array | None = None  #: joint position where xi = 0, (n,); default the centre of the domain
    scaled: bool = True  #: whether coordinates are scaled to a mean gradient length of 1


@runtime_checkable
class Parametrisation(Protocol):
    """A choice of family, before the joints are known; plain settings only."""

    @property
    def label(self) -> str:
        """Short name that the command line understands, for example 'polynomial:4'."""
        ...

    @property
    def linear(self) -> bool:
        """Whether its families are linear in their parameters: then Gauss-Newton is the default solver."""
        ...

    @property
    def closed_form(self) -> "Callable[[Problem], ClosedForm] | None":
        """What finds the parameters without a fit; None if they are fitted."""
        ...

    def for_problem(self, problem: "Problem") -> "Parametrisation":
        """The same with everything it has to know of the problem; itself, if that is nothing."""
        ...

    def family(self, space: JointSpace, outputs: int) -> Family:
        """The family of functions of the given joints with `outputs` components."""
        ...


@runtime_checkable
class GradedParametrisation(Parametrisation, Protocol):
    """A parametrisation with a degree, whose families of lower degree lie inside those of higher degree."""

    @property
    def degree(self) -> int:
        """Total degree."""
        ...

    def of_degree(self, degree: int) -> Self:
        """The same parametrisation with another degree."""
        ...

    def term_count(self, n: int) -> int:
        """Number of basis functions for n joints, without building them."""
        ...

    def family(self, space: JointSpace, outputs: int) -> GradedFamily:
        """The family on the given joints."""
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
