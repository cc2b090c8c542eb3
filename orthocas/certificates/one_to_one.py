"""Proofs that phi is one-to-one on a box.

Two points q = c + d and p = c - d of the box have phi(q) - phi(p) = 2 Jm(c, d) d, see `orthocas.certificates.jets`. So
phi is one-to-one if Jm(c, d) is nonsingular for all of them. Near the faces of the box, middles c leave little room for
d; in its centre, J is usually best. The middles are divided into parts, and Jm is proved nonsingular on each part. Rows
of x may be replaced by others whose differences vanish with theirs, such as those of the rotation that x stands for.

If phi is the same up to a motion of the task for all positions of a leading joint, such as the turning base of an arm,
the middle of that joint does not matter, and the coordinates bound how far two of its positions are apart.
"""

from dataclasses import dataclass, replace
from itertools import takewhile

import numpy as np
from numpy.typing import NDArray

from orthocas.bases.products import ProductFamily
from orthocas.certificates.chart_rows import ChartRows, CoordinateRows, GraphRows, ProductRows, true_gradients
from orthocas.certificates.jets import ORDERS, Around, Jets, TipJets
from orthocas.certificates.judges import (
    Verdicts,
    all_positive,
    between,
    chosen,
    influences,
    is_orthogonal,
    most_influential,
    pivots,
    singular_vectors,
)
from orthocas.certificates.task_rows import TipRows
from orthocas.certificates.taylor import TINY, UNIT, UP, TaylorModel, above, sum_error
from orthocas.charts.certificate import Subdivision
from orthocas.charts.chart import Chart
from orthocas.charts.coordinates import Coordinates
from orthocas.tools.batch import one_blas_thread
from orthocas.tools.checks import Array

_AT_ONCE = 48  #: boxes, whose terms fit into the cache of a processor
_ROUNDS = 2  # of bounds of the differences by the coordinates


@dataclass(frozen=True, eq=False)
class OneToOneJudge:
    """Proves that Jm(c, d) is nonsingular, for middles c in a box and all d that two points of the whole can have."""

    task: TipJets
    coordinates: ProductRows | None
    active: tuple[int, ...]
    still: tuple[int, ...]  #: columns of joints that Jm does not depend on in the middle; they may have wide ranges
    low: Array  #: of the whole, (n,)
    high: Array

    @property
    def joints(self) -> tuple[int, ...]:
        """The joints whose middles matter."""
        return tuple(joint for k, joint in enumerate(self.active) if k not in self.still)

    @property
    def still_joints(self) -> tuple[int, ...]:
        """The joints of the columns `still`."""
        return tuple(self.active[k] for k in self.still)

    def __call__(self, low: Array, high: Array) -> Verdicts:
        """Judge boxes between corners (boxes, n)."""
        found = []
        with one_blas_thread(), np.errstate(invalid="ignore", over="ignore", divide="ignore"):
            for k in range(0, len(low), _AT_ONCE):
                found.append(self._few(low[k : k + _AT_ONCE], high[k : k + _AT_ONCE]))
        return _verdicts(found)

    def _few(self, low: Array, high: Array) -> tuple[NDArray[np.bool_], Array]:
        q, around = (low + high).T / 2, self._around(low, high)
        if self.still and self.coordinates is not None:
            for _ in range(_ROUNDS):
                around = self._bounded(around, self.coordinates.jets(around))
        proved, widest, promising = self._judged(q, around)
        for order in ORDERS[1:]:
            again = np.flatnonzero(promising)
            if again.size:
                proved[again], widest[again], promising[again] = self._judged(
                    q[:, again], replace(around[again], order=order)
                )
        return proved, widest

    def _judged(self, q: Array, around: Around) -> tuple[NDArray[np.bool_], Array, NDArray[np.bool_]]:
        """Whether boxes are proved, the joint to halve, and whether they might be proved with higher derivatives."""
        own = () if self.coordinates is None else (self.coordinates.jets(around),)
        jets = Jets.joined([self.task(q, around), *own])
        model, terms = jets.average(around, self.active)
        left, right = singular_vectors(model)
        turned = between(left, model, right)
        known = replace(turned, remainder=(turned.remainder + _spread(left, terms, right)) * UP)
        rest = (np.abs(left) @ jets.rest.transpose(2, 0, 1) @ np.abs(right)).transpose(1, 2, 0) * UP
        all_ = replace(known, remainder=(known.remainder + rest) * UP)
        sound = is_orthogonal(left) & is_orthogonal(right)
        gains = influences(all_)
        gains[:, self.still] = 0
        proved = all_positive(pivots(all_)) & sound
        promising = ~proved & sound
        if around.order < ORDERS[-1] and promising.any():
            promising[promising] = all_positive(pivots(chosen(known, promising)))
        return proved, most_influential(gains, self.active), promising

    def _around(self, low: Array, high: Array) -> Around:
        """Middles of the boxes, and the largest differences that two points of the whole with such middles have."""
        rounding = 8 * UNIT * (np.abs(self.low) + np.abs(self.high))
        centre, outer = (self.low + self.high) / 2, (self.high - self.low) / 2
        nearest = np.maximum(np.maximum(low - centre, centre - high), 0)
        room = np.maximum(outer - nearest, 0) * UP + rounding
        half = (high - low) / 2 * UP + rounding
        columns = list(self.active)
        middles = np.ascontiguousarray(half.T[columns])
        middles[list(self.still)] = 0
        return Around((low + high).T[columns] / 2, middles, np.ascontiguousarray(room.T[columns]))

    def _bounded(self, around: Around, own: Jets) -> Around:
        """Smaller differences: for xi(q) = xi(p), each row w of a combination of coordinates has w Jm d = 0."""
        model, terms = own.average(around, self.active)
        centre = model.centre.transpose(2, 0, 1)
        doubt = (model.deviation() + (np.abs(terms).sum(axis=2) + own.rest) * UP).transpose(2, 0, 1)
        r = centre.shape[1]
        projected = np.linalg.pinv(np.nan_to_num(centre))[:, list(self.still)]
        D = around.differences.copy()
        for rows in (projected, np.broadcast_to(np.eye(r), (len(centre), r, r))):
            sizes, least = _combined(rows, centre, doubt)
            for row in range(sizes.shape[1]):
                for k in self.still:
                    others = (sizes[:, row] * D.T).sum(axis=1) - sizes[:, row, k] * D[k]
                    bound = np.maximum(others, 0) * UP * UP / least[:, row, k]
                    D[k] = np.where((least[:, row, k] > 0) & (bound < D[k]), bound * UP + TINY, D[k])
        return replace(around, differences=D)


@dataclass(frozen=True, eq=False)
class ConvexJudge:
    """Proves that the symmetric part of P J is positive definite, for one P on all boxes and the true rows of J.

    (q - p)^T P (phi(q) - phi(p)) is the integral of (q - p)^T P J (q - p) over the segment between points of a convex
    set, so it is positive. This is for rows that have bounds, but no derivatives in closed form.
    """

    rows: ChartRows
    inverse: Array  #: P, (active, active)
    low: Array  #: of the convex set, (n,)
    high: Array
    still_joints: tuple[int, ...] = ()

    @property
    def joints(self) -> tuple[int, ...]:
        """The joints that J depends on."""
        return self.rows.variables

    def __call__(self, low: Array, high: Array) -> Verdicts:
        """Judge boxes between corners (boxes, n)."""
        found = []
        with one_blas_thread(), np.errstate(invalid="ignore", over="ignore", divide="ignore"):
            for k in range(0, len(low), _AT_ONCE):
                found.append(self._few(self.rows(low[k : k + _AT_ONCE], high[k : k + _AT_ONCE])))
        return _verdicts(found)

    def _few(self, J: TaylorModel) -> tuple[NDArray[np.bool_], Array]:
        boxes = J.remainder.shape[-1]
        unit = np.broadcast_to(np.eye(len(self.inverse)), (boxes, *self.inverse.shape))
        product = between(np.broadcast_to(self.inverse, unit.shape), J, unit)
        transposed = replace(
            product, coefficients=product.coefficients.swapaxes(1, 2), remainder=product.remainder.swapaxes(0, 1)
        )
        symmetric = product + transposed
        vectors = np.linalg.eigh(np.nan_to_num(np.moveaxis(symmetric.centre, -1, 0)))[1][:, :, ::-1]
        turned = between(vectors.transpose(0, 2, 1), symmetric, vectors)
        proved = all_positive(pivots(turned)) & is_orthogonal(vectors) & self._within_a_turn(J)
        return proved, most_influential(influences(turned), J.variables)

    def _within_a_turn(self, J: TaylorModel) -> NDArray[np.bool_]:
        """Whether rows with a period change by less than it, over the widths at their largest slopes, (boxes,)."""
        circles = np.flatnonzero(self.rows.turns)
        widths = (self.high - self.low)[list(self.rows.active), None] * UP
        change = (J.magnitude()[circles] * widths).sum(axis=1)
        return np.asarray((change * UP < self.rows.turns[circles, None]).all(axis=0))


def one_to_one_judge(chart: Chart, rows: ChartRows, base: Subdivision) -> OneToOneJudge | ConvexJudge | None:
    """The judge for a box in the domain of a chart, with rows whose vanishing differences are those of phi.

    None if the other rows depend on an idle joint, which then is none, or jump where an arc tangent begins a new turn,
    or stand for those at another heading of a moving base.
    """
    tip, tree, active = TipRows.of(chart.problem.task), chart.problem.robot.tree, rows.active
    coordinates, known = chart.coordinates, isinstance(rows.coordinates, ProductRows | None)
    if rows.base or {*rows.variables} - {*active} or _jumps(chart, rows):
        return None
    if tip is None or not known:
        true = replace(rows, task=true_gradients(chart.problem.task, active)[0])
        centre = chart.problem.domain.centre[None]
        inverse = np.asarray(np.linalg.pinv(true(centre, centre).centre[:, :, 0]), dtype=float)
        return ConvexJudge(true, inverse, base.low, base.high)
    own: ProductRows | None = None
    if rows.coordinates is not None:
        assert isinstance(coordinates, Coordinates)
        assert isinstance(coordinates.family, ProductFamily)
        own = ProductRows.of(coordinates.family, coordinates.theta, ORDERS[-1] + 2)
    leading = takewhile(lambda i: i not in rows.variables, tree.carriers(tree.tip_parent))
    still = tuple(active.index(i) for i in leading if i in active)
    task = TipJets.of(tip, tree, active, chart.problem.domain)
    return OneToOneJudge(task, own, active, still, base.low, base.high)


def _jumps(chart: Chart, rows: ChartRows) -> bool:
    """Whether task or coordinates have steps with jumps, other than those of a coordinate's own period."""
    task = TipRows.of(chart.problem.task) is None and _has_angle(rows.task)
    return task or (_has_angle(rows.coordinates) and not rows.turns[rows.m :].all())


def _has_angle(rows: CoordinateRows | None) -> bool:
    return isinstance(rows, GraphRows) and any(step[0] == "atan2" for step in rows.graph.tape["steps"])


def _verdicts(found: list[tuple[NDArray[np.bool_], Array]]) -> Verdicts:
    proved, widest = (np.concatenate(each) for each in zip(*found, strict=True))
    nothing = np.zeros(len(proved))
    return Verdicts(proved, proved, nothing, nothing, widest)


def _spread(left: Array, terms: Array, right: Array) -> Array:
    """Sums of |left @ term @ right| over the terms (rows, columns, terms, boxes), (rows, columns, boxes)."""
    rows, columns, count, boxes = terms.shape
    parts = np.ascontiguousarray(terms.transpose(3, 0, 1, 2))
    products = (left @ parts.reshape(boxes, rows, columns * count)).reshape(boxes, rows, columns, count)
    products = right.transpose(0, 2, 1)[:, None] @ products
    sums = np.abs(products, out=products).sum(axis=3)
    sizes = np.abs(left) @ np.abs(parts, out=parts).sum(axis=3) @ np.abs(right)
    spread: Array = ((sums + sum_error(2 * (rows + columns)) * sizes) * above(count)).transpose(1, 2, 0)
    return spread


def _combined(rows: Array, centre: Array, doubt: Array) -> tuple[Array, Array]:
    """Upper and lower bounds of the sizes of rows @ J for |J - centre| <= doubt, (boxes, rows, columns)."""
    middle = np.abs(rows @ centre)
    error = (np.abs(rows) @ (doubt + sum_error(rows.shape[2]) * np.abs(centre))) * UP
    return (middle + error) * UP, (middle - error) / UP
