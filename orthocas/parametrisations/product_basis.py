"""Bases of products of one-joint functions: polynomials and Fourier terms."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
import scipy
from numpy.typing import NDArray

from orthocas.casadi_tools.cached import cached_property
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

    @cached_property
    def derivatives(self) -> list[tuple[Array, NDArray[np.int_], NDArray[np.int_]]]:
        """Entries of D_i with d (1, psi) / d q_i = D_i (1, psi): values, rows and columns for every joint."""
        terms = ((0,) * self.space.n, *self.terms)
        places = {term: k for k, term in enumerate(terms)}
        found = []
        for i in range(self.space.n):
            D = self.one_joint_derivatives(i)
            parts = [np.flatnonzero(row).tolist() for row in D]
            entries = [
                (k, places[(*term[:i], b, *term[i + 1 :])], D[term[i], b])
                for k, term in enumerate(terms)
                for b in parts[term[i]]
            ]
            rows, columns, values = np.array(entries, dtype=float).reshape(-1, 3).T
            found.append((values, rows.astype(int), columns.astype(int)))
        return found

    def derivative_matrix(self, joint: int) -> Any:
        """D_i as a sparse matrix, (1 + K, 1 + K)."""
        values, rows, columns = self.derivatives[joint]
        return scipy.sparse.csr_array((values, (rows, columns)), shape=(1 + self.width,) * 2)

    def derivative_tables(self, theta: Array) -> Array:
        """C_i with d xi / d q_i = C_i (1, psi), (n, r, 1 + K)."""
        C = np.hstack([np.zeros((self.outputs, 1)), theta.reshape(self.outputs, self.width)])
        tables = np.zeros((self.space.n, self.outputs, 1 + self.width))
        for table, (values, rows, columns) in zip(tables, self.derivatives, strict=True):
            np.add.at(table.T, columns, (C[:, rows] * values).T)
        return tables


def product_family(
    space: JointSpace,
    outputs: int,
    terms: tuple[Term, ...],
    one_joint_functions: Callable[[Any], list[Any]],
    one_joint_derivatives: Callable[[int], Array],
) -> ProductFamily:
    """The family of the given terms.

    Args:
        space: the joints.
        outputs: number of components.
        terms: the terms. None is constant, and the terms of their derivatives are included.
        one_joint_functions: f_1, f_2, ... of all joints at once, (n, N) each, for q (n, N).
        one_joint_derivatives: D of joint i, with f_i,a' = sum_b D_ab f_i,b.
    """

    def basis(q: Any) -> Any:
        return _products(terms, ca.vertcat(*one_joint_functions(q)))

    return ProductFamily(space, outputs, basis, terms=terms, one_joint_derivatives=one_joint_derivatives)


def _products(terms: tuple[Term, ...], factors: Any) -> Any:
    """Values of terms, (K, N), from those of the one-joint functions f_1 of all joints, then f_2 and so on.

    All terms with as many factors are one product of columns: to build them one by one takes CasADi ten times as long.
    """
    n = len(terms[0])
    levels: list[Any] = []
    rows: list[dict[Term, int]] = []  # of the terms in their levels
    for level in by_factors(terms):
        parts = [split(term) for term in level]
        values = factors[[n * (index - 1) + joint for _, joint, index in parts], :]
        levels.append(levels[-1][[rows[-1][rest] for rest, *_ in parts], :] * values if levels else values)
        rows.append({term: k for k, term in enumerate(level)})
    places = {term: k for k, term in enumerate(term for level in rows for term in level)}
    return ca.vertcat(*levels)[[places[term] for term in terms], :]


def by_factors(terms: Iterable[Term]) -> list[list[Term]]:
    """Terms and what they are made of, by the number of factors; each level is sorted."""
    levels: dict[int, list[Term]] = {}
    for term in sorted(with_parts(terms)):
        levels.setdefault(len(term) - term.count(0), []).append(term)
    return [levels[k] for k in sorted(levels)]


def with_parts(terms: Iterable[Term]) -> set[Term]:
    """The terms, and what is left of each without its last factors."""
    found: set[Term] = set()
    waiting = list(terms)
    while waiting:
        term = waiting.pop()
        if any(term) and term not in found:
            found.add(term)
            waiting.append(split(term)[0])
    return found


def split(term: Term) -> tuple[Term, int, int]:
    """A term without its last factor, the joint of this factor, and the index of its function."""
    joint = len(term) - 1
    while not term[joint]:
        joint -= 1
    return (*term[:joint], 0, *term[joint + 1 :]), joint, term[joint]


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
