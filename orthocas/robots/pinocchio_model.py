"""`pin.Model`: planar arms with uniform links as one, and any one as the numbers of a `KinematicTree`."""

from collections.abc import Sequence

import numpy as np
import pinocchio as pin

from orthocas.errors import InvalidValueError, RobotError
from orthocas.robots.spatial import rotation_z_to, snap
from orthocas.robots.tree import JointKind, KinematicTree, on_moving_base
from orthocas.tools.checks import Array, frozen_array, require_known

LINKS = (pin.FrameType.BODY, pin.FrameType.OP_FRAME)  #: links of URDF, bodies and sites of MJCF
_UNLIMITED = 1e10  # Pinocchio uses the largest double for "no limit"
TIP = "tip"
GRAVITY = 9.81  #: [m/s^2]


def tree_from_model(model: pin.Model, *tips: str, base: str | None = None) -> KinematicTree:
    """Read joints, bodies, limits, tips and links from a Pinocchio model, whose base may move; see `on_moving_base`.

    Raises:
        UnknownNameError: if there is no frame with the name of a tip.
        RobotError: if a joint is not revolute, continuous or prismatic. The message names it.
    """
    tip = model.frames[frame_index(model, tips[0])]
    links = (frame.name for frame in model.frames if frame.type in LINKS and frame.name.isprintable())
    names = dict.fromkeys(name for name in (*tips, *links) if name != tips[0])
    further = [model.frames[frame_index(model, name)] for name in names]
    axes = [joint_axis(model, i) for i in range(1, model.njoints)]
    turns = [np.eye(3)] + [rotation_z_to(axis) for _, axis in axes]  # body frame -> frame with the axis along z
    bodies = range(1, model.njoints)
    placed = [(turns[frame.parentJoint].T, frame.placement) for frame in (tip, *further)]
    rotations = [snap(across @ place.rotation) for across, place in placed]
    translations = [across @ place.translation for across, place in placed]
    continuous = [model.joints[i].nq == 2 for i in bodies]
    tree = KinematicTree(
        joint_names=tuple(model.names[i] for i in bodies),
        joint_kinds=tuple(kind for kind, _ in axes),
        parents=tuple(model.parents[i] - 1 for i in bodies),
        rotations=np.array(
            [snap(turns[model.parents[i]].T @ model.jointPlacements[i].rotation @ turns[i]) for i in bodies]
        ),
        translations=np.array([turns[model.parents[i]].T @ model.jointPlacements[i].translation for i in bodies]),
        masses=np.array([model.inertias[i].mass for i in bodies]),
        centres=np.array([turns[i].T @ model.inertias[i].lever for i in bodies]),
        inertias=np.array([turns[i].T @ model.inertias[i].inertia @ turns[i] for i in bodies]),
        armatures=np.array([model.armature[model.joints[i].idx_v] for i in bodies]),
        lower=_limits(model, model.lowerPositionLimit, continuous, -np.inf),
        upper=_limits(model, model.upperPositionLimit, continuous, np.inf),
        effort_limits=_largest(model, "effort", model.effortLimit),
        velocity_limits=_largest(model, "velocity", model.velocityLimit),
        tip_name=tip.name,
        tip_parent=tip.parentJoint - 1,
        tip_rotation=rotations[0],
        tip_translation=translations[0],
        gravity=np.array(model.gravity.linear),
        tips=tuple(tips[1:]),
        frame_names=tuple(frame.name for frame in further),
        frame_parents=tuple(frame.parentJoint - 1 for frame in further),
        frame_rotations=np.array(rotations[1:]).reshape(-1, 3, 3),
        frame_translations=np.array(translations[1:]).reshape(-1, 3),
    )
    own = model.inertias[0]  # links that no joint of the file moves
    return tree if base is None else on_moving_base(tree, base, own.mass, own.lever, own.inertia)


def frame_index(model: pin.Model, name: str) -> int:
    """Index of a frame. If they share a name, a link is preferred to a site, and a site to a joint.

    Raises:
        UnknownNameError: if there is no such frame.
    """
    require_known("frame", name, [frame.name for frame in model.frames])
    found = [i for i, frame in enumerate(model.frames) if frame.name == name]
    kinds = {i: model.frames[i].type for i in found}
    return min(found, key=lambda i: (kinds[i] != pin.FrameType.BODY, kinds[i] == pin.FrameType.JOINT))


def joint_axis(model: pin.Model, i: int) -> tuple[JointKind, Array]:
    """Kind and axis of joint i, from its motion subspace.

    Raises:
        RobotError: if the joint is not revolute, continuous or prismatic. The message says which joint to lock.
    """
    joint, name = model.joints[i], model.names[i]
    if i in set(model.mimicking_joints):
        leader = model.names[leader_of(model, i)]
        raise RobotError(f"joint '{name}' is a mimic joint, expected independent joints: {remedy(leader)}")
    if joint.nv != 1:
        raise RobotError(
            f"joint '{name}' is of type {joint.shortname()} with {joint.nv} degrees of freedom, "
            f"expected revolute, continuous or prismatic joints: {remedy(name)}"
        )
    data = joint.createData()
    joint.calc(data, pin.neutral(model))
    subspace = np.asarray(data.S).ravel()
    linear, angular = subspace[:3], subspace[3:]
    if not linear.any():
        return "revolute", angular
    if not angular.any():
        return "prismatic", linear
    raise RobotError(f"joint '{name}' is helical, expected revolute, continuous or prismatic joints: {remedy(name)}")


def leader_of(model: pin.Model, mimic: int) -> int:
    """The joint that a mimic joint follows."""
    return int(model.mimicked_joints[list(model.mimicking_joints).index(mimic)])


def remedy(joint: str) -> str:
    """Instructions for locking a joint, in Python and on the command line."""
    return f"lock it with locked={{'{joint}': 0.0}} or --lock {joint}=0"


def _limits(model: pin.Model, limits: Array, continuous: list[bool], unlimited: float) -> Array:
    """Position limits, one per joint. A continuous joint has none."""
    values = [unlimited if free else limits[model.joints[i + 1].idx_q] for i, free in enumerate(continuous)]
    return np.array([unlimited if abs(value) > _UNLIMITED else value for value in values])


def _largest(model: pin.Model, what: str, limits: Array) -> Array:
    """Limits of effort or velocity, one per joint. 0 means no limit: many files use it as a placeholder.

    Raises:
        RobotError: if a limit is negative or NaN. The message names the joint.
    """
    values = np.array([limits[joint.idx_v] for joint in model.joints[1:]])
    for name, value in zip(list(model.names)[1:], values, strict=True):
        if not value >= 0:
            raise RobotError(f"joint '{name}' has the {what} limit {value:g}, expected a number >= 0 (0: unlimited)")
    return np.where((values > 0) & (values < _UNLIMITED), values, np.inf)


def planar_model(lengths: Sequence[float], masses: Sequence[float]) -> pin.Model:
    """A chain in the x-y plane with joints about z. At q = 0 it lies along x; gravity points along -y.

    Each link is a thin rod with uniform mass: I = m l^2 / 12 about its centre.

    Args:
        lengths: link lengths [m], > 0.
        masses: link masses [kg], > 0, one per link.

    Raises:
        ShapeError: if the two differ in length.
        InvalidValueError: if a number is not positive.

    Source:
        [AS2023] Fig. 5 and Sec. 8.
    """
    lengths = frozen_array("lengths", lengths, (None,)).tolist()
    masses = frozen_array("masses", masses, (len(lengths),)).tolist()
    for name, values in (("lengths", lengths), ("masses", masses)):
        if not values or min(values) <= 0:
            raise InvalidValueError(name, values, "positive numbers, one per link")
    model = pin.Model()
    model.name = f"planar_{len(lengths)}r"
    model.gravity.linear = np.array([0.0, -GRAVITY, 0.0])
    parent, offset = 0, 0.0
    limit = np.full(1, np.inf)
    for i, (length, mass) in enumerate(zip(lengths, masses, strict=True)):
        placement = pin.SE3(np.eye(3), np.array([offset, 0.0, 0.0]))
        parent = model.addJoint(parent, pin.JointModelRZ(), placement, f"q{i + 1}", limit, limit, -limit, limit)
        across = mass * length**2 / 12
        rod = pin.Inertia(mass, np.array([length / 2, 0.0, 0.0]), np.diag([0.0, across, across]))
        model.appendBodyToJoint(parent, rod, pin.SE3.Identity())
        offset = length
    model.addFrame(pin.Frame(TIP, parent, pin.SE3(np.eye(3), np.array([offset, 0.0, 0.0])), pin.FrameType.OP_FRAME))
    return model
