"""Ipopt through CasADi's nlpsol: an interior-point method with constraints, and exact Hessians where available."""

from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from orthocas.solvers.array_node import ArrayNode
from orthocas.solvers.protocol import BestPoint, ConstrainedObjective, Objective, SmoothObjective, SolveResult, Status
from orthocas.tools.cached import building
from orthocas.tools.checks import Array, require_at_least, require_count
from orthocas.tools.interrupts import deferred
from orthocas.tools.progress import UNWATCHED, Watch

_EXACT = 1500  # largest number of parameters for exact, dense Hessians
_BARRIER = 1e-4  # starts are good; a stronger barrier would push away from them into worse minima
_FEASIBLE = 1e-6  # constraint violations up to this size count as zero
_STATUS = {
    "Solve_Succeeded": Status.CONVERGED,
    "Solved_To_Acceptable_Level": Status.CONVERGED,
    "Search_Direction_Becomes_Too_Small": Status.STALLED,
    "Restoration_Failed": Status.STALLED,
    "Maximum_Iterations_Exceeded": Status.ITERATION_LIMIT,
    "Infeasible_Problem_Detected": Status.INFEASIBLE,
}


@dataclass(frozen=True)
class Ipopt:
    """Primal-dual interior-point method [WB2006]: Newton steps on the Lagrangian with a filter line search.

    The Hessian is exact if the objective provides one and has up to 1,500 parameters; otherwise it is a limited-memory
    approximation.

    Args:
        max_iterations: largest number of iterations.
        tolerance: tolerance on the scaled optimality conditions.
    """

    max_iterations: int = 300
    tolerance: float = 1e-6
    name: str = "ipopt"

    def __post_init__(self) -> None:
        require_count("max_iterations", self.max_iterations)
        require_at_least("tolerance", self.tolerance, 1e-300)

    def coarser(self) -> "Ipopt":
        """The same solver with a quarter of the iterations and a looser tolerance."""
        return replace(self, max_iterations=max(1, self.max_iterations // 4), tolerance=max(1e-3, self.tolerance))

    def minimise(self, objective: Objective, theta0: Array, watch: Watch = UNWATCHED) -> SolveResult:
        """Minimise from theta0, subject to the objective's constraints if it has any."""
        return _Run(self, objective, theta0, watch).result()


class _Run:
    """One minimisation: CasADi functions around the objective, and their results."""

    def __init__(self, settings: Ipopt, objective: Objective, theta0: Array, watch: Watch) -> None:
        self.settings, self.objective = settings, objective
        self.constrained = objective if isinstance(objective, ConstrainedObjective) else None
        self.best = BestPoint(objective, theta0, watch)
        self.size = theta0.size
        self._nodes: list[ArrayNode] = []
        self._at: tuple[bytes, float, Array] | None = None
        self._constraints_at: tuple[bytes, Array, Array] | None = None
        self._count = 0
        self._current = self.best.theta
        self._least = np.inf, self._current  # violation of the constraints

    def result(self) -> SolveResult:
        """Minimise. If no point meets the constraints, theta is the point with the smallest violation."""
        start = {"x0": ca.DM(self._current)}
        if self.constrained:
            start |= {name: ca.DM(bound) for name, bound in zip(("lbg", "ubg"), self.constrained.bounds, strict=True)}
        try:
            with deferred():
                with building:
                    solver = self._solver()
                solver(**start)
            for node in self._nodes:
                node.reraise()
        except KeyboardInterrupt:
            if not self.best.found:
                raise
            return self.best.result(Status.INTERRUPTED)
        return self._outcome(_STATUS.get(solver.stats()["return_status"], Status.STALLED))

    def _outcome(self, status: Status) -> SolveResult:
        if self.best.found or not np.isfinite(self._least[0]):
            return self.best.result(status)
        self.best.theta = self._least[1]
        return replace(self.best.result(Status.INFEASIBLE), status=status)

    def _solver(self) -> ca.Function:
        x, p = ca.MX.sym("x", self.size), ca.MX.sym("p", 0)
        value = self._node("f", [self.size], [(1, 1)], lambda theta: [self._evaluate(theta)[0]])
        both = self._node("grad_f", [self.size], [(1, 1), (self.size, 1)], self._evaluate)
        problem: dict[str, Any] = {"x": x, "f": value(x)}
        options: dict[str, Any] = {"grad_f": ca.Function("nlp_grad_f", [x, p], list(both(x)))}
        if self.constrained:
            rows = len(self.constrained.bounds[0])
            constraints, jacobian = (
                self._node("g", [self.size], [(rows, 1)], lambda theta: [self._constraints(theta)[0]]),
                self._node("jac_g", [self.size], [(rows, 1), (rows, self.size)], self._constraints),
            )
            problem["g"] = constraints(x)
            options["jac_g"] = ca.Function("nlp_jac_g", [x, p], list(jacobian(x)))
        options |= self._hessian_options(x, p)
        options |= {
            "iteration_callback": self._watcher(),
            "print_time": False,
            "error_on_fail": False,
            "show_eval_warnings": False,
            "no_nlp_grad": True,
        }
        settings = {
            "print_level": 0,
            "sb": "yes",
            "tol": self.settings.tolerance,
            "mu_init": _BARRIER,
            "max_iter": self.settings.max_iterations,
        }
        options |= {f"ipopt.{name}": value for name, value in settings.items()}
        return ca.nlpsol("ipopt", "ipopt", problem, options)

    def _hessian_options(self, x: ca.MX, p: ca.MX) -> dict[str, Any]:
        """An exact Hessian of the Lagrangian, or the limited-memory approximation."""
        known = self.constrained or isinstance(self.objective, SmoothObjective)
        if not known or self.size > _EXACT:
            return {"ipopt.hessian_approximation": "limited-memory", "ipopt.limited_memory_max_history": 20}
        rows = len(self.constrained.bounds[0]) if self.constrained else 0
        lam_f, lam_g = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", rows)
        node = self._node("hessian", [self.size, 1, rows], [(self.size, self.size)], self._hessian)
        upper = ca.triu(node(x, lam_f, lam_g))
        return {"hess_lag": ca.Function("nlp_hess_l", [x, p, lam_f, lam_g], [upper])}

    def _node(self, name: str, rows: list[int], shapes: list[tuple[int, int]], compute: Any) -> ArrayNode:
        node = ArrayNode(name, rows, shapes, compute)
        self._nodes.append(node)
        return node

    def _evaluate(self, theta: Array) -> tuple[float, Array]:
        """Value and gradient; cached, because Ipopt asks for them one after the other at the same point."""
        key = theta.tobytes()
        if self._at is None or self._at[0] != key:
            value, gradient = self.objective.value_and_gradient(theta)
            self.best.evaluations += 1
            self._at, self._current = (key, value, gradient), theta
            violation = self._violation(theta) if np.isfinite(value) else np.inf
            if violation < self._least[0]:
                self._least = violation, theta
            if violation <= _FEASIBLE:
                self.best.offer(theta, value)
        return self._at[1], self._at[2]

    def _constraints(self, theta: Array) -> tuple[Array, Array]:
        """Values and Jacobian; cached, because Ipopt asks for them several times at the same point."""
        assert self.constrained is not None
        key = theta.tobytes()
        if self._constraints_at is None or self._constraints_at[0] != key:
            self._constraints_at = key, *self.constrained.constraints(theta)
        return self._constraints_at[1], self._constraints_at[2]

    def _violation(self, theta: Array) -> float:
        """Largest constraint violation; 0 without constraints."""
        if self.constrained is None:
            return 0.0
        lower, upper = self.constrained.bounds
        values = self._constraints(theta)[0]
        return float(np.maximum(np.maximum(lower - values, values - upper), 0).max())

    def _hessian(self, theta: Array, factor: Array, multipliers: Array) -> list[Array]:
        if self.constrained:
            return [self.constrained.lagrangian_hessian(theta, float(factor[0]), multipliers)]
        assert isinstance(self.objective, SmoothObjective)
        return [factor[0] * self.objective.hessian(theta)]

    def _watcher(self) -> ca.Callback:
        """A callback that Ipopt calls at the start and after every iteration; an error stops Ipopt."""
        rows = [ca.nlpsol_out(i) for i in range(ca.nlpsol_n_out())]
        lengths = {"x": self.size, "f": 1, "g": self._rows(), "lam_x": self.size, "lam_g": self._rows()}
        node = ArrayNode("watch", [lengths.get(name, 0) for name in rows], [(1, 1)], self._iterated)
        self._nodes.append(node)
        return node

    def _rows(self) -> int:
        return len(self.constrained.bounds[0]) if self.constrained else 0

    def _iterated(self, *_: Array) -> list[float]:
        if self._count:
            self.best.next_iteration(self.settings.max_iterations)
        self._count += 1
        return [1.0 if any(node.error for node in self._nodes) else 0.0]
