"""The best point of a minimisation, kept through interrupts and restarts. All solvers use it."""

import time
from collections.abc import Callable

import numpy as np

from orthocas.casadi_tools.interrupts import check_remembered
from orthocas.checks import Array
from orthocas.minimising.objective import Objective
from orthocas.minimising.solver import SolveResult, Status
from orthocas.minimising.watch import State, Watch


class BestPoint:
    """Counts evaluations of an objective and remembers the best point, its value and the time spent.

    Args:
        objective: the function to minimise.
        theta0: start of a new run.
        watch: monitor and keeper. If the keeper holds the state of an earlier run, the run resumes from it.
    """

    def __init__(self, objective: Objective, theta0: Array, watch: Watch) -> None:
        self.objective, self.watch = objective, watch
        self.restored = watch.keeper.restored()
        kept: State = self.restored or {}
        self.theta = np.array(kept.get("best_theta", theta0), dtype=float)
        self.value = float(kept.get("best_value", np.inf))
        self.iterations = int(kept.get("iterations", 0))
        self.evaluations = int(kept.get("evaluations", 0))
        self._start = time.perf_counter() - float(kept.get("seconds", 0.0))

    @property
    def seconds(self) -> float:
        """Time spent, including earlier runs."""
        return time.perf_counter() - self._start

    @property
    def found(self) -> bool:
        """Whether there is a point with a finite value."""
        return bool(np.isfinite(self.value))

    def offer(self, theta: Array, value: float) -> bool:
        """Take a point if it is better, and tell whether it was."""
        better = value < self.value
        if better:
            self.theta, self.value = np.array(theta), float(value)
        return better

    def value_and_gradient(self, theta: Array) -> tuple[float, Array]:
        """Evaluate the objective, and take the point if it is better."""
        value, gradient = self.objective.value_and_gradient(theta)
        self.evaluations += 1
        self.offer(theta, value)
        return value, gradient

    def next_iteration(self, limit: int, **state: Array | float) -> None:
        """Count an iteration, report it to the monitor, and offer the state to the keeper.

        The state holds everything that decides how the run goes on. The solver does not change its arrays in place
        later.
        """
        check_remembered()
        self.iterations += 1
        self.keep(**state)
        self.watch.report(self.iterations / limit, self.value)

    def keep(self, **state: Array | float) -> None:
        """Offer the state to the keeper: the best point, the counts, and the solver's own state."""
        self.watch.keeper.keep(lambda: self._state(**state))

    def run(self, iterate: Callable[[], Status]) -> SolveResult:
        """Iterate to the end. After Ctrl-C the result is the best point so far, if there is one."""
        try:
            status = iterate()
        except KeyboardInterrupt:
            if not self.found:
                raise
            status = Status.INTERRUPTED
        return self.result(status)

    def result(self, status: Status) -> SolveResult:
        """The result. Its status is FAILED if no point (that satisfies the constraints) has a finite value."""
        if not self.found and status is not Status.INFEASIBLE:
            status = Status.FAILED
        return SolveResult(self.theta, self.value, status, self.iterations, self.evaluations, self.seconds)

    def _state(self, **state: Array | float) -> dict[str, Array]:
        numbers: dict[str, Array | float] = {
            "best_theta": self.theta,
            "best_value": self.value,
            "iterations": self.iterations,
            "evaluations": self.evaluations,
            "seconds": self.seconds,
            **state,
        }
        return {name: np.asarray(value, dtype=float) for name, value in numbers.items()}
