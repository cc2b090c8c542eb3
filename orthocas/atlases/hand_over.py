"""A law on an atlas, tick by tick, with its hand-overs (ours)."""

from dataclasses import dataclass, replace

import numpy as np

from orthocas.atlases.asked_posture import AskedPosture
from orthocas.atlases.laws import AtlasLaw, Command, require_atlas_law
from orthocas.checks import Array, as_number, as_point, frozen_array, require_finite
from orthocas.errors import InvalidValueError
from orthocas.showing import Shown

_FADE = 0.1  # [s], time constant of what is left of the torque before a hand-over


@dataclass(frozen=True, eq=False)
class HandOver:
    """What changed when a chart took over from another, at one state."""

    time: float  #: [s]
    before: int  #: chart
    after: int  #: chart
    posture_step: float  #: of the posture asked for [rad] or [m]
    velocity_step: float  #: of its velocity [rad/s] or [m/s]
    torque_step: float  #: largest difference of the torques of both laws at a joint [N m] or [N]
    storage_step: float  #: of the energy as the law sees it [J]


class AtlasControl(Shown):
    """Holds xi while the tool follows task values, in the chart of the position, and hands over.

    At a hand-over the laws of both charts differ by a torque, which is added at first and then fades with exp(-t / 0.1
    s). So the command does not jump, whatever the tracking error.

    Args:
        law: `HandedOver` or `BlendedImpedance`.

    Raises:
        InvalidValueError: if it is no law on an atlas.
    """

    def __init__(self, law: AtlasLaw) -> None:
        require_atlas_law(law)
        self.law = law
        self._started = False
        self.asked = AskedPosture(law.atlas)
        self.hand_overs: list[HandOver] = []
        self._left, self._since = np.zeros(law.atlas.problem.n), 0.0

    def start(self, q: Array, time: float = 0.0) -> None:
        """Begin at rest at a posture (n,).

        Raises:
            ShapeError, InvalidValueError: for arguments of the wrong shape or value.
            PathError: if the atlas has no chart there.
        """
        here, now = as_point("q", q, self.law.atlas.problem.n), _instant(time)
        self.asked.start(here, now)
        self.hand_overs = []
        self._left, self._since, self._started = 0.0 * here, now, True

    def tick(self, time: float, q: Array, dq: Array, x: Array) -> Command:
        """The command at a time, for a measured state and the task values with two derivatives, (3, m).

        Raises:
            ShapeError, InvalidValueError: for arguments of the wrong shape or value, and before `start`.
            PathError: if the task values cannot be reached with the posture held.
        """
        if not self._started:
            raise InvalidValueError("control", "not started", "start(q) before the first tick")
        problem = self.law.atlas.problem
        time, q, dq = _instant(time), as_point("q", q, problem.n), as_point("dq", dq, problem.n)
        self.asked.move(time, frozen_array("x", x, (3, problem.m)))
        said, number = self.law.command(q, dq, self.asked), self.asked.wanted_at(q)
        if number != self.asked.number:
            said = self._handed_over(said, number, time, q, dq)
        torque = said.torque + self._left * np.exp((self._since - time) / _FADE)
        limits = problem.robot.effort_limits
        return replace(said, torque=np.clip(torque, -limits, limits))

    def facts(self) -> dict[str, str]:
        """The law, hand-overs so far, and the atlas."""
        return {"law": self.law.name, "hand-overs": str(len(self.hand_overs)), **self.law.atlas.facts()}

    def _handed_over(self, said: Command, number: int, time: float, q: Array, dq: Array) -> Command:
        """The command of the law in the next chart."""
        asked = self.asked
        old, posture, velocity = asked.number, asked.q, asked.dq
        asked.hand_over(number)
        after = self.law.command(q, dq, asked)
        self._left = self._left * np.exp((self._since - time) / _FADE) + said.torque - after.torque
        self._since = time
        steps = (asked.q - posture, asked.dq - velocity, after.torque - said.torque)
        q_step, dq_step, torque_step = (float(np.abs(step).max()) for step in steps)
        change = HandOver(time, old, number, q_step, dq_step, torque_step, after.storage - said.storage)
        self.hand_overs.append(change)
        return after


def _instant(time: float) -> float:
    """A finite time [s]."""
    value = as_number("time", time)
    require_finite("time", np.asarray(value))
    return value
