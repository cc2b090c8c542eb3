"""What a method is, what it is given, and what a scenario asks."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import pinocchio as pin

from orthocas.tools.checks import Array
from redundancy.arms import Arm


@dataclass(frozen=True)
class Target:
    """What is wanted at a tick."""

    placement: pin.SE3  #: of the tip
    posture: Array  #: (n,), for methods that take one: home, if nothing else is wanted
    elbow: float | None = None  #: angle of the elbow, if that is wanted [rad]


class Unsuited(Exception):  # noqa: N818 (it is an answer, not an error)
    """Why a method does not do this arm or this scenario; the table prints it."""


class Method(Protocol):
    """One way to follow targets. A file in `methods` lists the classes of its methods in `METHODS`."""

    name: str  #: of the row
    packages: Sequence[
        str
    ]  #: distributions whose versions are recorded; one that is missing makes the row "not installed"
    grid: Sequence[
        Mapping[str, Any]
    ]  #: up to three settings, as keyword arguments; the first is that of the documentation

    def __init__(self, arm: Arm, **settings: Any) -> None:
        """Prepare for an arm. Raises Unsuited if it cannot be done."""
        ...

    def start(self, q: Array, path: Sequence[Target] | None) -> None:
        """Begin at rest at q. The path is that of all targets where they are known before, and None otherwise."""
        ...

    def step(self, target: Target) -> Array:
        """The joint position at the end of this tick of 10 ms (n,). A torque law simulates its arm here."""
        ...


@dataclass(frozen=True)
class Stream:
    """One run: where it begins, and all targets."""

    start: Array
    targets: Sequence[Target]
    known: bool = True  #: before the run begins


@dataclass(frozen=True)
class Run:
    """What a method did with a stream."""

    stream: Stream
    q: Array  #: (N, n)
    errors: Array  #: of the tip, position [m] and rotation [rad] (N, 2)
    placed: bool  #: whether all joints stayed within their limits of position
    slow: bool  #: whether they stayed within 1.05 times their limits of velocity

    @property
    def followed(self) -> bool:
        """Whether the tip was where it was wanted at 99 % of the ticks, and joints within their limits."""
        return bool(np.mean(self.on_target) >= FOLLOWED and self.placed and self.slow)

    @property
    def on_target(self) -> Array:
        """Whether the tip was where it was wanted (N,)."""
        return np.asarray((self.errors[:, 0] < CLOSE) & (self.errors[:, 1] < CLOSE_TURN))


CLOSE, CLOSE_TURN, FOLLOWED = 2e-3, 2e-2, 0.99  # [m], [rad], share of ticks


@dataclass(frozen=True)
class Score:
    """The number of a scenario for one arm and one method; `served` is False where the task itself failed."""

    value: float
    served: bool
    also: float = float("nan")  #: the second number, if the scenario has one


@dataclass(frozen=True)
class Scenario:
    """A question of a user. A file in `scenarios` has one as `SCENARIO`."""

    name: str
    title: str
    number: str  #: what counts, with its unit; less is better
    threads: Mapping[str, str]  #: addresses of public threads, and one line of each
    streams: Callable[[Arm, np.random.Generator, bool], list[Stream]]  #: of an arm; True for a short run
    judge: Callable[[Arm, list[Run]], Score]
    also: str = ""  #: the name of the second number
    mobile: bool = False  #: whether the arm stands on a mobile base
    least: float = 0.0  #: numbers below this are the same to the user; they share a rank
    percent: bool = False  #: whether the number is a share; then the mean over the arms counts
    served: str = (
        "the tip was within 2 mm and 0.02 rad of its target at 99 % of the ticks, and all joints within their limits "
        "of position and velocity"
    )
