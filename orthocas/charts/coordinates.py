"""Coordinates xi(q) of a chart: protocols, functions of one joint position, and fitted coordinates."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import casadi as ca
import numpy as np

from orthocas.bases.family import (
    Expression,
    Family,
    GradedParametrisation,
    JointSpace,
    LinearFamily,
    Parametrisation,
    PeriodicFamily,
    SelfDerivativeFamily,
)
from orthocas.tools.batch import Batched, dense_function, one_blas_thread
from orthocas.tools.blas_graph import NumpyGraph
from orthocas.tools.cached import BuiltOnUse, cached_property
from orthocas.tools.checks import Array, freeze_array, require_shape
from orthocas.tools.columns import COLUMNS, MANY, BlockedFunction, BlockFunction, ColumnFunction, fill
from orthocas.tools.expressions import expand_scalars

_FEW = 8  # smaller sets of joint positions are evaluated one by one by networks


class CoordinateMap(Protocol):
    """Coordinates xi(q), fitted or grown."""

    @property
    def r(self) -> int:
        """Number of coordinates."""
        ...

    @property
    def label(self) -> str:
        """Short name of the representation, for example 'polynomial:4'."""
        ...

    @property
    def size(self) -> int:
        """Number of parameters."""
        ...

    @property
    def functions(self) -> dict[str, ca.Function]:
        """CasADi functions of one joint position (n, 1), by name.

        They are xi (r, 1), jacobian (r, n), and second_derivative (r, 1) of q, v, w: (d/ds) J_xi(q + s v) w at s = 0.
        """
        ...

    def xi(self, points: Array) -> Array:
        """Coordinates (N, r) at points (N, n)."""
        ...

    def jacobian(self, points: Array) -> Array:
        """J_xi (N, r, n) at points (N, n)."""
        ...


@runtime_checkable
class InvertibleMap(Protocol):
    """Coordinates with their own inverse map."""

    @property
    def turn(self) -> float:
        """Period of the coordinates: 2 pi on a circle, 0 if they are not periodic."""
        ...

    def inverse(self, phi: Array, q_start: Array) -> Array:
        """Joint positions (N, n) with task values and coordinates phi (N, n), from q_start (N, n); NaN if none."""
        ...


def point_functions(family: Family, theta: Array, n: int) -> dict[str, ca.Function]:
    """CasADi functions of a family: xi (r, 1) and jacobian (r, n) of q (n, 1), and second_derivative (r, 1) of q, v, w.

    second_derivative is d^2 xi(q)[v, w]. For linear families, the basis is evaluated once and multiplied by the matrix
    of coefficients in a loop. As scalar code, a polynomial of degree 4 on seven joints would take 10,000 operations.
    """
    if isinstance(family, SelfDerivativeFamily):
        return _from_tables(family, theta, n)
    if isinstance(family, LinearFamily):
        # xi = C psi, J = C dpsi/dq and C d^2 psi[v, w], with the coefficients C and the basis psi
        x, a, b = (ca.SX.sym(name, n) for name in ("q", "v", "w"))
        psi = family.basis(x)
        basis = ca.Function("basis", [x], [psi])
        slopes = ca.Function("basis_slopes", [x], [ca.densify(ca.jacobian(psi, x))])
        bends = ca.Function("basis_bends", [x, a, b], [ca.densify(second_derivative(psi, x, a, b))])
        C = ca.MX(ca.DM(theta.reshape(family.outputs, family.width)))
        q, v, w = (ca.MX.sym(name, n) for name in ("q", "v", "w"))
        return _functions(C @ basis(q), C @ slopes(q), C @ bends(q, v, w), q, v, w)
    kind: Any = ca.MX if family.as_matrices else ca.SX
    q, v, w = (kind.sym(name, n) for name in ("q", "v", "w"))
    # weights are constants of the graph, so that calls do not slice and transpose them
    parameters: Any = ca.DM(theta)
    xi = family.expression(q, parameters)
    jacobian = ca.horzcat(*family.jacobian(q, parameters)).T
    return _functions(xi, jacobian, second_derivative(xi, q, v, w), q, v, w)


def second_derivative(values: Any, q: Any, v: Any, w: Any) -> Any:
    """(d/ds) J(q + s v) w at s = 0, with the Jacobian J of an SX or MX expression `values` in q."""
    return ca.jtimes(ca.jtimes(values, q, w), q, v)


def _from_tables(family: SelfDerivativeFamily, theta: Array, n: int) -> dict[str, ca.Function]:
    """`point_functions` for a family whose basis psi is closed under differentiation: d xi / d q_i = C_i psi'.

    psi' is the part of [1; psi] that occurs in derivatives: for a polynomial of degree d, the terms up to degree d - 1.
    So J is one matrix of coefficients times psi'.
    """
    r = family.outputs
    tables = family.derivative_tables(theta)
    # the terms of psi' are those with a coefficient in any derivative
    places = np.flatnonzero(tables.any(axis=(0, 1)))
    x, u = ca.SX.sym("q", n), ca.SX.sym("v", n)
    psi = family.basis(x)
    smaller = ca.vertcat(1, psi)[places.tolist()]
    basis = ca.Function("basis", [x], [psi])
    smaller_basis = ca.Function("smaller_basis", [x], [smaller])
    change = ca.Function("smaller_basis_change", [x, u], [ca.densify(ca.jtimes(smaller, x, u))])
    # coefficients are MX matrices, so that generated C multiplies in loops
    values = ca.MX(ca.DM(theta.reshape(r, family.width)))
    slopes = ca.MX(ca.DM(tables[:, :, places].reshape(n * r, len(places))))
    q, v, w = (ca.MX.sym(name, n) for name in ("q", "v", "w"))
    jacobian, rate = (ca.reshape(slopes @ of, r, n) for of in (smaller_basis(q), change(q, v)))
    found = _functions(values @ basis(q), jacobian, rate @ w, q, v, w)
    return {**found, "jacobian_rate": ca.Function("dJ_xi", [q, v], [rate])}


def _functions(xi: Any, jacobian: Any, second: Any, q: Any, v: Any, w: Any) -> dict[str, ca.Function]:
    """Dense CasADi functions of expressions in q, v, w, by name."""
    return {
        "xi": dense_function("xi", [q], [xi]),
        "jacobian": dense_function("J_xi", [q], [jacobian]),
        "second_derivative": dense_function("d2xi", [q, v, w], [second], ["q", "v", "w"]),
    }


Maker = Callable[[], BlockFunction]  #: builds a function of a block of joint positions (n, c); one for each thread


def _values(coordinates: "Coordinates", family: SelfDerivativeFamily) -> Maker:
    """Maker of the function q (n, c) -> xi (r, c) on blocks: scale (C psi - offset), then the idle joints."""
    r, active, idle = family.outputs, coordinates.active, list(coordinates.idle)
    # scale and offset are applied to the coefficients once
    C = coordinates.scale[:, None] * coordinates.theta.reshape(r, -1)
    shift, centre = (coordinates.scale * coordinates.offset)[:, None], coordinates.space.centre[idle, None]
    q = ca.SX.sym("q", len(active))
    basis = ColumnFunction(ca.Function("basis", [q], [ca.densify(family.basis(q))]))

    def make() -> BlockFunction:
        psi, xi = basis.build_block_function(), np.empty((coordinates.r, COLUMNS))

        def build_block_function(columns: Array) -> Array:
            np.matmul(C, psi(columns[active])[0], out=xi[:r])
            xi[:r] -= shift
            xi[r:] = columns[idle] - centre
            return xi

        return build_block_function

    return make


def _slopes(coordinates: "Coordinates", family: SelfDerivativeFamily) -> Maker:
    """Maker of the function q (n, c) -> J_xi (r n, c) on blocks, row by row.

    The entries of fitted coordinates are scale C_i psi' (see `_from_tables`); idle joints have rows of the identity.
    """
    n, r, active = coordinates.space.n, family.outputs, coordinates.active
    by_joint = family.derivative_tables(coordinates.theta)  # (active, r, 1 + K)
    # one table for all joints, with the scales, and only the terms that occur
    places = np.flatnonzero(by_joint.any(axis=(0, 1)))
    table = np.zeros((r, n, len(places)))
    table[:, active] = coordinates.scale[:, None, None] * by_joint[:, :, places].transpose(1, 0, 2)
    flat = table.reshape(r * n, len(places))
    # gradients of idle joints are constant
    of_idle = np.eye(n)[list(coordinates.idle)].reshape(-1, 1)
    q = ca.SX.sym("q", len(active))
    smaller = ca.vertcat(1, family.basis(q))[places.tolist()]
    basis = ColumnFunction(ca.Function("smaller_basis", [q], [ca.densify(smaller)]))

    def make() -> BlockFunction:
        psi, J = basis.build_block_function(), np.empty((coordinates.r * n, COLUMNS))
        J[r * n :] = of_idle

        def build_block_function(columns: Array) -> Array:
            np.matmul(flat, psi(columns[active])[0], out=J[: r * n])
            return J

        return build_block_function

    return make


@dataclass(frozen=True, eq=False)
class Coordinates:
    """xi(q) = [scale (family(q_active) - offset); q_idle - centre_idle], (r, 1).

    Fits choose offset and scale so that xi(centre) = 0, and so that the mean gradient length of each coordinate over
    the domain is 1. They do not change any angles.
    """

    parametrisation: Parametrisation
    space: JointSpace = field(repr=False)  #: all joints of the robot
    idle: tuple[int, ...]  #: joints that are coordinates themselves; they come last
    theta: Array = field(repr=False)  #: parameters of the family, (size,)
    offset: Array = field(repr=False)  #: (r - idle,)
    scale: Array = field(repr=False)  #: (r - idle,)

    def __post_init__(self) -> None:
        fitted = len(self.offset)
        # check theta before the basis is built, because a wrong degree could make the basis enormous
        if isinstance(self.parametrisation, GradedParametrisation):
            terms = self.parametrisation.term_count(len(self.active)) if fitted else 0
            require_shape("theta", np.shape(self.theta), (fitted * terms,))
        size = self.family.size if fitted else 0
        object.__setattr__(self, "theta", freeze_array("theta", self.theta, (size,)))
        object.__setattr__(self, "offset", freeze_array("offset", self.offset, (fitted,)))
        object.__setattr__(self, "scale", freeze_array("scale", self.scale, (fitted,)))

    @property
    def r(self) -> int:
        """Number of coordinates."""
        return len(self.offset) + len(self.idle)

    @property
    def label(self) -> str:
        """Short name of the parametrisation, or 'joints' if all coordinates are idle joints."""
        return self.parametrisation.label if len(self.offset) else "joints"

    @property
    def size(self) -> int:
        """Number of parameters."""
        return self.theta.size

    @property
    def active(self) -> list[int]:
        """The joints that are not idle; the fitted family depends on them."""
        return [i for i in range(self.space.n) if i not in self.idle]

    @property
    def turns(self) -> Array:
        """Periods of the coordinates, (r,): 2 pi scale for those that are angles, 0 for others."""
        fitted = len(self.offset)
        own = self.family.periods if fitted and isinstance(self.family, PeriodicFamily) else np.zeros(fitted)
        return np.concatenate([own * np.abs(self.scale), np.zeros(len(self.idle))])

    @property
    def as_matrices(self) -> bool:
        """Whether the functions consist of dense matrix products, as for networks."""
        return bool(len(self.offset)) and self.family.as_matrices

    @cached_property
    def family(self) -> Family:
        """The fitted family on the active joints."""
        return self.parametrisation.family(self.space.restricted_to(self.active), len(self.offset))

    def expression(self, q: Expression) -> Expression:
        """The expression of xi, (r, N), for joint positions q as columns (n, N)."""
        columns = q.shape[1]
        rows: list[Expression] = []
        # fitted coordinates, then the joints that are coordinates themselves
        if len(self.offset):
            theta = type(q)(ca.DM(self.theta))
            fitted = self.family.expression(q[self.active, :], theta)
            rows.append((fitted - _columns(self.offset, columns)) * _columns(self.scale, columns))
        if self.idle:
            rows.append(q[list(self.idle), :] - _columns(self.space.centre[list(self.idle)], columns))
        return ca.vertcat(*rows)

    def xi(self, points: Array) -> Array:
        """Coordinates (N, r) at points (N, n)."""
        return self.into("xi", np.empty((len(points), self.r)), points)

    def jacobian(self, points: Array) -> Array:
        """J_xi (N, r, n) at points (N, n)."""
        return self.into("jacobian", np.empty((len(points), self.r, self.space.n)), points)

    def once(self, name: str, points: Array) -> Array:
        """Values of `xi` or `jacobian` for a single call: without building the faster functions for later calls."""
        if self.as_matrices:
            return self.xi(points) if name == "xi" else self.jacobian(points)
        return Batched(self.functions[name])(points)[0]

    def into(self, name: str, results: Array, points: Array) -> Array:
        """Write xi or the Jacobian at points (N, n) to `results`, which may be part of a larger array; return it."""
        if len(points) < (_FEW if self.as_matrices else MANY) or self._on_blocks is None:
            self._point_by_point[name].into(results, points)
        else:
            with one_blas_thread():
                fill(results, points, self._on_blocks[name])
        return results

    @cached_property
    def functions(self) -> dict[str, ca.Function]:
        """Functions of one joint position: xi (r, 1), jacobian (r, n), and second_derivative of q, v, w (r, 1)."""
        n, idle, active = self.space.n, list(self.idle), self.active
        q, v, w = (ca.MX.sym(name, n) for name in ("q", "v", "w"))
        unit = np.eye(n)
        xi, J, second = [], [], []
        if len(self.offset):
            parts, scale = point_functions(self.family, self.theta, len(active)), ca.DM(self.scale)
            xi.append((parts["xi"](q[active]) - ca.DM(self.offset)) * scale)
            J_active = parts["jacobian"](q[active]) * ca.repmat(scale, 1, len(active))
            J.append(J_active @ ca.DM(unit[active]) if idle else J_active)
            if "jacobian_rate" in parts:
                # The rate is a function of its own, so that C computes it once for several w. It has its own symbols,
                # because CasADi inlines a function that is called with the symbols that define it.
                at, along = (ca.MX.sym(name, n) for name in ("q", "v"))
                rate = parts["jacobian_rate"](at[active], along[active])
                second.append((ca.Function("dJ_xi", [at, along], [rate])(q, v) @ w[active]) * scale)
            else:
                second.append(parts["second_derivative"](q[active], v[active], w[active]) * scale)
        if idle:
            xi.append(q[idle] - ca.DM(self.space.centre[idle]))
            J.append(ca.MX(ca.DM(unit[idle])))
            second.append(ca.MX(len(idle), 1))
        return _functions(ca.vertcat(*xi), ca.vertcat(*J), ca.vertcat(*second), q, v, w)

    @cached_property
    def _point_by_point(self) -> BuiltOnUse[str, BlockedFunction]:
        """xi and jacobian for few joint positions: as scalar code, except for networks."""
        fast = (lambda graph: graph) if self.as_matrices else expand_scalars
        return BuiltOnUse(lambda name: BlockedFunction(fast(self.functions[name])))

    @cached_property
    def _on_blocks(self) -> BuiltOnUse[str, Maker] | None:
        """Makers of xi and jacobian on blocks of joint positions; None if the family has no matrix products."""
        if not self.as_matrices:
            if not len(self.offset) or not isinstance(family := self.family, SelfDerivativeFamily):
                return None
            return BuiltOnUse(lambda name: (_values if name == "xi" else _slopes)(self, family))
        # networks: graphs of xi and vec(J_xi^T) for joint positions as columns (n, COLUMNS)
        q, unit = ca.MX.sym("q", self.space.n, COLUMNS), np.eye(self.space.n)
        # the gradient of each fitted coordinate, (n, COLUMNS), spread from the active joints to all; then idle joints
        own = self.family.jacobian(q[self.active, :], ca.MX(ca.DM(self.theta)))
        spread = ca.DM(unit[:, self.active])
        gradients = [spread @ gradient * scale for gradient, scale in zip(own, self.scale, strict=True)]
        J_xi = ca.vertcat(*gradients, *(ca.MX(_columns(unit[k], COLUMNS)) for k in self.idle))
        graphs = {"xi": NumpyGraph("xi", [q], [self.expression(q)]), "jacobian": NumpyGraph("J_xi", [q], [J_xi])}
        return BuiltOnUse(lambda name: graphs[name].build_block_function)


def _columns(values: Sequence[float] | Array, columns: int) -> ca.DM:
    """Values as a column that is repeated `columns` times."""
    return ca.DM(np.repeat(np.asarray(values, dtype=float)[:, None], columns, axis=1))


def fill_coordinates(coordinates: CoordinateMap, name: str, results: Array, points: Array) -> None:
    """Write `xi` or `jacobian` (by `name`) at points (N, n) to `results`, which may be part of a larger array."""
    if isinstance(coordinates, Coordinates):
        coordinates.into(name, results, points)
    else:
        results[...] = getattr(coordinates, name)(points)
