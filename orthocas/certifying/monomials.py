"""Tables of the monomials up to degree 3 in several variables, and of their products."""

from dataclasses import dataclass
from functools import cache
from itertools import combinations_with_replacement

import numpy as np
from numpy.typing import NDArray

DEGREE = 3
Variables = tuple[int, ...]  #: increasing numbers of variables
Monomial = tuple[int, ...]  #: its variables in increasing order, repeated for powers
Places = slice | NDArray[np.intp]  #: where coefficients go


@cache
def monomials(variables: Variables, degree: int = DEGREE) -> tuple[Monomial, ...]:
    """All monomials up to the degree, in order of their degrees."""
    degrees = range(degree + 1)
    return tuple(m for d in degrees for m in combinations_with_replacement(variables, d))


@cache
def order_starts(count: int) -> tuple[int, ...]:
    """Where the monomials of degree 0, 1, 2, 3 in so many variables start, and how many there are in all."""
    linear, quadratic = 1 + count, (1 + count) * (2 + count) // 2
    return 0, 1, linear, quadratic, quadratic * (3 + count) // 3


@cache
def places(part: Variables, whole: Variables) -> Places:
    """Where the monomials of some of the variables stand among those of all."""
    index = {monomial: k for k, monomial in enumerate(monomials(whole))}
    return _compact([index[monomial] for monomial in monomials(part)])


@dataclass(frozen=True, slots=True)
class Product:
    """How to multiply two polynomials a and b, cut off after degree 3."""

    variables: Variables  #: of the product
    size: int  #: number of coefficients of the product
    left: Places  #: of a's monomials
    right: Places  #: of b's monomials
    by_linear: tuple[Places, ...]  #: of a's linear monomials times b's linear and quadratic ones
    quadratic_by: tuple[Places, ...]  #: of a's quadratic monomials times b's linear ones


@cache
def product(left: Variables, right: Variables) -> Product:
    """The table for polynomials in the given variables."""
    both = tuple(sorted({*left, *right}))
    index = {monomial: k for k, monomial in enumerate(monomials(both))}

    def of(one: Monomial, others: tuple[Monomial, ...]) -> Places:
        return _compact([index[tuple(sorted(one + other))] for other in others])

    a, b = monomials(left), monomials(right)
    starts = order_starts(len(left))
    middle = b[1 : order_starts(len(right))[3]]
    return Product(
        both,
        len(index),
        places(left, both),
        places(right, both),
        tuple(of((i,), middle) for i in left),
        tuple(of((j,), a[starts[2] : starts[3]]) for j in right),
    )


def _compact(indices: list[int]) -> Places:
    """A slice where the indices follow each other."""
    if indices and indices == list(range(indices[0], indices[-1] + 1)):
        return slice(indices[0], indices[-1] + 1)
    return np.array(indices, dtype=np.intp)
