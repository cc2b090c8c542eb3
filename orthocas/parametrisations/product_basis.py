"""Bases of products of one-joint functions, linear in their coefficients: polynomials and Fourier terms."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol, Self, runtime_checkable

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from orthocas.casadi_tools.columns import ColumnFunction, blocked
from orthocas.checks import Array
from orthocas.parametrisations.family import Expression, JointSpace, component_gradients

Term = tuple[int, ...]  #: for every joint, which one-joint function the term takes; 0 is the constant 1


@dataclass(frozen=True, eq=False)
class LinearFamily:
    """xi_theta(q) = C psi(q), with theta the rows of C (r, K) one after the other.

    psi_k(q) = prod_i f_i,k_i(q_i) over the joints. No term is constant: a constant does not change J_xi. Derivatives of
    terms are sums of terms: with a term, the family has those that come from it when a factor is differentiated.
    """

    space: JointSpace
    outputs: int
    terms: tuple[Term, ...]
    one_joint_functions: Callable[[int, Any], list[Any]]
    one_joint_derivatives: Callable[[int], Array]  #: D of joint i, with f_i,a' = sum_b D_ab f_i,b
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

    def derivative_tables(self, theta: Array) -> Array:
        """C_i with d xi / d q_i = C_i (1, psi), (n, r, 1 + K)."""
        n, C = self.space.n, theta.reshape(self.outputs, self.width)
        places = {(0,) * n: 0} | {term: 1 + k for k, term in enumerate(self.terms)}
        tables = np.zeros((n, self.outputs, 1 + self.width))
        for i in range(n):
            D = self.one_joint_derivatives(i)
            for k, term in enumerate(self.terms):
                for b in np.flatnonzero(D[term[i]]):
                    tables[i, :, places[(*term[:i], int(b), *term[i + 1 :])]] += D[term[i], b] * C[:, k]
        return tables

    @cached_property
    def terms_of_joints(self) -> NDArray[np.int_]:
        """For every joint the places of the terms that depend on it, (n, W); a shorter row ends with -1.

        For n joints and total degree d that is a share of d / (n + d) of all polynomials: most gradients are zero.
        """
        rows = [[k for k, term in enumerate(self.terms) if term[i]] for i in range(self.space.n)]
        width = max(len(row) for row in rows)
        return np.array([row + [-1] * (width - len(row)) for row in rows])

    def basis_gradients(self, points: Array) -> Array:
        """The gradients d psi_k / dq_i that are not zero, at points (N, n), in blocks of c samples, (B, n, W, c).

        Entry w of joint i belongs to term `terms_of_joints[i, w]`; blocks as in `orthocas.casadi_tools.columns`.
        """
        gradients = self._gradient_columns(blocked(points))[0]
        return gradients.reshape(len(gradients), self.space.n, -1, gradients.shape[2])

    def dense_gradients(self, gradients: Array, samples: int, every: int = 1) -> Array:
        """All gradients sample by sample, zeros included, (N, n, K), from those of `basis_gradients`.

        Args:
            gradients: (B, n, W, c).
            samples: number of samples, without the copies that fill the last block.
            every: take only every second, third, ... sample.
        """
        stack = gradients.transpose(0, 3, 1, 2).reshape(-1, *gradients.shape[1:3])[:samples:every]
        dense = np.zeros((len(stack), self.space.n, len(self.terms)), dtype=gradients.dtype)
        for i, places in enumerate(self.terms_of_joints):
            known = places[places >= 0]
            dense[:, i, known] = stack[:, i, : len(known)]
        return dense

    @cached_property
    def _gradient_columns(self) -> ColumnFunction:
        q = ca.SX.sym("q", self.space.n)
        J = ca.densify(ca.jacobian(self.basis(q), q))
        entries = [J[int(k), i] if k >= 0 else 0 for i, row in enumerate(self.terms_of_joints) for k in row]
        return ColumnFunction(ca.Function("basis_gradients", [q], [ca.densify(ca.vertcat(*entries))]))

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
