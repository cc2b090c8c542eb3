"""Fitted coordinates xi(q): a family on the active joints, and the idle joints themselves."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import casadi as ca
import numpy as np

from orthocas.casadi_tools.batch import Batched, dense_function
from orthocas.casadi_tools.blas_graph import NumpyGraph
from orthocas.casadi_tools.blocks import MANY, BlockedFunction, fill
from orthocas.casadi_tools.cached import BuiltOnUse, cached_property
from orthocas.casadi_tools.columns import COLUMNS
from orthocas.casadi_tools.scalar_code import scalar_code
from orthocas.casadi_tools.threads import one_blas_thread
from orthocas.checks import Array, frozen_array, require_shape
from orthocas.coordinates.blocks import Maker, block_function
from orthocas.coordinates.point_functions import point_functions
from orthocas.parametrisations import Family, JointSpace, Parametrisation
from orthocas.parametrisations.circle import TURN, CircleFamily
from orthocas.parametrisations.family import Expression, GradedParametrisation, SelfDerivativeFamily

_FEW = 8  # joint positions below which networks are evaluated one by one


@dataclass(frozen=True, eq=False)
class Coordinates:
    """xi(q) = [scale (family(q_active) - offset); q_idle - centre_idle], (r, 1).

    Offset and scale are chosen so that xi(centre) = 0, and the mean gradient length of each coordinate over the domain
    is 1. They do not change any angles.
    """

    parametrisation: Parametrisation
    space: JointSpace = field(repr=False)  #: all joints of the robot
    idle: tuple[int, ...]  #: joints that are coordinates themselves; they come last
    theta: Array = field(repr=False)  #: parameters of the family, (size,)
    offset: Array = field(repr=False)  #: (r - idle,)
    scale: Array = field(repr=False)  #: (r - idle,)

    def __post_init__(self) -> None:
        fitted = len(self.offset)
        if isinstance(self.parametrisation, GradedParametrisation):  # before a basis is built that may be enormous
            terms = self.parametrisation.term_count(len(self.active)) if fitted else 0
            require_shape("theta", np.shape(self.theta), (fitted * terms,))
        size = self.family.size if fitted else 0
        object.__setattr__(self, "theta", frozen_array("theta", self.theta, (size,)))
        object.__setattr__(self, "offset", frozen_array("offset", self.offset, (fitted,)))
        object.__setattr__(self, "scale", frozen_array("scale", self.scale, (fitted,)))

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
        """Joints that the fitted family depends on."""
        return [i for i in range(self.space.n) if i not in self.idle]

    @property
    def turns(self) -> Array:
        """Periods of the coordinates, (r,): 2 pi scale for circle-valued ones, 0 for others."""
        fitted = len(self.offset)
        own = TURN * np.abs(self.scale) if fitted and isinstance(self.family, CircleFamily) else np.zeros(fitted)
        return np.concatenate([own, np.zeros(len(self.idle))])

    @property
    def as_matrices(self) -> bool:
        """Whether the graphs consist of dense matrix products, as for networks."""
        return bool(len(self.offset)) and self.family.as_matrices

    @cached_property
    def family(self) -> Family:
        """The fitted family on the active joints."""
        return self.parametrisation.family(self.space.restricted_to(self.active), len(self.offset))

    def expression(self, q: Expression) -> Expression:
        """xi(q), (r, N), for joint positions as columns (n, N)."""
        columns = q.shape[1]
        rows: list[Expression] = []
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
        """Values of `xi` or `jacobian`, without building what makes later calls fast."""
        if self.as_matrices:
            return self.xi(points) if name == "xi" else self.jacobian(points)
        return Batched(self.functions[name])(points)[0]

    def into(self, name: str, results: Array, points: Array) -> Array:
        """Write xi or the Jacobian at points (N, n) to `results`, which may be part of a larger array; return it."""
        if not self._has_blocks or len(points) < (_FEW if self.as_matrices else MANY):
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
            second.append(parts["second_derivative"](q[active], v[active], w[active]) * scale)
        if idle:
            xi.append(q[idle] - ca.DM(self.space.centre[idle]))
            J.append(ca.MX(ca.DM(unit[idle])))
            second.append(ca.MX(len(idle), 1))
        return {
            "xi": dense_function("xi", [q], [ca.vertcat(*xi)]),
            "jacobian": dense_function("J_xi", [q], [ca.vertcat(*J)]),
            "second_derivative": dense_function("d2xi", [q, v, w], [ca.vertcat(*second)], ["q", "v", "w"]),
        }

    @cached_property
    def _point_by_point(self) -> BuiltOnUse[BlockedFunction]:
        fast = (lambda graph: graph) if self.as_matrices else scalar_code
        return BuiltOnUse(lambda name: BlockedFunction(fast(self.functions[name])))

    @property
    def _has_blocks(self) -> bool:
        """Whether products of matrices make the family fast on blocks of joint positions."""
        return self.as_matrices or (len(self.offset) > 0 and isinstance(self.family, SelfDerivativeFamily))

    @cached_property
    def _on_blocks(self) -> BuiltOnUse[Maker]:
        """What makes functions of many joint positions side by side."""
        if self.as_matrices:
            return BuiltOnUse(lambda name: self._column_graphs[name].on_one_block)
        return BuiltOnUse(lambda name: block_function(self, name))

    @cached_property
    def _column_graphs(self) -> dict[str, NumpyGraph]:
        """Functions xi and vec(J_xi^T) of many joint positions side by side, where dense products are fast."""
        q = ca.MX.sym("q", self.space.n, COLUMNS)
        J_xi = ca.vertcat(*self._gradients(q))
        return {"xi": NumpyGraph("xi", [q], [self.expression(q)]), "jacobian": NumpyGraph("J_xi", [q], [J_xi])}

    def _gradients(self, q: ca.MX) -> list[ca.MX]:
        """Gradients of all coordinates, r matrices (n, N), for joint positions as columns (n, N)."""
        N = q.shape[1]
        unit = np.eye(self.space.n)
        gradients: list[ca.MX] = []
        if len(self.offset):
            own = self.family.jacobian(q[self.active, :], ca.MX(ca.DM(self.theta)))
            spread = ca.DM(unit[:, self.active])
            gradients += [spread @ gradient * scale for gradient, scale in zip(own, self.scale, strict=True)]
        return gradients + [ca.MX(_columns(unit[k], N)) for k in self.idle]


def _columns(values: Sequence[float] | Array, columns: int) -> ca.DM:
    return ca.DM(np.repeat(np.asarray(values, dtype=float)[:, None], columns, axis=1))
