"""Simulation of laws across the charts of an atlas in MuJoCo."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from atlas_control.laws import AskedPosture, AtlasLaw, Command, require_atlas_law
from orthocas.control.controller import FROM_THE_LAW
from orthocas.control.reference import Reference
from orthocas.errors import InvalidValueError
from orthocas.simulation.disturbances import Loads, Push
from orthocas.simulation.mujoco_plant import MuJoCoPlant
from orthocas.simulation.physics import apply_pushes
from orthocas.tools.checks import Array, Indices, as_number, as_point, frozen_array, require_finite, require_kind
from orthocas.tools.display import Shown

_FADE = 0.1  # [s], time constant of what is left of the torque before a hand-over
_FASTEST, _SLOWEST = 1e5, 1.0  # ticks per second


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


@dataclass(frozen=True, eq=False, repr=False)
class AtlasRun(Shown):
    """A closed loop on an atlas at N ticks."""

    law: str
    times: Array  #: (N,) [s]
    q: Array  #: (N, n)
    dq: Array  #: (N, n)
    torque: Array  #: (N, n)
    status: Indices  #: `orthocas.control.ControlStatus`, (N,)
    charts: Indices  #: (N,)
    x: Array  #: (N, m)
    x_asked: Array  #: (N, m)
    q_asked: Array  #: (N, n)
    storage: Array  #: (N,) [J]
    dissipated_power: Array  #: (N,) [W]
    hand_overs: tuple[HandOver, ...]

    @property
    def fell_back(self) -> NDArray[np.bool_]:
        """Where the torque was the fallback of the law, (N,)."""
        return ~np.isin(self.status, FROM_THE_LAW)

    @property
    def energy_balance(self) -> Array:
        """Energy as the law sees it, less its start, plus what its damping took, less steps at hand-overs, (N,) [J].

        It is 0 for a posture at rest without pushes and friction, up to the ticks.
        """
        lost = np.concatenate([[0.0], np.cumsum(self.dissipated_power[:-1] * np.diff(self.times))])
        steps = np.zeros(len(self.times))
        for change in self.hand_overs:
            steps[self.times >= change.time] += change.storage_step
        return np.asarray(self.storage - self.storage[0] + lost - steps)

    def facts(self) -> dict[str, str]:
        """Errors and hand-overs."""
        worst = [
            max((getattr(change, name) for change in self.hand_overs), default=0.0)
            for name in ("posture_step", "velocity_step", "torque_step")
        ]
        posture, velocity, torque = worst
        return {
            "run": f"{self.law}, {self.times[-1]:.4g} s, {len(set(self.charts.tolist()))} charts",
            "tool error": f"{np.abs(self.x - self.x_asked).max():.3g}",
            "hand-overs": f"{len(self.hand_overs)}",
            "largest steps": f"posture {posture:.2g}, its velocity {velocity:.2g}, torque {torque:.3g}",
            "fallback": f"at {np.count_nonzero(self.fell_back)} ticks",
        }


def simulate_in_atlas(
    law: AtlasLaw,
    motion: Reference,
    q_start: ArrayLike,
    plant: MuJoCoPlant,
    *,
    control_rate: float = 1000.0,
    pushes: Sequence[Push] = (),
) -> AtlasRun:
    """Run a law on an atlas: the tool follows a motion from q_start at rest, and xi is held in every chart.

    Args:
        law: `HandedOver` or `BlendedImpedance`.
        motion: of the task, with its labels; it begins where q_start has the tool.
        q_start: joint positions, (n,) [rad] or [m].
        plant: the robot; it is reset to q_start.
        control_rate: ticks per second.
        pushes: external loads.

    Raises:
        ShapeError, InvalidValueError: for arguments of the wrong shape, value or type.
        PathError: if the motion leaves the charts or what the arm can reach.
        SimulationError: if the state diverges.
    """
    require_atlas_law(law)
    times = _checked_times(law, motion, plant, control_rate)
    q, wanted = as_point("q_start", q_start, law.atlas.problem.n), np.stack(motion.sample(times), axis=1)
    loads, seconds = Loads(plant.robot.tree, pushes), 1 / control_rate
    shares, control = loads.shares(times, seconds), AtlasControl(law)
    control.start(q)
    plant.reset(q)
    rows: list[tuple[Array, Array, Command, int, Array]] = []
    for k, time in enumerate(times):
        q, dq = plant.q, plant.dq
        said = control.tick(float(time), q, dq, wanted[k])
        rows.append((q, dq, said, control.asked.number, control.asked.q))
        plant.step(said.torque, seconds, apply_pushes(plant, loads, shares[k]))
    return _run(law, times, wanted[:, 0], rows, control.hand_overs)


def _checked_times(law: AtlasLaw, motion: Reference, plant: MuJoCoPlant, control_rate: float) -> Array:
    """The ticks of a run, (N,), after checks of what is asked for."""
    require_kind("motion", motion, Reference)
    require_kind("plant", plant, MuJoCoPlant)
    labels, rate = law.atlas.problem.task.labels, as_number("control_rate", control_rate)
    if motion.labels != labels:
        raise InvalidValueError("labels of motion", motion.labels, f"those of the task, {labels}")
    if not _SLOWEST <= rate <= _FASTEST:
        raise InvalidValueError("control_rate", rate, f"a number from {_SLOWEST:g} to {_FASTEST:g}")
    return np.arange(int(motion.duration * rate + 1e-9)) / rate


def _run(
    law: AtlasLaw,
    times: Array,
    x_asked: Array,
    rows: list[tuple[Array, Array, Command, int, Array]],
    changes: Sequence[HandOver],
) -> AtlasRun:
    q, dq, said, charts, q_asked = zip(*rows, strict=True)
    return AtlasRun(
        law.name,
        times,
        np.array(q),
        np.array(dq),
        np.array([command.torque for command in said]),
        np.array([command.status for command in said]),
        np.array(charts),
        law.atlas.problem.task.batched(np.array(q))[0],
        x_asked,
        np.array(q_asked),
        np.array([command.storage for command in said]),
        np.array([command.dissipated for command in said]),
        tuple(changes),
    )
