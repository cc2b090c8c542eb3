"""The Jacobian of a chart on boxes, as Taylor models."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from orthocas.casadi_tools.batch import dense_function
from orthocas.casadi_tools.structure import gradient_dependences
from orthocas.casadi_tools.tape import to_tape
from orthocas.certifying.derivative_graph import DerivativeGraph
from orthocas.certifying.graph import TaylorGraph
from orthocas.certifying.monomials import Variables
from orthocas.certifying.network_rows import NetworkRows
from orthocas.certifying.product_rows import ProductRows
from orthocas.certifying.rounding import TINY
from orthocas.certifying.task_rows import task_rows
from orthocas.certifying.taylor import TaylorModel, stacked
from orthocas.chart import Chart
from orthocas.checks import Array
from orthocas.coordinates.fitted import Coordinates
from orthocas.domains import Domain
from orthocas.errors import CertifyError
from orthocas.parametrisations.mlp import MLPFamily
from orthocas.parametrisations.product_basis import ProductFamily
from orthocas.tasks import Task

MOST_VARIABLES = 20
_MOST_STEPS = 100_000
CoordinateRows = Callable[[list[TaylorModel], Array, Variables], TaylorModel]


@dataclass(frozen=True, eq=False)
class ChartRows:
    """J on boxes, without idle joints: their rows and columns are those of the identity.

    The rows of the task may be rotated, and those of the coordinates lack their scale, so that det J keeps its sign.
    """

    n: int
    m: int
    active: Variables  #: joints that are not coordinates themselves: the columns
    variables: Variables  #: joints that J depends on
    task: "GraphRows"  #: of the active joints
    coordinates: CoordinateRows | None
    turns: Array  #: periods of the rows; 0 for those that have none

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

    graph: TaylorGraph | DerivativeGraph
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
    variables = tuple(sorted({*moved_by, *depends}))
    if len(variables) > MOST_VARIABLES:
        raise CertifyError(f"the chart depends on {len(variables)} joints, expected at most {MOST_VARIABLES}")
    periods = coordinates.turns[: len(coordinates.offset)] / np.abs(coordinates.scale)
    turns = np.concatenate([np.zeros(chart.m), periods])
    return ChartRows(chart.n, chart.m, active, variables, task, own, turns)


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
    return _derivatives(task.function, joints, "the task")


def _derivatives(function: ca.Function, joints: Sequence[int], what: str) -> tuple[GraphRows, set[int]]:
    """Columns of the Jacobian of a function of q, and the inputs that they depend on."""
    graph = DerivativeGraph.of(function, joints, what)
    known = gradient_dependences(to_tape(function))
    return GraphRows(graph, graph.outputs), {k for row in known for j in joints for k in row.get(j, ())}


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
