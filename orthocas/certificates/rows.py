"""Rows of the Jacobian of phi as Taylor models, for tasks, product bases and networks.

Multiplying the rows from the left by a nonsingular matrix does not change whether J is singular. If the matrix has a
positive determinant, the sign of det J stays too. So the rows of a tip task may be replaced by those of the frame
Jacobian: velocity and angular velocity of the tip. In the axes of a body in the middle of the chain, each entry depends
on fewer joints than in world axes, so boxes can be larger. These rows are regular even half a turn from the reference,
where the components of x lose rank though the arm does not.

The stored rotations of a robot are rotations up to rounding only. Each of the at most n factors changes an entry by at
most its deviation times the length of the chain, and an allowance covers all changes. It also covers the constants that
CasADi multiplies and adds while it builds these rows: these are fewer than 10 n roundings of numbers up to the length,
and the allowance is 512 n of them. All other rows come from `graph`, which includes all rounding.

Source:
    ours, docs/explanation/certificates.md.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from orthocas.bases.composed import Mobile
from orthocas.bases.mlp import MLPFamily, split_layers
from orthocas.bases.products import ProductFamily
from orthocas.certificates.graph import TaylorGraph
from orthocas.certificates.jets import (
    Around,
    Jets,
    average_powers,
    build_power_weights,
    compute_powers,
    find_neighbours,
    list_multi_indices,
)
from orthocas.certificates.taylor import (
    DEGREE,
    TINY,
    UNIT,
    UP,
    Monomial,
    TaylorModel,
    Variables,
    compute_margin,
    cosine,
    reciprocal,
    sine,
    square,
    square_root,
    stack,
    sum_error,
    tanh,
)
from orthocas.charts.chart import Chart
from orthocas.charts.coordinates import Coordinates
from orthocas.errors import CertifyError, InvalidValueError
from orthocas.robots.kinematics import Pose, TipTurn
from orthocas.robots.spatial import constant, turn
from orthocas.robots.tree import KinematicTree
from orthocas.tasks.domains import Box, Domain
from orthocas.tasks.task import Task
from orthocas.tools.batch import dense_function
from orthocas.tools.checks import Array
from orthocas.tools.expressions import find_gradient_dependences

MOST_VARIABLES = 20  #: largest number of joints that J may depend on
_MOST_STEPS = 100_000  #: largest number of operations of coordinates times joints
CoordinateRows = Callable[[list[TaylorModel], Array, Variables], TaylorModel]


@dataclass(frozen=True, eq=False, repr=False)
class ChartRows:
    """J on boxes, without idle joints, whose rows and columns are those of the identity.

    The rows of the task may be rotated, and those of the coordinates are not scaled; the sign of det J stays. On a
    moving base, J is evaluated at one position and heading, see `_find_base`.
    """

    n: int
    m: int
    active: Variables  #: joints that are not coordinates themselves; they are the columns
    variables: Variables  #: joints that J depends on
    task: "GraphRows"  #: task rows for the active joints
    coordinates: CoordinateRows | None
    turns: Array  #: periods of the rows; 0 for rows without a period
    base: Variables = ()  #: joints of a moving base that J depends on, but det J does not

    def __call__(self, low: Array, high: Array) -> TaylorModel:
        """Models (active, active, boxes) for the boxes between corners (boxes, n)."""
        joints, half_widths = build_joint_models(low, high, self.variables)
        rows = [self.task(joints)]
        if self.coordinates is not None:
            active = list(self.active)
            rows.append(self.coordinates([joints[i] for i in active], half_widths[active], self.active))
        # Extend all rows to the union of their variables.
        variables = tuple(sorted({v for part in rows for v in part.variables}))
        rows = [part.extend(variables) for part in rows]
        return TaylorModel(
            variables,
            np.concatenate([part.coefficients for part in rows], axis=1),
            np.concatenate([part.remainder for part in rows]),
        )


@dataclass(frozen=True, eq=False, repr=False)
class GraphRows:
    """A matrix whose entries a TaylorGraph computes, column by column."""

    graph: TaylorGraph
    rows: int
    allowance: float = 0.0  #: added to the remainders

    def __call__(
        self, joints: list[TaylorModel], half_widths: Array | None = None, variables: Variables = ()
    ) -> TaylorModel:
        """Models (rows, columns, boxes)."""
        entries = self.graph(joints)
        boxes = joints[0].remainder.shape
        entries = [entry.broadcast_to(boxes) for entry in entries]
        flat = stack([stack(entries[k : k + self.rows]) for k in range(0, len(entries), self.rows)])
        remainder = flat.remainder.swapaxes(0, 1) + self.allowance
        return TaylorModel(flat.variables, flat.coefficients.swapaxes(1, 2), remainder)


def build_chart_rows(chart: Chart) -> ChartRows:
    """Build the rows of a fitted chart.

    Raises:
        CertifyError: if the chart is grown, or uses operations without proven bounds.
    """
    coordinates = chart.coordinates
    if not isinstance(coordinates, Coordinates):
        raise CertifyError(f"a chart with {coordinates.label} coordinates has no expression, expected a fitted chart")
    if not np.all(coordinates.scale != 0):
        raise CertifyError("a coordinate is scaled by 0, so it is constant, expected coordinates that vary")
    # Rows of the task and of the coordinates, for joints that are not coordinates themselves.
    active = tuple(coordinates.active)
    task, moved_by = build_task_rows(chart.problem.task, chart.problem.domain, active)
    own, depends = _build_coordinate_rows(coordinates)
    # Keep a base at rest if det J is the same at all its positions.
    base = _find_base(chart)
    variables = tuple(sorted({*moved_by, *depends} - {*base}))
    if len(variables) > MOST_VARIABLES:
        raise CertifyError(f"the chart depends on {len(variables)} joints, expected at most {MOST_VARIABLES}")
    periods = coordinates.turns[: len(coordinates.offset)] / np.abs(coordinates.scale)
    turns = np.concatenate([np.zeros(chart.m), periods])
    return ChartRows(chart.n, chart.m, active, variables, task, own, turns, base)


def _find_base(chart: Chart) -> Variables:
    """The joints of a planar base that does not affect det J, because `Mobile` coordinates move with it.

    With the position p, the heading t and the arm's joints a, J(p, t, a) = D J(0, 0, a) E. D turns the rows of x and y
    and those of xi_1 and xi_2 by R(t), and E turns the columns of p by R(-t); both have determinant 1. Rows of the
    orientation in axes of the tip, the row of z, and all other coordinates stay the same. This holds for tasks of the
    tip's whole position and of its orientation, if the base carries the tip, which is checked.
    """
    coordinates, problem = chart.coordinates, chart.problem
    assert isinstance(coordinates, Coordinates)
    chosen, tip = coordinates.parametrisation, TipRows.build(problem.task)
    if not isinstance(chosen, Mobile) or tip is None or tip.position not in ((), (0, 1, 2)):
        return ()
    try:
        chosen.for_problem(problem)
    except InvalidValueError as error:
        raise CertifyError(f"the base of the chart is not a planar base: {error}") from None
    tree = problem.robot.tree
    # Check that the base carries the tip, joint by joint from the world on.
    places = tuple(tree.joint_names.index(name) for name in chosen.base)
    if tree.carriers(tree.tip_parent)[: len(places)] != list(places) or not isinstance(problem.domain, Box):
        return ()
    return places


def build_task_rows(task: Task, domain: Domain, joints: Sequence[int]) -> tuple[GraphRows, set[int]]:
    """Columns of J_x, or of C(q) J_x from `transform_task_rows`, and the joints that they depend on."""
    rows, allowance = transform_task_rows(task, domain)
    if rows is task.jacobian_function:
        return build_true_gradients(task, joints)
    return build_closed_form(rows, joints, allowance)


def build_closed_form(rows: ca.Function, joints: Sequence[int], allowance: float = 0.0) -> tuple[GraphRows, set[int]]:
    """Columns of the matrix that a function of q returns, and the joints that they depend on."""
    q = ca.SX.sym("q", rows.size1_in(0))
    J = ca.densify(rows(q)[:, list(joints)])
    graph = TaylorGraph.build(dense_function("task_rows", [q], [J]), "the task")
    return GraphRows(graph, J.shape[0], allowance), {k for k in range(q.shape[0]) if ca.depends_on(J, q[k])}


def build_true_gradients(task: Task, joints: Sequence[int]) -> tuple[GraphRows, set[int]]:
    """Columns of J_x by differentiation of h, and the joints that they depend on."""
    return _build_derivatives(task.smooth_function, joints, "the task")


def _build_derivatives(function: ca.Function, joints: Sequence[int], what: str) -> tuple[GraphRows, set[int]]:
    """Columns of the Jacobian of a function of q, and the inputs that they depend on."""
    graph = TaylorGraph.build(function, what, joints)
    gradients = find_gradient_dependences(graph.tape)
    return GraphRows(graph, len(gradients)), {k for row in gradients for j in joints for k in row.get(j, ())}


def build_joint_models(low: Array, high: Array, variables: Variables) -> tuple[list[TaylorModel], Array]:
    """Models of q_1, ..., q_n on boxes between corners (boxes, n), and the half-widths (n, boxes).

    Other joints stay at the centre of the box, because J does not depend on them.
    """
    centre = (low + high) / 2
    half = np.nextafter(np.maximum(high - centre, centre - low), np.inf) + TINY
    models = []
    for k in range(low.shape[1]):
        # q_k = centre + half-width t.
        if k in variables:
            linear = np.stack([centre[:, k], half[:, k], *np.zeros((2, len(low)))])
            models.append(TaylorModel((k,), linear, np.zeros(len(low))))
        else:
            models.append(TaylorModel.constant(np.ascontiguousarray(centre[:, k])))
    return models, np.ascontiguousarray(half.T)


def _build_coordinate_rows(coordinates: Coordinates) -> tuple[CoordinateRows | None, set[int]]:
    """Rows of the fitted coordinates, and the joints that they depend on."""
    if not len(coordinates.offset):
        return None, set()
    # Product bases and networks have rows of their own. Other families are differentiated operation by operation.
    family, active = coordinates.family, coordinates.active
    if isinstance(family, ProductFamily):
        rows = ProductRows.build(family, coordinates.theta)
        return rows, {active[i] for i in rows.find_dependences()}
    if isinstance(family, MLPFamily):
        return NetworkRows.build(family, coordinates.theta), {active[i] for i in family.inputs}
    own = ca.SX.sym("q", len(active))
    xi = family.expression(own, ca.SX(ca.DM(coordinates.theta)))
    function = dense_function("xi", [own], [xi])
    if function.n_instructions() * len(active) > _MOST_STEPS:
        raise CertifyError(f"{coordinates.label} coordinates take too many operations, expected at most {_MOST_STEPS}")
    graph_rows, depends = _build_derivatives(function, range(len(active)), "the coordinates")
    return graph_rows, {active[i] for i in depends}


@dataclass(frozen=True)
class TipRows:
    """The parts of the tip's pose that a task fixes: x(q) = x(p) if and only if these parts are equal at q and p."""

    position: tuple[int, ...] = ()  #: world axes along which the position is fixed
    rotation: bool = False  #: whether the whole orientation is fixed
    axis: int | None = None  #: axis of the tip whose direction is fixed, unless the whole orientation is

    @classmethod
    def build(cls, task: Task) -> "TipRows | None":
        """Build for a task; None for other tasks or frames, for a tip that does not move, and with mimic joints."""
        kind, tree = task.recipe["kind"], task.robot.tree
        if tree.tip_parent < 0 or not task.of_tip or tree.mimic_names:
            return None
        # Position, or some of its components.
        if kind == "polar":
            return cls((0, 1))
        if kind.startswith("position:"):
            return cls(tuple(map("xyz".index, kind.removeprefix("position:"))))
        # Orientation, pose, or one axis.
        if (turned := TipTurn.from_kind(kind)) is None:
            return None
        whole = turned.whole or turned.axis is None
        return cls((0, 1, 2) if turned.with_position else (), whole, None if whole else "xyz".index(str(turned.axis)))


def transform_task_rows(task: Task, domain: Domain) -> tuple[ca.Function, float]:
    """q (n, 1) -> J_x (m, n), or C(q) J_x with det C > 0 up to an error of the entries; and this error."""
    tip, tree = TipRows.build(task), task.robot.tree
    # Rows of only some world axes cannot be rotated.
    if tip is None or tip.position not in ((), (0, 1, 2)):
        return task.jacobian_function, 0.0
    q = ca.SX.sym("q", task.robot.n)
    parts, rows = [], [build_velocity_rows(tree, q, body) for body in tree.carriers(tree.tip_parent)]
    if tip.position:
        parts.append(_choose_sparsest(q, [J[:3, :] for J in rows]))
    if tip.rotation:
        parts.append(_choose_sparsest(q, [J[3:, :] for J in rows]))
    if tip.axis is not None:
        parts.append(build_axis_rows(tree, q, tip.axis))
    # Effect of stored rotations on an entry: 16 n deviations times the length of the chain.
    error = 16 * (tree.n + 1) * bound_rotation_error(tree) * bound_reach(tree, domain)
    return dense_function("task_rows", [q], [ca.vertcat(*parts)]), error


def build_velocity_rows(tree: KinematicTree, q: ca.SX, body: int) -> ca.SX:
    """Jacobian of the tip's velocity and angular velocity in the axes of a body of the chain, (6, n)."""
    # Poses of all bodies relative to that body: outwards to the tip, then back to the base.
    chain = tree.carriers(tree.tip_parent)
    here = chain.index(body)
    poses: dict[int, Pose] = {body: (ca.SX.eye(3), ca.SX.zeros(3))}
    for below, i in zip(chain[here:], chain[here + 1 :], strict=False):
        R, p = poses[below]
        rotation, shift = _build_step(tree, q, i)
        poses[i] = (R @ rotation, p + R @ shift)
    for i, below in zip(chain[here:0:-1], chain[here - 1 :: -1] if here else [], strict=False):
        R, p = poses[i]
        rotation, shift = _build_step(tree, q, i)
        back = R @ rotation.T
        poses[below] = (back, p - back @ shift)
    # Turning joints move the tip about their axes, sliding joints along them.
    R, p = poses[tree.tip_parent]
    tip = p + R @ constant(tree.tip_translation)
    J = ca.SX(6, tree.n)
    for i, (rotation, origin) in poses.items():
        axis = rotation[:, 2]
        if tree.prismatic[i]:
            J[:3, i] = axis
        else:
            J[:3, i], J[3:, i] = ca.cross(axis, tip - origin), axis
    return J


def build_axis_rows(tree: KinematicTree, q: ca.SX, axis: int) -> ca.SX:
    """Jacobian of the direction of a tip axis, along the two other axes of the tip, (2, n)."""
    # Directions of the axis (3,) and of the two others (3, 2) in the frame of the body that carries the tip.
    own, others = tree.tip_rotation[:, axis], tree.tip_rotation[:, [k for k in range(3) if k != axis]]
    J = build_velocity_rows(tree, q, tree.tip_parent)[3:, :]
    along = ca.horzcat(*[ca.cross(J[:, i], ca.SX(ca.DM(own))) for i in range(tree.n)])
    return constant(others.T) @ along


def bound_rotation_error(tree: KinematicTree) -> float:
    """Upper bound of the deviation of stored or computed rotation matrices from exact rotations."""
    stored = np.concatenate([tree.rotations, tree.tip_rotation[None]])
    squares = stored.transpose(0, 2, 1) @ stored - np.eye(3)
    return 3 * float(np.abs(squares).max()) + 32 * UNIT


def bound_reach(tree: KinematicTree, domain: Domain) -> float:
    """Upper bound of the distance from any joint's origin to the tip on the box of a domain [m], plus 1."""
    furthest = np.abs(domain.centre) + domain.half_width
    slides = float(furthest[np.array(tree.prismatic)].sum())
    return float(np.abs(tree.translations).sum() + np.abs(tree.tip_translation).sum()) + slides + 1.0


def _choose_sparsest(q: ca.SX, choices: list[ca.SX]) -> ca.SX:
    return min(choices, key=lambda J: int(ca.jacobian(ca.vec(J), q).nnz()))


def _build_step(tree: KinematicTree, q: ca.SX, i: int) -> Pose:
    """Rotation and position of a body in the frame of its parent."""
    rotation, shift = constant(tree.rotations[i]), constant(tree.translations[i])
    if tree.prismatic[i]:
        return rotation, shift + rotation[:, 2] * q[i]
    return rotation @ turn(q[i]), shift


@dataclass(frozen=True, eq=False, repr=False)
class Derivatives:
    """Derivatives of one order of all coordinates, as sums of a few basis functions."""

    used: NDArray[np.intp]  #: indices of the basis functions
    table: Array  #: (multi-indices * r, used)
    sizes: Array  #: upper bounds of the terms of the entries, same shape
    rounding: float  #: relative error of entries and of sums over them


@dataclass(frozen=True, eq=False, repr=False)
class ProductRows:
    """J_xi of a product family on boxes."""

    r: int
    terms: Array  #: (1 + K, n): for each term, the index of the one-joint function of each joint
    functions: TaylorGraph  #: q -> all one-joint functions that are not constant
    numbers: Array  #: (n, functions of one joint): index of each function in `functions`
    orders: tuple[Derivatives, ...]  #: from order 1 on

    @classmethod
    def build(cls, family: ProductFamily, theta: Array, highest: int = DEGREE + 2) -> "ProductRows":
        """Tabulate a family with its parameters."""
        n, r = family.space.n, family.outputs
        terms = np.array([(0,) * n, *family.terms])
        # Terms of a single joint, from whose functions all terms are products.
        alone = np.flatnonzero(np.count_nonzero(terms, axis=1) == 1)
        q = ca.SX.sym("q", n)
        functions = family.basis(q)[[int(k) - 1 for k in alone]]
        numbers = np.zeros((n, terms.max() + 1), dtype=int)
        for place, k in enumerate(alone):
            joint = int(np.flatnonzero(terms[k])[0])
            numbers[joint, terms[k, joint]] = place
        graph = TaylorGraph.build(dense_function("functions", [q], [functions]), "the coordinates")
        # Derivatives of basis functions are sums of basis functions, so derivatives of coordinates are tables, one per
        # order.
        steps = [family.build_derivative_matrix(i) for i in range(n)]
        C = np.hstack([np.zeros((r, 1)), theta.reshape(r, -1)])
        tables: dict[Monomial, tuple[Any, Any]] = {(): (C, np.abs(C))}
        orders: list[Derivatives] = []
        for order in range(1, highest + 1):
            indices = list_multi_indices(n, order)
            # Derivatives of higher order than the polynomial's degree vanish.
            if orders and not len(orders[-1].used):
                nothing = np.zeros((len(indices) * r, 0))
                orders.append(Derivatives(orders[-1].used, nothing, nothing, 0.0))
                continue
            for index in indices:
                values, sizes = tables[index[:-1]]
                step = steps[index[-1]]
                tables[index] = (values @ step, sizes @ abs(step))
            table, sizes = (np.concatenate([tables[index][k] for index in indices]) for k in (0, 1))
            used = np.flatnonzero(sizes.any(axis=0))
            rounding = 4 * UNIT * (len(terms) + 64 * order)
            orders.append(Derivatives(used, table[:, used], sizes[:, used] * UP, rounding))
        return cls(r, terms, graph, numbers, tuple(orders))

    def __call__(self, boxes: list[TaylorModel], half_widths: Array, variables: Variables) -> TaylorModel:
        """J_xi, (r, n, boxes), for models of the joints on boxes of the given half-widths (n, boxes)."""
        # Taylor series: derivatives at the centre, and the next order on the whole box for the remainder. Start with
        # the values of the basis at the centres, and their errors.
        points = [TaylorModel.constant(box.centre) for box in boxes]
        values, errors = self._evaluate_basis(self.functions(points))
        parts, left_out = [], np.zeros((self.r, len(boxes), half_widths.shape[1]))
        # Use derivatives up to the degree of the models; the next order bounds the truncation error.
        for order in range(1, DEGREE + 2):
            derivatives, doubt = self._evaluate_derivatives(order, values, errors)
            weights = compute_powers(half_widths, order - 1)
            coefficients = derivatives * weights
            left_out += (doubt * weights + sum_error(DEGREE + 2) * np.abs(coefficients)).sum(axis=2)
            parts.append(coefficients)
        left_out += (self._bound_derivatives(DEGREE + 2, boxes) * compute_powers(half_widths, DEGREE + 1)).sum(axis=2)
        coefficients = np.concatenate(parts, axis=2).transpose(2, 0, 1, 3)
        return TaylorModel(variables, coefficients, left_out * compute_margin(len(coefficients)) + TINY)

    def find_dependences(self) -> set[int]:
        """The joints that J_xi depends on."""
        # Second derivatives of the coordinates are first derivatives of J_xi.
        changing = self.orders[1]
        indices = list_multi_indices(self.terms.shape[1], 2)
        sizes = np.asarray(changing.sizes.reshape(len(indices), self.r * len(changing.used)).any(axis=1))
        return {i for index, there in zip(indices, sizes.tolist(), strict=True) if there for i in index}

    def build_jets(self, around: Around) -> Jets:
        """The derivatives of J_xi at centres of boxes; the next order on the whole box bounds the truncation error."""
        points = [TaylorModel.constant(np.ascontiguousarray(c)) for c in around.centre]
        values, errors = self._evaluate_basis(self.functions(points))
        orders = [self._evaluate_derivatives(order, values, errors) for order in range(1, around.order + 2)]
        # Truncation error: the next order anywhere between the points.
        linear = np.stack([around.centre, around.reach, *np.zeros((2, *around.centre.shape))], axis=1)
        boxes = [TaylorModel((k,), each, np.zeros(each.shape[1:])) for k, each in enumerate(linear)]
        weights = average_powers(build_power_weights(around, around.order + 1), of_size=True)
        left_out = self._bound_derivatives(around.order + 2, boxes) * weights
        derivatives, doubts = zip(*orders, strict=True)
        return Jets(derivatives, doubts, left_out.sum(axis=2) * compute_margin(left_out.shape[2]) + TINY)

    def _evaluate_derivatives(self, order: int, values: Array, errors: Array) -> tuple[Array, Array]:
        """Derivatives of J_xi of order `order` - 1 at points, and error bounds."""
        one = self.orders[order - 1]
        derivatives = one.table @ values[one.used]
        doubt = one.sizes @ (errors[one.used] + one.rounding * np.abs(values[one.used]))
        return self._spread(derivatives, order), self._spread(doubt * compute_margin(len(one.used)), order)

    def _bound_derivatives(self, order: int, boxes: list[TaylorModel]) -> Array:
        """Upper bounds of the derivatives of J_xi of order `order` - 1 on boxes, (r, n, multi-indices, boxes)."""
        last = self.orders[order - 1]
        # If no other function is used, all are constants.
        if last.used.any():
            highest = self._multiply_functions([box.bound_magnitude() for box in self.functions(boxes)], last.used)
        else:
            highest = np.ones((len(last.used), boxes[0].remainder.shape[-1]))
        return self._spread(last.sizes @ highest * (1 + last.rounding) * compute_margin(len(last.used)), order)

    def _spread(self, derivatives: Array, order: int) -> Array:
        """Rearrange derivatives of xi as those of J_xi: (r, n, multi-indices of one order less, boxes)."""
        n, boxes = self.terms.shape[1], derivatives.shape[1]
        values: Array = derivatives.reshape(-1, self.r, boxes)[find_neighbours(n, order)].transpose(2, 0, 1, 3)
        return values

    def _evaluate_basis(self, functions: list[TaylorModel]) -> tuple[Array, Array]:
        """Basis functions at points, (1 + K, boxes), and error bounds."""
        every = np.arange(len(self.terms))
        values = self._multiply_functions([model.centre for model in functions], every)
        size = self._multiply_functions([np.abs(model.centre) for model in functions], every)
        high = self._multiply_functions([np.abs(model.centre) + model.remainder for model in functions], every)
        return values, np.maximum(high - size, 0) + sum_error(3 * self.terms.shape[1]) * high + TINY

    def _multiply_functions(self, functions: list[Array], which: NDArray[np.intp]) -> Array:
        """Products of one-joint functions, (terms, boxes)."""
        table = np.stack(functions)
        out = np.ones((len(which), table.shape[1]))
        for joint in range(self.terms.shape[1]):
            chosen = self.terms[which, joint]
            there = np.flatnonzero(chosen)
            out[there] *= table[self.numbers[joint, chosen[there]]]
        return out


@dataclass(frozen=True, eq=False, repr=False)
class NetworkRows:
    """J_xi of xi = W_out a(W_2 a(W_1 [sin q; cos q; q] + b_1) + b_2) + A q on boxes."""

    layers: tuple[tuple[Array, Array], ...]  #: weights (out, in) and biases (out,)
    turning: list[int]  #: joints that enter as sine and cosine
    direct: list[int]  #: joints that enter as q itself
    slopes: Array  #: A for all joints, (r, n); 0 for joints of the network
    activation: str  #: a

    @classmethod
    def build(cls, family: MLPFamily, theta: Array) -> "NetworkRows":
        """Read the layers of a family with its parameters."""
        layers = tuple((V.T.copy(), b) for V, b in zip(*split_layers(theta, family.widths), strict=True))
        slopes = np.zeros((family.outputs, family.space.n))
        slopes[:, list(family.linear)] = family.split_slopes(theta)
        return cls(layers, family.turning, family.direct, slopes, family.activation)

    def __call__(self, joints: list[TaylorModel], half_widths: Array, variables: Variables) -> TaylorModel:
        """J_xi, (r, n, boxes), for models of the joints."""
        sines, cosines = ([of(joints[i]) for i in self.turning] for of in (sine, cosine))
        # Values from layer to layer, then gradients backwards.
        layer, slopes = stack([*sines, *cosines, *(joints[i] for i in self.direct)]), []
        one = TaylorModel.constant(np.ones((1, 1)))
        for W, b in self.layers[:-1]:
            layer = _multiply_weights(W, layer) + TaylorModel.constant(b[:, None])
            if self.activation == "tanh":
                layer = tanh(layer)
                slopes.append(one - square(layer))
            else:
                root = reciprocal(square_root(one + square(layer)))
                layer = layer * root
                slopes.append(root * square(root))
        rows = []
        for weights, constants in zip(self.layers[-1][0], self.slopes, strict=True):
            gradient = TaylorModel.constant(weights[:, None])
            for (W, _), slope in zip(self.layers[-2::-1], slopes[::-1], strict=True):
                gradient = _multiply_weights(W.T, gradient * slope)
            # Derivatives by the joints, from derivatives by the inputs [sin q; cos q; q].
            turning, columns = len(sines), [TaylorModel.constant(np.full(1, value)) for value in constants]
            for k, i in enumerate(self.turning):
                columns[i] = gradient[k] * cosines[k] - gradient[turning + k] * sines[k]
            for k, i in enumerate(self.direct):
                columns[i] = gradient[2 * turning + k]
            rows.append(stack(columns))
        return stack(rows)


def _multiply_weights(W: Array, models: TaylorModel) -> TaylorModel:
    """W times a column of models, (out, boxes)."""
    size = np.abs(W)
    rounding = 4 * UNIT * (W.shape[1] + 8) * np.abs(models.coefficients).sum(axis=0)
    remainder = (size @ (models.remainder + rounding)) * compute_margin(W.shape[1]) + TINY
    return TaylorModel(models.variables, W @ models.coefficients, remainder)
