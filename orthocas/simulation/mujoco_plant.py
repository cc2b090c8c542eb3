"""MuJoCo as the plant of a simulation: scenes, models and time steps."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from math import ceil, sqrt
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthocas.control.gains import non_negative_gains, positive_gains
from orthocas.errors import InvalidValueError, RobotError, SimulationError
from orthocas.robots.robot import Robot
from orthocas.robots.spatial import rotate_z_to
from orthocas.robots.tree import KinematicTree, require_body
from orthocas.simulation.disturbances import Friction, Link, count_steps, place_of
from orthocas.tools.checks import (
    Array,
    as_number,
    as_point,
    freeze_array,
    import_extra,
    require_at_least,
    require_kind,
    require_positive,
)
from orthocas.tools.display import Shown

MUJOCO = "mujoco"  #: name of this plant
TIP = "tip"  #: name of the body at the tip frame; it carries the payload
HAND = "hand"  #: name of the geom at the tip that touches the wall


@dataclass(frozen=True, slots=True)
class MuJoCoRules:
    """Numbers of MuJoCo as a plant."""

    timestep: float = 1e-3  #: longest step of the physics [s]
    timesteps: tuple[float, float] = (1e-6, 1e-2)  #: allowed range of this step [s]
    stop_time: float = 0.004  #: time constant of the stops, critically damped; MuJoCo's default is 0.02 [s]
    #: MuJoCo's default of 0.9 to 0.95 lets a motor press a light wrist 0.1 rad beyond its stop
    stop_impedance: tuple[float, float] = (0.99, 0.999)
    #: with MuJoCo's default, a light wrist creeps at 0.4 rad/s below its friction
    friction_impedance: tuple[float, float] = (0.999, 0.999)
    far: float = 1e9  #: stands for an infinite limit, because MuJoCo's ranges have two finite ends [rad] or [m]
    most_parts: int = 8  #: largest number of parts of the longest step with RK4
    largest: float = 1e10  #: largest torque [N m] or [N]
    runaway: float = 1e6  #: largest velocity [rad/s] or [m/s]


RULES = MuJoCoRules()


@dataclass(frozen=True, eq=False)
class Payload:
    """A body fixed at the tip.

    Args:
        mass: >= 0 [kg].
        centre: centre of mass in the tip frame, (3,) [m]; default the tip.
        inertia: about the centre of mass, in axes of the tip frame, (3, 3) [kg m^2]; default a point mass.

    Raises:
        ShapeError, InvalidValueError, RobotError: for numbers that no body has.
    """

    mass: float
    centre: Array
    inertia: Array

    def __init__(
        self, mass: float, centre: ArrayLike = (0.0, 0.0, 0.0), inertia: ArrayLike = ((0.0,) * 3,) * 3
    ) -> None:
        object.__setattr__(self, "mass", require_at_least("mass of a payload", mass, 0.0))
        object.__setattr__(self, "centre", freeze_array("centre of a payload", centre, (3,)))
        object.__setattr__(self, "inertia", freeze_array("inertia of a payload", inertia, (3, 3)))
        require_body("tip", self.mass, self.inertia, 0.0)


@dataclass(frozen=True, eq=False)
class Wall:
    """A fixed wall that only a sphere around the tip can touch.

    Args:
        point: centre of its face, in the world, (3,) [m].
        normal: outward normal of the face, (3,), of any length > 0.
        tip_radius: radius of the sphere [m], > 0.
        size: length of the square face's sides [m], > 0.
        thickness: thickness of the wall behind the face [m], > 0.
        time_constant: time constant of the contact [s], > 0, critically damped. MuJoCo uses at least two time steps.
    """

    point: Array
    normal: Array
    tip_radius: float = 0.02
    size: float = 1.0
    thickness: float = 0.2
    time_constant: float = 0.01

    def __post_init__(self) -> None:
        object.__setattr__(self, "point", freeze_array("point of a wall", self.point, (3,)))
        normal = freeze_array("normal of a wall", self.normal, (3,))
        if not 0 < np.linalg.norm(normal) < np.inf:
            raise InvalidValueError("normal of a wall", normal.tolist(), "a direction other than zero")
        object.__setattr__(self, "normal", freeze_array("normal", normal / np.linalg.norm(normal), (3,)))
        for name in ("tip_radius", "size", "thickness", "time_constant"):
            require_positive(f"{name} of a wall", getattr(self, name))


@dataclass(frozen=True, eq=False)
class Elasticity:
    """Springs and dampers between motor rotors and joints, as in elastic gears.

    With rotors at theta, M ddq + C dq + g = k (theta - q) + d (dtheta - dq) + loads and
    B ddtheta = u - friction - k (theta - q) - d (dtheta - dq). Rotors turn about their own axes only [S1987].

    Args:
        stiffness: k > 0, (n,) or one number [N m/rad].
        inertia: B > 0 of the rotors, seen at the joints, (n,) or one number [kg m^2]. It replaces the robot's
            armatures.
        damping: d >= 0, (n,) or one number [N m s/rad].
    """

    stiffness: ArrayLike
    inertia: ArrayLike
    damping: ArrayLike = 0.0

    def numbers(self, n: int) -> tuple[Array, Array, Array]:
        """Stiffness, inertia and damping of n joints, (n,) each.

        Raises:
            ShapeError, InvalidValueError: for invalid shapes and values.
        """
        gains = [positive_gains(f"{name} of elasticity", getattr(self, name), n) for name in ("stiffness", "inertia")]
        return gains[0], gains[1], non_negative_gains("damping of elasticity", self.damping, n)


@dataclass(frozen=True, eq=False)
class MuJoCo:
    """MuJoCo as a plant of `simulate`: `simulate(..., plant=MuJoCo(...), control_rate=1000)`.

    The model is built from the robot's numbers, so it works for every chart file; see `MuJoCoPlant`. Needs the extra
    `orthocas[mujoco]`.

    Args:
        robot: the true robot; default: the controller's model.
        stops: whether joints stop at their position limits.
        effort_limits: whether motors saturate at the robot's effort limits.
        payload: a body fixed at the tip, unknown to the controller.
        wall: a wall that the tip may touch.
        timestep: longest step of the physics [s], from 1e-6 to 0.01.
        elasticity: elasticity of the gears; default: rigid. Sensors measure the joints, not the rotors.
    """

    robot: Robot | None = None
    stops: bool = True
    effort_limits: bool = True
    payload: Payload | None = None
    wall: Wall | None = None
    timestep: float = RULES.timestep
    elasticity: Elasticity | None = None

    def __post_init__(self) -> None:
        for name, kind in (("robot", Robot), ("payload", Payload), ("wall", Wall), ("elasticity", Elasticity)):
            if getattr(self, name) is not None:
                require_kind(name, getattr(self, name), kind)
        require_kind("stops", self.stops, bool)
        require_kind("effort_limits", self.effort_limits, bool)
        shortest, longest = RULES.timesteps
        if not shortest <= as_number("timestep", self.timestep) <= longest:
            raise InvalidValueError("timestep", self.timestep, f"a number from {shortest:g} to {longest:g}")


def mujoco() -> ModuleType:
    """Import the package `mujoco`, which only simulations with MuJoCo need.

    Raises:
        MissingExtraError: if it is not installed.
    """
    return import_extra("mujoco", "MuJoCo as plant", "mujoco")


def body_name(i: int) -> str:
    """Name of the body that joint i moves."""
    return f"body{i}"


def rotor_name(joint: str) -> str:
    """Name of the rotor's joint for a joint of the robot, if gears are elastic."""
    return f"{joint}/rotor"


def handle_name(i: int) -> str:
    """Name of the massless body on which pushes at body i act."""
    return f"handle{i}"


def mujoco_model(tree: KinematicTree, scene: MuJoCo, viscous: Array, coulomb: Array) -> Any:
    """An `mjModel` with the dynamics of a tree: M ddq + C dq + g = u - friction + loads.

    Joints have the robot's names. The motor "motor<i>" (gear 1) moves joint i. This joint carries "body<i>" and the
    massless "handle<i>", on which pushes act. The tip frame is the body "tip". With elasticity, the motor moves the
    joint "<name>/rotor" instead, which the spring "gear<i>" couples to the robot's joint; friction then acts at the
    rotor.

    Args:
        tree: the robot.
        scene: stops, effort limits, payload, wall and elasticity.
        viscous: joint damping (n,) [N m s/rad] or [N s/m].
        coulomb: dry friction (n,) [N m] or [N], a constraint that MuJoCo solves (`frictionloss`).

    Raises:
        MissingExtraError: if mujoco is not installed.
        RobotError: if MuJoCo refuses the model.
    """
    mj = mujoco()
    tree.require_no_mimics("MuJoCo's plant")
    spec = mj.MjSpec()
    spec.compiler.degree = False
    spec.option.gravity = tree.gravity
    # Report a run that diverges instead of resetting it.
    spec.option.disableflags |= mj.mjtDisableBit.mjDSBL_AUTORESET
    # One body per joint, with a massless handle for pushes, and a motor.
    bodies: list[Any] = []
    for i, parent in enumerate(tree.parents):
        carrier = bodies[parent] if parent >= 0 else spec.worldbody
        bodies.append(_add_body(mj, carrier, body_name(i), tree.translations[i], tree.rotations[i]))
        _place_inertia(bodies[i].add_body(name=handle_name(i)), 0.0)
        joint = _add_joint(mj, bodies[i], tree, i, scene.stops)
        moved = joint if scene.elasticity is None else _add_rotor(mj, spec, joint, i, scene.elasticity.numbers(tree.n))
        moved.damping[0], moved.frictionloss = viscous[i], coulomb[i]
        moved.solimp_friction[:2] = RULES.friction_impedance
        motor = spec.add_actuator(name=f"motor{i}", target=moved.name, trntype=mj.mjtTrn.mjTRN_JOINT)
        motor.set_to_motor()
        if scene.effort_limits and np.isfinite(limit := tree.effort_limits[i]):
            motor.forcelimited, motor.forcerange = mj.mjtLimited.mjLIMITED_TRUE, (-limit, limit)
    # The tip carries the payload and touches the wall.
    carrier = bodies[tree.tip_parent] if tree.tip_parent >= 0 else spec.worldbody
    tip = _add_body(mj, carrier, TIP, tree.tip_translation, tree.tip_rotation)
    if scene.wall is not None:
        _add_wall(mj, spec, tip, scene.wall)
    try:
        model = spec.compile()
    except ValueError as error:
        raise RobotError(f"MuJoCo refuses the robot: {str(error)[:200]}") from None
    _set_inertias(mj, model, tree, scene.payload)
    return model


def _add_body(mj: ModuleType, carrier: Any, name: str, position: Array, rotation: Array) -> Any:
    """Add a body whose inertia `_set_inertias` will write."""
    body = carrier.add_body(name=name, pos=position, quat=_compute_quaternion(mj, rotation))
    _place_inertia(body, 1.0)
    return body


def _place_inertia(body: Any, scale: float) -> None:
    """Set a placeholder, because MuJoCo refuses identified inertias and treats centres at 0 specially."""
    body.explicitinertial = True
    body.mass, body.inertia = scale, scale * np.array([1.0, 1.1, 1.2])
    body.ipos, body.iquat = (0.1, 0.2, 0.3), (0.5, 0.5, -0.5, 0.5)


def _add_joint(mj: ModuleType, body: Any, tree: KinematicTree, i: int, stops: bool) -> Any:
    # A hinge or a slide, with the inertia of the robot's own rotor.
    kind = mj.mjtJoint.mjJNT_SLIDE if tree.joint_kinds[i] == "prismatic" else mj.mjtJoint.mjJNT_HINGE
    joint = body.add_joint(name=tree.joint_names[i], type=kind, axis=(0, 0, 1), armature=tree.armatures[i])
    # Stops at finite limits, if the scene has stops.
    ends = np.array([tree.lower[i], tree.upper[i]])
    limited = stops and bool(np.isfinite(ends).any())
    joint.limited = mj.mjtLimited.mjLIMITED_TRUE if limited else mj.mjtLimited.mjLIMITED_FALSE
    if limited:
        joint.range, joint.solref_limit = np.clip(ends, -RULES.far, RULES.far), (RULES.stop_time, 1.0)
        joint.solimp_limit[:2] = RULES.stop_impedance
    return joint


def _add_rotor(mj: ModuleType, spec: Any, joint: Any, i: int, numbers: tuple[Array, Array, Array]) -> Any:
    """Add a rotor as a joint in the world, and a spring between it and the robot's joint."""
    stiffness, inertia, damping = (float(part[i]) for part in numbers)
    # A body without weight, with the inertia of the rotor.
    body = spec.worldbody.add_body(name=f"rotor_body{i}", gravcomp=1.0)
    body.explicitinertial = True
    body.mass, body.inertia = inertia, (inertia, inertia, inertia)
    rotor = body.add_joint(name=rotor_name(joint.name), type=joint.type, axis=(0, 0, 1))
    rotor.limited = mj.mjtLimited.mjLIMITED_FALSE
    joint.armature = 0.0
    # The spring acts on the difference of the two angles.
    gear = spec.add_tendon(name=f"gear{i}", springlength=(0.0, 0.0))
    gear.stiffness[0], gear.damping[0] = stiffness, damping
    gear.wrap_joint(rotor.name, 1.0)
    gear.wrap_joint(joint.name, -1.0)
    return rotor


def _add_wall(mj: ModuleType, spec: Any, tip: Any, wall: Wall) -> None:
    """Add a sphere at the tip and a fixed box; no other geoms collide."""
    half = np.array([wall.size / 2, wall.size / 2, wall.thickness / 2])
    centre = wall.point - wall.normal * half[2]
    solref = (wall.time_constant, 1.0)
    box = spec.worldbody.add_geom(type=mj.mjtGeom.mjGEOM_BOX, size=half, pos=centre, name="wall", solref=solref)
    box.quat = _compute_quaternion(mj, rotate_z_to(wall.normal))
    size = (wall.tip_radius, 0, 0)
    tip.add_geom(type=mj.mjtGeom.mjGEOM_SPHERE, size=size, mass=0, name=HAND, solref=solref)


def _set_inertias(mj: ModuleType, model: Any, tree: KinematicTree, payload: Payload | None) -> None:
    """Write masses, centres and principal moments of inertia, and values that MuJoCo derives from them."""
    bodies = {body_name(i): (tree.masses[i], tree.centres[i], tree.inertias[i]) for i in range(tree.n)}
    nothing = (0.0, np.zeros(3), np.zeros((3, 3)))
    bodies[TIP] = nothing if payload is None else (payload.mass, payload.centre, payload.inertia)
    for name, (mass, centre, inertia) in bodies.items():
        moments, axes = np.linalg.eigh((inertia + inertia.T) / 2)
        # Make the axes a rotation, with determinant +1.
        axes[:, 2] *= np.linalg.det(axes)
        k = model.body(name).id
        model.body_mass[k], model.body_ipos[k], model.body_inertia[k] = mass, centre, moments
        model.body_iquat[k] = _compute_quaternion(mj, axes)
    mj.mj_setConst(model, mj.MjData(model))


def _compute_quaternion(mj: ModuleType, rotation: Array) -> Array:
    quaternion = np.zeros(4)
    mj.mju_mat2Quat(quaternion, np.ascontiguousarray(rotation, dtype=float).ravel())
    return quaternion


class MuJoCoPlant(Shown):
    """A robot in MuJoCo that holds a torque for a tick and then reports its state; fast enough for long runs.

    M ddq + C dq + g = clip(torque) + loads + pushes - friction, with stops at the joint limits. The physics takes
    fourth-order steps (RK4). They are shorter where viscous friction is stiff for the inertia of a joint
    (docs/reference/simulation.md). Not thread-safe. Needs the extra `orthocas[mujoco]`.

    Args:
        robot: the true robot.
        friction: viscous friction becomes MuJoCo's joint damping, Coulomb friction its `frictionloss`.
        stops: whether joints stop at their position limits.
        effort_limits: whether motors saturate at the robot's effort limits.
        payload: a body fixed at the tip.
        wall: a wall that the tip may touch.
        timestep: longest step of the physics [s], from 1e-6 to 0.01.
        elasticity: elasticity of the gears; default: rigid. Motors and friction then act on rotors, which springs
            couple to the joints.

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
        timestep: float = RULES.timestep,
        elasticity: Elasticity | None = None,
    ) -> None:
        require_kind("robot", robot, Robot)
        scene = MuJoCo(robot, stops, effort_limits, payload, wall, timestep, elasticity)
        friction = Friction() if friction is None else friction
        require_kind("friction", friction, Friction)
        viscous, coulomb, extra, _ = np.split(friction.numbers(robot.n), 4)
        if extra.any():
            raise InvalidValueError(
                "breakaway", friction.breakaway, "no breakaway friction, which only StickingPlant has"
            )
        self.robot, self.elasticity = robot, elasticity
        #: MuJoCo's model and data, for renderers and for inspection; only `step` may change them
        self.model: Any = mujoco_model(robot.tree, scene, viscous, coulomb)
        self.data: Any = mujoco().MjData(self.model)
        self._step = mujoco().mj_step
        self._timestep = float(timestep)
        self._dofs = self._find_dofs(robot.joint_names)
        #: indices of the velocities that motors drive: of the robot's joints, or of their rotors
        self._motors = self._dofs if elasticity is None else self._find_dofs(map(rotor_name, robot.joint_names))
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
        """Positions of the rotors, as motor encoders measure them, (n,); equal to q with rigid gears."""
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
        """Motor torque in the last step, after saturation (n,) [N m] or [N]."""
        return np.asarray(self.data.qfrc_actuator[self._motors])

    @property
    def acceleration(self) -> Array:
        """Joint accelerations under the torque and the loads of the last step, (n,) [rad/s^2] or [m/s^2]."""
        mujoco().mj_forward(self.model, self.data)
        return np.asarray(self.data.qacc[self._dofs])

    @property
    def bias(self) -> Array:
        """C dq + g with the payload, (n,) [N m] or [N], a copy. At rest, this torque holds the arm."""
        return np.array(self.data.qfrc_bias[self._dofs])

    @property
    def contact_force(self) -> Array:
        """Force of the wall on the tip in the last step, in the world, (3,) [N]; zero without contact."""
        total, wrench = np.zeros(3), np.zeros(6)
        for k in range(self.data.ncon):
            mujoco().mj_contactForce(self.model, self.data, k, wrench)
            contact = self.data.contact[k]
            # MuJoCo's contact force acts on the second geom.
            sign = 1.0 if contact.geom[1] == self.model.geom(HAND).id else -1.0
            total += sign * np.reshape(contact.frame, (3, 3)).T @ wrench[:3]
        return total

    def reset(self, q: ArrayLike, dq: ArrayLike | None = None) -> None:
        """Restart at joint positions (n,) and velocities (n,) (default: at rest), at time 0 and without pushes.

        Rotors of elastic gears start where their springs hold the robot's own weight.

        Raises:
            ShapeError, InvalidValueError: for invalid states.
        """
        q = as_point("q", q, self.robot.n)
        dq = np.zeros(self.robot.n) if dq is None else as_point("dq", dq, self.robot.n)
        mujoco().mj_resetData(self.model, self.data)
        for warning in self.data.warning:
            # MuJoCo prints and logs only the first warning, so set the count to 1; `step` raises an error instead.
            warning.number = 1
        if self.elasticity is not None:
            sag = np.asarray(self.robot.gravity(q), dtype=float) / self.elasticity.numbers(self.robot.n)[0]
            self.data.qpos[self._motors], self.data.qvel[self._motors] = q + sag, dq
        self.data.qpos[self._dofs], self.data.qvel[self._dofs] = q, dq
        mujoco().mj_forward(self.model, self.data)
        self._choose_integrator()

    def _choose_integrator(self) -> None:
        """Choose physics steps of at most 1 / rate, where rate is the largest eigenvalue of M^-1 D at the start.

        RK4 is stable up to 2.8 / rate. If 1 / rate is less than an eighth of the longest step, a first-order implicit
        method takes steps of an eighth. With both methods, springs K require steps of at most 1 / frequency, where
        frequency^2 is the largest eigenvalue of M^-1 K.
        """
        # D and K of all joints and rotors, and the largest eigenvalues of M^-1 D and M^-1 K.
        M, D = np.zeros((self.model.nv,) * 2), np.diag(self.model.dof_damping)
        mujoco().mj_fullM(self.model, self.data, M)
        K = np.zeros_like(D)
        if self.elasticity is not None:
            stiffness, _, damping = self.elasticity.numbers(self.robot.n)
            across, rows = np.zeros((self.robot.n, self.model.nv)), np.arange(self.robot.n)
            across[rows, self._motors], across[rows, self._dofs] = 1.0, -1.0
            D, K = D + across.T * damping @ across, across.T * stiffness @ across
        damped, squared = (
            self._timestep * float(np.linalg.eigvals(np.linalg.solve(M, part)).real.max()) if part.any() else 0.0
            for part in (D, K)
        )
        # Number of parts of the longest step for which the method is stable.
        parts = max(
            min(ceil(min(damped, RULES.most_parts + 1)), RULES.most_parts), ceil(sqrt(self._timestep * squared)), 1
        )
        kinds = mujoco().mjtIntegrator
        self.model.opt.integrator = kinds.mjINT_RK4 if damped <= RULES.most_parts else kinds.mjINT_IMPLICITFAST
        self._longest = self._timestep / parts

    def _find_dofs(self, names: Iterable[str]) -> NDArray[np.intp]:
        """Indices of joints among all velocities of the model."""
        return np.array([self.model.joint(name).dofadr[0] for name in names])

    def push(self, force: ArrayLike, link: Link = None, point: ArrayLike = (0.0, 0.0, 0.0)) -> None:
        """Push from now on, in addition to other pushes, until `release`.

        Args:
            force: in world axes, (3,) [N].
            link: the link, by the name or the index of the joint that moves it; default: the tip.
            point: point where the force acts, in the frame of the link, or of the tip, (3,) [m]. Frames of links are
                those of `robot.tree`: the origin lies on the joint's axis, which is z.

        Raises:
            ShapeError, InvalidValueError, UnknownNameError: for invalid forces, points or links.
        """
        force = freeze_array("force", force, (3,))
        body, at = place_of(self.robot.tree, link, freeze_array("point", point, (3,)))
        if body < 0:
            # The tip is fixed to the world, so a push has no effect.
            return
        handle = self._handles[body]
        applied = self.data.xfrc_applied[handle]
        if not applied.any():
            # The handle has no mass, so its centre can be placed at the point of the force.
            self.model.body_ipos[handle] = at
        else:
            # A further push at this link adds its force, and its torque about the first point.
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
            torque: motor torque, (n,) [N m] or [N].
            seconds: > 0 [s]; divided into equal physics steps, none longer than `timestep`.
            loads: additional joint torques, which do not saturate, (n,) [N m] or [N].

        Raises:
            ShapeError, InvalidValueError: for torques that are not (n,) or not finite, and for ticks that are too long.
            SimulationError: if the state has diverged.
        """
        data = self.data
        data.ctrl[:] = self._check("torque", torque)
        data.qfrc_applied[self._dofs] = 0.0 if loads is None else self._check("loads", loads)
        steps = count_steps(seconds, self._longest)
        self.model.opt.timestep = seconds / steps
        self._step(self.model, data, steps)
        if not data.qvel @ data.qvel < RULES.runaway**2:
            raise SimulationError(
                f"the simulation diverged at {self.time:g} s: joint velocities beyond {RULES.runaway:g}"
            )

    def _check(self, name: str, value: ArrayLike) -> Array:
        """Check joint torques (n,). MuJoCo would replace NaN and very large torques by 0."""
        if type(value) is not np.ndarray or value.shape != (self.robot.n,) or value.dtype != float:
            value = as_point(name, value, self.robot.n)
        if not np.abs(value).max() < RULES.largest:
            raise InvalidValueError(name, value.tolist(), f"numbers up to {RULES.largest:g}")
        return value
