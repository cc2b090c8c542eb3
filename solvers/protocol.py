"""The interface of solvers: objectives, results, and the best point so far, which is kept after Ctrl-C."""

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

    moment: float = 0.9  #: Adam: decay of the mean gradient [KB2015]
    square: float = 0.999  #: Adam: decay of the mean squared gradient
    small: float = 1e-8  #: Adam: added to the root of the mean square
    part: int = 2**14  #: Adam: number of parameters updated at a time, so that they stay in the cache
    most_rejections: int = 16  #: GaussNewton: largest number of rejected steps; damping grows from 1e-7 up to 400
    damping: float = 3e-3  #: QuasiNewton: damping of the matrix, relative to its diagonal
    exact_hessian: int = 1500  #: Ipopt: largest number of parameters for exact, dense Hessians
    barrier: float = 1e-4  #: Ipopt: first barrier parameter; a larger one would push good starts away to worse minima
    feasible: float = 1e-6  #: Ipopt: constraint violations up to this size count as zero
    difference: float = 1e-7  #: GradientFlow: step of finite differences, relative to theta
    first_interval: float = 1e-3  #: GradientFlow: length of the first interval, in units of |theta0| / |grad L|
    moved: float = 0.03  #: GradientFlow: relative change of theta after which a Jacobian is out of date
    most_uses: int = 10  #: GradientFlow: largest number of uses of a Jacobian; a new one may restore convergence


RULES = SolverRules()


class Objective(Protocol):
    """A smooth function L(theta) to minimise, theta (size,)."""

    def value(self, theta: Array) -> float:
        """L(theta)."""
        ...

    def value_and_gradient(self, theta: Array) -> tuple[float, Array]:
        """L(theta) and dL/dtheta, (size,)."""
        ...


@runtime_checkable
class LeastSquaresObjective(Objective, Protocol):
    """A mean of squared residuals that provides its Gauss-Newton matrix."""

    def normal_equations(self, theta: Array) -> tuple[float, Array, Array]:
        """L(theta), its gradient (size,) and the Gauss-Newton matrix (size, size)."""
        ...


@runtime_checkable
class EstimatedObjective(Objective, Protocol):
    """A mean of squared residuals that provides an estimate of its Gauss-Newton matrix, from a part of the samples."""

    def curvature_estimate(self, theta: Array) -> list[Array]:
        """Estimate of the Gauss-Newton matrix as a list of its diagonal blocks in the order of theta.

        If the list has one block, it is the whole matrix (size, size).
        """
        ...


@runtime_checkable
class SmoothObjective(Objective, Protocol):
    """An objective that provides its exact Hessian."""

    def hessian(self, theta: Array) -> Array:
        """d^2L/dtheta^2, (size, size)."""
        ...


@runtime_checkable
class SampledObjective(Objective, Protocol):
    """A mean over samples that can draw fresh samples."""

    def batches(self, size: int, count: int, seed: tuple[int, ...]) -> Iterator[Objective]:
        """Yield `count` objectives, each the mean over at most `size` fresh samples."""
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
        """Return the result, for callers that cannot use an interrupted one.

        Raises:
            KeyboardInterrupt: if Ctrl-C ended the minimisation.
            SolveError: if no usable point was found.
        """
        if self.status is Status.INTERRUPTED:
            raise KeyboardInterrupt
        return self.raise_if_failed()

    def raise_if_failed(self) -> "SolveResult":
        """Return the result, or raise SolveError if no usable point was found.

        The best point at the iteration limit or at Ctrl-C is usable.
        """
        if self.status in (Status.FAILED, Status.INFEASIBLE):
            raise SolveError(
                f"the minimiser ended after {self.iterations} iterations at loss {self.value:.6g}: {self.status.value}"
            )
        return self


@runtime_checkable
class Solver(Protocol):
    """A minimiser with its settings."""

    @property
    def name(self) -> str:
        """Short name, as used on the command line."""
        ...

    def coarser(self) -> "Solver":
        """The same solver with looser settings, for the stages of a continuation before the last one."""
        ...

    def minimise(self, objective: Objective, theta0: Array, watch: Watch = UNWATCHED) -> SolveResult:
        """Minimise from theta0; after Ctrl-C, return the best point so far with the status INTERRUPTED."""
        ...


class BestPoint:
    """Counts evaluations of an objective and remembers the best point, its value and the time spent.

    Args:
        objective: the function to minimise.
        theta0: start.
        watch: receives the progress after each iteration.
    """

    def __init__(self, objective: Objective, theta0: Array, watch: Watch) -> None:
        self.objective, self.watch = objective, watch
        self.theta = np.array(theta0, dtype=float)
        self.value = float("inf")
        self.iterations = self.evaluations = 0
        self._start = time.perf_counter()

    @property
    def found(self) -> bool:
        """Whether a point with a finite value was found."""
        return bool(np.isfinite(self.value))

    def offer(self, theta: Array, value: float) -> bool:
        """Keep a point if its value is the lowest so far; return whether it is."""
        better = value < self.value
        if better:
            self.theta, self.value = np.array(theta), float(value)
        return better

    def evaluate(self, theta: Array) -> float:
        """Return L(theta), and keep the point if its value is the lowest so far."""
        value = self.objective.value(theta)
        self.evaluations += 1
        self.offer(theta, value)
        return value

    def value_and_gradient(self, theta: Array) -> tuple[float, Array]:
        """Return L(theta) and its gradient (size,), and keep the point if its value is the lowest so far."""
        value, gradient = self.objective.value_and_gradient(theta)
        self.evaluations += 1
        self.offer(theta, value)
        return value, gradient

    def next_iteration(self, limit: int) -> None:
        """Count an iteration, and report the share of `limit` and the best value to the watch."""
        check_remembered()
        self.iterations += 1
        self.watch.report(self.iterations / limit, self.value)

    def run(self, iterate: Callable[[], Status]) -> SolveResult:
        """Run a minimisation to its end and return the result; after Ctrl-C, that of the best point so far.

        Raises:
            KeyboardInterrupt: after Ctrl-C if there is no point with a finite value yet.
        """
        try:
            status = iterate()
        except KeyboardInterrupt:
            if not self.found:
                raise
            status = Status.INTERRUPTED
        return self.result(status)

    def result(self, status: Status) -> SolveResult:
        """The result with a status; FAILED or INFEASIBLE if no point with a finite value was kept."""
        if not self.found and status is not Status.INFEASIBLE:
            status = Status.FAILED
        seconds = time.perf_counter() - self._start
        return SolveResult(self.theta, self.value, status, self.iterations, self.evaluations, seconds)
