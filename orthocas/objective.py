"""What minimisers see, and what they return. Solvers live in `orthocas.solvers` and import this, never the reverse."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Protocol, runtime_checkable

from orthocas.checks import Array
from orthocas.errors import SolveError


class Status(Enum):
    """How a minimisation ended."""

    CONVERGED = "converged"
    ITERATION_LIMIT = "iteration limit"
    STALLED = "no further descent"
    INTERRUPTED = "interrupted"
    FAILED = "failed"


@dataclass(frozen=True)
class Progress:
    """One step of long work, for progress displays."""

    stage: str
    fraction: float  #: of the stage, 0 to 1
    detail: str


Monitor = Callable[[Progress], None]


def silent(progress: Progress) -> None:
    """The default monitor: shows nothing."""


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


@dataclass(frozen=True, eq=False)
class SolveResult:
    """Outcome of a minimisation; theta is the best point seen, whatever the status."""

    theta: Array
    value: float
    status: Status
    iterations: int
    evaluations: int
    seconds: float

    def raise_if_failed(self) -> "SolveResult":
        """Raise SolveError if no usable point was found; running out of iterations is usable."""
        if self.status is Status.FAILED:
            raise SolveError(f"the minimiser failed after {self.iterations} iterations at loss {self.value:.6g}")
        return self


@runtime_checkable
class Solver(Protocol):
    """A minimiser."""

    @property
    def name(self) -> str:
        """Short name, as on the command line."""
        ...

    def coarser(self) -> "Solver":
        """The same with looser settings, for the stages of a continuation before the last."""
        ...

    def minimise(self, objective: Objective, theta0: Array, monitor: Monitor = silent, stage: str = "") -> SolveResult:
        """Minimise from theta0; Ctrl-C returns the best point so far with status INTERRUPTED."""
        ...
