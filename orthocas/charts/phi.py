"""The map phi(q) = [h(q); xi(q)] as functions, its angles, and the scale of its errors."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar, overload

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthocas.charts.coordinates import CoordinateMap, Coordinates
from orthocas.errors import InvalidValueError
from orthocas.robots.robot import Robot
from orthocas.tasks.domains import Domain
from orthocas.tasks.problem import Problem
from orthocas.tasks.relative import Relative
from orthocas.tasks.task import Task
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array, as_point_set, require_shape
from orthocas.tools.expressions import wrap_shortest

ROUNDING = 1e-5  #: of phi: 1e-9 of it are 45 units in the last place
_SINGULAR = 1e-8  # ratio of singular values of J below which the inverse map fails


def leave_over(apart: float, tolerance: float, change: Array, turning: tuple[int, ...]) -> Array | None:
    """What a loop leaves over in the joints: their change (n,), less full turns of those that turn without end.

    None if phi at its ends differs by more than the tolerance, relative to the sizes of the components.
    """
    turns = np.zeros(len(change))
    turns[list(turning)] = 2 * np.pi
    return None if apart > tolerance else np.asarray(wrap_shortest(change, turns))


def counted_on(rows: Array, turns: Array) -> Array:
    """Rows (N, k) of values along a curve; periodic ones go on by the shorter way from row to row."""
    if not turns.any():
        return rows
    steps = wrap_shortest(np.diff(rows, axis=0), turns)
    return np.asarray(rows[0] + np.concatenate([np.zeros((1, rows.shape[1])), np.cumsum(steps, axis=0)]))


def require_no_turns(labels: tuple[str, ...], turns: Array, purpose: str) -> None:
    """Raise InvalidValueError if a component of phi is periodic, for what cannot deal with that yet."""
    circles = [label for label, turn in zip(labels, turns, strict=True) if turn > 0]
    if circles:
        raise InvalidValueError(
            "chart", f"one with circle-valued coordinates ({', '.join(circles)})", f"real-valued ones for {purpose}"
        )


@dataclass(frozen=True)
class Differences:
    """Differences of two phi: the shorter way around for periodic components and for orientations."""

    turns: Array  #: periods of the components, (n,); 0 for those that have none
    task: Relative | None = None  #: of the first components; None for plain differences

    def __call__(self, targets: Any, values: Any) -> Any:
        """Targets - values, as NumPy rows (..., n) or CasADi columns (n, 1)."""
        if self.task is None or not self.task.turned:
            return wrap_shortest(targets - values, self.turns)
        # orientations differ by a rotation, other components by numbers
        m, symbolic = self.task.task.m, isinstance(values, ca.SX | ca.MX)
        pair = (targets[:m], values[:m]) if symbolic else (targets[..., :m], values[..., :m])
        first = self.task.difference(*pair)
        if symbolic:
            return ca.vertcat(first, wrap_shortest(targets[m:] - values[m:], self.turns[m:]))
        rest = wrap_shortest(targets[..., m:] - values[..., m:], self.turns[m:])
        return np.concatenate([first, rest], axis=-1)


@dataclass(frozen=True)
class PhiMap:
    """phi at many points. Points are finite, values need not be."""

    phi: Callable[[Array], Array]  #: (N, n) -> (N, n)
    jacobian: Callable[[Array], Array]  #: (N, n) -> (N, n, n): how fast phi moves, d(difference) = -J dq where it is 0
    sizes: Array  #: sizes of the components, (n,)
    difference: Differences  #: of targets (..., n) and values (..., n)

    def scale(self, targets: Array) -> Array:
        """Scale of errors (N, n): the sizes of the components, and more where rounding of phi exceeds them."""
        scale: Array = self.sizes + ROUNDING * np.abs(targets)
        return scale

    def residual(self, targets: Array, q: Array) -> Array:
        """(phi - phi(q)) / scale, (N, n), by the shorter way around."""
        residual: Array = self.difference(targets, self.phi(q)) / self.scale(targets)
        return residual

    def is_singular(self, q: Array) -> NDArray[np.bool_]:
        """Whether J is singular or undefined at points (N, n), (N,)."""
        J = self.jacobian(q) / self.sizes[:, None]
        known = np.asarray(np.isfinite(J).all(axis=(1, 2)))
        J[~known] = 0.0
        values = np.linalg.svd(J, compute_uv=False)
        return np.asarray(~known | (values[:, -1] <= _SINGULAR * values[:, 0]))


def largest(residual: Array) -> Array:
    """The largest entries of residuals (N, n), (N,): infinite where phi is undefined."""
    error = np.abs(residual).max(axis=1)
    return np.where(np.isfinite(error), error, np.inf)


Symbolic = TypeVar("Symbolic", ca.SX, ca.MX)


class PhiFunctions:
    """The functions of a chart: numbers for joint positions, expressions for CasADi columns."""

    problem: Problem
    coordinates: CoordinateMap
    notes: Mapping[str, str | float]

    @property
    def robot(self) -> Robot:
        """The robot."""
        return self.problem.robot

    @property
    def task(self) -> Task:
        """The task h; `task(q)` and `x(q)` are its values."""
        return self.problem.task

    @property
    def domain(self) -> Domain:
        """Where the chart is meant to be used."""
        return self.problem.domain

    @property
    def n(self) -> int:
        """Number of joints."""
        return self.problem.n

    @property
    def m(self) -> int:
        """Number of task components."""
        return self.problem.m

    @property
    def r(self) -> int:
        """Number of extra coordinates."""
        return self.problem.r

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the components of phi: those of the task, then xi1, xi2, ..."""
        return (*self.problem.task.labels, *(f"xi{k + 1}" for k in range(self.r)))

    @overload
    def xi(self, q: Symbolic) -> Symbolic: ...
    @overload
    def xi(self, q: ArrayLike) -> Array: ...
    def xi(self, q: Any) -> Any:
        """Extra coordinates, (r,) or (N, r)."""
        if isinstance(q, ca.SX | ca.MX):
            return self._expression("xi", q)
        points, single = as_point_set("q", q, self.n)
        values = self.coordinates.xi(points)
        return values[0] if single else values

    @overload
    def x(self, q: Symbolic) -> Symbolic: ...
    @overload
    def x(self, q: ArrayLike) -> Array: ...
    def x(self, q: Any) -> Any:
        """Task values x = h(q), (m,) or (N, m)."""
        return self.task(q)

    @overload
    def phi(self, q: Symbolic) -> Symbolic: ...
    @overload
    def phi(self, q: ArrayLike) -> Array: ...
    def phi(self, q: Any) -> Any:
        """Task values and extra coordinates stacked, (n,) or (N, n)."""
        if isinstance(q, ca.SX | ca.MX):
            return self._expression("phi", q)
        points, single = as_point_set("q", q, self.n)
        phi = np.empty((len(points), self.n))
        self.problem.task.batched.into(phi[:, : self.m], points)
        fill_coordinates(self.coordinates, "xi", phi[:, self.m :], points)
        return phi[0] if single else phi

    @overload
    def jacobian(self, q: Symbolic) -> Symbolic: ...
    @overload
    def jacobian(self, q: ArrayLike) -> Array: ...
    def jacobian(self, q: Any) -> Any:
        """J = dphi/dq, (n, n) or (N, n, n); task rows first."""
        if isinstance(q, ca.SX | ca.MX):
            return self._expression("jacobian", q)
        points, single = as_point_set("q", q, self.n)
        J = np.empty((len(points), self.n, self.n))
        self.problem.task.evaluate_jacobian(points, J[:, : self.m])
        fill_coordinates(self.coordinates, "jacobian", J[:, self.m :], points)
        return J[0] if single else J

    def _graph(self, name: str) -> ca.Function:
        """The CasADi function of that name, but the inverse."""
        if name == "task":
            return self.problem.task.function
        return self.problem.task.jacobian_function if name == "task_jacobian" else self._functions[name]

    def _expression(self, name: str, q: Any) -> Any:
        """Evaluate a function at a CasADi column (n, 1)."""
        require_shape("q", q.shape, (self.n, 1))
        return self._graph(name)(q)

    @cached_property
    def _functions(self) -> dict[str, ca.Function]:
        q = ca.MX.sym("q", self.n)
        task, coordinates = self.problem.task, self.coordinates.functions
        # task first, then coordinates
        x, J_x = task.function(q), task.jacobian_function(q)
        xi, J_xi = coordinates["xi"](q), coordinates["jacobian"](q)
        outputs = {
            "xi": xi,
            "phi": ca.vertcat(x, xi),
            "jacobian": ca.vertcat(J_x, J_xi),
        }
        functions = {name: ca.Function(name, [q], [ca.densify(out)], ["q"], [name]) for name, out in outputs.items()}
        # d^2 phi [v, w] is linear in both, so that C calls it with any two directions
        v, w = ca.MX.sym("v", self.n), ca.MX.sym("w", self.n)
        second = ca.vertcat(task.second_derivative_function(q, v, w), coordinates["second_derivative"](q, v, w))
        functions["second_derivative"] = ca.Function(
            "second_derivative", [q, v, w], [ca.densify(second)], ["q", "v", "w"], ["second_derivative"]
        )
        return functions


def fill_coordinates(coordinates: CoordinateMap, name: str, results: Array, points: Array) -> None:
    """Write xi or its Jacobian, by name, at points (N, n) to part of an array."""
    if isinstance(coordinates, Coordinates):
        coordinates.into(name, results, points)
    else:
        results[...] = getattr(coordinates, name)(points)
