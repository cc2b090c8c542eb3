"""Bases of products of one-joint functions, linear in their coefficients: polynomials and Fourier terms."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol, Self, runtime_checkable

import casadi as ca
import numpy as np

from orthocas.batch import Batched, dense_function
from orthocas.checks import Array
from orthocas.parametrisations.family import Expression, JointSpace, component_gradients

Term = tuple[int, ...]  #: for every joint, which one-joint function the term takes; 0 is the constant 1


@dataclass(frozen=True, eq=False)
class LinearFamily:
    """xi_theta(q) = C psi(q), with theta the rows of C (r, K) one after the other.

    psi_k(q) = prod_i f_i,k_i(q_i) over the joints. No term is constant: a constant does not change J_xi.
    """

    space: JointSpace
    outputs: int
    terms: tuple[Term, ...]
    one_joint_functions: Callable[[int, Any], list[Any]]
    as_matrices: bool = False

    @property
    def size(self) -> int:
        """Number of coefficients r K."""
        return self.outputs * len(self.terms)

    @property
    def width(self) -> int:
        """Number of basis functions K."""
        return len(self.terms)

    def basis(self, q: Expression) -> Expression:
        """psi(q), (K, N), for q (n, N)."""
        tables = [self.one_joint_functions(i, q[i, :]) for i in range(self.space.n)]
        products: dict[Term, Any] = {}
        for term in self.terms:
            self._product(term, tables, products)
        values: Expression = ca.vertcat(*(products[term] for term in self.terms))
        return values

    def expression(self, q: Expression, theta: Expression) -> Expression:
        """xi_theta(q), (r, N), for q (n, N)."""
        return ca.reshape(theta, len(self.terms), self.outputs).T @ self.basis(q)

    def jacobian(self, q: Expression, theta: Expression) -> list[Expression]:
        """Gradients of the components, r matrices (n, N)."""
        return component_gradients(self.expression(q, theta), q)

    def initial(self, seed: int) -> Array:
        """Random coefficients that fall with the degree, (size,)."""
        order = np.array([np.count_nonzero(term) for term in self.terms])
        C = np.random.default_rng(seed).normal(size=(self.outputs, len(self.terms))) * 0.3**order
        return C.ravel()

    def basis_gradients(self, points: Array) -> Array:
        """Gradients d psi / dq at points (N, n), (N, n, K)."""
        return self._batched_gradients(points)[0].transpose(0, 2, 1)  # contiguous: CasADi fills columns

    @cached_property
    def _batched_gradients(self) -> Batched:
        q = ca.SX.sym("q", self.space.n)
        return Batched(dense_function("basis_gradients", [q], [ca.jacobian(self.basis(q), q)]))

    @classmethod
    def _product(cls, term: Term, tables: list[list[Any]], products: dict[Term, Any]) -> Any:
        """Value of a term: the term without its last factor, times that factor."""
        if term not in products:
            last = int(np.flatnonzero(term)[-1])
            rest = (*term[:last], 0, *term[last + 1 :])
            factor = tables[last][term[last]]
            products[term] = cls._product(rest, tables, products) * factor if any(rest) else factor
        return products[term]


@runtime_checkable
class GradedParametrisation(Protocol):
    """A parametrisation with a degree, whose families of lower degree lie inside those of higher degree."""

    @property
    def label(self) -> str:
        """Short name, for example 'polynomial:4'."""
        ...

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

    def family(self, space: JointSpace, outputs: int) -> LinearFamily:
        """The family on the given joints."""
        ...


def terms_up_to(degrees: list[list[int]], total: int) -> Iterator[Term]:
    """All non-constant choices of one function per joint whose degrees add up to at most `total`.

    Args:
        degrees: for every joint, the degrees of its functions; the first is 0.
        total: the largest sum of degrees.
    """

    def extend(prefix: Term, left: int) -> Iterator[Term]:
        if len(prefix) == len(degrees):
            if any(prefix):
                yield prefix
            return
        for k, degree in enumerate(degrees[len(prefix)]):
            if degree <= left:
                yield from extend((*prefix, k), left - degree)

    return extend((), total)
