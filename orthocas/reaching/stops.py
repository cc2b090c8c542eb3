"""What stops a self-motion: borders of the domain, near-singular positions, and folds."""

from dataclasses import dataclass
from enum import Enum

import numpy as np

from orthocas.checks import Array
from orthocas.domains import borders
from orthocas.postures.clear_box import ClearBox
from orthocas.problem import Problem

_AT_LIMIT = 1e-9  # of the half-width: borders closer to a joint limit are that limit


class StopKind(Enum):
    """Why a motion ends."""

    JOINT = "joint"  #: a joint is at the border of the domain, or at its limit
    NEAR_SINGULAR = "near singular"  #: the relative singular value of the task is at the bound of a `ClearBox`
    FOLD = "fold"  #: the coordinate turns back: J = dphi/dq is singular
    SINGULAR = "singular"  #: no way on: the task is singular there, or grown coordinates end
    ENDLESS = "endless"  #: nothing: the motion returns to its start up to full turns of unbounded joints


@dataclass(frozen=True)
class Stop:
    """What ends a motion, and where."""

    kind: StopKind
    joint: str = ""  #: name of the joint, for JOINT
    value: float = np.nan  #: position of that joint [rad] or [m], or the relative singular value of the task
    is_limit: bool = False  #: whether the border of the domain is the limit of the joint

    def __str__(self) -> str:
        if self.kind is StopKind.JOINT:
            return f"joint '{self.joint}' at {self.value:.4g}{', its limit' if self.is_limit else ''}"
        if self.kind is StopKind.NEAR_SINGULAR:
            return f"the task near singular, with a relative singular value of {self.value:.3g}"
        return {
            StopKind.FOLD: "a fold of the chart",
            StopKind.SINGULAR: "a singularity or the end of the chart",
            StopKind.ENDLESS: "nothing",
        }[self.kind]


class Walls:
    """The borders of a problem's domain as functions that are positive inside.

    They are (q_i - low_i) and (high_i - q_i), divided by the half-width of the domain, for every bounded joint; and for
    a `ClearBox` also s(q) - bound.
    """

    def __init__(self, problem: Problem) -> None:
        domain = problem.domain
        self._domain, self._robot = domain, problem.robot
        self._low, self._high = borders(domain)
        self._clear = domain if isinstance(domain, ClearBox) else None
        endless = np.isinf(self._low) & ~np.array(problem.robot.tree.prismatic)
        self.turning = endless  #: unbounded revolute joints, (n,): they are at the same place after a full turn

    def values(self, q: Array) -> Array:
        """All functions at one joint position (n,), positive inside; infinite for unbounded joints."""
        width = self._domain.half_width
        parts = [(q - self._low) / width, (self._high - q) / width]
        if self._clear is not None:
            value = self._clear.singular_values(q) - self._clear.least_singular_value
            parts.append(np.array([value if np.isfinite(value) else -1.0]))
        return np.concatenate(parts)

    def stop(self, k: int, q: Array) -> Stop:
        """What the k-th function stands for, at q (n,)."""
        n = len(q)
        if k >= 2 * n:
            assert self._clear is not None
            return Stop(StopKind.NEAR_SINGULAR, value=float(self._clear.singular_values(q)))
        i = k % n
        border, limit = (self._low, self._robot.lower) if k < n else (self._high, self._robot.upper)
        at_limit = bool(abs(border[i] - limit[i]) <= _AT_LIMIT * self._domain.half_width[i])
        return Stop(StopKind.JOINT, self._robot.joint_names[i], float(border[i]), at_limit)

    def worst(self, q: Array) -> Stop:
        """The border that q (n,) has crossed farthest, or is nearest to."""
        return self.stop(int(np.argmin(self.values(q))), q)

    def gap(self, q: Array, start: Array) -> Array:
        """q - start (n,), up to full turns of unbounded revolute joints."""
        difference = q - start
        turns = 2 * np.pi * np.round(difference / (2 * np.pi))
        return np.where(self.turning, difference - turns, difference)
