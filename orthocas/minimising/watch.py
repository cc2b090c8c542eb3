"""Observe long computations: progress for displays, and a keeper of the state for checkpoints."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

from orthocas.checks import Array


@dataclass(frozen=True)
class Progress:
    """One progress report of a long computation."""

    stage: str
    fraction: float  #: completed fraction of the stage, 0 to 1
    detail: str
    value: float = float("nan")  #: current loss; NaN before there is one


Monitor = Callable[[Progress], None]
State = Mapping[str, Array]  #: all that a minimiser needs to resume


def silent(progress: Progress) -> None:
    """The default monitor. It shows nothing."""


class Keeper(Protocol):
    """Keeps the state of a minimisation, so that a killed run can resume."""

    def restored(self) -> State | None:
        """The state that an earlier run kept, or None for a new run."""
        ...

    def keep(self, state: Callable[[], State]) -> None:
        """Offer the current state. The keeper decides whether to write it."""
        ...


class Forgetful:
    """The default keeper. It keeps nothing."""

    def restored(self) -> State | None:
        """Nothing."""
        return None

    def keep(self, state: Callable[[], State]) -> None:
        """Do nothing."""


FORGETFUL = Forgetful()


@dataclass(frozen=True)
class Watch:
    """Observes a running minimiser: a monitor and a keeper."""

    monitor: Monitor = silent
    stage: str = ""  #: name of the stage, for the monitor
    keeper: Keeper = FORGETFUL

    def report(self, fraction: float, value: float) -> None:
        """Report progress to the monitor."""
        self.monitor(Progress(self.stage, fraction, f"loss {value:.5g}", value))


UNWATCHED = Watch()
