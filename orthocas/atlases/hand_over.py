"""A law on an atlas, tick by tick, with its hand-overs (ours)."""

from dataclasses import dataclass, replace

import numpy as np

from orthocas.atlases.asked_posture import AskedPosture
from orthocas.atlases.laws import AtlasLaw, Command
from orthocas.checks import Array

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


class AtlasControl:
    """Holds xi while the tool follows task values, in the chart of the position, and hands over.

    At a hand-over the laws of both charts differ by a torque, which is added at first and then fades with exp(-t / 0.1
    s). So the command does not jump, whatever the tracking error.

    Args:
        law: `HandedOver` or `BlendedImpedance`.
    """

    def __init__(self, law: AtlasLaw) -> None:
        self.law = law
        self.asked = AskedPosture(law.atlas)
        self.hand_overs: list[HandOver] = []
        self._left, self._since = np.zeros(law.atlas.problem.n), 0.0

    def start(self, q: Array, time: float = 0.0) -> None:
        """Begin at rest at a posture (n,).

        Raises:
            PathError: if the atlas has no chart there.
        """
        self.asked.start(q, time)
        self.hand_overs = []
        self._left, self._since = 0.0 * q, time

    def tick(self, time: float, q: Array, dq: Array, x: Array) -> Command:
        """The command at a time, for a measured state and the task values with two derivatives, (3, m).

        Raises:
            PathError: if the task values cannot be reached with the posture held.
        """
        self.asked.move(time, x)
        said, number = self.law.command(q, dq, self.asked), self.asked.wanted_at(q)
        if number != self.asked.number:
            said = self._handed_over(said, number, time, q, dq)
        torque = said.torque + self._left * np.exp((self._since - time) / _FADE)
        limits = self.law.atlas.problem.robot.effort_limits
        return replace(said, torque=np.clip(torque, -limits, limits))

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
