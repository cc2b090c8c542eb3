"""Limited-memory BFGS (SciPy), for any parametrisation."""

from dataclasses import dataclass, replace

import scipy.optimize

from orthocas.checks import Array, require_at_least, require_count
from orthocas.minimising.best_point import BestPoint
from orthocas.minimising.objective import Objective
from orthocas.minimising.solver import SolveResult, Status
from orthocas.minimising.watch import UNWATCHED, Watch


@dataclass(frozen=True)
class LBFGS:
    """SciPy's L-BFGS-B without bounds. A restored run starts with an empty memory.

    Args:
        max_iterations: largest number of iterations.
        tolerance: stop when an iteration reduces the loss by less than this fraction.
        memory: number of stored correction pairs.
    """

    max_iterations: int = 500
    tolerance: float = 1e-6
    memory: int = 20
    name: str = "lbfgs"

    def __post_init__(self) -> None:
        require_count("max_iterations", self.max_iterations)
        require_count("memory", self.memory)
        require_at_least("tolerance", self.tolerance, 0)

    def coarser(self) -> "LBFGS":
        """The same solver with a quarter of the iterations."""
        return replace(self, max_iterations=max(1, self.max_iterations // 4))

    def minimise(self, objective: Objective, theta0: Array, watch: Watch = UNWATCHED) -> SolveResult:
        """Minimise from theta0."""
        best = BestPoint(objective, theta0, watch)
        left = self.max_iterations - best.iterations
        if left <= 0:
            return best.result(Status.ITERATION_LIMIT)

        def count(intermediate_result: scipy.optimize.OptimizeResult) -> None:
            best.next_iteration(self.max_iterations)

        options = {"maxiter": left, "maxfun": 2 * left, "ftol": self.tolerance, "maxcor": self.memory, "gtol": 0.0}

        def iterate() -> Status:
            outcome = scipy.optimize.minimize(
                best.value_and_gradient, best.theta, jac=True, method="L-BFGS-B", callback=count, options=options
            )
            return {0: Status.CONVERGED, 1: Status.ITERATION_LIMIT}.get(outcome.status, Status.STALLED)

        return best.run(iterate)
