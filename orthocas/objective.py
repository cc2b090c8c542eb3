"""What minimisers see, and what they return. Solvers live in `orthocas.solvers` and import this, never the reverse."""

from collections.abc import Callable, Iterator, Mapping
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
    INFEASIBLE = "constraints cannot be met"
    INTERRUPTED = "interrupted"
    FAILED = "failed"


@dataclass(frozen=True)
class Progress:
    """One step of long work, for progress displays."""

    stage: str
    fraction: float  #: of the stage, 0 to 1
    detail: str
    value: float = float("nan")  #: loss, if there is one already


Monitor = Callable[[Progress], None]
State = Mapping[str, Array]  #: all that a minimiser needs to go on where it was


def silent(progress: Progress) -> None:
    """The default monitor: shows nothing."""


class Keeper(Protocol):
    """Keeps the state of a minimisation, so that a killed run can go on."""

    def restored(self) -> State | None:
        """The state that an earlier run kept; None for a new run."""
        ...

    def keep(self, state: Callable[[], State]) -> None:
        """Offer the current state; the keeper decides whether it is time to write it."""
        ...


class Forgetful:
    """The default keeper: keeps nothing."""

    def restored(self) -> State | None:
        """Nothing."""
        return None

    def keep(self, state: Callable[[], State]) -> None:
        """Do nothing."""


FORGETFUL = Forgetful()


@dataclass(frozen=True)
class Watch:
    """Who looks on while a minimiser works."""

    monitor: Monitor = silent
    stage: str = ""  #: name of the work for the monitor
    keeper: Keeper = FORGETFUL

    def report(self, fraction: float, value: float) -> None:
        """Tell the monitor."""
        self.monitor(Progress(self.stage, fraction, f"loss {value:.5g}", value))


UNWATCHED = Watch()


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
class SmoothObjective(Objective, Protocol):
    """An objective with its exact Hessian."""

    def hessian(self, theta: Array) -> Array:
        """d^2L/dtheta^2, (size, size)."""
        ...


@runtime_checkable
class SampledObjective(Objective, Protocol):
    """A mean over samples, of which fresh ones can be drawn."""

    def batches(self, size: int, count: int, seed: tuple[int, ...]) -> Iterator[Objective]:
        """The same mean over `count` fresh sample sets, of `size` each or a little less."""
        ...


@runtime_checkable
class ConstrainedObjective(Objective, Protocol):
    """An objective with constraints lower <= c(theta) <= upper."""

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper, (constraints,) each."""
        ...

    def constraints(self, theta: Array) -> tuple[Array, Array]:
        """c(theta), (constraints,), and its Jacobian, (constraints, size)."""
        ...

    def lagrangian_hessian(self, theta: Array, factor: float, multipliers: Array) -> Array:
        """Hessian of factor L + multipliers . c, (size, size)."""
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
        """Short name, as on the command line."""
        ...

    def coarser(self) -> "Solver":
        """The same with looser settings, for the stages of a continuation before the last."""
        ...

    def minimise(self, objective: Objective, theta0: Array, watch: Watch = UNWATCHED) -> SolveResult:
        """Minimise from theta0, or go on from the state that the watch's keeper restores.

        Ctrl-C returns the best point so far with status INTERRUPTED.
        """
        ...
