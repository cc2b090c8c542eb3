"""Work with a `pin.Model`: convert it to a `KinematicTree`, lock joints, find tips and postures, build planar arms."""

import logging
import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from orthocas.errors import InvalidValueError, RobotError, TipWarning, degrees_hint, warn_caller
from orthocas.robots.spatial import rotate_z_to, snap
from orthocas.robots.tree import BASE_JOINTS, JointKind, KinematicTree, place_on_base
from orthocas.tools.checks import Array, freeze_array, require_known

_log = logging.getLogger(__name__)

LINKS = (pin.FrameType.BODY, pin.FrameType.OP_FRAME)  #: frames of links in URDF, of bodies and sites in MJCF
_ROUNDED = 1e-6  #: [rad] or [m], by which a locked joint may be beyond its limits: files round 170 degrees
_UNLIMITED = 1e10  #: limits above this count as infinite: Pinocchio uses the largest double
_GRIPPER = re.compile("gripper|finger|jaw", re.IGNORECASE)
_FINGER = re.compile("finger|jaw", re.IGNORECASE)
_SHAPE = re.compile("_sc$|collision", re.IGNORECASE)  #: names of frames that only stand for shapes in collision checks
_TOOL = re.compile("tool|tcp|end_?effector|eef|(^|_)ee(_|$)", re.IGNORECASE)
_SHORTEST_ARM = 3  #: a hand needs an arm with more joints than this before it
WORLD = "universe"  #: Pinocchio's name for what does not move
TIP = "tip"
GRAVITY = 9.81  #: [m/s^2]


class Mimic(NamedTuple):
    """How a joint follows an independent one: its position is factor * (position of the leader) + offset."""

    leader: str
    factor: float
    offset: float  #: [rad] or [m]


Mimics = Mapping[str, Mimic]  #: keys: names of the joints that follow


def resolve_mimics(direct: Mimics) -> dict[str, Mimic]:
    """Map each following joint to its independent leader. Leaders in `direct` may themselves follow others.

    Raises:
        RobotError: if joints follow each other in a loop.
    """
    resolved = {}
    for name in direct:
        leader, factor, offset, passed = name, 1.0, 0.0, set[str]()
        while leader in direct:
            if leader in passed:
                raise RobotError(f"joint '{name}' mimics itself")
            passed.add(leader)
            step = direct[leader]
            offset += factor * step.offset
            factor *= step.factor
            leader = step.leader
        resolved[name] = Mimic(leader, factor, offset)
    return resolved


def build_tree(model: pin.Model, *tips: str, base: str | None = None, mimics: Mimics | None = None) -> KinematicTree:
    """Read joints, bodies, limits, tips and links from a Pinocchio model. Its base may move; see `place_on_base`.

    Joints of `mimics` follow their leaders. The limits of each leader are narrowed so that its followers keep theirs.

    Raises:
        UnknownNameError: if there is no frame with the name of a tip.
        RobotError: if a joint is not revolute, continuous or prismatic. The message names it.
    """
    tip = model.frames[find_frame(model, tips[0])]
    links = (frame.name for frame in model.frames if frame.type in LINKS and frame.name.isprintable())
    names = dict.fromkeys(name for name in (*tips, *links) if name != tips[0])
    further = [model.frames[find_frame(model, name)] for name in names]
    axes = [find_axis(model, i) for i in range(1, model.njoints)]
    # Each body frame is turned so that the joint's axis is its z axis.
    turns = [np.eye(3)] + [rotate_z_to(axis) for _, axis in axes]
    # Independent joints come first, then the mimic joints.
    follow = {model.getJointId(name): mimic for name, mimic in (mimics or {}).items() if model.existJointName(name)}
    leaders = [i for i in range(1, model.njoints) if i not in follow]
    followers = [i for i in range(1, model.njoints) if i in follow]
    bodies = [*leaders, *followers]
    place_of = {0: -1} | {i: place for place, i in enumerate(bodies)}
    led = [place_of[model.getJointId(follow[i].leader)] for i in followers]
    lower, upper, velocities = _find_limits(model, bodies, [follow[i] for i in followers], led)
    placed = [(turns[frame.parentJoint].T, frame.placement) for frame in (tip, *further)]
    rotations = [snap(across @ place.rotation) for across, place in placed]
    translations = [across @ place.translation for across, place in placed]
    tree = KinematicTree(
        joint_names=tuple(model.names[i] for i in leaders),
        joint_kinds=tuple(axes[i - 1][0] for i in leaders),
        parents=tuple(place_of[model.parents[i]] for i in bodies),
        rotations=np.array(
            [snap(turns[model.parents[i]].T @ model.jointPlacements[i].rotation @ turns[i]) for i in bodies]
        ),
        translations=np.array([turns[model.parents[i]].T @ model.jointPlacements[i].translation for i in bodies]),
        masses=np.array([model.inertias[i].mass for i in bodies]),
        centres=np.array([turns[i].T @ model.inertias[i].lever for i in bodies]),
        inertias=np.array([turns[i].T @ model.inertias[i].inertia @ turns[i] for i in bodies]),
        armatures=np.array([model.armature[model.joints[i].idx_v] for i in bodies]),
        lower=lower,
        upper=upper,
        effort_limits=_read_largest(model, leaders, "effort", model.effortLimit),
        velocity_limits=velocities,
        tip_name=tip.name,
        tip_parent=place_of[tip.parentJoint],
        tip_rotation=rotations[0],
        tip_translation=translations[0],
        gravity=np.array(model.gravity.linear),
        tips=tuple(tips[1:]),
        frame_names=tuple(frame.name for frame in further),
        frame_parents=tuple(place_of[frame.parentJoint] for frame in further),
        frame_rotations=np.array(rotations[1:]).reshape(-1, 3, 3),
        frame_translations=np.array(translations[1:]).reshape(-1, 3),
        mimic_names=tuple(model.names[i] for i in followers),
        mimic_kinds=tuple(axes[i - 1][0] for i in followers),
        mimic_leaders=tuple(led),
        mimic_factors=np.array([follow[i].factor for i in followers]),
        mimic_offsets=np.array([follow[i].offset for i in followers]),
    )
    # The moving base itself has the links that no joint of the file moves.
    own = model.inertias[0]
    return tree if base is None else place_on_base(tree, base, own.mass, own.lever, own.inertia)


def find_frame(model: pin.Model, name: str) -> int:
    """Index of a frame. If they share a name, a link is preferred to a site, and a site to a joint.

    Raises:
        UnknownNameError: if there is no such frame.
    """
    require_known("frame", name, [frame.name for frame in model.frames])
    candidates = [i for i, frame in enumerate(model.frames) if frame.name == name]
    kinds = {i: model.frames[i].type for i in candidates}
    return min(candidates, key=lambda i: (kinds[i] != pin.FrameType.BODY, kinds[i] == pin.FrameType.JOINT))


def find_axis(model: pin.Model, i: int) -> tuple[JointKind, Array]:
    """Kind and axis of joint i, from its motion subspace.

    Raises:
        RobotError: if the joint is not revolute, continuous or prismatic. The message says which joint to lock.
    """
    joint, name = model.joints[i], model.names[i]
    if i in set(model.mimicking_joints):
        leader = model.names[find_leader(model, i)]
        hint = f"{suggest_lock(leader)}, or read the file with Robot.from_urdf"
        raise RobotError(f"joint '{name}' of the model is a mimic joint, expected independent joints: {hint}")
    if joint.nv != 1:
        raise RobotError(
            f"joint '{name}' is of type {joint.shortname()} with {joint.nv} degrees of freedom, "
            f"expected revolute, continuous or prismatic joints: {suggest_lock(name)}"
        )
    # The motion subspace of a joint with one degree of freedom is a unit twist.
    data = joint.createData()
    joint.calc(data, pin.neutral(model))
    subspace = np.asarray(data.S).ravel()
    linear, angular = subspace[:3], subspace[3:]
    if not linear.any():
        return "revolute", angular
    if not angular.any():
        return "prismatic", linear
    raise RobotError(
        f"joint '{name}' is helical, expected revolute, continuous or prismatic joints: {suggest_lock(name)}"
    )


def find_leader(model: pin.Model, mimic: int) -> int:
    """The joint that a mimic joint follows."""
    return int(model.mimicked_joints[list(model.mimicking_joints).index(mimic)])


def suggest_lock(joint: str) -> str:
    """Instructions for locking a joint, in Python and on the command line."""
    return f"lock it with locked={{'{joint}': 0.0}} or --lock {joint}=0"


def _find_limits(
    model: pin.Model, bodies: list[int], follow: list[Mimic], led: list[int]
) -> tuple[Array, Array, Array]:
    """Lower and upper limits and largest speeds of the n independent joints, (n,), so that mimic joints keep theirs.

    With q_f = a q + b in [l, u], q lies between (l - b) / a and (u - b) / a, and |dq| is at most the speed limit over
    |a|. If the limits of a mimic joint leave its leader no range at all, they are ignored and logged, as in ROS. An
    endless joint is limited to [-pi, pi] if a full turn would not bring its mimic joints back to the same place.
    """
    n = len(bodies) - len(follow)
    # Read the limits of all joints, then narrow the leaders to the range of their mimic joints.
    ends: tuple[list[float], list[float]] = ([], [])
    for i in bodies:
        joint = model.joints[i]
        for side, limits, endless in ((0, model.lowerPositionLimit, -np.inf), (1, model.upperPositionLimit, np.inf)):
            # A continuous joint has no limits.
            value = endless if joint.nq == 2 else limits[joint.idx_q]
            ends[side].append(endless if abs(value) > _UNLIMITED else value)
    lower, upper = (np.array(values) for values in ends)
    speeds = _read_largest(model, bodies, "velocity", model.velocityLimit)
    for j, (mimic, leader) in enumerate(zip(follow, led, strict=True)):
        speeds[leader] = min(speeds[leader], speeds[n + j] / abs(mimic.factor))
        low, high = sorted((end[n + j] - mimic.offset) / mimic.factor for end in (lower, upper))
        low, high = max(float(lower[leader]), low), min(float(upper[leader]), high)
        # Full turns of an endless leader must bring the mimic joint back to the same place; otherwise limit the leader.
        slides, leads = (find_axis(model, i)[0] == "prismatic" for i in (bodies[n + j], bodies[leader]))
        if np.isinf([low, high]).all() and not leads and (slides or mimic.factor % 1):
            low, high = -np.pi, np.pi
        if low < high:
            lower[leader], upper[leader] = low, high
        else:
            name = model.names[bodies[n + j]]
            _log.warning("limits of joint '%s' leave '%s', which it mimics, no way: ignored", name, mimic.leader)
    return lower[:n], upper[:n], speeds[:n]


def _read_largest(model: pin.Model, ids: list[int], what: str, limits: Array) -> Array:
    """Limits of effort or velocity of joints. 0 means no limit: many files use it as a placeholder.

    Raises:
        RobotError: if a limit is negative or NaN. The message names the joint.
    """
    values = np.array([limits[model.joints[i].idx_v] for i in ids])
    for i, value in zip(ids, values, strict=True):
        if not value >= 0:
            joint = f"joint '{model.names[i]}'"
            raise RobotError(f"{joint} has the {what} limit {value:g}, expected a number >= 0 (0: unlimited)")
    return np.where((values > 0) & (values < _UNLIMITED), values, np.inf)


def lock_joints(model: pin.Model, locked: Mapping[str, float], mimics: Mimics | None = None) -> pin.Model:
    """Lock joints at the given positions [rad] or [m]. Joints that mimic a locked joint follow it.

    A joint with several degrees of freedom (floating, spherical, planar) is locked at its neutral position, given as 0.

    Raises:
        UnknownNameError: if there is no such joint.
        InvalidValueError: if a position is not finite, is beyond the limits of its joint, or looks like degrees.
        RobotError: if the joint mimics another one, or has several degrees of freedom and a position other than 0.
    """
    if not isinstance(locked, Mapping):
        raise InvalidValueError("locked", locked, "a mapping from joint names to positions")
    # Set each locked joint, and the joints that mimic it.
    names = list(model.names)[1:]
    position = pin.neutral(model)
    ids = []
    for name, value in locked.items():
        require_known("joint", name, names)
        if mimics and name in mimics:
            raise _refuse_lock(name, mimics[name].leader)
        if not isinstance(value, int | float | np.number) or not np.isfinite(value):
            raise InvalidValueError(f"locked position of joint '{name}'", repr(value), "a finite number")
        ids.append(model.getJointId(name))
        set_position(model, ids[-1], float(value), position)
        # A continuous joint has no limits, and equal limits are a placeholder.
        joint = model.joints[ids[-1]]
        if joint.nq == joint.nv == 1:
            lower, upper = model.lowerPositionLimit[joint.idx_q], model.upperPositionLimit[joint.idx_q]
            if lower < upper and not lower - _ROUNDED <= value <= upper + _ROUNDED:
                limits = f"a position within its limits [{lower:g}, {upper:g}]"
                raise InvalidValueError(f"locked position of joint '{name}'", f"{value:g}", limits)
    ids += [i for i in model.mimicking_joints if find_leader(model, i) in ids]
    for name, mimic in (mimics or {}).items():
        if mimic.leader in locked and name in names:
            ids.append(model.getJointId(name))
            set_position(model, ids[-1], mimic.factor * locked[mimic.leader] + mimic.offset, position)
    return fix_joints(model, ids, position) if ids else model


def lock_off_chain(model: pin.Model, *tips: str, mimics: Mimics | None = None) -> pin.Model:
    """Lock every joint that moves no tip, whatever its type, at its neutral position or the limit closest to zero.

    Leaders of mimic joints that move a tip are kept, and all joints that follow these leaders.

    Raises:
        UnknownNameError: if there is no frame with the name of a tip.
        RobotError: as in `lock_others`; also if the leader of a mimic joint is not in the model.
    """
    follow = {name: mimic for name, mimic in (mimics or {}).items() if model.existJointName(name)}
    chains = [model.supports[model.frames[find_frame(model, tip)].parentJoint] for tip in tips]
    moving = {model.names[i] for supports in chains for i in supports if i > 0}
    # A mimic joint on the chain needs its leader, wherever that is, and the leader moves its other mimic joints too.
    for name in sorted(moving & follow.keys()):
        if not model.existJointName(leader := follow[name].leader):
            raise RobotError(f"joint '{name}' mimics joint '{leader}', which the file does not have")
        moving.add(leader)
    moving |= {name for name, mimic in follow.items() if mimic.leader in moving}
    return lock_others(model, [i for i in range(1, model.njoints) if model.names[i] in moving], follow)


def lock_others(model: pin.Model, chain: list[int], mimics: Mimics | None = None) -> pin.Model:
    """Lock every joint outside a chain, whatever its type, at its neutral position or the limit closest to zero.

    Raises:
        RobotError: if a joint of the chain is not revolute, continuous or prismatic. The message names it.
    """
    for i in chain:
        find_axis(model, i)
    # Put all other joints at neutral, moved into their limits.
    ids = [i for i in range(1, model.njoints) if i not in chain]
    position, following = pin.neutral(model), set(model.mimicking_joints)
    for i in ids:
        joint = model.joints[i]
        if joint.nq == joint.nv == 1 and i not in following:
            limits = model.lowerPositionLimit[joint.idx_q], model.upperPositionLimit[joint.idx_q]
            position[joint.idx_q] = np.clip(0.0, *limits)
    # Put mimic joints where their leaders take them.
    for i in ids:
        if mimic := (mimics or {}).get(model.names[i]):
            k = model.getJointId(mimic.leader)
            leads = k < model.njoints and model.joints[k].nq == model.joints[k].nv == 1
            at = float(position[model.joints[k].idx_q]) if leads else 0.0
            set_position(model, i, mimic.factor * at + mimic.offset, position)
    return fix_joints(model, ids, position) if ids else model


def fix_joints(model: pin.Model, ids: list[int], position: Array) -> pin.Model:
    """The model with some joints fixed at a configuration.

    Pinocchio looks up joints by name among all frames, and in a model a body, a site and a joint may share a name. So
    all frames that are not joints get unique names while joints are fixed.

    Raises:
        RobotError: if a joint has the name of Pinocchio's world.
    """
    if WORLD in list(model.names)[1:]:
        raise RobotError(f"a joint is called '{WORLD}', which is reserved when joints are locked: rename the joint")
    # Rename frames other than joints for now.
    renamed, names = model.copy(), {}
    for i, frame in enumerate(renamed.frames):
        if i > 0 and frame.type != pin.FrameType.JOINT:
            unique = f"{i}\n{frame.name}"
            names[unique], frame.name = frame.name, unique
    reduced = pin.buildReducedModel(renamed, ids, position)
    for frame in reduced.frames:
        frame.name = names.get(frame.name, frame.name)
    return reduced


def set_position(model: pin.Model, i: int, value: float, position: Array) -> None:
    """Write a joint position into a configuration. Pinocchio stores cos and sin of a continuous joint."""
    joint, name = model.joints[i], model.names[i]
    if i in set(model.mimicking_joints):
        raise _refuse_lock(name, model.names[find_leader(model, i)])
    if joint.nv != 1:
        if value != 0:
            raise RobotError(
                f"locked position of joint '{name}' is {value:g}, expected 0: "
                f"a joint with {joint.nv} degrees of freedom can only be locked at its neutral position"
            )
        return
    # A large angle is probably in degrees.
    turns = joint.shortname().startswith("JointModelR")
    if turns and (hint := degrees_hint(value)):
        raise InvalidValueError(f"locked position of joint '{name}'", f"{value:g}", f"an angle in radians{hint}")
    position[joint.idx_q : joint.idx_q + joint.nq] = (np.cos(value), np.sin(value)) if joint.nq == 2 else value


def _refuse_lock(name: str, leader: str) -> RobotError:
    return RobotError(f"joint '{name}' mimics joint '{leader}', expected an independent joint: {suggest_lock(leader)}")


def find_default_tip(model: pin.Model) -> str:
    """Name of the frame at the end of the longest chain of joints; if several are equally long, of the first one.

    Joints of a gripper or of the fingers of a hand are not counted. If a frame at the end is called a tool or an end
    effector, the last such frame is the tip. Otherwise it is the last frame that belongs neither to a finger nor to a
    collision shape. If the robot has several chains, a TipWarning names the others.

    Raises:
        RobotError: if no joint moves.
    """
    ids = [i for i in range(1, model.njoints) if not _is_of_gripper(model, i)] or list(range(1, model.njoints))
    ids = [i for i in ids if not any(_carries_fingers(model, k) for k in model.supports[i] if k not in (0, i))]
    carriers = {model.parents[i] for i in ids}
    ends = [i for i in ids if i not in carriers]
    if not ends:
        raise RobotError("the robot has no movable joint, expected at least one")
    # Take the first of the longest chains, and mention the others.
    longest = max(ends, key=lambda i: (len(model.supports[i]), -i))
    moving = [i for i in model.supports[longest] if i and model.joints[i].nv == 1]
    names = {i: _list_ends(model, i) for i in ends}
    if len(ends) > 1:
        listing = "; ".join(", ".join(names[i]) for i in ends if i != longest)
        taken = f"tip='{names[longest][0]}', with {len(moving)} joints, the longest"
        chains = f"the robot has {len(ends)} chains; taken is {taken}. Other tips to name: {listing}"
        warn_caller(chains, TipWarning)
    return names[longest][0]


def find_floating_base(model: pin.Model, tips: Sequence[str]) -> list[str]:
    """Joints with six degrees of freedom at the root of the chains to the tips."""
    chains = [model.supports[model.frames[find_frame(model, tip)].parentJoint] for tip in tips]
    roots = {chain[1] for chain in chains if len(chain) > 2}
    return [model.names[i] for i in sorted(roots) if model.joints[i].shortname() == "JointModelFreeFlyer"]


def _carries_fingers(model: pin.Model, i: int) -> bool:
    """Whether a hand begins behind a joint: parallel chains, none of them longer than the arm before it."""
    above, below = list(model.supports[i]), [k for k in range(i + 1, model.njoints) if i in model.supports[k]]
    branching = [k for k in above[:-1] if sum(parent == k for parent in model.parents) > 1]
    arm = len(above) - 1 - (above.index(branching[-1]) if branching else 0)
    deepest = max((len(model.supports[k]) - len(above) for k in below), default=0)
    side_by_side = sum(model.parents[k] == i for k in below) > 1
    return side_by_side and arm > _SHORTEST_ARM and deepest <= arm


def _is_of_gripper(model: pin.Model, i: int) -> bool:
    """Whether a joint and all joints that it carries belong to a gripper or a finger, by the names of joint or link."""
    link = next((frame.name for frame in model.frames if frame.parentJoint == i and frame.type in LINKS), "")
    own = _GRIPPER.search(model.names[i]) or _FINGER.search(link)
    return bool(own) and all(_is_of_gripper(model, k) for k in range(i + 1, model.njoints) if model.parents[k] == i)


def _list_ends(model: pin.Model, i: int) -> list[str]:
    """Candidate tips of a body: the best frame first, then the others that carry no further frame."""
    frames = {k: frame for k, frame in enumerate(model.frames) if frame.parentJoint == i}
    links = [k for k in frames if frames[k].type in LINKS] or list(frames)
    plain = [k for k in links if not (_FINGER.search(frames[k].name) or _SHAPE.search(frames[k].name))]
    best = [*links, *plain, *(k for k in plain if _TOOL.search(frames[k].name))][-1]
    # The parent frame of a link is a fixed joint, whose parent frame is a link.
    inner = {model.frames[frames[k].parentFrame].parentFrame for k in plain}
    return [frames[best].name, *(frames[k].name for k in plain if k != best and k not in inner)]


def read_model_postures(model: pin.Model, joint_names: Sequence[str]) -> dict[str, Array]:
    """Named postures (n,): reference configurations of a Pinocchio model, which are the keyframes of an MJCF file."""
    states: dict[str, dict[str, float]] = {}
    for entry in model.referenceConfigurations:
        position, joints = entry.data(), states.setdefault(entry.key(), {})
        for name, joint in zip(list(model.names)[1:], list(model.joints)[1:], strict=True):
            # Pinocchio stores cos and sin of a continuous joint.
            if joint.nv == 1:
                part = position[joint.idx_q : joint.idx_q + joint.nq]
                joints[name] = float(part[0]) if len(part) == 1 else float(np.arctan2(part[1], part[0]))
    # Pinocchio adds the zero posture of an MJCF file under this name; the file does not have it.
    states.pop("qpos0", None)
    return collect_postures(states, joint_names)


def collect_postures(states: Mapping[str, Mapping[str, float]], joint_names: Sequence[str]) -> dict[str, Array]:
    """States as joint positions (n,), with a moving base at 0. States without a value for another joint are skipped."""
    placed = {name: {**dict.fromkeys(BASE_JOINTS, 0.0), **joints} for name, joints in states.items()}
    return {
        name: np.array([joints[joint] for joint in joint_names])
        for name, joints in placed.items()
        if all(joint in joints for joint in joint_names)
    }


def build_planar(lengths: Sequence[float], masses: Sequence[float]) -> pin.Model:
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
    lengths = freeze_array("lengths", lengths, (None,)).tolist()
    masses = freeze_array("masses", masses, (len(lengths),)).tolist()
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
