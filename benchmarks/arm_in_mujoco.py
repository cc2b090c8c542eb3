"""A law on an arm in MuJoCo, with what lies between them: delay, encoders, friction, pushes."""

from collections import deque
from dataclasses import dataclass

import numpy as np
from compared_laws import COULOMB, Law
from reference_motions import TICK, Motion

import orthocas as oc
from orthocas.control.controller import FROM_THE_LAW
from orthocas.errors import SimulationError
from orthocas.simulation import Friction, MuJoCoPlant
from orthocas.tools.checks import Array

BITS, CUTOFF = 14, 100.0  # of the encoders; of the low pass behind the differences [Hz]
GIVEN_UP = 100  # ticks without the law, after which a run ends


@dataclass(frozen=True)
class Loop:
    """What lies between law and arm, and a force at the flange."""

    delay: int = 0  #: ticks from measurement to torque
    every: int = 1  #: ticks between commands
    encoders: bool = False
    coulomb: float = 0.0  #: friction, as a share of COULOMB
    push: tuple[float, ...] = (0.0, 0.0, 0.0)  #: [N]
    stops: bool = True  #: of the joints


@dataclass(frozen=True)
class Run:
    """What happened."""

    q: Array  #: (N, n), after each tick
    noise: Array  #: (N, n), command minus the command at the true state [N m]
    status: str  #: "" if all is well


class Encoders:
    """Joint positions in counts of a turn, velocities by filtered differences."""

    def __init__(self, q: Array, period: float) -> None:
        self.count, self.period = 2 * np.pi / 2**BITS, period
        self.keep = np.exp(-2 * np.pi * CUTOFF * period)
        self.q, self.dq = self._rounded(q), np.zeros_like(q)

    def measure(self, q: Array) -> tuple[Array, Array]:
        """Measured q and dq."""
        rounded = self._rounded(q)
        self.dq = self.keep * self.dq + (1 - self.keep) * (rounded - self.q) / self.period
        self.q = rounded
        return self.q, self.dq

    def _rounded(self, q: Array) -> Array:
        return np.asarray(self.count * np.round(q / self.count))


def followed(law: Law, robot: oc.Robot, q: Array, motion: Motion, loop: Loop = Loop()) -> Run:
    """Run a law on the arm in MuJoCo, from rest at q."""
    plant = MuJoCoPlant(robot, friction=Friction(coulomb=loop.coulomb * np.array(COULOMB)), stops=loop.stops)
    plant.reset(q)
    plant.push(loop.push)
    encoders = Encoders(q, TICK * loop.every)
    late = deque([robot.gravity(q)] * loop.delay)
    path, noise, lost, command = [], [], 0, late[0] if late else np.zeros_like(q)
    for k in range(len(motion.phi)):
        if k % loop.every == 0:
            state = encoders.measure(plant.q) if loop.encoders else (plant.q, plant.dq)
            command, status = law.command(*state, motion, k)
            lost += status not in FROM_THE_LAW
            noise.append(command - law.command(plant.q, plant.dq, motion, k)[0] if loop.encoders else 0 * q)
        late.append(command)
        try:
            plant.step(late.popleft(), TICK)
        except SimulationError:
            lost = GIVEN_UP + 1
        path.append(plant.q)
        if lost > GIVEN_UP:
            return Run(np.array(path), np.array(noise), "left the domain")
    swinging = np.ptp(path[-300:], axis=0).max() > 0.02  # [rad], in the last 0.3 s, where the reference is at rest
    return Run(np.array(path), np.array(noise), "swings" if swinging else "")
