"""Gradient flow theta' = -grad L, integrated by SUNDIALS CVODES until the loss hardly falls any more."""

from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from orthocas.solvers.array_node import ArrayNode
from orthocas.solvers.protocol import BestPoint, LeastSquaresObjective, Objective, SmoothObjective, SolveResult, Status
from orthocas.tools.cached import building
from orthocas.tools.checks import Array, require_at_least, require_count
from orthocas.tools.interrupts import deferred
from orthocas.tools.progress import UNWATCHED, Watch

_DIFFERENCE = 1e-7  # step of finite differences, relative to theta
_FIRST = 1e-3  # first time interval, in units of |theta0| / |grad L|
_MOVED = 0.03  # relative change of theta after which a Jacobian is out of date
_MAX_USES = 10  # of a Jacobian, so that Newton's method gets a new one where it does not converge


@dataclass(frozen=True)
class GradientFlow:
    """Follows the path of steepest descent: slow, but with the same limit as gradient descent with tiny steps.

    Time is divided into intervals, each twice as long as the previous one. The flow is stiff, so CVODES takes implicit
    BDF steps. Their Jacobian is the Hessian if the objective has one, or else the Gauss-Newton matrix. If it has
    neither, as for networks, a Krylov method uses finite differences of the gradient.

    A run ends as STALLED where an interval needs more than `max_steps` steps. In networks that happens long before a
    minimum: where the loss curves downwards, no step can be longer than the time in which neighbours move apart.

    Args:
        max_iterations: largest number of intervals.
        tolerance: stop when the loss falls by less than this fraction in an interval.
        accuracy: relative tolerance of the integration.
        max_steps: largest number of steps in an interval. Default: 500 with a matrix; 50 without, where a step takes
            tens of gradients.
    """

    max_iterations: int = 60
    tolerance: float = 1e-3
    accuracy: float = 1e-3
    max_steps: int | None = None
    name: str = "gradient_flow"

    def __post_init__(self) -> None:
        require_count("max_iterations", self.max_iterations)
        require_at_least("tolerance", self.tolerance, 0)
        require_at_least("accuracy", self.accuracy, 1e-14)
        if self.max_steps is not None:
            require_count("max_steps", self.max_steps)

    def coarser(self) -> "GradientFlow":
        """The same solver with ten times the tolerance."""
        return replace(self, tolerance=10 * self.tolerance)

    def minimise(self, objective: Objective, theta0: Array, watch: Watch = UNWATCHED) -> SolveResult:
        """Follow the flow from theta0."""
        run = _Run(self, objective, theta0, watch)
        return run.best.run(run.iterate)


class _Run:
    """State of one flow."""

    def __init__(self, settings: GradientFlow, objective: Objective, theta0: Array, watch: Watch) -> None:
        self.settings, self.objective = settings, objective
        self.best = BestPoint(objective, theta0, watch)
        self.theta = np.array(theta0, dtype=float)
        self.value, self.stretch = np.nan, 0.0
        self.scale = float(np.abs(self.theta).max() or 1.0)  # of the theta that the flow starts from
        self.direct = isinstance(objective, SmoothObjective | LeastSquaresObjective)
        self._last = np.full_like(self.theta, np.nan), self.theta
        self._kept, self._uses = (self._last[0], np.empty((0, 0))), 0

    def iterate(self) -> Status:
        best, limit = self.best, self.settings.max_iterations
        status = self._start()
        if status is not None:
            return status
        with deferred(), building:
            node = self._flow_node()
            integrator = self._integrator(node)
        while best.iterations < limit:
            if not self._advance(integrator, node):
                return Status.STALLED
            before, self.value = self.value, self.objective.value(self.theta)
            best.evaluations += 1
            if not np.isfinite(self.value):
                return Status.STALLED
            best.offer(self.theta, self.value)
            self.stretch *= 2
            converged = before - self.value <= self.settings.tolerance * before and best.iterations >= 5
            best.next_iteration(limit)
            if converged:
                return Status.CONVERGED
        return Status.ITERATION_LIMIT

    def _start(self) -> Status | None:
        """Choose the first stretch; a status if there is nowhere to flow."""
        self.value, gradient = self.best.value_and_gradient(self.theta)
        if not np.isfinite(self.value):
            return Status.FAILED
        if not np.any(gradient):
            return Status.CONVERGED
        self.stretch = _FIRST * max(float(np.linalg.norm(self.theta)), 1e-3) / float(np.linalg.norm(gradient))
        return None

    def _advance(self, integrator: ca.Function, node: ArrayNode) -> bool:
        """Follow the flow for one interval, and return whether the integrator reached the end."""
        self._uses = _MAX_USES  # a new Jacobian
        try:
            with deferred():
                end = integrator(x0=self.theta, p=self.stretch)["xf"]
        except RuntimeError:
            node.reraise()
            return False
        node.reraise()
        self.theta = np.asarray(end.nonzeros())
        return bool(np.isfinite(self.theta).all())

    def _flow_node(self) -> ArrayNode:
        """-grad L as a CasADi function, with a Jacobian."""
        size = self.theta.size
        if not self.direct:
            along = ArrayNode("flow_along", [size, size], [(size, 1)], lambda *at: [self._curvature_along(*at)])
            return ArrayNode("flow", [size], [(size, 1)], lambda theta: [self._descent(theta)], forward=along)
        jacobian = ArrayNode("flow_jacobian", [size], [(size, size)], lambda theta: [-self._curvature(theta)])
        return ArrayNode("flow", [size], [(size, 1)], lambda theta: [self._descent(theta)], jacobian=jacobian)

    def _descent(self, theta: Array) -> Array:
        self._last = theta, -self.best.value_and_gradient(theta)[1]
        return self._last[1]

    def _curvature(self, theta: Array) -> Array:
        """The Hessian or the Gauss-Newton matrix at theta, or near it. CVODES asks for it twice in a row."""
        at, kept = self._kept
        self._uses += 1
        if self._uses <= _MAX_USES and np.linalg.norm(theta - at) <= _MOVED * np.linalg.norm(theta):
            return kept
        objective = self.objective
        if isinstance(objective, SmoothObjective):
            matrix = objective.hessian(theta)
        else:
            assert isinstance(objective, LeastSquaresObjective)
            matrix = objective.normal_equations(theta)[2]
        self._kept, self._uses = (theta, matrix), 0
        return matrix

    def _curvature_along(self, theta: Array, direction: Array) -> Array:
        """Change of the descent along a direction, by one finite difference."""
        length = float(np.linalg.norm(direction))
        if length == 0:
            return np.zeros_like(direction)
        step = _DIFFERENCE * max(float(np.linalg.norm(theta)), 1.0) / length
        at, here = self._last
        if not np.array_equal(at, theta):
            here = -self.best.value_and_gradient(theta)[1]
        change: Array = (-self.best.value_and_gradient(theta + step * direction)[1] - here) / step
        return change

    def _integrator(self, node: ArrayNode) -> ca.Function:
        x, stretch = ca.MX.sym("x", self.theta.size), ca.MX.sym("stretch")
        system: dict[str, Any] = {"x": x, "p": stretch, "ode": stretch * node(x)}
        options: dict[str, Any] = {
            "reltol": self.settings.accuracy,
            "abstol": self.settings.accuracy * 1e-2 * self.scale,
            "newton_scheme": "direct" if self.direct else "gmres",
            "max_num_steps": self.settings.max_steps or (500 if self.direct else 50),
            "disable_internal_warnings": True,
        }
        if self.direct:
            options["linear_solver"] = "lapacklu"
        return ca.integrator("flow", "cvodes", system, 0.0, 1.0, options)
