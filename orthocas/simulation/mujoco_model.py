"""A MuJoCo model of a robot, made from the numbers of its kinematic tree, so that it needs no robot file."""

from types import ModuleType
from typing import Any

import numpy as np

from orthocas.checks import Array, of_extra
from orthocas.errors import RobotError
from orthocas.robots import KinematicTree
from orthocas.robots.spatial import rotation_z_to
from orthocas.simulation.mujoco_scene import MuJoCo, Payload, Wall

TIP = "tip"  #: name of the body at the tip frame; it carries the payload
HAND = "hand"  #: name of the geom at the tip that touches the wall
_STOP_TIME = 0.004  # [s] time constant of the stops, critically damped; MuJoCo's is 0.02 ...
_STOP_IMPEDANCE = (0.99, 0.999)  # ... and 0.9 to 0.95, which lets a motor press a light wrist 0.1 rad beyond its stop
_FRICTION_IMPEDANCE = (0.999, 0.999)  # with MuJoCo's, a light wrist creeps at 0.4 rad/s below its friction
_FAR = 1e9  # [rad] or [m]: MuJoCo's ranges have two ends


def mujoco() -> ModuleType:
    """The package `mujoco`, which only simulations with MuJoCo need.

    Raises:
        MissingExtraError: if it is not installed.
    """
    return of_extra("mujoco", "MuJoCo as plant", "sim")


def body_name(i: int) -> str:
    """Name of the body that joint i moves."""
    return f"body{i}"


def rotor_name(i: int) -> str:
    """Name of the joint of rotor i, with elasticity."""
    return f"rotor{i}"


def handle_name(i: int) -> str:
    """Name of the massless body where pushes at body i act."""
    return f"handle{i}"


def mujoco_model(tree: KinematicTree, scene: MuJoCo, viscous: Array, coulomb: Array) -> Any:
    """An `mjModel` with the dynamics of a tree: M ddq + C dq + g = u - friction + loads.

    Joint i is "joint<i>", moved by the motor "motor<i>" (gear 1), and carries "body<i>" and the massless "handle<i>",
    where pushes act. The tip frame is the body "tip". With elasticity, the motor turns "rotor<i>", which the spring
    "gear<i>" couples to the joint; friction then acts at the rotor.

    Args:
        tree: the robot.
        scene: what else there is: stops, limits of effort, a payload, a wall.
        viscous: joint damping (n,) [N m s/rad] or [N s/m].
        coulomb: dry friction (n,) [N m] or [N], a constraint that MuJoCo solves (`frictionloss`).

    Raises:
        MissingExtraError: if mujoco is not installed.
        RobotError: if MuJoCo refuses the model.
    """
    mj = mujoco()
    spec = mj.MjSpec()
    spec.compiler.degree = False
    spec.option.gravity = tree.gravity
    spec.option.disableflags |= mj.mjtDisableBit.mjDSBL_AUTORESET  # a run that diverges must say so
    bodies: list[Any] = []
    for i, parent in enumerate(tree.parents):
        carrier = bodies[parent] if parent >= 0 else spec.worldbody
        bodies.append(_add_body(mj, carrier, body_name(i), tree.translations[i], tree.rotations[i]))
        _place_inertia(bodies[i].add_body(name=handle_name(i)), 0.0)
        joint = _add_joint(mj, bodies[i], tree, i, scene.stops)
        moved = joint if scene.elasticity is None else _add_rotor(mj, spec, joint, i, scene.elasticity.numbers(tree.n))
        _add_friction(moved, viscous[i], coulomb[i])
        _add_motor(mj, spec, moved.name, i, tree.effort_limits[i] if scene.effort_limits else np.inf)
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
    """A body whose inertia is `_set_inertias`'s to write."""
    body = carrier.add_body(name=name, pos=position, quat=_quaternion(mj, rotation))
    _place_inertia(body, 1.0)
    return body


def _place_inertia(body: Any, scale: float) -> None:
    """A placeholder: MuJoCo would refuse identified inertias, and take short cuts with a centre at the origin."""
    body.explicitinertial = True
    body.mass, body.inertia = scale, scale * np.array([1.0, 1.1, 1.2])
    body.ipos, body.iquat = (0.1, 0.2, 0.3), (0.5, 0.5, -0.5, 0.5)


def _add_joint(mj: ModuleType, body: Any, tree: KinematicTree, i: int, stops: bool) -> Any:
    kind = mj.mjtJoint.mjJNT_SLIDE if tree.joint_kinds[i] == "prismatic" else mj.mjtJoint.mjJNT_HINGE
    joint = body.add_joint(name=f"joint{i}", type=kind, axis=(0, 0, 1), armature=tree.armatures[i])
    ends = np.array([tree.lower[i], tree.upper[i]])
    limited = stops and bool(np.isfinite(ends).any())
    joint.limited = mj.mjtLimited.mjLIMITED_TRUE if limited else mj.mjtLimited.mjLIMITED_FALSE
    if limited:
        joint.range, joint.solref_limit = np.clip(ends, -_FAR, _FAR), (_STOP_TIME, 1.0)
        joint.solimp_limit[:2] = _STOP_IMPEDANCE
    return joint


def _add_rotor(mj: ModuleType, spec: Any, joint: Any, i: int, numbers: tuple[Array, Array, Array]) -> Any:
    """A joint of its own in the world, with the inertia of a rotor, and a spring between it and the robot's joint."""
    stiffness, inertia, damping = (float(part[i]) for part in numbers)
    body = spec.worldbody.add_body(name=f"rotor_body{i}", gravcomp=1.0)
    body.explicitinertial = True
    body.mass, body.inertia = inertia, (inertia, inertia, inertia)
    rotor = body.add_joint(name=rotor_name(i), type=joint.type, axis=(0, 0, 1))
    rotor.limited = mj.mjtLimited.mjLIMITED_FALSE
    joint.armature = 0.0
    gear = spec.add_tendon(name=f"gear{i}", springlength=(0.0, 0.0))
    gear.stiffness[0], gear.damping[0] = stiffness, damping
    gear.wrap_joint(rotor.name, 1.0)
    gear.wrap_joint(joint.name, -1.0)
    return rotor


def _add_friction(joint: Any, viscous: float, coulomb: float) -> None:
    joint.damping[0], joint.frictionloss = viscous, coulomb
    joint.solimp_friction[:2] = _FRICTION_IMPEDANCE


def _add_motor(mj: ModuleType, spec: Any, target: str, i: int, limit: float) -> None:
    motor = spec.add_actuator(name=f"motor{i}", target=target, trntype=mj.mjtTrn.mjTRN_JOINT)
    motor.set_to_motor()
    if np.isfinite(limit):
        motor.forcelimited, motor.forcerange = mj.mjtLimited.mjLIMITED_TRUE, (-limit, limit)


def _add_wall(mj: ModuleType, spec: Any, tip: Any, wall: Wall) -> None:
    """A sphere at the tip and a fixed box; nothing else touches anything."""
    half = np.array([wall.size / 2, wall.size / 2, wall.thickness / 2])
    centre = wall.point - wall.normal * half[2]
    solref = (wall.time_constant, 1.0)
    box = spec.worldbody.add_geom(type=mj.mjtGeom.mjGEOM_BOX, size=half, pos=centre, name="wall", solref=solref)
    box.quat = _quaternion(mj, rotation_z_to(wall.normal))
    size = (wall.tip_radius, 0, 0)
    tip.add_geom(type=mj.mjtGeom.mjGEOM_SPHERE, size=size, mass=0, name=HAND, solref=solref)


def _set_inertias(mj: ModuleType, model: Any, tree: KinematicTree, payload: Payload | None) -> None:
    """Write masses, centres and principal moments of inertia, and what MuJoCo derives from them."""
    bodies = {body_name(i): (tree.masses[i], tree.centres[i], tree.inertias[i]) for i in range(tree.n)}
    nothing = (0.0, np.zeros(3), np.zeros((3, 3)))
    bodies[TIP] = nothing if payload is None else (payload.mass, payload.centre, payload.inertia)
    for name, (mass, centre, inertia) in bodies.items():
        moments, axes = np.linalg.eigh((inertia + inertia.T) / 2)
        axes[:, 2] *= np.linalg.det(axes)  # +-1: a rotation
        k = model.body(name).id
        model.body_mass[k], model.body_ipos[k], model.body_inertia[k] = mass, centre, moments
        model.body_iquat[k] = _quaternion(mj, axes)
    mj.mj_setConst(model, mj.MjData(model))


def _quaternion(mj: ModuleType, rotation: Array) -> Array:
    quaternion = np.zeros(4)
    mj.mju_mat2Quat(quaternion, np.ascontiguousarray(rotation, dtype=float).ravel())
    return quaternion
