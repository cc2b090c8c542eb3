"""Products of one-joint functions as code: a plan that builds the terms level by level, and tables of coefficients."""

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from typing import Self

import casadi as ca
import numpy as np

from orthocas.casadi_tools.batch import dense_function
from orthocas.checks import Array
from orthocas.coordinates.fitted import Coordinates
from orthocas.exporting.form import Form, idle_part
from orthocas.exporting.tapes import function_code
from orthocas.parametrisations.product_basis import ProductFamily, Term, split, with_parts


@dataclass(frozen=True)
class Plan:
    """Terms by number of factors. Each is a term of the level before times its last factor.

    In every level, the terms that derivatives need come first.
    """

    levels: list[list[Term]]
    lower: set[Term]  #: what derivatives need

    @classmethod
    def of(cls, terms: Iterable[Term], of_derivatives: Iterable[Term]) -> Self:
        """The plan for these terms, with what they are made of."""
        every, lower = with_parts(terms), with_parts(of_derivatives)
        every |= {_split(term)[1] for term in every}
        lower = lower or {min(term for term in every if np.count_nonzero(term) == 1)}
        ordered = sorted(every, key=lambda term: (term not in lower, term))
        most = max(np.count_nonzero(term) for term in every)
        return cls([[term for term in ordered if np.count_nonzero(term) == k + 1] for k in range(most)], lower)

    @property
    def terms(self) -> list[Term]:
        """All terms in the order of the code."""
        return [term for level in self.levels for term in level]

    @property
    def counts(self) -> dict[str, str]:
        """How many terms each level has, and how many of them derivatives need, as Python."""
        lower = [sum(term in self.lower for term in level) for level in self.levels]
        return {"all": _tuple(map(len, self.levels)), "lower": _tuple(count for count in lower if count)}

    @property
    def indices(self) -> dict[str, list[int]]:
        """For the terms of each level, rows of the level before and rows of one-joint functions."""
        found: dict[str, list[int]] = {}
        functions = {term: k for k, term in enumerate(self.levels[0])}
        for k, (before, level) in enumerate(pairwise(self.levels), start=1):
            rows = {term: row for row, term in enumerate(before)}
            split = [_split(term) for term in level]
            found[f"parents_{k}"] = [rows[rest] for rest, _ in split]
            found[f"factors_{k}"] = [functions[alone] for _, alone in split]
        return found


def product_form(coordinates: Coordinates) -> Form | None:
    """xi = C psi + A q + c and J_xi = T psi' + D; None if the coordinates are no such products."""
    family = coordinates.family if len(coordinates.offset) else None
    if not isinstance(family, ProductFamily):
        return None
    slopes = coordinates.scale[:, None, None] * family.derivative_tables(coordinates.theta).transpose(1, 0, 2)
    used = np.flatnonzero(slopes[:, :, 1:].any(axis=(0, 1)))
    plan = Plan.of(family.terms, [family.terms[k] for k in used])
    rows = {term: k for k, term in enumerate(family.terms)}
    if not set(plan.levels[0]) <= set(rows):  # then the family has no term for a function that its terms contain
        return None
    q = ca.SX.sym("q", coordinates.space.n)
    functions = family.basis(q[coordinates.active])[[rows[term] for term in plan.levels[0]]]
    code = function_code("_one_joint", "Functions of one joint each, (k, N).", dense_function("f", [q], [functions]))
    tables = _coefficients(coordinates, plan, rows) | _slopes(coordinates, slopes, plan, rows)
    return Form("products", plan.counts, code, tables, plan.indices)


def _coefficients(coordinates: Coordinates, plan: Plan, rows: dict[Term, int]) -> dict[str, Array]:
    """C (r, terms), A (r, n) and c (r, 1)."""
    fitted, scale = len(coordinates.offset), coordinates.scale[:, None]
    A, c = idle_part(coordinates)
    C = np.zeros((coordinates.r, len(plan.terms)))
    theta = coordinates.theta.reshape(fitted, -1)
    for k, term in enumerate(plan.terms):
        if term in rows:
            C[:fitted, k] = coordinates.scale * theta[:, rows[term]]
    c[:fitted] = -scale * coordinates.offset[:, None]
    return {"C": C, "A": A, "c": c}


def _slopes(coordinates: Coordinates, slopes: Array, plan: Plan, rows: dict[Term, int]) -> dict[str, Array]:
    """T (r n, terms of derivatives) and D (r, n, 1), from the slopes (fitted, active, 1 + K)."""
    r, n, fitted, active = coordinates.r, coordinates.space.n, len(coordinates.offset), coordinates.active
    lower = [term for term in plan.terms if term in plan.lower]
    T, D = np.zeros((r, n, len(lower))), idle_part(coordinates)[0]
    for k, term in enumerate(lower):
        if term in rows:
            T[:fitted, active, k] = slopes[:, :, 1 + rows[term]]
    D[:fitted, active] = slopes[:, :, 0]
    return {"T": T.reshape(r * n, -1), "D": D[:, :, None]}


def _split(term: Term) -> tuple[Term, Term]:
    """A term without its last factor, and that factor alone."""
    rest, joint, index = split(term)
    return rest, tuple(index if k == joint else 0 for k in range(len(term)))


def _tuple(values: Iterable[int]) -> str:
    return f"({', '.join(map(str, values))},)"
