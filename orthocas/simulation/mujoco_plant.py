"""A robot in MuJoCo, driven tick by tick."""

from math import ceil, sqrt
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthocas.checks import Array, as_number, as_point, frozen_array, require_kind
from orthocas.control.gains import non_negative_gains
from orthocas.errors import InvalidValueError, SimulationError
from orthocas.robots import Robot
from orthocas.showing import Shown
from orthocas.simulation.disturbances import Friction
from orthocas.simulation.mujoco_model import HAND, handle_name, mujoco, mujoco_model, rotor_name
from orthocas.simulation.mujoco_scene import TIMESTEP, Elasticity, MuJoCo, Payload, Wall
from orthocas.simulation.places import Link, place_of

_MOST_PARTS = 8  # of the longest step, for RK4
_LARGEST = 1e10  # [N m] or [N]
_MOST_STEPS = 100_000  # of the physics in a tick, about 5 s of computing
_RUNAWAY = 1e6  # [rad/s] or [m/s]


class MuJoCoPlant(Shown):
    """A robot in MuJoCo that holds a torque for a tick, then shows where it is. Fast enough for runs of many ticks.

    M ddq + C dq + g = clip(torque) + loads + pushes - friction, with stops at the joint limits. The physics takes steps
    of fourth order (RK4), shorter ones where viscous friction is stiff for the inertia of a joint (docs/simulate.md).
    Not for several threads at once. Needs the extra `orthocas[sim]`.

    Args:
        robot: the true robot.
        friction: viscous friction becomes MuJoCo's joint damping, Coulomb friction its `frictionloss`.
        stops: whether the joints stop at their limits of position.
        effort_limits: whether the motors saturate at the robot's limits of effort.
        payload: a body fixed at the tip.
        wall: a wall in the tip's way.
        timestep: longest step of the physics [s], from 1e-6 to 0.01.
        elasticity: of the gears; default rigid ones. Motors and friction then act on rotors, which springs couple to
            the joints.

    Raises:
        ShapeError, InvalidValueError: for arguments of the wrong shape, value or type.
        MissingExtraError: if mujoco is not installed.
        RobotError: if MuJoCo refuses the robot.

    Example:
        >>> import orthocas as oc
        >>> robot = oc.Robot.planar(lengths=[1.0, 1.0], masses=[3.0, 3.0])
        >>> plant = oc.simulation.MuJoCoPlant(robot)
        >>> plant.reset([0.3, 0.4])
        >>> plant.push([0.0, 20.0, 0.0], link="q2")  # at the elbow
        >>> for _ in range(100):
        ...     plant.step(robot.gravity(plant.q), 1e-3)
        >>> plant.release()
        >>> plant.q.round(3).tolist()
        [0.347, 0.288]
    """

    def __init__(
        self,
        robot: Robot,
        *,
        friction: Friction | None = None,
        stops: bool = True,
        effort_limits: bool = True,
        payload: Payload | None = None,
        wall: Wall | None = None,
        timestep: float = TIMESTEP,
        elasticity: Elasticity | None = None,
    ) -> None:
        require_kind("robot", robot, Robot)
        scene = MuJoCo(robot, stops, effort_limits, payload, wall, timestep, elasticity)
        friction = Friction() if friction is None else friction
        require_kind("friction", friction, Friction)
        viscous, coulomb = (
            non_negative_gains(name, getattr(friction, name), robot.n) for name in ("viscous", "coulomb")
        )
        self.robot, self.elasticity = robot, elasticity
        #: MuJoCo's model and data, for renderers and for looking; `step` owns them.
        self.model: Any = mujoco_model(robot.tree, scene, viscous, coulomb)
        self.data: Any = mujoco().MjData(self.model)
        self._step = mujoco().mj_step
        self._timestep = float(timestep)
        self._dofs = self._numbers([f"joint{i}" for i in range(robot.n)])
        #: joints that the motors move: those of the robot, or their rotors
        self._motors = self._dofs if elasticity is None else self._numbers([rotor_name(i) for i in range(robot.n)])
        self._handles = [int(self.model.body(handle_name(i)).id) for i in range(robot.n)]
        self.reset(np.zeros(robot.n))

    def facts(self) -> dict[str, str]:
        """The robot, the time and the state."""
        q, dq = (np.array2string(values, precision=3, max_line_width=1000) for values in (self.q, self.dq))
        return {"plant": f"{self.robot.heading}, in MuJoCo", "time": f"{self.time:g} s", "q": q, "dq": dq}

    @property
    def q(self) -> Array:
        """Joint positions (n,) [rad] or [m], a copy."""
        return np.asarray(self.data.qpos[self._dofs])

    @property
    def dq(self) -> Array:
        """Joint velocities (n,) [rad/s] or [m/s], a copy."""
        return np.asarray(self.data.qvel[self._dofs])

    @property
    def motor_q(self) -> Array:
        """Positions of the rotors, as encoders of motors measure them, (n,); with rigid gears those of the joints."""
        return np.asarray(self.data.qpos[self._motors])

    @property
    def motor_dq(self) -> Array:
        """Velocities of the rotors, (n,)."""
        return np.asarray(self.data.qvel[self._motors])

    @property
    def time(self) -> float:
        """Time since `reset` [s]."""
        return float(self.data.time)

    @property
    def torque(self) -> Array:
        """The torque of the motors in the last step, after saturation (n,) [N m] or [N]."""
        return np.asarray(self.data.qfrc_actuator[self._motors])

    @property
    def acceleration(self) -> Array:
        """Joint accelerations now, with the torque and the loads of the last step, (n,) [rad/s^2] or [m/s^2]."""
        mujoco().mj_forward(self.model, self.data)
        return np.asarray(self.data.qacc[self._dofs])

    @property
    def contact_force(self) -> Array:
        """Force of the wall on the tip in the last step, in the world, (3,) [N]; zero without contact."""
        total, wrench = np.zeros(3), np.zeros(6)
        for k in range(self.data.ncon):
            mujoco().mj_contactForce(self.model, self.data, k, wrench)
            contact = self.data.contact[k]
            sign = 1.0 if contact.geom[1] == self.model.geom(HAND).id else -1.0  # the force acts on the second geom
            total += sign * np.reshape(contact.frame, (3, 3)).T @ wrench[:3]
        return total

    def reset(self, q: ArrayLike, dq: ArrayLike | None = None) -> None:
        """Begin anew at joint positions (n,) and velocities (n,), default at rest, at time 0 and without pushes.

        Rotors of elastic gears start where their springs carry the robot's own weight.

        Raises:
            ShapeError, InvalidValueError: for other states.
        """
        q = as_point("q", q, self.robot.n)
        dq = np.zeros(self.robot.n) if dq is None else as_point("dq", dq, self.robot.n)
        mujoco().mj_resetData(self.model, self.data)
        for warning in self.data.warning:
            warning.number = 1  # MuJoCo prints and logs the first one: `step` raises an error instead
        if self.elasticity is not None:
            sag = np.asarray(self.robot.gravity(q), dtype=float) / self.elasticity.numbers(self.robot.n)[0]
            self.data.qpos[self._motors], self.data.qvel[self._motors] = q + sag, dq
        self.data.qpos[self._dofs], self.data.qvel[self._dofs] = q, dq
        mujoco().mj_forward(self.model, self.data)
        self._choose_integrator()

    def _choose_integrator(self) -> None:
        """Choose steps of at most 1 / rate, where rate is the largest eigenvalue of M^-1 D at the start.

        RK4 is stable up to 2.8 / rate. If 1 / rate is less than an eighth of the longest step, an implicit method of
        first order takes eighths. Springs K need steps of at most 1 / frequency with both, the root of the largest
        eigenvalue of M^-1 K.
        """
        M = np.zeros((self.model.nv,) * 2)
        mujoco().mj_fullM(self.model, self.data, M)
        damped, squared = (self._timestep * _largest_eigenvalue(M, part) for part in self._dampers_and_springs())
        parts = max(min(ceil(min(damped, _MOST_PARTS + 1)), _MOST_PARTS), ceil(sqrt(self._timestep * squared)), 1)
        kinds = mujoco().mjtIntegrator
        self.model.opt.integrator = kinds.mjINT_RK4 if damped <= _MOST_PARTS else kinds.mjINT_IMPLICITFAST
        self._longest = self._timestep / parts

    def _numbers(self, names: list[str]) -> NDArray[np.intp]:
        """Where joints stand among all."""
        return np.array([self.model.joint(name).dofadr[0] for name in names])

    def _dampers_and_springs(self) -> tuple[Array, Array]:
        """D and K of all joints and rotors."""
        D = np.diag(self.model.dof_damping)
        K = np.zeros_like(D)
        if self.elasticity is not None:
            stiffness, _, damping = self.elasticity.numbers(self.robot.n)
            across = np.zeros((self.robot.n, self.model.nv))
            rows = np.arange(self.robot.n)
            across[rows, self._motors], across[rows, self._dofs] = 1.0, -1.0
            D, K = D + across.T * damping @ across, across.T * stiffness @ across
        return D, K

    def push(self, force: ArrayLike, link: Link = None, point: ArrayLike = (0.0, 0.0, 0.0)) -> None:
        """Push from now on, in addition to other pushes, until `release`.

        Args:
            force: in world axes, (3,) [N].
            link: the link, by the name or the index of the joint that moves it; default the tip.
            point: where the force acts, in the frame of the link, or of the tip, (3,) [m]. Frames of links are those of
                `robot.tree`: the origin is on the joint's axis, which is z.

        Raises:
            ShapeError, InvalidValueError, UnknownNameError: for other forces and places.
        """
        force = frozen_array("force", force, (3,))
        body, at = place_of(self.robot.tree, link, frozen_array("point", point, (3,)))
        if body < 0:
            return  # what carries the tip does not move
        handle = self._handles[body]
        applied = self.data.xfrc_applied[handle]
        if not applied.any():
            self.model.body_ipos[handle] = at  # the handle has no mass: its centre may be anywhere
        else:  # another push at this link: the same force, and the torque between the two points
            mujoco().mj_kinematics(self.model, self.data)
            rotation = np.reshape(self.data.xmat[handle], (3, 3))
            applied[3:] += np.cross(rotation @ (at - self.model.body_ipos[handle]), force)
        applied[:3] += force

    def release(self) -> None:
        """End all pushes."""
        self.data.xfrc_applied[:] = 0.0

    def step(self, torque: ArrayLike, seconds: float, loads: ArrayLike | None = None) -> None:
        """Hold a torque for some time.

        Args:
            torque: of the motors, (n,) [N m] or [N].
            seconds: > 0 [s]; divided into equal steps of the physics, none longer than `timestep`.
            loads: further joint torques, which do not saturate, (n,) [N m] or [N].

        Raises:
            ShapeError, InvalidValueError: for torques that are not (n,) or not finite, and ticks that are too long.
            SimulationError: if the state has diverged.
        """
        data = self.data
        data.ctrl[:] = self._checked("torque", torque)
        data.qfrc_applied[self._dofs] = 0.0 if loads is None else self._checked("loads", loads)
        self._step(self.model, data, self._divided(seconds))
        if not data.qvel @ data.qvel < _RUNAWAY**2:
            raise SimulationError(f"MuJoCo gave up at {self.time:g} s: joint velocities beyond {_RUNAWAY:g}")

    def _checked(self, name: str, value: ArrayLike) -> Array:
        """Joint torques (n,). MuJoCo would take 0 in place of NaN and of larger ones."""
        if not isinstance(value, np.ndarray) or value.shape != (self.robot.n,) or value.dtype != float:
            value = as_point(name, value, self.robot.n)
        if not np.abs(value).max() < _LARGEST:
            raise InvalidValueError(name, value.tolist(), f"numbers up to {_LARGEST:g}")
        return value

    def _divided(self, seconds: float) -> int:
        """Into how many steps of the physics a tick is divided; sets their length."""
        count = as_number("seconds", seconds) / self._longest - 1e-9
        if not -1e-9 < count <= _MOST_STEPS:
            raise InvalidValueError("seconds", seconds, f"a number > 0, at most {_MOST_STEPS * self._longest:g}")
        steps = max(1, ceil(count))
        self.model.opt.timestep = seconds / steps
        return steps


def _largest_eigenvalue(M: Array, K: Array) -> float:
    """Of M^-1 K, for symmetric M > 0 and K >= 0."""
    return float(np.linalg.eigvals(np.linalg.solve(M, K)).real.max()) if K.any() else 0.0
