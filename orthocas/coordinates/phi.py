"""phi(q) = [h(q); xi(q)]: values and derivatives of task and extra coordinates together."""

from typing import Any, TypeVar, overload

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from orthocas.casadi_tools.cached import cached_property
from orthocas.casadi_tools.scalar_code import fast_form
from orthocas.checks import Array, as_point_set, require_shape
from orthocas.coordinates.fitted import Coordinates
from orthocas.coordinates.map import CoordinateMap
from orthocas.problem import Problem, task_jacobians

Symbolic = TypeVar("Symbolic", ca.SX, ca.MX)


class PhiFunctions:
    """The functions of a chart: numbers for joint positions, expressions for CasADi columns."""

    problem: Problem
    coordinates: CoordinateMap

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

    def runnable(self, graph: ca.Function) -> ca.Function:
        """The fast form of a graph of this chart's functions: scalar code, or the graph itself for networks.

        It is also the graph itself for robots with more than 10 joints.
        """
        matrices = isinstance(self.coordinates, Coordinates) and self.coordinates.as_matrices
        return graph if matrices else fast_form(graph, self.n)

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
    def task(self, q: Symbolic) -> Symbolic: ...
    @overload
    def task(self, q: ArrayLike) -> Array: ...
    def task(self, q: Any) -> Any:
        """Task values x = h(q), (m,) or (N, m)."""
        if isinstance(q, ca.SX | ca.MX):
            return self._expression("task", q)
        points, single = as_point_set("q", q, self.n)
        values = self.problem.task.batched(points)[0]
        return values[0] if single else values

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
        self._coordinates_into("xi", phi[:, self.m :], points)
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
        task_jacobians(self.problem, points, J[:, : self.m])
        self._coordinates_into("jacobian", J[:, self.m :], points)
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

    def _coordinates_into(self, name: str, results: Array, points: Array) -> None:
        """Write xi or its Jacobian at points (N, n) to part of an array."""
        if isinstance(self.coordinates, Coordinates):
            self.coordinates.into(name, results, points)
        else:
            results[...] = getattr(self.coordinates, name)(points)

    @cached_property
    def _functions(self) -> dict[str, ca.Function]:
        q = ca.MX.sym("q", self.n)
        task, coordinates = self.problem.task, self.coordinates.functions
        x, J_x = task.function(q), task.jacobian_function(q)
        xi, J_xi = coordinates["xi"](q), coordinates["jacobian"](q)
        outputs = {
            "xi": xi,
            "phi": ca.vertcat(x, xi),
            "jacobian": ca.vertcat(J_x, J_xi),
        }
        functions = {name: ca.Function(name, [q], [ca.densify(out)], ["q"], [name]) for name, out in outputs.items()}
        v, w = ca.MX.sym("v", self.n), ca.MX.sym("w", self.n)
        second = ca.vertcat(task.second_derivative_function(q, v, w), coordinates["second_derivative"](q, v, w))
        functions["second_derivative"] = ca.Function(
            "second_derivative", [q, v, w], [ca.densify(second)], ["q", "v", "w"], ["second_derivative"]
        )
        return functions
