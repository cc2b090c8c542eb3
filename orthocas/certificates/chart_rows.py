"""Rows of the Jacobian of phi as Taylor models: product bases, networks, and tasks."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from orthocas.bases.cyclic import Mobile
from orthocas.bases.mlp import MLPFamily
from orthocas.bases.products import ProductFamily
from orthocas.certificates.graph import TaylorGraph
from orthocas.certificates.jets import Around, Jets, largest_average, multi_indices, neighbours, power_weights, powers
from orthocas.certificates.task_rows import TipRows, task_rows
from orthocas.certificates.taylor import (
    DEGREE,
    TINY,
    UNIT,
    UP,
    Monomial,
    TaylorModel,
    Variables,
    above,
    cosine,
    sine,
    square,
    stacked,
    sum_error,
    tanh,
)
from orthocas.charts.chart import Chart
from orthocas.charts.coordinates import Coordinates
from orthocas.errors import CertifyError, InvalidValueError
from orthocas.tasks.domains import Box, Domain
from orthocas.tasks.task import Task
from orthocas.tools.batch import dense_function
from orthocas.tools.checks import Array
from orthocas.tools.expressions import gradient_dependences

MOST_VARIABLES = 20
_MOST_STEPS = 100_000
CoordinateRows = Callable[[list[TaylorModel], Array, Variables], TaylorModel]


@dataclass(frozen=True, eq=False)
class Derivatives:
    """The derivatives of one order of all coordinates, as sums of a few basis functions."""

    used: NDArray[np.intp]  #: numbers of the basis functions
    table: Array  #: (multi-indices * r, used)
    sizes: Array  #: bounds of what the entries are sums of, same shape
    rounding: float  #: relative error of entries and of sums with them


@dataclass(frozen=True, eq=False)
class ProductRows:
    """J_xi of a product family on boxes."""

    r: int
    terms: Array  #: (1 + K, n): the one-joint function of each joint
    functions: TaylorGraph  #: q -> the one-joint functions that are not constant
    numbers: Array  #: (n, functions of one joint): where each is among them
    orders: tuple[Derivatives, ...]  #: from order 1 on

    @classmethod
    def of(cls, family: ProductFamily, theta: Array, highest: int = DEGREE + 2) -> "ProductRows":
        """The tables of a family with its parameters."""
        n, r = family.space.n, family.outputs
        terms = np.array([(0,) * n, *family.terms])
        alone = np.flatnonzero(np.count_nonzero(terms, axis=1) == 1)
        q = ca.SX.sym("q", n)
        values = family.basis(q)[[int(k) - 1 for k in alone]]
        numbers = np.zeros((n, terms.max() + 1), dtype=int)
        for place, k in enumerate(alone):
            joint = int(np.flatnonzero(terms[k])[0])
            numbers[joint, terms[k, joint]] = place
        graph = TaylorGraph.of(dense_function("functions", [q], [values]), "the coordinates")
        C = np.hstack([np.zeros((r, 1)), theta.reshape(r, -1)])
        return cls(r, terms, graph, numbers, _orders(family, terms, C, highest))

    def __call__(self, boxes: list[TaylorModel], half_widths: Array, variables: Variables) -> TaylorModel:
        """J_xi, (r, n, boxes), for models of the joints on boxes of the given half-widths (n, boxes)."""
        points = [TaylorModel.constant(box.centre) for box in boxes]
        values, errors = self._basis(self.functions(points))
        parts, left_out = [], np.zeros((self.r, len(boxes), half_widths.shape[1]))
        for order in range(1, DEGREE + 2):
            found, doubt = self._derivatives(order, values, errors)
            weights = powers(half_widths, order - 1)
            coefficients = found * weights
            left_out += (doubt * weights + sum_error(DEGREE + 2) * np.abs(coefficients)).sum(axis=2)
            parts.append(coefficients)
        left_out += (self._largest(DEGREE + 2, boxes) * powers(half_widths, DEGREE + 1)).sum(axis=2)
        coefficients = np.concatenate(parts, axis=2).transpose(2, 0, 1, 3)
        return TaylorModel(variables, coefficients, left_out * above(len(coefficients)) + TINY)

    def dependences(self) -> set[int]:
        """The joints that J_xi depends on."""
        changing = self.orders[1]  # of J_xi
        indices = multi_indices(self.terms.shape[1], 2)
        sizes = np.asarray(changing.sizes.reshape(len(indices), self.r * len(changing.used)).any(axis=1))
        return {i for index, there in zip(indices, sizes.tolist(), strict=True) if there for i in index}

    def jets(self, around: Around) -> Jets:
        """The derivatives of J_xi at the middles of boxes. The next order, on the whole box, bounds the rest."""
        points = [TaylorModel.constant(np.ascontiguousarray(c)) for c in around.centre]
        values, errors = self._basis(self.functions(points))
        known = [self._derivatives(order, values, errors) for order in range(1, around.order + 2)]
        linear = np.stack([around.centre, around.reach, *np.zeros((2, *around.centre.shape))], axis=1)
        boxes = [TaylorModel((k,), each, np.zeros(each.shape[1:])) for k, each in enumerate(linear)]
        left_out = self._largest(around.order + 2, boxes) * largest_average(power_weights(around, around.order + 1))
        derivatives, doubts = zip(*known, strict=True)
        return Jets(derivatives, doubts, left_out.sum(axis=2) * above(left_out.shape[2]) + TINY)

    def _derivatives(self, order: int, values: Array, errors: Array) -> tuple[Array, Array]:
        """Those of J_xi at points, of one order less, and bounds of their errors."""
        one = self.orders[order - 1]
        found = one.table @ values[one.used]
        doubt = one.sizes @ (errors[one.used] + one.rounding * np.abs(values[one.used]))
        return self._spread(found, order), self._spread(doubt * above(len(one.used)), order)

    def _largest(self, order: int, boxes: list[TaylorModel]) -> Array:
        """Bounds of the derivatives of J_xi of one order less on boxes, (r, n, multi-indices, boxes)."""
        last = self.orders[order - 1]
        if last.used.any():
            highest = self._products([box.magnitude() for box in self.functions(boxes)], last.used)
        else:  # constants only
            highest = np.ones((len(last.used), boxes[0].remainder.shape[-1]))
        return self._spread(last.sizes @ highest * (1 + last.rounding) * above(len(last.used)), order)

    def _spread(self, found: Array, order: int) -> Array:
        """Derivatives by multi-index as those of J_xi: (r, n, multi-indices of one order less, boxes)."""
        n = self.terms.shape[1]
        values: Array = found.reshape(-1, self.r, found.shape[1])[neighbours(n, order)].transpose(2, 0, 1, 3)
        return values

    def _basis(self, functions: list[TaylorModel]) -> tuple[Array, Array]:
        """Basis functions at points, (1 + K, boxes), and bounds of their errors."""
        every = np.arange(len(self.terms))
        values = self._products([model.centre for model in functions], every)
        size = self._products([np.abs(model.centre) for model in functions], every)
        high = self._products([np.abs(model.centre) + model.remainder for model in functions], every)
        return values, np.maximum(high - size, 0) + sum_error(3 * self.terms.shape[1]) * high + TINY

    def _products(self, functions: list[Array], which: NDArray[np.intp]) -> Array:
        """Products of one-joint functions, (terms, boxes)."""
        table = np.stack(functions)
        out = np.ones((len(which), table.shape[1]))
        for joint in range(self.terms.shape[1]):
            chosen = self.terms[which, joint]
            there = np.flatnonzero(chosen)
            out[there] *= table[self.numbers[joint, chosen[there]]]
        return out


def _orders(family: ProductFamily, terms: Array, C: Array, highest: int) -> tuple[Derivatives, ...]:
    n = family.space.n
    steps = [family.build_derivative_matrix(i) for i in range(n)]
    known: dict[Monomial, tuple[Any, Any]] = {(): (C, np.abs(C))}
    orders: list[Derivatives] = []
    for order in range(1, highest + 1):
        indices = multi_indices(n, order)
        if orders and not len(orders[-1].used):  # a polynomial of a lower degree
            nothing = np.zeros((len(indices) * len(C), 0))
            orders.append(Derivatives(orders[-1].used, nothing, nothing, 0.0))
            continue
        for index in indices:
            values, sizes = known[index[:-1]]
            step = steps[index[-1]]
            known[index] = (values @ step, sizes @ abs(step))
        table, sizes = (np.concatenate([known[index][k] for index in indices]) for k in (0, 1))
        used = np.flatnonzero(sizes.any(axis=0))
        rounding = 4 * UNIT * (len(terms) + 64 * order)
        orders.append(Derivatives(used, table[:, used], sizes[:, used] * UP, rounding))
    return tuple(orders)


@dataclass(frozen=True, eq=False)
class NetworkRows:
    """J_xi of xi = W_out tanh(W_2 tanh(W_1 [sin q; cos q; q] + b_1) + b_2) on boxes."""

    layers: tuple[tuple[Array, Array], ...]  #: weights (out, in) and biases (out,)
    direct: tuple[bool, ...]  #: which joints enter as q itself

    @classmethod
    def of(cls, family: MLPFamily, theta: Array) -> "NetworkRows":
        """The layers of a family with its parameters."""
        layers, start = [], 0
        for width, out in pairwise(family.widths):
            end = start + out * width
            layers.append((theta[start:end].reshape(width, out).T.copy(), theta[end : end + out]))
            start = end + out
        return cls(tuple(layers), family.direct)

    def __call__(self, joints: list[TaylorModel], half_widths: Array, variables: Variables) -> TaylorModel:
        """J_xi, (r, n, boxes), for models of the joints."""
        turning = [q for q, slides in zip(joints, self.direct, strict=True) if not slides]
        sliding = [q for q, slides in zip(joints, self.direct, strict=True) if slides]
        sines, cosines = [sine(q) for q in turning], [cosine(q) for q in turning]
        layer, slopes = stacked([*sines, *cosines, *sliding]), []
        one = TaylorModel.constant(np.ones((1, 1)))
        for W, b in self.layers[:-1]:
            layer = tanh(_weighted(W, layer) + TaylorModel.constant(b[:, None]))
            slopes.append(one - square(layer))
        rows = []
        for weights in self.layers[-1][0]:
            gradient = TaylorModel.constant(weights[:, None])
            for (W, _), slope in zip(self.layers[-2::-1], slopes[::-1], strict=True):
                gradient = _weighted(W.T, gradient * slope)
            rows.append(self._by_joint(gradient, sines, cosines))
        return stacked(rows)

    def _by_joint(self, gradient: TaylorModel, sines: list[TaylorModel], cosines: list[TaylorModel]) -> TaylorModel:
        """Derivatives by the joints from those by the inputs [sin q; cos q; q]."""
        turning, columns = len(sines), []
        angle, slide = 0, 2 * turning
        for slides in self.direct:
            if slides:
                columns.append(gradient[slide])
                slide += 1
            else:
                by_sine, by_cosine = gradient[angle], gradient[turning + angle]
                columns.append(by_sine * cosines[angle] - by_cosine * sines[angle])
                angle += 1
        return stacked(columns)


def _weighted(W: Array, models: TaylorModel) -> TaylorModel:
    """W times a column of models, (out, boxes)."""
    size = np.abs(W)
    rounding = 4 * UNIT * (W.shape[1] + 8) * np.abs(models.coefficients).sum(axis=0)
    remainder = (size @ (models.remainder + rounding)) * above(W.shape[1]) + TINY
    return TaylorModel(models.variables, W @ models.coefficients, remainder)


@dataclass(frozen=True, eq=False)
class ChartRows:
    """J on boxes, without idle joints: their rows and columns are those of the identity.

    The rows of the task may be rotated, and those of the coordinates lack their scale, so that det J keeps its sign.
    Where a base moves, J stands for that at one place and heading, see `_base_of`.
    """

    n: int
    m: int
    active: Variables  #: joints that are not coordinates themselves: the columns
    variables: Variables  #: joints that J depends on
    task: "GraphRows"  #: of the active joints
    coordinates: CoordinateRows | None
    turns: Array  #: periods of the rows; 0 for those that have none
    base: Variables = ()  #: joints of a moving base on which J depends, but det J does not

    def __call__(self, low: Array, high: Array) -> TaylorModel:
        """Models (active, active, boxes) for the boxes between corners (boxes, n)."""
        joints, half_widths = joint_models(low, high, self.variables)
        rows = [self.task(joints)]
        if self.coordinates is not None:
            active = list(self.active)
            rows.append(self.coordinates([joints[i] for i in active], half_widths[active], self.active))
        variables = tuple(sorted({v for part in rows for v in part.variables}))
        rows = [part.over(variables) for part in rows]
        return TaylorModel(
            variables,
            np.concatenate([part.coefficients for part in rows], axis=1),
            np.concatenate([part.remainder for part in rows]),
        )


@dataclass(frozen=True, eq=False)
class GraphRows:
    """A matrix of so many rows that a graph gives column by column."""

    graph: TaylorGraph
    rows: int
    allowance: float = 0.0  #: added to the remainders

    def __call__(
        self, joints: list[TaylorModel], half_widths: Array | None = None, variables: Variables = ()
    ) -> TaylorModel:
        """Models (rows, columns, boxes)."""
        entries = self.graph(joints)
        boxes = joints[0].remainder.shape
        entries = [entry.on(boxes) for entry in entries]
        flat = stacked([stacked(entries[k : k + self.rows]) for k in range(0, len(entries), self.rows)])
        remainder = flat.remainder.swapaxes(0, 1) + self.allowance
        return TaylorModel(flat.variables, flat.coefficients.swapaxes(1, 2), remainder)


def chart_rows(chart: Chart) -> ChartRows:
    """The rows of a fitted chart.

    Raises:
        CertifyError: if the chart is grown, or uses operations without proven bounds.
    """
    coordinates = chart.coordinates
    if not isinstance(coordinates, Coordinates):
        raise CertifyError(f"a chart with {coordinates.label} coordinates has no expression, expected a fitted chart")
    if not np.all(coordinates.scale != 0):
        raise CertifyError("a coordinate is scaled by 0, so it is constant, expected coordinates that vary")
    active = tuple(coordinates.active)
    task, moved_by = task_gradients(chart.problem.task, chart.problem.domain, active)
    own, depends = _coordinate_rows(coordinates)
    base = _base_of(chart)
    variables = tuple(sorted({*moved_by, *depends} - {*base}))
    if len(variables) > MOST_VARIABLES:
        raise CertifyError(f"the chart depends on {len(variables)} joints, expected at most {MOST_VARIABLES}")
    periods = coordinates.turns[: len(coordinates.offset)] / np.abs(coordinates.scale)
    turns = np.concatenate([np.zeros(chart.m), periods])
    return ChartRows(chart.n, chart.m, active, variables, task, own, turns, base)


def _base_of(chart: Chart) -> Variables:
    """The joints of a planar base at whose positions det J is the same, because `Mobile` coordinates move with it.

    With the place p, the heading t and the arm's joints a, J(p, t, a) = D J(0, 0, a) E. D turns the rows of x and y and
    those of xi_1 and xi_2 by R(t); E turns the columns of p by R(-t); both have the determinant 1. Rows of the
    orientation in axes of the tip, z, and all other coordinates stay as they are. This holds for tasks of the tip's
    whole position and of its orientation, if the base carries the tip: no word of a file is taken for that.
    """
    coordinates, problem = chart.coordinates, chart.problem
    assert isinstance(coordinates, Coordinates)
    chosen, tip = coordinates.parametrisation, TipRows.of(problem.task)
    if not isinstance(chosen, Mobile) or tip is None or tip.position not in ((), (0, 1, 2)):
        return ()
    try:
        chosen.for_problem(problem)
    except InvalidValueError as error:
        raise CertifyError(f"the base of the chart is none: {error}") from None
    tree = problem.robot.tree
    places = tuple(tree.joint_names.index(name) for name in chosen.base)
    if tree.carriers(tree.tip_parent)[: len(places)] != list(places) or not isinstance(problem.domain, Box):
        return ()
    return places


def task_gradients(task: Task, domain: Domain, joints: Sequence[int]) -> tuple[GraphRows, set[int]]:
    """Columns of J_x, or of C(q) J_x from `task_rows`, and the joints that they depend on."""
    rows, allowance = task_rows(task, domain)
    if rows is task.jacobian_function:
        return true_gradients(task, joints)
    return closed_form_rows(rows, joints, allowance)


def closed_form_rows(rows: ca.Function, joints: Sequence[int], allowance: float = 0.0) -> tuple[GraphRows, set[int]]:
    """Columns of a matrix that a function of q gives as it is, and the joints that they depend on."""
    q = ca.SX.sym("q", rows.size1_in(0))
    J = ca.densify(rows(q)[:, list(joints)])
    graph = TaylorGraph.of(dense_function("task_rows", [q], [J]), "the task")
    return GraphRows(graph, J.shape[0], allowance), {k for k in range(q.shape[0]) if ca.depends_on(J, q[k])}


def true_gradients(task: Task, joints: Sequence[int]) -> tuple[GraphRows, set[int]]:
    """Columns of J_x itself, the derivative of h, and the joints that they depend on."""
    return _derivatives(task.smooth_function, joints, "the task")


def _derivatives(function: ca.Function, joints: Sequence[int], what: str) -> tuple[GraphRows, set[int]]:
    """Columns of the Jacobian of a function of q, and the inputs that they depend on."""
    graph = TaylorGraph.of(function, what, joints)
    known = gradient_dependences(graph.tape)
    return GraphRows(graph, len(known)), {k for row in known for j in joints for k in row.get(j, ())}


def joint_models(low: Array, high: Array, variables: Variables) -> tuple[list[TaylorModel], Array]:
    """Models of q_1, ..., q_n on boxes between corners (boxes, n), and the half-widths (n, boxes).

    Joints that are no variables stand still at the middle of the box: J does not depend on them.
    """
    centre = (low + high) / 2
    half = np.nextafter(np.maximum(high - centre, centre - low), np.inf) + TINY
    models = []
    for k in range(low.shape[1]):
        if k in variables:
            linear = np.stack([centre[:, k], half[:, k], *np.zeros((2, len(low)))])
            models.append(TaylorModel((k,), linear, np.zeros(len(low))))
        else:
            models.append(TaylorModel.constant(np.ascontiguousarray(centre[:, k])))
    return models, np.ascontiguousarray(half.T)


def _coordinate_rows(coordinates: Coordinates) -> tuple[CoordinateRows | None, set[int]]:
    """The fitted coordinates, and the joints they depend on."""
    if not len(coordinates.offset):
        return None, set()
    family, active = coordinates.family, coordinates.active
    if isinstance(family, ProductFamily):
        rows = ProductRows.of(family, coordinates.theta)
        return rows, {active[i] for i in rows.dependences()}
    if isinstance(family, MLPFamily):
        return NetworkRows.of(family, coordinates.theta), set(active)
    own = ca.SX.sym("q", len(active))
    xi = family.expression(own, ca.SX(ca.DM(coordinates.theta)))
    function = dense_function("xi", [own], [xi])
    if function.n_instructions() * len(active) > _MOST_STEPS:
        raise CertifyError(f"{coordinates.label} coordinates take too many operations, expected at most {_MOST_STEPS}")
    found, depends = _derivatives(function, range(len(active)), "the coordinates")
    return found, {active[i] for i in depends}
