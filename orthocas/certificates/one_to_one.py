"""Proofs that phi is one-to-one on a box.

Two points q = c + d and p = c - d of the box have phi(q) - phi(p) = 2 Jm(c, d) d, see `orthocas.certificates.jets`. So
phi is one-to-one if Jm(c, d) is nonsingular for all of them. Near the faces of the box, centres c leave little room for
d; near its centre, J is usually best. The set of centres is divided into parts, and Jm is proved nonsingular on each
part. The rows of x may be replaced by functions that agree at q and p exactly if x does, such as the entries of the
rotation that x describes.

If phi is the same up to a motion of the task for all positions of a leading joint, such as the turning base of an arm,
then the centre position of that joint is irrelevant, and the coordinates bound how far two of its positions are apart.
"""

from dataclasses import dataclass, replace
from itertools import takewhile
from math import comb, factorial

import numpy as np
from numpy.typing import NDArray

from orthocas.bases.products import ProductFamily
from orthocas.certificates.box_checks import (
    BoxResults,
    check_in_turn,
    compute_influences,
    compute_pivots,
    find_most_influential,
    find_singular_vectors,
    have_positive_pivots,
    is_orthogonal,
    multiply_between,
    select_boxes,
)
from orthocas.certificates.jets import ORDERS, Around, Jets, find_neighbours, list_multi_indices
from orthocas.certificates.rows import (
    ChartRows,
    CoordinateRows,
    GraphRows,
    ProductRows,
    TipRows,
    bound_reach,
    bound_rotation_error,
    build_true_gradients,
)
from orthocas.certificates.taylor import TINY, UNIT, UP, compute_margin, evaluate_sine_cosine, sum_error
from orthocas.charts.certificate import Subdivision
from orthocas.charts.chart import Chart
from orthocas.charts.coordinates import Coordinates
from orthocas.robots.tree import KinematicTree
from orthocas.tasks.domains import Domain
from orthocas.tools.checks import Array


@dataclass(frozen=True, slots=True)
class OneToOneRules:
    """Numbers of the one-to-one proof."""

    at_once: int = 48  #: number of boxes whose terms fit into the cache of a processor
    rounds: int = 2  #: rounds in which coordinates tighten the bounds of the differences


RULES = OneToOneRules()


def choose_one_to_one_check(chart: Chart, rows: ChartRows, base: Subdivision) -> "OneToOneCheck | ConvexCheck | None":
    """The check for a box in the domain of a chart; it may use other rows that vanish for the same differences.

    None if the replaced rows depend on an idle joint, if an arc tangent in them jumps by a full turn, or if they belong
    to another heading of a moving base.
    """
    tip, tree, active = TipRows.build(chart.problem.task), chart.problem.robot.tree, rows.active
    coordinates, closed_form = chart.coordinates, isinstance(rows.coordinates, ProductRows | None)
    # An arc tangent jumps where a new turn begins; only the period of a coordinate is handled.
    jumps = (tip is None and _has_angle(rows.task)) or (_has_angle(rows.coordinates) and not rows.turns[rows.m :].all())
    if rows.base or {*rows.variables} - {*active} or jumps:
        return None
    # Rows without derivatives in closed form get the convex check.
    if tip is None or not closed_form:
        true = replace(rows, task=build_true_gradients(chart.problem.task, active)[0])
        centre = chart.problem.domain.home[None]
        inverse = np.asarray(np.linalg.pinv(true(centre, centre).centre[:, :, 0]), dtype=float)
        return ConvexCheck(true, inverse, base.low, base.high)
    own: ProductRows | None = None
    if rows.coordinates is not None:
        assert isinstance(coordinates, Coordinates)
        assert isinstance(coordinates.family, ProductFamily)
        own = ProductRows.build(coordinates.family, coordinates.theta, ORDERS[-1] + 2)
    # Leading joints on which J does not depend keep their whole range.
    leading = takewhile(lambda i: i not in rows.variables, tree.carriers(tree.tip_parent))
    still = tuple(active.index(i) for i in leading if i in active)
    task = TipJets.build(tip, tree, active, chart.problem.domain)
    return OneToOneCheck(task, own, active, still, base.low, base.high)


def _has_angle(rows: CoordinateRows | None) -> bool:
    return isinstance(rows, GraphRows) and any(step[0] == "atan2" for step in rows.graph.tape["steps"])


@dataclass(frozen=True, eq=False, repr=False)
class OneToOneCheck:
    """Proves that Jm(c, d) is nonsingular for centres c in a box and all d possible in the whole box."""

    task: "TipJets"
    coordinates: ProductRows | None
    active: tuple[int, ...]
    still: tuple[int, ...]  #: columns of joints whose centre does not affect Jm; they may have wide ranges
    low: Array  #: lower corner of the whole box, (n,)
    high: Array

    @property
    def joints(self) -> tuple[int, ...]:
        """The joints whose centres affect the result."""
        return tuple(joint for k, joint in enumerate(self.active) if k not in self.still)

    @property
    def still_joints(self) -> tuple[int, ...]:
        """The joints of the columns `still`."""
        return tuple(self.active[k] for k in self.still)

    def __call__(self, low: Array, high: Array) -> BoxResults:
        """Evaluate boxes between corners (boxes, n)."""
        return _build_results(*check_in_turn(self._check_few, low, high, RULES.at_once))

    def _check_few(self, low: Array, high: Array) -> tuple[NDArray[np.bool_], Array]:
        q, around = (low + high).T / 2, self._build_around(low, high)
        # Coordinates bound how far two points are apart in these joints.
        if self.still and self.coordinates is not None:
            for _ in range(RULES.rounds):
                around = self._narrow_differences(around, self.coordinates.build_jets(around))
        # Use higher derivatives on boxes where they may help.
        proved, widest, promising = self._check_at_order(q, around)
        for order in ORDERS[1:]:
            again = np.flatnonzero(promising)
            if again.size:
                proved[again], widest[again], promising[again] = self._check_at_order(
                    q[:, again], replace(around[again], order=order)
                )
        return proved, widest

    def _check_at_order(self, q: Array, around: Around) -> tuple[NDArray[np.bool_], Array, NDArray[np.bool_]]:
        """Whether boxes are proved, the joint to halve, and whether higher derivatives might prove them."""
        # Jets of the task's rows, then of the coordinates.
        own = () if self.coordinates is None else (self.coordinates.build_jets(around),)
        jets = Jets.join([self.task(q, around), *own])
        # Average J over the segments, in the singular basis of its centre.
        model, terms = jets.average(around, self.active)
        left, right = find_singular_vectors(model)
        turned = multiply_between(left, model, right)
        narrow = replace(turned, remainder=(turned.remainder + _spread(left, terms, right)) * UP)
        rest = (np.abs(left) @ jets.rest.transpose(2, 0, 1) @ np.abs(right)).transpose(1, 2, 0) * UP
        all_ = replace(narrow, remainder=(narrow.remainder + rest) * UP)
        sound = is_orthogonal(left) & is_orthogonal(right)
        # Halving the joints in `still` is useless.
        gains = compute_influences(all_)
        gains[:, self.still] = 0
        proved = have_positive_pivots(compute_pivots(all_)) & sound
        promising = ~proved & sound
        if around.order < ORDERS[-1] and promising.any():
            promising[promising] = have_positive_pivots(compute_pivots(select_boxes(narrow, promising)))
        return proved, find_most_influential(gains, self.active), promising

    def _build_around(self, low: Array, high: Array) -> Around:
        """Centres of the boxes, and the largest differences of two points of the whole box with such centres."""
        # A centre far from the middle of the whole box leaves less room for two points around it.
        rounding = 8 * UNIT * (np.abs(self.low) + np.abs(self.high))
        centre, outer = (self.low + self.high) / 2, (self.high - self.low) / 2
        nearest = np.maximum(np.maximum(low - centre, centre - high), 0)
        room = np.maximum(outer - nearest, 0) * UP + rounding
        half = (high - low) / 2 * UP + rounding
        # Jm does not depend on the centres of the joints in `still`.
        columns = list(self.active)
        middles = np.ascontiguousarray(half.T[columns])
        middles[list(self.still)] = 0
        return Around((low + high).T[columns] / 2, middles, np.ascontiguousarray(room.T[columns]))

    def _narrow_differences(self, around: Around, own: Jets) -> Around:
        """Tighten the differences: if xi(q) = xi(p), each row w of a combination of coordinates has w Jm d = 0."""
        # Use the combinations that isolate one joint in `still` each, and the coordinates themselves.
        model, terms = own.average(around, self.active)
        centre = model.centre.transpose(2, 0, 1)
        doubt = (model.bound_deviation() + (np.abs(terms).sum(axis=2) + own.rest) * UP).transpose(2, 0, 1)
        r = centre.shape[1]
        projected = np.linalg.pinv(np.nan_to_num(centre))[:, list(self.still)]
        D = around.differences.copy()
        for rows in (projected, np.broadcast_to(np.eye(r), (len(centre), r, r))):
            # Upper and lower bounds of |rows @ J| for |J - centre| <= doubt, (boxes, rows, columns).
            size_at_centre = np.abs(rows @ centre)
            error = (np.abs(rows) @ (doubt + sum_error(rows.shape[2]) * np.abs(centre))) * UP
            sizes, least = (size_at_centre + error) * UP, (size_at_centre - error) / UP
            for row in range(sizes.shape[1]):
                # |w J_k| D_k is at most the sum over the other columns.
                for k in self.still:
                    others = (sizes[:, row] * D.T).sum(axis=1) - sizes[:, row, k] * D[k]
                    bound = np.maximum(others, 0) * UP * UP / least[:, row, k]
                    D[k] = np.where((least[:, row, k] > 0) & (bound < D[k]), bound * UP + TINY, D[k])
        return replace(around, differences=D)


@dataclass(frozen=True, eq=False, repr=False)
class ConvexCheck:
    """Proves that the symmetric part of P J is positive definite, with one P for all boxes and the exact rows of J.

    On a convex set, (q - p)^T P (phi(q) - phi(p)) is the integral of (q - p)^T P J (q - p) over the segment from p to
    q, so it is positive. This check is for rows with bounds but without derivatives in closed form.
    """

    rows: ChartRows
    inverse: Array  #: P, (active, active)
    low: Array  #: lower corner of the convex set, (n,)
    high: Array
    still_joints: tuple[int, ...] = ()

    @property
    def joints(self) -> tuple[int, ...]:
        """The joints that J depends on."""
        return self.rows.variables

    def __call__(self, low: Array, high: Array) -> BoxResults:
        """Evaluate boxes between corners (boxes, n)."""
        return _build_results(*check_in_turn(self._check_few, low, high, RULES.at_once))

    def _check_few(self, low: Array, high: Array) -> tuple[NDArray[np.bool_], Array]:
        J = self.rows(low, high)
        boxes = J.remainder.shape[-1]
        unit = np.broadcast_to(np.eye(len(self.inverse)), (boxes, *self.inverse.shape))
        product = multiply_between(np.broadcast_to(self.inverse, unit.shape), J, unit)
        transposed = replace(
            product, coefficients=product.coefficients.swapaxes(1, 2), remainder=product.remainder.swapaxes(0, 1)
        )
        symmetric = product + transposed
        # In the basis of its eigenvectors, the symmetric part is nearly diagonal.
        vectors = np.linalg.eigh(np.nan_to_num(np.moveaxis(symmetric.centre, -1, 0)))[1][:, :, ::-1]
        turned = multiply_between(vectors.transpose(0, 2, 1), symmetric, vectors)
        proved = have_positive_pivots(compute_pivots(turned)) & is_orthogonal(vectors)
        # A row with a period must change by less than this period over the whole box, at its largest slopes.
        circles = np.flatnonzero(self.rows.turns)
        widths = (self.high - self.low)[list(self.rows.active), None] * UP
        change = (J.bound_magnitude()[circles] * widths).sum(axis=1)
        proved &= np.asarray((change * UP < self.rows.turns[circles, None]).all(axis=0))
        return proved, find_most_influential(compute_influences(turned), J.variables)


def _build_results(proved: Array, widest: Array) -> BoxResults:
    nothing = np.zeros(len(proved))
    return BoxResults(proved, proved, nothing, nothing, widest)


def _spread(left: Array, terms: Array, right: Array) -> Array:
    """Sums of |left @ term @ right| over the terms (rows, columns, terms, boxes), (rows, columns, boxes)."""
    # One product from the left for all terms, then one from the right.
    rows, columns, count, boxes = terms.shape
    parts = np.ascontiguousarray(terms.transpose(3, 0, 1, 2))
    products = (left @ parts.reshape(boxes, rows, columns * count)).reshape(boxes, rows, columns, count)
    products = right.transpose(0, 2, 1)[:, None] @ products
    sums = np.abs(products, out=products).sum(axis=3)
    sizes = np.abs(left) @ np.abs(parts, out=parts).sum(axis=3) @ np.abs(right)
    spread: Array = ((sums + sum_error(2 * (rows + columns)) * sizes) * compute_margin(count)).transpose(1, 2, 0)
    return spread


@dataclass(frozen=True, eq=False, repr=False)
class TipJets:
    """Rows of a tip task in world axes, for the columns of some joints in increasing order."""

    rows: TipRows
    tree: KinematicTree
    columns: tuple[int, ...]
    #: upper bounds of the distance from each joint's origin to the tip, 1 for prismatic joints, (columns,)
    lengths: Array
    doubt: float  #: error bound of an entry, from rounding and from stored matrices that are not exact rotations

    @classmethod
    def build(cls, rows: TipRows, tree: KinematicTree, columns: tuple[int, ...], domain: Domain) -> "TipJets":
        """Build the jets for boxes within a domain."""
        # Rounding errors of the kinematics, relative to the reach of the arm.
        doubt = 64 * (tree.n + 8) * bound_rotation_error(tree) * bound_reach(tree, domain)
        chain = tree.carriers(tree.tip_parent)
        slides = np.where(tree.prismatic, np.abs(domain.centre) + domain.half_width, 0.0)
        steps = np.linalg.norm(tree.translations, axis=1) + slides
        beyond = float(np.linalg.norm(tree.tip_translation))
        longer = 1 + 16 * tree.n * bound_rotation_error(tree)
        # Going from the tip to the base, a joint's distance to the tip is at most the length of the chain behind it.
        lengths = dict.fromkeys(columns, 0.0)
        for i in reversed(chain):
            lengths[i] = 1.0 if tree.prismatic[i] else beyond
            beyond += float(steps[i])
        return cls(rows, tree, columns, np.array([lengths[i] for i in columns]) * longer, doubt)

    def __call__(self, q: Array, around: Around) -> Jets:
        """Jets at joint positions q (all joints, boxes), whose columns are the centres of the boxes."""
        # Each part consists of nested cross products of joint axes with an arm, a rotation, or an axis of the tip.
        axes, arms, R = self._compute_geometry(q)
        turning = np.array([not self.tree.prismatic[i] for i in self.columns])
        carried = np.array([i in self.tree.carriers(self.tree.tip_parent) for i in self.columns])
        outer = axes * (turning & carried)[:, None, None]
        parts, rests = [], []
        if self.rows.position:
            first = np.where(turning[:, None, None], np.cross(axes, arms, axis=1), axes) * carried[:, None, None]
            along = list(self.rows.position)
            parts.append([each[:, along] for each in _nest_products(outer, first, around.order)])
            rests.append(np.repeat(_bound_rest(around, self.lengths)[None], len(along), axis=0))
        if self.rows.rotation:
            parts.append(_nest_rotations(outer, around.order))
            rests.append(np.repeat(self._bound_rest_of_turns(around, turning & carried)[None], 3, axis=0))
        if self.rows.axis is not None:
            u = R[:, :, self.rows.axis]
            across = R[:, :, [k for k in range(3) if k != self.rows.axis]]
            first = np.cross(outer, np.broadcast_to(u.T[None], outer.shape), axis=1)
            nested = _nest_products(outer, first, around.order)
            parts.append([np.einsum("bxk,mxb->mkb", across, each) for each in nested])
            rests.append(np.repeat(self._bound_rest_of_turns(around, turning & carried)[None], 2, axis=0))
        # Collect the derivatives of all parts in the order of their rows.
        n = len(self.columns)
        derivatives = tuple(
            np.concatenate([part[order][find_neighbours(n, order + 1)] for part in parts], axis=2).transpose(2, 0, 1, 3)
            for order in range(around.order + 1)
        )
        doubt = np.full((1, 1, 1, 1), self.doubt)
        return Jets(derivatives, (doubt,) * (around.order + 1), np.concatenate(rests) * UP)

    def _bound_rest_of_turns(self, around: Around, turning: Array) -> Array:
        """Truncation error for unit vectors, which prismatic joints do not change."""
        still = np.logical_not(turning)[:, None]
        part = Around(around.centre, np.where(still, 0, around.middles), np.where(still, 0, around.differences))
        return _bound_rest(part, np.asarray(turning, dtype=float))

    def _compute_geometry(self, q: Array) -> tuple[Array, Array, Array]:
        """Joint axes and arms from their origins to the tip, (columns, 3, boxes); R of the tip, (boxes, 3, 3)."""
        boxes = q.shape[1]
        # Forward kinematics of the chain, for all boxes at once.
        R, p = np.broadcast_to(np.eye(3), (boxes, 3, 3)), np.zeros((boxes, 3))
        axes, origins = {}, {}
        for i in self.tree.carriers(self.tree.tip_parent):
            p = p + R @ self.tree.translations[i]
            R = R @ self.tree.rotations[i]
            if self.tree.prismatic[i]:
                p = p + R[:, :, 2] * q[i][:, None]
            else:
                # Rotation about z.
                (s, _), (c, _) = evaluate_sine_cosine(q[i])
                zero, one = np.zeros_like(s), np.ones_like(s)
                turn = np.stack([c, -s, zero, s, c, zero, zero, zero, one], axis=-1).reshape(-1, 3, 3)
                R = R @ turn
            axes[i], origins[i] = R[:, :, 2], p
        # Joints outside the chain do not move the tip.
        tip = p + R @ self.tree.tip_translation
        nothing = np.zeros((boxes, 3))
        own = np.stack([axes.get(i, nothing).T for i in self.columns])
        arms = np.stack([(tip - origins.get(i, tip)).T for i in self.columns])
        return own, arms, R @ self.tree.tip_rotation


def _nest_products(axes: Array, first: Array, highest: int) -> list[Array]:
    """a_i x (a_j x ... first_l) for multi-indices i <= j <= ... <= l from order 1 on, (multi-indices, 3, boxes)."""
    nested = [first]
    for order in range(2, highest + 2):
        outer, inner = _split(len(axes), order)
        nested.append(np.cross(axes[outer], nested[-1][inner], axis=1))
    return nested


def _nest_rotations(axes: Array, highest: int) -> list[Array]:
    """The skew part of [a_i]x [a_j]x ... [a_l]x as a vector, for multi-indices from order 1 on."""
    # Matrices [a]x of cross products with the axes.
    n, _, boxes = axes.shape
    crosses = np.zeros((n, 3, 3, boxes))
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        crosses[:, j, i], crosses[:, i, j] = axes[:, k], -axes[:, k]
    # Each order multiplies by one more axis; keep the skew part of the products.
    nested, product = [], crosses
    for order in range(1, highest + 2):
        if order > 1:
            outer, inner = _split(n, order)
            product = np.einsum("mijb,mjkb->mikb", crosses[outer], product[inner])
        skew = [(product[:, (k + 2) % 3, (k + 1) % 3] - product[:, (k + 1) % 3, (k + 2) % 3]) / 2 for k in range(3)]
        nested.append(np.stack(skew, axis=1))
    return nested


def _split(n: int, order: int) -> tuple[Array, Array]:
    """For multi-indices of an order: the first joint, and the index of the remaining multi-index."""
    index = {m: k for k, m in enumerate(list_multi_indices(n, order - 1))}
    indices = list_multi_indices(n, order)
    return np.array([m[0] for m in indices]), np.array([index[m[1:]] for m in indices])


def _bound_rest(around: Around, lengths: Array) -> Array:
    """Truncation error of the average with these derivatives of J, (columns, boxes).

    Two orders remain. In the next order, evaluated at the centre, only the terms even in d count. The order after it is
    bounded for all points of the segment. The length of a derivative depends on the last of its joints only. So each
    joint's length is multiplied by a sum over the joints up to it, weighted by their steps.
    """
    # Average over s the sums over all multi-indices, from cumulative sums of centres and differences over the joints.
    next_ = around.order + 1
    c, s = np.cumsum(around.middles, axis=0), np.cumsum(around.differences, axis=0)
    odd = sum(comb(next_, k) * c ** (next_ - k) * s**k / (k + 1) for k in range(0, next_, 2))
    even = sum(comb(next_ + 1, k) * c ** (next_ + 1 - k) * s**k / (k + 1) for k in range(next_ + 2))
    upto = (odd / factorial(next_) + even / factorial(next_ + 1)) * UP
    steps = np.diff(upto, axis=0, prepend=0.0) * lengths[:, None]
    # Contributions of the joint itself and those after it, then of those before it.
    later = np.cumsum(steps[::-1], axis=0)[::-1]
    before = upto - np.diff(upto, axis=0, prepend=0.0)
    return np.asarray((later + before * lengths[:, None]) * UP)
