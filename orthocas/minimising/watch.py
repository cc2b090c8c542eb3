"""Observing long work: progress for displays, and a keeper of state for checkpoints."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

from orthocas.checks import Array


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
