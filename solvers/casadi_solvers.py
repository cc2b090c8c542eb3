"""Solvers through CasADi: Ipopt, and the gradient flow by CVODES; and the nodes by which they call NumPy."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from orthocas.solvers.protocol import (
    RULES,
    BestPoint,
    ConstrainedObjective,
    LeastSquaresObjective,
    Objective,
    SmoothObjective,
    SolveResult,
    Status,
)
from orthocas.tools.blas_graph import DenseNode
from orthocas.tools.cached import building
from orthocas.tools.checks import Array, require_at_least, require_count, require_positive
from orthocas.tools.interrupts import check, deferred
from orthocas.tools.progress import UNWATCHED, Watch

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
        require_positive("tolerance", self.tolerance)

    def coarser(self) -> "Ipopt":
        """The same solver with a quarter of the iterations and a looser tolerance."""
        return replace(self, max_iterations=max(1, self.max_iterations // 4), tolerance=max(1e-3, self.tolerance))

    def minimise(self, objective: Objective, theta0: Array, watch: Watch = UNWATCHED) -> SolveResult:
        """Minimise from theta0, subject to the objective's constraints if it has any."""
        return _IpoptRun(self, objective, theta0, watch).result()


class _IpoptRun:
    """The state of one minimisation by Ipopt: the objective as CasADi nodes, cached values, and the best point."""

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
        # the least violation of the constraints so far, and its theta
        self._least = np.inf, self._current

    def result(self) -> SolveResult:
        """Run Ipopt. If no point meets the constraints, theta is the point with the smallest violation."""
        start = {"x0": ca.DM(self._current)}
        if self.constrained:
            start |= {name: ca.DM(bound) for name, bound in zip(("lbg", "ubg"), self.constrained.bounds, strict=True)}
        try:
            # Ctrl-C and exceptions of nodes are raised after the compiled code has returned
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
        # The best point that meets the constraints, or else the one with the smallest violation.
        status = _STATUS.get(solver.stats()["return_status"], Status.STALLED)
        if self.best.found or not np.isfinite(self._least[0]):
            return self.best.result(status)
        self.best.theta = self._least[1]
        return replace(self.best.result(Status.INFEASIBLE), status=status)

    def _solver(self) -> ca.Function:
        """Build Ipopt for the objective."""
        x, p = ca.MX.sym("x", self.size), ca.MX.sym("p", 0)
        # values and gradients come from NumPy, through nodes
        value = self._node("f", [self.size], [(1, 1)], lambda theta: [self._evaluate(theta)[0]])
        both = self._node("grad_f", [self.size], [(1, 1), (self.size, 1)], self._evaluate)
        problem: dict[str, Any] = {"x": x, "f": value(x)}
        options: dict[str, Any] = {"grad_f": ca.Function("nlp_grad_f", [x, p], list(both(x)))}
        # constraints, if there are any
        rows = len(self.constrained.bounds[0]) if self.constrained else 0
        if self.constrained:
            constraints = self._node("g", [self.size], [(rows, 1)], lambda theta: [self._constraints(theta)[0]])
            jacobian = self._node("jac_g", [self.size], [(rows, 1), (rows, self.size)], self._constraints)
            problem["g"] = constraints(x)
            options["jac_g"] = ca.Function("nlp_jac_g", [x, p], list(jacobian(x)))
        # the exact Hessian of the Lagrangian if it is known and not too large
        if (self.constrained or isinstance(self.objective, SmoothObjective)) and self.size <= RULES.exact_hessian:
            lam_f, lam_g = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", rows)
            node = self._node("hessian", [self.size, 1, rows], [(self.size, self.size)], self._hessian)
            upper = ca.triu(node(x, lam_f, lam_g))
            options["hess_lag"] = ca.Function("nlp_hess_l", [x, p, lam_f, lam_g], [upper])
        else:
            options |= {"ipopt.hessian_approximation": "limited-memory", "ipopt.limited_memory_max_history": 20}
        # Ipopt calls the watcher at the start and after every iteration. A result of 1 stops it.
        lengths = {"x": self.size, "f": 1, "g": rows, "lam_x": self.size, "lam_g": rows}
        names = [ca.nlpsol_out(i) for i in range(ca.nlpsol_n_out())]
        watcher = ArrayNode("watch", [lengths.get(name, 0) for name in names], [(1, 1)], self._iterated)
        self._nodes.append(watcher)
        options |= {
            "iteration_callback": watcher,
            "print_time": False,
            "error_on_fail": False,
            "show_eval_warnings": False,
            "no_nlp_grad": True,
        }
        settings = {
            "print_level": 0,
            "sb": "yes",
            "tol": self.settings.tolerance,
            "mu_init": RULES.barrier,
            "max_iter": self.settings.max_iterations,
        }
        options |= {f"ipopt.{name}": value for name, value in settings.items()}
        return ca.nlpsol("ipopt", "ipopt", problem, options)

    def _node(self, name: str, rows: list[int], shapes: list[tuple[int, int]], compute: Any) -> "ArrayNode":
        """Make an `ArrayNode` and keep it, so that its exceptions can be raised later."""
        node = ArrayNode(name, rows, shapes, compute)
        self._nodes.append(node)
        return node

    def _evaluate(self, theta: Array) -> tuple[float, Array]:
        """L(theta) and its gradient; cached, because Ipopt asks for them one after the other at the same point."""
        key = theta.tobytes()
        if self._at is None or self._at[0] != key:
            value, gradient = self.objective.value_and_gradient(theta)
            self.best.evaluations += 1
            self._at, self._current = (key, value, gradient), theta
            # largest violation of a constraint; 0 without constraints, infinite if L is not finite
            violation = 0.0 if np.isfinite(value) else np.inf
            if self.constrained and np.isfinite(value):
                (lower, upper), values = self.constrained.bounds, self._constraints(theta)[0]
                violation = float(np.maximum(np.maximum(lower - values, values - upper), 0).max())
            if violation < self._least[0]:
                self._least = violation, theta
            if violation <= RULES.feasible:
                self.best.offer(theta, value)
        return self._at[1], self._at[2]

    def _constraints(self, theta: Array) -> tuple[Array, Array]:
        """Constraints and their Jacobian; cached, because Ipopt asks for them several times at the same point."""
        assert self.constrained is not None
        key = theta.tobytes()
        if self._constraints_at is None or self._constraints_at[0] != key:
            self._constraints_at = key, *self.constrained.constraints(theta)
        return self._constraints_at[1], self._constraints_at[2]

    def _hessian(self, theta: Array, factor: Array, multipliers: Array) -> list[Array]:
        """Hessian of the Lagrangian, factor L + multipliers . c, (size, size)."""
        if self.constrained:
            return [self.constrained.lagrangian_hessian(theta, float(factor[0]), multipliers)]
        assert isinstance(self.objective, SmoothObjective)
        return [factor[0] * self.objective.hessian(theta)]

    def _iterated(self, *_: Array) -> list[float]:
        """Count an iteration, except at the start; 1 stops Ipopt, because a node has failed."""
        if self._count:
            self.best.next_iteration(self.settings.max_iterations)
        self._count += 1
        return [1.0 if any(node.error for node in self._nodes) else 0.0]


@dataclass(frozen=True)
class GradientFlow:
    """Integrates dtheta/dt = -grad L(theta): slow, but with the same limit as gradient descent with tiny steps.

    Time is divided into intervals, each twice as long as the previous one. The flow is stiff, so CVODES takes implicit
    BDF steps. Their Jacobian is the Hessian if the objective has one, or else the Gauss-Newton matrix. If it has
    neither, as for networks, a Krylov method uses finite differences of the gradient.

    A run ends as STALLED if an interval needs more than `max_steps` steps. For networks, this happens long before a
    minimum: where the loss has negative curvature, neighbouring solutions diverge, and steps must stay short.

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
        """The same solver with ten times the tolerance on the loss."""
        return replace(self, tolerance=10 * self.tolerance)

    def minimise(self, objective: Objective, theta0: Array, watch: Watch = UNWATCHED) -> SolveResult:
        """Follow the flow from theta0."""
        run = _Flow(self, objective, theta0, watch)
        return run.best.run(run.iterate)


class _Flow:
    """The state of one run of `GradientFlow`."""

    def __init__(self, settings: GradientFlow, objective: Objective, theta0: Array, watch: Watch) -> None:
        self.settings, self.objective = settings, objective
        self.best = BestPoint(objective, theta0, watch)
        self.theta = np.array(theta0, dtype=float)
        # L(theta), and the length of the next interval of time
        self.value, self.stretch = np.nan, 0.0
        # scale of the absolute tolerance: the largest entry of theta0
        self.scale = float(np.abs(self.theta).max() or 1.0)
        self.direct = isinstance(objective, SmoothObjective | LeastSquaresObjective)
        self._last = np.full_like(self.theta, np.nan), self.theta
        self._kept, self._uses = (self._last[0], np.empty((0, 0))), 0

    def iterate(self) -> Status:
        """Follow the flow interval by interval until the loss falls no more; return how it ended."""
        best, limit = self.best, self.settings.max_iterations
        # The first interval moves theta by a small part of its length. At a zero gradient the flow is at rest.
        self.value, gradient = best.value_and_gradient(self.theta)
        if not np.isfinite(self.value):
            return Status.FAILED
        if not np.any(gradient):
            return Status.CONVERGED
        length = max(float(np.linalg.norm(self.theta)), 1e-3)
        self.stretch = RULES.first_interval * length / float(np.linalg.norm(gradient))
        with deferred(), building:
            integrator, node = self._build_integrator()
        # intervals, each twice as long as the one before
        while best.iterations < limit:
            if not self._advance(integrator, node):
                return Status.STALLED
            before, self.value = self.value, best.evaluate(self.theta)
            if not np.isfinite(self.value):
                return Status.STALLED
            self.stretch *= 2
            converged = before - self.value <= self.settings.tolerance * before and best.iterations >= 5
            best.next_iteration(limit)
            if converged:
                return Status.CONVERGED
        return Status.ITERATION_LIMIT

    def _advance(self, integrator: ca.Function, node: "ArrayNode") -> bool:
        """Follow the flow for one interval; return whether the integrator reached the end with a finite theta."""
        self._uses = RULES.most_uses  # forces a new Jacobian
        try:
            # CasADi raises RuntimeError both for an exception in a node and if the integrator gives up.
            with deferred():
                end = integrator(x0=self.theta, p=self.stretch)["xf"]
        except RuntimeError:
            node.reraise()
            return False
        node.reraise()
        self.theta = np.asarray(end.nonzeros())
        return bool(np.isfinite(self.theta).all())

    def _build_integrator(self) -> tuple[ca.Function, "ArrayNode"]:
        """CVODES for dtheta/ds = -stretch grad L from s = 0 to 1, and the node of -grad L that it evaluates."""
        size, jacobian, along = self.theta.size, None, None
        # CVODES needs a Jacobian for Newton's method with a direct solver, or directional derivatives for GMRES.
        if self.direct:
            jacobian = ArrayNode("flow_jacobian", [size], [(size, size)], lambda theta: [-self._curvature(theta)])
        else:
            along = ArrayNode("flow_along", [size, size], [(size, 1)], lambda *at: [self._curvature_along(*at)])
        node = ArrayNode("flow", [size], [(size, 1)], self._descend, jacobian=jacobian, forward=along)
        # time is scaled by the length of the interval, so that each one ends at s = 1
        x, stretch = ca.MX.sym("x", size), ca.MX.sym("stretch")
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
        return ca.integrator("flow", "cvodes", system, 0.0, 1.0, options), node

    def _descend(self, theta: Array) -> list[Array]:
        """-grad L at theta, kept for finite differences."""
        self._last = theta, -self.best.value_and_gradient(theta)[1]
        return [self._last[1]]

    def _curvature(self, theta: Array) -> Array:
        """The Hessian or the Gauss-Newton matrix at theta, or at a point near it."""
        # The last matrix is used a few times near its theta, also because CVODES asks for it twice in a row.
        at, kept = self._kept
        self._uses += 1
        if self._uses <= RULES.most_uses and np.linalg.norm(theta - at) <= RULES.moved * np.linalg.norm(theta):
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
        """Directional derivative of -grad L at theta along a direction, by one finite difference."""
        length = float(np.linalg.norm(direction))
        if length == 0:
            return np.zeros_like(direction)
        # the step is short relative to theta
        step = RULES.difference * max(float(np.linalg.norm(theta)), 1.0) / length
        at, here = self._last
        if not np.array_equal(at, theta):
            here = -self.best.value_and_gradient(theta)[1]
        change: Array = (-self.best.value_and_gradient(theta + step * direction)[1] - here) / step
        return change


class ArrayNode(DenseNode):
    """A CasADi function of columns whose outputs are computed in NumPy.

    Exceptions, including Ctrl-C, cannot pass through the compiled solver. So the node stores an exception in `error`,
    and fails this evaluation and all later ones, which makes the solver give up soon.

    Args:
        name: name of the function.
        rows: length of each input column.
        shapes: shape of each output.
        compute: maps arrays (rows,) to one array per output.
        jacobian: derivative of the single output with respect to the single input, for solvers that need it.
        forward: directional derivative, as a function of input and direction; avoids a dense Jacobian.
    """

    def __init__(
        self,
        name: str,
        rows: Sequence[int],
        shapes: Sequence[tuple[int, int]],
        compute: Callable[..., Sequence[Any]],
        jacobian: "ArrayNode | None" = None,
        forward: "ArrayNode | None" = None,
    ) -> None:
        self._rows, self._compute, self._jacobian, self._forward = tuple(rows), compute, jacobian, forward
        self.error: BaseException | None = None
        DenseNode.__init__(self, name, [(count, 1) for count in rows], shapes)

    def eval_buffer(self, arg: Sequence[Any], res: Sequence[Any]) -> int:
        """Evaluate the outputs into `res`. Returns 1, which means failure in CasADi, after an exception; else 0."""
        if self.error is not None:
            return 1
        try:
            check()
            # CasADi passes None for an input of zeros
            results = self._compute(
                *(
                    np.zeros(count) if memory is None else np.frombuffer(memory).copy()
                    for count, memory in zip(self._rows, arg, strict=True)
                )
            )
            for memory, result in zip(res, results, strict=True):
                if memory is not None:
                    np.frombuffer(memory)[:] = np.asarray(result, dtype=float).ravel(order="F")
        except BaseException as error:
            self.error = error
            return 1
        return 0

    def has_jacobian(self) -> bool:
        """Whether the node has a Jacobian."""
        return self._jacobian is not None

    def get_jacobian(
        self, name: str, inames: Sequence[str], onames: Sequence[str], opts: Mapping[str, Any]
    ) -> ca.Function:
        """The Jacobian in the form that CasADi requires: a function of the inputs and an unused output."""
        if self._jacobian is None:
            raise NotImplementedError(name)
        inputs = [ca.MX.sym("x", rows) for rows in self._rows]
        unused = ca.MX.sym("y", *self._outputs[0])
        return ca.Function(name, [*inputs, unused], [self._jacobian(*inputs)], list(inames), list(onames), dict(opts))

    def has_forward(self, nfwd: int) -> bool:
        """Whether the node has a directional derivative."""
        return self._forward is not None and nfwd == 1

    def get_forward(
        self, nfwd: int, name: str, inames: Sequence[str], onames: Sequence[str], opts: Mapping[str, Any]
    ) -> ca.Function:
        """The directional derivative in CasADi's form: a function of the input, an unused output, and the direction."""
        if self._forward is None:
            raise NotImplementedError(name)
        x, unused, direction = (ca.MX.sym(letter, self._rows[0]) for letter in "xyd")
        outputs = [self._forward(x, direction)]
        return ca.Function(name, [x, unused, direction], outputs, list(inames), list(onames), dict(opts))

    def has_jac_sparsity(self, oind: int, iind: int) -> bool:
        """Whether `get_jac_sparsity` gives the sparsity of the Jacobian: with a directional derivative."""
        return self._forward is not None

    def get_jac_sparsity(self, oind: int, iind: int, symmetric: bool) -> ca.Sparsity:
        """An empty sparsity pattern, because a Krylov method uses only products with the Jacobian."""
        return ca.Sparsity(self._outputs[oind][0], self._rows[iind])

    def reraise(self) -> None:
        """Raise the exception that stopped an evaluation, if any."""
        if self.error is not None:
            raise self.error
