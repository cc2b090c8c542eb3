"""A plant whose joints stick: dry friction with exact standstill, by time stepping."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from orthocas.errors import SimulationError
from orthocas.robots.robot import Robot
from orthocas.simulation.disturbances import Friction, count_steps
from orthocas.tools.batch import Batched, dense_function
from orthocas.tools.checks import Array, as_point, require_kind, require_positive
from orthocas.tools.display import Shown


@dataclass(frozen=True, slots=True)
class StickingRules:
    """Numbers of the plant that sticks."""

    timestep: float = 2.5e-4  #: longest step of the physics [s]
    runaway: float = 1e6  #: velocity [rad/s] or [m/s]
    #: rounds of pivoting that change all joints at once; later rounds change one joint each, which always terminates
    blocks: int = 10
    rounds: int = 1000  #: largest number of rounds of the pivoting


RULES = StickingRules()


class StickingPlant(Shown):
    """A robot that holds a torque for a tick. Its joints stick: they stay exactly at rest until breakaway.

    M ddq + C dq + g = clip(torque) + loads - viscous dq - f, with the dry friction f of `Friction`. If dq_i = 0, |f_i|
    is at most the breakaway torque; otherwise f_i has the size F_i(dq_i) and the sign of dq_i. A step of length h
    computes the new velocities as the minimum of a convex function,

        dq+ = argmin_v 1/2 v^T (M + h B) v - (M dq + h (torque - C dq - g))^T v + h sum_i F_i |v_i|,

    evaluated at the position in the middle of the step. Joints at the kinks v_i = 0 stick. The steps are of first
    order. There is no smoothed sign function, no contact stiffness and no creep. Joints do not stop at their limits.

    Args:
        robot: the true robot.
        friction: joint friction; default: none.
        effort_limits: whether motors saturate at the robot's effort limits.
        timestep: longest step of the physics [s].

    Raises:
        ShapeError, InvalidValueError: for arguments of the wrong shape, value or type.

    Source:
        [M1988] for the time stepping, [JP1994] for the minimum.

    Example:
        >>> import orthocas as oc
        >>> robot = oc.Robot.planar(lengths=[1.0], masses=[3.0])
        >>> plant = oc.simulation.StickingPlant(robot, friction=oc.simulation.Friction(coulomb=1.0, breakaway=1.2))
        >>> weight = robot.gravity(plant.q)
        >>> plant.step(weight + 1.1, 0.5)
        >>> float(plant.q[0])
        0.0
        >>> plant.step(weight + 1.3, 0.5)
        >>> float(plant.q[0].round(3))
        0.017
    """

    def __init__(
        self,
        robot: Robot,
        *,
        friction: Friction | None = None,
        effort_limits: bool = True,
        timestep: float = RULES.timestep,
    ) -> None:
        require_kind("robot", robot, Robot)
        friction = Friction() if friction is None else friction
        require_kind("friction", friction, Friction)
        self.robot, self.friction, self._timestep = robot, friction, require_positive("timestep", timestep)
        self._viscous, self._coulomb, self._extra, self._speed = np.split(friction.numbers(robot.n), 4)
        self._limit = robot.effort_limits if effort_limits else np.full(robot.n, np.inf)
        q, dq = ca.SX.sym("q", robot.n), ca.SX.sym("dq", robot.n)
        outputs = [robot.function("mass_matrix")(q), robot.function("bias")(q, dq)]
        self._dynamics = Batched(dense_function("dynamics", [q, dq], outputs))
        self.reset(np.zeros(robot.n))

    def facts(self) -> dict[str, str]:
        """The robot, the time and the state."""
        q, dq = (np.array2string(values, precision=3, max_line_width=1000) for values in (self.q, self.dq))
        return {"plant": f"{self.robot.heading}, with joints that stick", "time": f"{self.time:g} s", "q": q, "dq": dq}

    def reset(self, q: ArrayLike, dq: ArrayLike | None = None) -> None:
        """Restart at joint positions (n,) and velocities (n,) (default: at rest), at time 0.

        Raises:
            ShapeError, InvalidValueError: for invalid states.
        """
        n = self.robot.n
        self.q: Array = np.array(as_point("q", q, n))  #: joint positions (n,) [rad] or [m]
        #: joint velocities (n,) [rad/s] or [m/s]; exactly 0 where a joint sticks
        self.dq: Array = np.zeros(n) if dq is None else np.array(as_point("dq", dq, n))
        self.time = 0.0  #: [s] since `reset`

    def step(self, torque: ArrayLike, seconds: float, loads: ArrayLike | None = None) -> None:
        """Hold a torque for some time.

        Args:
            torque: motor torque, (n,) [N m] or [N].
            seconds: > 0 [s]; divided into equal physics steps, none longer than `timestep`.
            loads: additional joint torques, which do not saturate, (n,) [N m] or [N].

        Raises:
            ShapeError, InvalidValueError: for torques that are not (n,) or not finite, and for ticks that are too long.
            SimulationError: if the state has diverged.
        """
        applied = np.clip(as_point("torque", torque, self.robot.n), -self._limit, self._limit)
        if loads is not None:
            applied = applied + as_point("loads", loads, self.robot.n)
        steps = count_steps(seconds, self._timestep)
        h, q, dq = seconds / steps, self.q, self.dq
        for _ in range(steps):
            # Mass matrix and bias at the middle position, and friction at the last velocity.
            middle = q + h / 2 * dq
            M, bias = (out[0] for out in self._dynamics(middle[None], dq[None]))
            size = self._coulomb + self._extra * np.exp(-((dq / self._speed) ** 2))
            A = M.reshape(len(q), -1) + h * np.diag(self._viscous)
            dq = minimise_with_kinks(A, M.reshape(len(q), -1) @ dq + h * (applied - bias), h * size, dq)
            q = middle + h / 2 * dq
        if not dq @ dq < RULES.runaway**2:
            raise SimulationError(f"the arm ran away at {self.time:g} s: joint velocities beyond {RULES.runaway:g}")
        self.q, self.dq = q, dq
        self.time += seconds


def minimise_with_kinks(A: Array, b: Array, size: Array, start: Array) -> Array:
    """The minimiser v of 1/2 v^T A v - b^T v + sum_i size_i |v_i|, for A symmetric positive definite, size >= 0.

    At the minimum, each v_i either is 0 with |b_i - (A v)_i| <= size_i, or has a sign s_i and b_i - (A v)_i = s_i
    size_i. The signs start from those of `start`, and are corrected where a condition is violated. The first rounds
    correct all signs at once. Later rounds correct only the last violated one, which always terminates because every
    principal minor of A is positive.
    """
    signs = np.where(size > 0, np.sign(start), 1.0)
    for k in range(RULES.rounds):
        v = np.zeros_like(b)
        moves = np.flatnonzero(signs)
        v[moves] = np.linalg.solve(A[np.ix_(moves, moves)], (b - signs * size)[moves])
        # Joints that must break away, and joints that move against their sign.
        rest = b - A @ v
        breaks, turns = (signs == 0) & (np.abs(rest) > size), signs * v * (size > 0) < 0
        wrong = np.flatnonzero(breaks | turns)
        if not wrong.size:
            return v
        changed = wrong if k < RULES.blocks else wrong[-1:]
        signs[changed] = np.where(signs[changed] == 0, np.sign(rest[changed]), 0.0)
    raise SimulationError("no consistent set of sticking joints was found")
