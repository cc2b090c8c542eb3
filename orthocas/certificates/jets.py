"""Jets: derivatives of the tip's position and of products with bounds of the next order."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from math import comb, factorial, prod

import numpy as np
from numpy.typing import NDArray

from orthocas.certificates.task_rows import TipRows, longest_reach, rotation_deviation
from orthocas.certificates.taylor import (
    DEGREE,
    TINY,
    UP,
    Monomial,
    TaylorModel,
    Variables,
    above,
    monomials,
    sine_and_cosine,
    sum_error,
)
from orthocas.robots.tree import KinematicTree
from orthocas.tasks.domains import Domain
from orthocas.tools.checks import Array

ORDERS = (4, 6)  #: of the derivatives of J that are used, at most: more of them cost more and leave less out


@dataclass(frozen=True, slots=True, eq=False)
class Around:
    """Boxes of middles c + C t, and half differences d = D v, for t and v in [-1, 1]^n."""

    centre: Array  #: c, (n, boxes)
    middles: Array  #: C, (n, boxes)
    differences: Array  #: D, (n, boxes)
    order: int = ORDERS[0]  #: of the derivatives of J that are used at most, even

    def __getitem__(self, boxes: NDArray[np.intp]) -> "Around":
        """Some of the boxes."""
        return Around(self.centre[:, boxes], self.middles[:, boxes], self.differences[:, boxes], self.order)

    @property
    def reach(self) -> Array:
        """How far a point c + t + s d is from c at most, (n, boxes)."""
        reach: Array = (self.middles + self.differences) * UP
        return reach


@dataclass(frozen=True, slots=True, eq=False)
class Jets:
    """Some rows of J: their derivatives at the middle, and what these leave out of the average."""

    derivatives: tuple[Array, ...]  #: by order, each (rows, columns, multi-indices of the order, boxes)
    doubts: tuple[Array, ...]  #: bounds of their errors, of shapes that broadcast to theirs
    rest: Array  #: (rows, columns, boxes)

    @classmethod
    def joined(cls, parts: Sequence["Jets"]) -> "Jets":
        """The rows of all parts."""
        derivatives = tuple(np.concatenate(each) for each in zip(*(part.derivatives for part in parts), strict=True))
        full = [[np.broadcast_to(e, d.shape) for d, e in zip(p.derivatives, p.doubts, strict=True)] for p in parts]
        doubts = tuple(np.concatenate(each) for each in zip(*full, strict=True))
        return cls(derivatives, doubts, np.concatenate([part.rest for part in parts]))

    def average(self, around: Around, variables: Variables) -> tuple[TaylorModel, Array]:
        """The average of J as a model in the middle, and terms (rows, columns, terms, boxes) with signs of their own.

        The rest comes on top of both. Terms with the square of one joint's difference have one sign only: half of each
        goes to the centre.
        """
        weights = [power_weights(around, order) for order in range(around.order + 1)]
        model = [d * w[:, 0] for d, w in zip(self.derivatives[: DEGREE + 1], weights, strict=False)]
        squared = self.derivatives[2] * (weights[2][:, 2] / 3)
        alone = [place for place, m in enumerate(multi_indices(len(around.centre), 2)) if m[0] == m[1]]
        squared[:, :, alone] /= 2
        centre = model[0][:, :, 0] + squared[:, :, alone].sum(axis=2)
        mixed = self.derivatives[3] * (weights[3][:, 2] / 3)
        higher = [self.derivatives[k] * even_average(weights[k]) for k in range(DEGREE + 1, around.order + 1)]
        terms = np.concatenate([squared, mixed, *higher], axis=2)
        coefficients = np.concatenate([centre[:, :, None], *model[1:]], axis=2)
        doubt = sum((e * even_average(w)).sum(axis=2) for e, w in zip(self.doubts, weights, strict=True))
        size = np.abs(coefficients).sum(axis=2) + np.abs(terms).sum(axis=2)
        remainder = (doubt + sum_error(8 * around.order) * size) * above(terms.shape[2]) + TINY
        return TaylorModel(variables, np.ascontiguousarray(coefficients.transpose(2, 0, 1, 3)), remainder), terms


def power_weights(around: Around, order: int) -> Array:
    """(C + s D)^a / a! as polynomials in s, (multi-indices a, order + 1, boxes)."""
    n, boxes = around.centre.shape
    weights = np.ones((1, 1, boxes))
    for k in range(1, order + 1):
        before, last = _prefixes(n, k)
        grown = np.zeros((len(last), k + 1, boxes))
        grown[:, :-1] = weights[before] * around.middles[last][:, None]
        grown[:, 1:] += weights[before] * around.differences[last][:, None]
        weights = grown
    scaled: Array = weights / _factorials(n, order)[:, None, None]
    return scaled


def even_average(weights: Array) -> Array:
    """The average over s in [-1, 1] of polynomials (terms, powers, boxes)."""
    powers_ = np.arange(weights.shape[1])
    average: Array = np.einsum("tkb,k->tb", weights, np.where(powers_ % 2, 0.0, 1 / (powers_ + 1)))
    return average


def largest_average(weights: Array) -> Array:
    """The average over s in [-1, 1] of polynomials (terms, powers, boxes) in |s|."""
    average: Array = np.einsum("tkb,k->tb", weights, 1 / (np.arange(weights.shape[1]) + 1))
    return average


@cache
def multi_indices(n: int, order: int) -> tuple[Monomial, ...]:
    """The derivatives of one order, each as its variables in increasing order."""
    return tuple(m for m in monomials(tuple(range(n)), order) if len(m) == order)


@cache
def neighbours(n: int, order: int) -> NDArray[np.intp]:
    """Where the multi-index m + e_i of an order stands among those of that order, (n, multi-indices m)."""
    index = {m: k for k, m in enumerate(multi_indices(n, order))}
    return np.array([[index[tuple(sorted((*m, i)))] for m in multi_indices(n, order - 1)] for i in range(n)])


@cache
def _prefixes(n: int, order: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """For each multi-index, the place of what comes before its last variable, and that variable."""
    index = {m: k for k, m in enumerate(multi_indices(n, order - 1))}
    indices = multi_indices(n, order)
    return np.array([index[m[:-1]] for m in indices]), np.array([m[-1] for m in indices])


@cache
def _factorials(n: int, order: int) -> Array:
    return np.array([float(prod(factorial(m.count(i)) for i in {*m})) for m in multi_indices(n, order)])


def powers(widths: Array, order: int) -> Array:
    """r^a / a! for all multi-indices of an order, (multi-indices, boxes), for half-widths r (n, boxes)."""
    n = len(widths)
    found = np.ones((1, widths.shape[1]))
    for k in range(1, order + 1):
        before, last = _prefixes(n, k)
        found = found[before] * widths[last]
    scaled: Array = found / _factorials(n, order)[:, None]
    return scaled


@dataclass(frozen=True, eq=False)
class TipJets:
    """The rows of a tip task in the axes of the world, for columns of some joints in increasing order."""

    rows: TipRows
    tree: KinematicTree
    columns: tuple[int, ...]
    lengths: Array  #: bounds of the distance from each joint's origin to the tip, 1 for prismatic joints, (columns,)
    doubt: float  #: bound of the error of an entry, from rounding and rotations that are none

    @classmethod
    def of(cls, rows: TipRows, tree: KinematicTree, columns: tuple[int, ...], domain: Domain) -> "TipJets":
        """For boxes within a domain."""
        doubt = 64 * (tree.n + 8) * rotation_deviation(tree) * longest_reach(tree, domain)
        chain = tree.carriers(tree.tip_parent)
        slides = np.where(tree.prismatic, np.abs(domain.centre) + domain.half_width, 0.0)
        steps = np.linalg.norm(tree.translations, axis=1) + slides
        beyond = float(np.linalg.norm(tree.tip_translation))
        longer = 1 + 16 * tree.n * rotation_deviation(tree)
        lengths = dict.fromkeys(columns, 0.0)
        for i in reversed(chain):
            lengths[i] = 1.0 if tree.prismatic[i] else beyond
            beyond += float(steps[i])
        return cls(rows, tree, columns, np.array([lengths[i] for i in columns]) * longer, doubt)

    def __call__(self, q: Array, around: Around) -> Jets:
        """Jets at joint positions q (all joints, boxes), the columns of which are the middles of the boxes."""
        axes, arms, R = self._geometry(q)
        turning = np.array([not self.tree.prismatic[i] for i in self.columns])
        carried = np.array([i in self.tree.carriers(self.tree.tip_parent) for i in self.columns])
        outer = axes * (turning & carried)[:, None, None]
        parts, rests = [], []
        if self.rows.position:
            first = np.where(turning[:, None, None], np.cross(axes, arms, axis=1), axes) * carried[:, None, None]
            along = list(self.rows.position)
            parts.append([each[:, along] for each in _nested(outer, first, around.order)])
            rests.append(np.repeat(_rest(around, self.lengths)[None], len(along), axis=0))
        if self.rows.rotation:
            parts.append(_rotated(outer, around.order))
            rests.append(np.repeat(self._rest_of_turns(around, turning & carried)[None], 3, axis=0))
        if self.rows.axis is not None:
            u = R[:, :, self.rows.axis]
            across = R[:, :, [k for k in range(3) if k != self.rows.axis]]
            nested = _nested(outer, np.cross(outer, np.broadcast_to(u.T[None], outer.shape), axis=1), around.order)
            parts.append([np.einsum("bxk,mxb->mkb", across, each) for each in nested])
            rests.append(np.repeat(self._rest_of_turns(around, turning & carried)[None], 2, axis=0))
        n = len(self.columns)
        derivatives = tuple(
            np.concatenate([part[order][neighbours(n, order + 1)] for part in parts], axis=2).transpose(2, 0, 1, 3)
            for order in range(around.order + 1)
        )
        doubt = np.full((1, 1, 1, 1), self.doubt)
        return Jets(derivatives, (doubt,) * (around.order + 1), np.concatenate(rests) * UP)

    def _rest_of_turns(self, around: Around, turning: Array) -> Array:
        """The rest for vectors of length 1 that prismatic joints leave alone."""
        still = np.logical_not(turning)[:, None]
        part = Around(around.centre, np.where(still, 0, around.middles), np.where(still, 0, around.differences))
        return _rest(part, np.asarray(turning, dtype=float))

    def _geometry(self, q: Array) -> tuple[Array, Array, Array]:
        """Axes of the columns' joints and arms from their origins to the tip, (columns, 3, boxes); R, (boxes, 3, 3)."""
        boxes = q.shape[1]
        R, p = np.broadcast_to(np.eye(3), (boxes, 3, 3)), np.zeros((boxes, 3))
        axes, origins = {}, {}
        for i in self.tree.carriers(self.tree.tip_parent):
            p = p + R @ self.tree.translations[i]
            R = R @ self.tree.rotations[i]
            if self.tree.prismatic[i]:
                p = p + R[:, :, 2] * q[i][:, None]
            else:
                R = R @ _turns(q[i])
            axes[i], origins[i] = R[:, :, 2], p
        tip = p + R @ self.tree.tip_translation
        nothing = np.zeros((boxes, 3))
        own = np.stack([axes.get(i, nothing).T for i in self.columns])
        arms = np.stack([(tip - origins.get(i, tip)).T for i in self.columns])
        return own, arms, R @ self.tree.tip_rotation


def _turns(angles: Array) -> Array:
    """Rz, (boxes, 3, 3)."""
    (s, _), (c, _) = sine_and_cosine(angles)
    zero, one = np.zeros_like(s), np.ones_like(s)
    return np.stack([c, -s, zero, s, c, zero, zero, zero, one], axis=-1).reshape(-1, 3, 3)


def _nested(axes: Array, first: Array, highest: int) -> list[Array]:
    """a_i x (a_j x ... first_l) for multi-indices i <= j <= ... <= l from order 1 on, (multi-indices, 3, boxes)."""
    found = [first]
    for order in range(2, highest + 2):
        outer, inner = _split(len(axes), order)
        found.append(np.cross(axes[outer], found[-1][inner], axis=1))
    return found


def _rotated(axes: Array, highest: int) -> list[Array]:
    """The skew part of [a_i]x [a_j]x ... [a_l]x as a vector, for multi-indices from order 1 on."""
    n, _, boxes = axes.shape
    crosses = np.zeros((n, 3, 3, boxes))
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        crosses[:, j, i], crosses[:, i, j] = axes[:, k], -axes[:, k]
    found, product = [], crosses
    for order in range(1, highest + 2):
        if order > 1:
            outer, inner = _split(n, order)
            product = np.einsum("mijb,mjkb->mikb", crosses[outer], product[inner])
        skew = [(product[:, (k + 2) % 3, (k + 1) % 3] - product[:, (k + 1) % 3, (k + 2) % 3]) / 2 for k in range(3)]
        found.append(np.stack(skew, axis=1))
    return found


def _split(n: int, order: int) -> tuple[Array, Array]:
    """The first joint of each multi-index of an order, and the place of the others among those of one order less."""
    index = {m: k for k, m in enumerate(multi_indices(n, order - 1))}
    indices = multi_indices(n, order)
    return np.array([m[0] for m in indices]), np.array([index[m[1:]] for m in indices])


def _rest(around: Around, lengths: Array) -> Array:
    """What the derivatives of J that are used leave out of the average, (columns, boxes).

    Of the next order at the middle, the terms that are odd in d cancel; the one after it is bounded everywhere between
    the points. The length of a derivative depends on the last of its joints: sums over joints up to each, weighted by
    their steps.
    """
    next_ = around.order + 1
    c, s = np.cumsum(around.middles, axis=0), np.cumsum(around.differences, axis=0)
    odd = sum(comb(next_, k) * c ** (next_ - k) * s**k / (k + 1) for k in range(0, next_, 2))
    even = sum(comb(next_ + 1, k) * c ** (next_ + 1 - k) * s**k / (k + 1) for k in range(next_ + 2))
    upto = (odd / factorial(next_) + even / factorial(next_ + 1)) * UP
    steps = np.diff(upto, axis=0, prepend=0.0) * lengths[:, None]
    later = np.cumsum(steps[::-1], axis=0)[::-1]  # of the joint itself and those after it
    before = upto - np.diff(upto, axis=0, prepend=0.0)
    rest: Array = (later + before * lengths[:, None]) * UP
    return rest
