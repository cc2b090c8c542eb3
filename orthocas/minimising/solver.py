"""What a minimiser is, and what it returns. Solvers live in `orthocas.solvers` and import this, never the reverse."""

from dataclasses import dataclass, field
from enum import Enum
from typing import Protocol, runtime_checkable

from orthocas.checks import Array
from orthocas.errors import SolveError
from orthocas.minimising.objective import Objective
from orthocas.minimising.watch import UNWATCHED, Watch


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
    """Outcome of a minimisation; theta is the best point seen, whatever the status."""

    theta: Array = field(repr=False)
    value: float
    status: Status
    iterations: int
    evaluations: int
    seconds: float

    def finished(self) -> "SolveResult":
        """The result, for callers that cannot use an unfinished one: raises KeyboardInterrupt if Ctrl-C ended it.

        Raises:
            KeyboardInterrupt: after Ctrl-C.
            SolveError: if no usable point was found.
        """
        if self.status is Status.INTERRUPTED:
            raise KeyboardInterrupt
        return self.raise_if_failed()

    def raise_if_failed(self) -> "SolveResult":
        """Raise SolveError if no usable point was found; running out of iterations is usable, and so is Ctrl-C."""
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
