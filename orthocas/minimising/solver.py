"""The interface of a minimiser, and its result. `orthocas.solvers` imports this module, never the reverse."""

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
    """Result of a minimisation. Whatever the status, theta is the best point found."""

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
        """Minimise from theta0, or resume from the state that the watch's keeper restores.

        After Ctrl-C it returns the best point so far, with status INTERRUPTED.
        """
        ...
