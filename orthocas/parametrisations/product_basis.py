"""Bases of products of one-joint functions: polynomials and Fourier terms."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from orthocas.checks import Array
from orthocas.parametrisations.basis import BasisFamily
from orthocas.parametrisations.family import JointSpace

Term = tuple[int, ...]  #: index of the one-joint function of every joint; 0 is the constant 1


@dataclass(frozen=True, eq=False, kw_only=True)
class ProductFamily(BasisFamily):
    """psi_k(q) = prod_i f_i,k_i(q_i) over the joints. Use `product_family` to build one.

    Derivatives of terms are sums of terms. So with each term, the family contains the terms of its derivatives.
    """

    terms: tuple[Term, ...]
    one_joint_derivatives: Callable[[int], Array]  #: D of joint i, with f_i,a' = sum_b D_ab f_i,b

    @property
    def width(self) -> int:
        """Number of terms K."""
        return len(self.terms)

    def initial(self, seed: int) -> Array:
        """Random coefficients that decrease with the degree, (size,)."""
        order = np.array([np.count_nonzero(term) for term in self.terms])
        C = np.random.default_rng(seed).normal(size=(self.outputs, len(self.terms))) * 0.3**order
        return C.ravel()

    def embed(self, theta: Array, coarser: "ProductFamily") -> Array:
        """Convert coefficients of a smaller basis to this one, (size,)."""
        place = {term: k for k, term in enumerate(self.terms)}
        wide = np.zeros((self.outputs, self.width))
        wide[:, [place[term] for term in coarser.terms]] = theta.reshape(self.outputs, coarser.width)
        return wide.ravel()

    def derivative_tables(self, theta: Array) -> Array:
        """C_i with d xi / d q_i = C_i (1, psi), (n, r, 1 + K)."""
        n, C = self.space.n, theta.reshape(self.outputs, self.width)
        places = {(0,) * n: 0} | {term: 1 + k for k, term in enumerate(self.terms)}
        tables = np.zeros((n, self.outputs, 1 + self.width))
        for i in range(n):
            D = self.one_joint_derivatives(i)
            parts = [np.flatnonzero(row).tolist() for row in D]
            for k, term in enumerate(self.terms):
                for b in parts[term[i]]:
                    tables[i, :, places[(*term[:i], b, *term[i + 1 :])]] += D[term[i], b] * C[:, k]
        return tables


def product_family(
    space: JointSpace,
    outputs: int,
    terms: tuple[Term, ...],
    one_joint_functions: Callable[[int, Any], list[Any]],
    one_joint_derivatives: Callable[[int], Array],
) -> ProductFamily:
    """The family of the given terms.

    Args:
        space: the joints.
        outputs: number of components.
        terms: the terms. None is constant, and the terms of their derivatives are included.
        one_joint_functions: f_i,0 = 1, f_i,1, ... of joint i at its position.
        one_joint_derivatives: D of joint i, with f_i,a' = sum_b D_ab f_i,b.
    """

    def basis(q: Any) -> Any:
        tables = [one_joint_functions(i, q[i, :]) for i in range(space.n)]
        products: dict[Term, Any] = {}
        for term in terms:
            _product(term, tables, products)
        return ca.vertcat(*(products[term] for term in terms))

    return ProductFamily(space, outputs, basis, terms=terms, one_joint_derivatives=one_joint_derivatives)


def _product(term: Term, tables: list[list[Any]], products: dict[Term, Any]) -> Any:
    """Value of a term: the product of all factors but the last, times the last."""
    if term not in products:
        last = int(np.flatnonzero(term)[-1])
        rest = (*term[:last], 0, *term[last + 1 :])
        factor = tables[last][term[last]]
        products[term] = _product(rest, tables, products) * factor if any(rest) else factor
    return products[term]


def reduced_terms(degrees: list[list[int]], total: int, linear: list[int]) -> tuple[Term, ...]:
    """The terms of `terms_up_to` without those in the joints `linear`, then the term linear in each of these."""
    kept = [[0] if k in linear else own for k, own in enumerate(degrees)]
    return (*terms_up_to(kept, total), *(tuple(int(i == k) for i in range(len(degrees))) for k in linear))


def terms_up_to(degrees: list[list[int]], total: int) -> Iterator[Term]:
    """All non-constant choices of one function per joint whose degrees add up to at most `total`.

    Args:
        degrees: the degrees of the functions of every joint. The first is 0.
        total: largest sum of degrees.
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
