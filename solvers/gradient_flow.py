"""Gradient flow theta' = -grad L, integrated by SUNDIALS CVODES until it hardly falls any more."""

from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np
from orthocas.solvers.array_node import ArrayNode

from orthocas.best_point import BestPoint
from orthocas.checks import Array, require_at_least, require_count
from orthocas.objective import UNWATCHED, LeastSquaresObjective, Objective, SolveResult, Status, Watch

_FIRST = 1e-3  # first stretch of time, in units of |theta0| / |grad L|


@dataclass(frozen=True)
class GradientFlow:
    """The path of steepest descent itself: slow, but it goes where gradient descent with tiny steps would go.

    Time is cut into stretches, each twice as long as the one before. The flow is stiff, so CVODES takes implicit BDF
    steps: with the Gauss-Newton matrix as Jacobian where the objective has one, with a Krylov method and finite
    differences of the gradient otherwise.

    Args:
        max_iterations: largest number of stretches.
        tolerance: stationary when the loss falls by less than this share in a stretch.
        accuracy: relative tolerance of the integration.
    """

    max_iterations: int = 60
    tolerance: float = 1e-4
    accuracy: float = 1e-3
    name: str = "gradient_flow"

    def __post_init__(self) -> None:
        require_count("max_iterations", self.max_iterations)
        require_at_least("tolerance", self.tolerance, 0)
        require_at_least("accuracy", self.accuracy, 1e-14)

    def coarser(self) -> "GradientFlow":
        """Stationary already at ten times the tolerance."""
        return replace(self, tolerance=10 * self.tolerance)

    def minimise(self, objective: Objective, theta0: Array, watch: Watch = UNWATCHED) -> SolveResult:
        """Flow from theta0."""
        run = _Run(self, objective, theta0, watch)
        try:
            status = run.iterate()
        except KeyboardInterrupt:
            if not run.best.found:
                raise
            status = Status.INTERRUPTED
        return run.best.result(status)


class _Run:
    """State of one flow."""

    def __init__(self, settings: GradientFlow, objective: Objective, theta0: Array, watch: Watch) -> None:
        self.settings, self.objective = settings, objective
        self.best = BestPoint(objective, theta0, watch)
        kept = self.best.restored or {}
        self.theta = np.array(kept.get("theta", theta0), dtype=float)
        self.stretch = float(kept.get("stretch", 0.0))
        self.node = self._flow_node()
        self.integrator = self._integrator()

    def iterate(self) -> Status:
        best = self.best
        value, gradient = best.value_and_gradient(self.theta)
        if not np.isfinite(value):
            return Status.FAILED
        if not np.any(gradient):
            return Status.CONVERGED
        if not self.stretch:
            self.stretch = _FIRST * max(float(np.linalg.norm(self.theta)), 1e-3) / float(np.linalg.norm(gradient))
        while best.iterations < self.settings.max_iterations:
            if not self._advance():
                return Status.STALLED
            before, value = value, self.objective.value(self.theta)
            best.evaluations += 1
            best.offer(self.theta, value)
            self.stretch *= 2
            best.next_iteration(self.settings.max_iterations, theta=self.theta, stretch=self.stretch)
            if before - value <= self.settings.tolerance * before and best.iterations > 5:
                return Status.CONVERGED
        return Status.ITERATION_LIMIT

    def _advance(self) -> bool:
        """Follow the flow for one stretch; whether the integrator got to its end."""
        try:
            end = self.integrator(x0=self.theta, p=self.stretch)["xf"]
        except RuntimeError:
            self.node.reraise()
            return False
        self.node.reraise()
        self.theta = np.asarray(end.nonzeros())
        return bool(np.isfinite(self.theta).all())

    def _flow_node(self) -> ArrayNode:
        """-grad L as a CasADi function, with a Jacobian."""
        size, objective = self.theta.size, self.objective
        if not isinstance(objective, LeastSquaresObjective):
            options = {"enable_fd": True, "fd_method": "forward"}
            return ArrayNode("flow", [size], [(size, 1)], lambda theta: [self._descent(theta)], options)
        jacobian = ArrayNode(
            "flow_jacobian", [size], [(size, size)], lambda theta: [-objective.normal_equations(theta)[2]]
        )
        return ArrayNode("flow", [size], [(size, 1)], lambda theta: [self._descent(theta)], None, jacobian)

    def _descent(self, theta: Array) -> Array:
        return -self.best.value_and_gradient(theta)[1]

    def _integrator(self) -> ca.Function:
        x, stretch = ca.MX.sym("x", self.theta.size), ca.MX.sym("stretch")
        system: dict[str, Any] = {"x": x, "p": stretch, "ode": stretch * self.node(x)}
        direct = isinstance(self.objective, LeastSquaresObjective)
        options: dict[str, Any] = {
            "reltol": self.settings.accuracy,
            "abstol": self.settings.accuracy * 1e-2 * float(np.abs(self.theta).max() or 1.0),
            "newton_scheme": "direct" if direct else "gmres",
            "max_num_steps": 5000,
        }
        if direct:
            options["linear_solver"] = "lapacklu"
        return ca.integrator("flow", "cvodes", system, 0.0, 1.0, options)
