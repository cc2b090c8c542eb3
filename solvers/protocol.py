"""The interface of solvers: objectives, results, and the best point so far, which Ctrl-C does not lose."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from enum import Enum
from typing import Protocol, runtime_checkable

import numpy as np

from orthocas.errors import SolveError
from orthocas.tools.checks import Array
from orthocas.tools.interrupts import check_remembered
from orthocas.tools.progress import UNWATCHED, Watch


@dataclass(frozen=True, slots=True)
class SolverRules:
    """Numbers of the solvers."""

    moment: float = 0.9  #: decay of Adam's mean gradient [KB2015]
    square: float = 0.999  #: decay of its mean square
    small: float = 1e-8  #: added to the root of it
    part: int = 2**14  #: parameters that Adam moves at a time, which stay in the cache
    most_rejections: int = 16  #: of a Gauss-Newton step: the damping may grow from its least to 400
    damping: float = 3e-3  #: of the matrix of QuasiNewton, relative to its diagonal
    exact_hessian: int = 1500  #: largest number of parameters for exact, dense Hessians in Ipopt
    barrier: float = 1e-4  #: of Ipopt: starts are good, a stronger one would push away from them into worse minima
    feasible: float = 1e-6  #: constraint violations up to this size count as zero
    difference: float = 1e-7  #: step of finite differences of the gradient flow, relative to theta
    first_interval: float = 1e-3  #: of the flow's time, in units of |theta0| / |grad L|
    moved: float = 0.03  #: relative change of theta after which a Jacobian of the flow is out of date
    most_uses: int = 10  #: of a Jacobian, so that Newton's method gets a new one where it does not converge


RULES = SolverRules()


class Objective(Protocol):
    """A smooth function of theta."""

    def value(self, theta: Array) -> float:
        """L(theta)."""
        ...

    def value_and_gradient(self, theta: Array) -> tuple[float, Array]:
        """L(theta) and dL/dtheta, (size,)."""
        ...


@runtime_checkable
class LeastSquaresObjective(Objective, Protocol):
    """A mean of squared residuals with a Gauss-Newton matrix."""

    def normal_equations(self, theta: Array) -> tuple[float, Array, Array]:
        """L(theta), its gradient (size,) and the Gauss-Newton matrix (size, size)."""
        ...


@runtime_checkable
class EstimatedObjective(Objective, Protocol):
    """A mean of squared residuals with a rough Gauss-Newton matrix, which costs less than the one of all samples."""

    def curvature_estimate(self, theta: Array) -> list[Array]:
        """An estimate of the Gauss-Newton matrix: its diagonal blocks, in the order of theta, or the whole as one."""
        ...


@runtime_checkable
class SmoothObjective(Objective, Protocol):
    """An objective with its exact Hessian."""

    def hessian(self, theta: Array) -> Array:
        """d^2L/dtheta^2, (size, size)."""
        ...


@runtime_checkable
class SampledObjective(Objective, Protocol):
    """A mean over samples that can draw fresh ones."""

    def batches(self, size: int, count: int, seed: tuple[int, ...]) -> Iterator[Objective]:
        """`count` objectives with the same mean over fresh samples, at most `size` each."""
        ...


@runtime_checkable
class ConstrainedObjective(Objective, Protocol):
    """An objective with constraints lower <= c(theta) <= upper."""

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds, (constraints,) each."""
        ...

    def constraints(self, theta: Array) -> tuple[Array, Array]:
        """c(theta), (constraints,), and its Jacobian, (constraints, size)."""
        ...

    def lagrangian_hessian(self, theta: Array, factor: float, multipliers: Array) -> Array:
        """Hessian of factor L + multipliers . c, (size, size)."""
        ...


class Status(Enum):
    """How a minimisation ended."""

    CONVERGED = "converged"
    ITERATION_LIMIT = "iteration limit"
    STALLED = "no further descent"
    INFEASIBLE = "constraints cannot be met"
    INTERRUPTED = "interrupted"
    FAILED = "failed"


@dataclass(frozen=True, eq=False)
class SolveResult:
    """Result of a minimisation. Whatever the status, theta is the best point found."""

    theta: Array = field(repr=False)
    value: float
    status: Status
    iterations: int
    evaluations: int
    seconds: float

    def require_finished(self) -> "SolveResult":
        """The result, for callers that cannot use an unfinished one: raises KeyboardInterrupt if Ctrl-C ended it.

        Raises:
            KeyboardInterrupt: after Ctrl-C.
            SolveError: if no usable point was found.
        """
        if self.status is Status.INTERRUPTED:
            raise KeyboardInterrupt
        return self.raise_if_failed()

    def raise_if_failed(self) -> "SolveResult":
        """Raise SolveError if no usable point was found. A point found at the limit or at Ctrl-C is usable."""
        if self.status in (Status.FAILED, Status.INFEASIBLE):
            raise SolveError(
                f"the minimiser ended after {self.iterations} iterations at loss {self.value:.6g}: {self.status.value}"
            )
        return self


@runtime_checkable
class Solver(Protocol):
    """A minimiser."""

    @property
    def name(self) -> str:
        """Short name, as used on the command line."""
        ...

    def coarser(self) -> "Solver":
        """The same solver with looser settings, for all stages of a continuation but the last."""
        ...

    def minimise(self, objective: Objective, theta0: Array, watch: Watch = UNWATCHED) -> SolveResult:
        """Minimise from theta0.

        After Ctrl-C it returns the best point so far, with status INTERRUPTED.
        """
        ...


class BestPoint:
    """Counts evaluations of an objective and remembers the best point, its value and the time spent.

    Args:
        objective: the function to minimise.
        theta0: start.
        watch: called with progress.
    """

    def __init__(self, objective: Objective, theta0: Array, watch: Watch) -> None:
        self.objective, self.watch = objective, watch
        self.theta = np.array(theta0, dtype=float)
        self.value = float("inf")
        self.iterations = self.evaluations = 0
        self._start = time.perf_counter()

    @property
    def found(self) -> bool:
        """Whether there is a point with a finite value."""
        return bool(np.isfinite(self.value))

    def offer(self, theta: Array, value: float) -> bool:
        """Take a point if it is better; returns whether it was."""
        better = value < self.value
        if better:
            self.theta, self.value = np.array(theta), float(value)
        return better

    def evaluate(self, theta: Array) -> float:
        """Evaluate the objective alone, and take the point if it is better; returns the value."""
        value = self.objective.value(theta)
        self.evaluations += 1
        self.offer(theta, value)
        return value

    def value_and_gradient(self, theta: Array) -> tuple[float, Array]:
        """Evaluate the objective, and take the point if it is better."""
        value, gradient = self.objective.value_and_gradient(theta)
        self.evaluations += 1
        self.offer(theta, value)
        return value, gradient

    def next_iteration(self, limit: int) -> None:
        """Count an iteration, of at most `limit`, and report it to the monitor."""
        check_remembered()
        self.iterations += 1
        self.watch.report(self.iterations / limit, self.value)

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
        seconds = time.perf_counter() - self._start
        return SolveResult(self.theta, self.value, status, self.iterations, self.evaluations, seconds)
