"""URDF files: checks for errors that Pinocchio's parser accepts, reading, and locked joints."""

import math
import os
import re
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin

from orthocas.errors import InvalidValueError, RobotError
from orthocas.robots.pinocchio_model import LINKS, frame_index, joint_axis, leader_of, remedy
from orthocas.robots.xml import MOST_LINKS, read_xml
from orthocas.tools.checks import Array, require_known

_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?", re.ASCII)
_LARGEST, _SHORTEST = 1e20, 1e-12  # of the vector along an axis
_LATE_LEADER = "parent joint of the mimic joint is not in the kinematic tree"  # what Pinocchio says
_GRIPPER = re.compile("gripper|finger|jaw", re.IGNORECASE)
_FINGER = re.compile("finger|jaw", re.IGNORECASE)
_TOOL = re.compile("tool|tcp|end_?effector|eef|(^|_)ee(_|$)", re.IGNORECASE)
_WITH_AXIS = ("revolute", "continuous", "prismatic")
WORLD = "universe"  #: Pinocchio's name for what does not move


def check_urdf(path: str | Path, root: ElementTree.Element) -> None:
    """Refuse zero axes, negative limits of effort and velocity, loops of joints, and more links than any robot has.

    Pinocchio's parser checks lengths of vectors, numbers and limits.

    Raises:
        RobotError: if a check fails. The message names the file and the joint.
    """
    links = len(root.findall("link"))
    if links > MOST_LINKS:
        raise RobotError(f"{path} has {links} links, expected at most {MOST_LINKS}")
    for joint in root.findall("joint"):
        axis = joint.find("axis")
        if axis is not None and joint.get("type") in _WITH_AXIS:
            _require_direction(path, f"<axis> of joint '{joint.get('name')}'", axis.get("xyz"))
        _require_limits(path, joint)
        _require_mimics(path, joint)
    _require_tree(path, root)


def _require_no_xacro(path: str | Path, root: ElementTree.Element) -> None:
    """Refuse files of macros, which parsers of URDF skip without a word.

    Raises:
        RobotError: if there is a macro, or a name with an expression.
    """
    macros = (element.tag for element in root.iter() if element.tag.startswith("{") and "xacro}" in element.tag)
    names = (element.get("name", "") for kind in ("link", "joint") for element in root.iter(kind))
    if next(macros, None) is not None or any("${" in name for name in names):
        raise RobotError(f"{path} is a xacro file, expected URDF: run xacro first (xacro {Path(path).name} > arm.urdf)")


def _require_direction(path: str | Path, label: str, text: str | None) -> None:
    """Raise RobotError unless the text is three plausible numbers, not all zero."""
    if text is None:
        raise RobotError(f"{path}: {label} has no attribute 'xyz'")
    words = text.split()
    unfit = f"{path}: xyz of {label} is '{text[:80]}', expected"
    if len(words) != 3 or not all(_NUMBER.fullmatch(word) for word in words):
        raise RobotError(f"{unfit} 3 numbers")
    length = math.hypot(*map(float, words))  # squares of numbers in words may overflow
    if not length <= _LARGEST:
        raise RobotError(f"{unfit} 3 numbers up to {_LARGEST:g}")
    if length < _SHORTEST:
        raise RobotError(f"{unfit} a vector that is not zero")


def _require_limits(path: str | Path, joint: ElementTree.Element) -> None:
    """Limits of effort and velocity are not negative; Pinocchio's parser refuses some, and names no joint."""
    limit = joint.find("limit")
    label = f"<limit> of joint '{joint.get('name')}'"
    for what in ("effort", "velocity"):
        text = "" if limit is None else limit.get(what, "")
        if _is_negative(text):
            raise RobotError(f"{path}: {what} of {label} is '{text[:80]}', expected a number >= 0 (0: unlimited)")


def _require_mimics(path: str | Path, joint: ElementTree.Element) -> None:
    """How a joint follows its leader; Pinocchio's parser reads this only where the leader comes first."""
    label = f"<mimic> of joint '{joint.get('name')}'"
    for mimic in joint.findall("mimic"):
        for what in ("multiplier", "offset"):
            text = mimic.get(what, "0").strip()
            if not _NUMBER.fullmatch(text) or abs(float(text)) > _LARGEST:
                raise RobotError(f"{path}: {what} of {label} is '{text[:80]}', expected a number up to {_LARGEST:g}")


def _is_negative(text: str) -> bool:
    """Whether a text is a number below 0; whether it is a number at all is left to Pinocchio's parser."""
    try:
        return float(text) < 0
    except ValueError:
        return False


def _require_tree(path: str | Path, root: ElementTree.Element) -> None:
    """Every joint hangs on a link that no joint carries; Pinocchio's parser leaves out loops without a word."""
    joints = [(joint, _link(joint, "parent"), _link(joint, "child")) for joint in root.findall("joint")]
    children: dict[str, list[str]] = {}
    for _, parent, child in joints:
        children.setdefault(parent, []).append(child)
    carried = {child for _, _, child in joints if child}
    waiting = [link.get("name", "") for link in root.findall("link") if link.get("name", "") not in carried]
    reached = set(waiting)
    while waiting:
        found = [child for child in children.get(waiting.pop(), ()) if child not in reached]
        reached.update(found)
        waiting += found
    for joint, parent, child in joints:
        if parent in carried and parent not in reached:
            raise RobotError(
                f"{path}: joint '{joint.get('name')}' hangs from link '{parent}' to link '{child}' "
                "in a loop of joints, expected a tree of links"
            )


def _link(joint: ElementTree.Element, end: str) -> str:
    """The link at one end of a joint; whether it is there is left to Pinocchio's parser."""
    element = joint.find(end)
    return "" if element is None else element.get("link", "")


def read_urdf(path: str | Path, tips: Sequence[str] = (), locked: Mapping[str, float] | None = None) -> pin.Model:
    """Read a URDF file. Mimic joints are kept, so that they can be refused or locked later.

    Pinocchio cannot keep joints that mimic a joint which comes later in its order. In files with such joints, all
    mimic joints are locked where their leaders are, at 0, at the limit closest to 0, or as `locked` says.

    Args:
        path: the file.
        tips: names of the frames that the robot moves; default: the last frame of a robot with a single chain.
        locked: positions of joints [rad] or [m] that are going to be locked.

    Raises:
        RobotError: if the file is missing or not a URDF model, or a joint has a zero axis; if a mimic joint that had to
            be locked moves the tip and its leader is not in `locked`.
    """
    root = read_xml(path, "URDF", "robot")
    _require_no_xacro(path, root)
    check_urdf(path, root)
    try:
        return _parsed(path, mimic=True)
    except RobotError as error:
        if _LATE_LEADER not in str(error):
            raise
    return _with_locked_mimics(_parsed(path, mimic=False), root, tips, locked or {})


def _parsed(path: str | Path, mimic: bool) -> pin.Model:
    """The file as Pinocchio reads it."""
    with _captured_stderr() as notes:
        try:
            model = pin.buildModelFromUrdf(str(path), mimic=mimic)
        except (ValueError, RuntimeError) as error:
            raise RobotError(f"{path} is not a usable URDF model: {_text(notes) or error}") from None
        complaints = _text(notes)
    if "Error:" in complaints:  # the parser skips what it cannot read, for example a mass
        raise RobotError(f"{path} is not a usable URDF model: {complaints}")
    try:
        _ = list(model.names), [frame.name for frame in model.frames]
    except UnicodeDecodeError:
        raise RobotError(f"{path} has names of joints or links that are not UTF-8, expected a file in UTF-8") from None
    return model


def _with_locked_mimics(
    model: pin.Model, root: ElementTree.Element, tips: Sequence[str], locked: Mapping[str, float]
) -> pin.Model:
    """The model with every mimic joint locked at multiplier x position of its leader + offset."""
    leaders = {joint.get("name", ""): mimic for joint in root.findall("joint") for mimic in joint.findall("mimic")}
    carriers = [model.frames[frame_index(model, tip)].parentJoint for tip in tips or (default_tip(model),)]
    chain = {i for carrier in carriers for i in model.supports[carrier]}
    position, ids = pin.neutral(model), []
    for name, mimic in leaders.items():
        leader, i = mimic.get("joint", ""), model.getJointId(name)
        if i >= model.njoints:
            continue  # of a fixed joint
        if i in chain and leader not in locked:
            raise RobotError(f"joint '{name}' is a mimic joint, expected independent joints: {remedy(leader)}")
        if name in locked:
            raise RobotError(f"joint '{name}' mimics joint '{leader}', expected an independent joint: {remedy(leader)}")
        _set_position(model, i, _followed(model, name, leaders, locked), position)
        ids.append(i)
    return _without_joints(model, ids, position)


def _followed(
    model: pin.Model, name: str, leaders: Mapping[str, ElementTree.Element], locked: Mapping[str, float]
) -> float:
    """Where a joint is locked: multiplier x position of the joint that it follows + offset, along all leaders."""
    factor, place, followed = 1.0, 0.0, set()
    while name in leaders:
        if name in followed:
            raise RobotError(f"joint '{name}' mimics itself")
        followed.add(name)
        mimic = leaders[name]
        place += factor * float(mimic.get("offset", 0))
        factor *= float(mimic.get("multiplier", 1))
        name = mimic.get("joint", "")
    return place + factor * _leading(model, name, locked)


def _leading(model: pin.Model, leader: str, locked: Mapping[str, float]) -> float:
    """The position at which a joint is going to be locked, 0 or the limit closest to 0 unless `locked` has another."""
    i = model.getJointId(leader)
    if leader in locked or i >= model.njoints:
        return float(locked.get(leader, 0.0))
    k = model.joints[i].idx_q
    return float(np.clip(0.0, model.lowerPositionLimit[k], model.upperPositionLimit[k]))


def lock_joints(model: pin.Model, locked: Mapping[str, float]) -> pin.Model:
    """Lock joints at the given positions [rad] or [m]. Joints that mimic a locked joint follow it.

    A joint with several degrees of freedom (floating, spherical, planar) is locked at its neutral position, given as 0.

    Raises:
        UnknownNameError: if there is no such joint.
        InvalidValueError: if a position is not finite.
        RobotError: if the joint mimics another one, or has several degrees of freedom and a position other than 0.
    """
    if not isinstance(locked, Mapping):
        raise InvalidValueError("locked", locked, "a mapping from joint names to positions")
    names = list(model.names)[1:]
    position = pin.neutral(model)
    ids = []
    for name, value in locked.items():
        require_known("joint", name, names)
        if not isinstance(value, int | float | np.number) or not np.isfinite(value):
            raise InvalidValueError(f"locked position of joint '{name}'", repr(value), "a finite number")
        ids.append(model.getJointId(name))
        _set_position(model, ids[-1], float(value), position)
    ids += [i for i in model.mimicking_joints if leader_of(model, i) in ids]
    return _without_joints(model, ids, position) if ids else model


def lock_off_chain(model: pin.Model, *tips: str) -> pin.Model:
    """Lock every joint that moves no tip, of any type, at neutral or at the limit closest to zero.

    Raises:
        UnknownNameError: if there is no frame with the name of a tip.
        RobotError: if a joint that moves a tip is not revolute, continuous or prismatic. The message names it.
    """
    chains = [model.supports[model.frames[frame_index(model, tip)].parentJoint] for tip in tips]
    chain = sorted({i for supports in chains for i in supports if i > 0})
    for i in chain:
        joint_axis(model, i)
    ids = [i for i in range(1, model.njoints) if i not in chain]
    position, mimics = pin.neutral(model), set(model.mimicking_joints)
    for i in ids:
        joint = model.joints[i]
        if joint.nq == joint.nv == 1 and i not in mimics:
            limits = model.lowerPositionLimit[joint.idx_q], model.upperPositionLimit[joint.idx_q]
            position[joint.idx_q] = np.clip(0.0, *limits)
    return _without_joints(model, ids, position) if ids else model


def default_tip(model: pin.Model) -> str:
    """The end of the arm of a robot with a single chain, apart from joints of a gripper, which is not moved.

    Of the frames there it is the last one that is called a tool or an end effector; otherwise the last one that is no
    part of a finger.

    Raises:
        RobotError: if the robot branches. The message lists the frames to choose from.
    """
    ids = [i for i in range(1, model.njoints) if not _is_of_gripper(model, i)] or list(range(1, model.njoints))
    carriers = {model.parents[i] for i in ids}
    tips = [_end_of(model, i) for i in ids if i not in carriers]
    if len(tips) != 1:
        raise RobotError(f"the robot has {len(tips)} chains, name the tip frame: {', '.join(tips)}")
    return tips[0]


def _is_of_gripper(model: pin.Model, i: int) -> bool:
    """Whether a joint is called after a gripper, or its link after a finger, as are all that it carries."""
    link = next((frame.name for frame in model.frames if frame.parentJoint == i and frame.type in LINKS), "")
    own = _GRIPPER.search(model.names[i]) or _FINGER.search(link)
    return bool(own) and all(_is_of_gripper(model, k) for k in range(i + 1, model.njoints) if model.parents[k] == i)


def _end_of(model: pin.Model, i: int) -> str:
    """The frame of a body that stands for its end."""
    frames = [frame for frame in model.frames if frame.parentJoint == i]
    names: list[str] = [frame.name for frame in frames if frame.type in LINKS] or [frame.name for frame in frames]
    plain = [name for name in names if not _FINGER.search(name)]
    return [*names, *plain, *(name for name in plain if _TOOL.search(name))][-1]


@contextmanager
def _captured_stderr() -> Iterator[IO[bytes]]:
    """Capture what the C++ parser writes to standard error. It belongs in our message, not on the user's terminal."""
    saved = os.dup(2)
    with tempfile.TemporaryFile() as sink:
        os.dup2(sink.fileno(), 2)
        try:
            yield sink
        finally:
            os.dup2(saved, 2)
            os.close(saved)


def _text(notes: IO[bytes]) -> str:
    """The captured text, on one line of at most 300 characters."""
    notes.seek(0)
    return " ".join(notes.read().decode(errors="replace").split())[:300]


def _without_joints(model: pin.Model, ids: list[int], position: Array) -> pin.Model:
    """The model with joints fixed at a position.

    Pinocchio finds joints by name among all frames, so others get names of their own meanwhile: bodies, sites and
    joints may share one.

    Raises:
        RobotError: if a joint has the name of Pinocchio's world.
    """
    if WORLD in list(model.names)[1:]:
        raise RobotError(
            f"a joint is called '{WORLD}', which no joint can be called while joints are locked: rename it"
        )
    renamed, names = model.copy(), {}
    for i, frame in enumerate(renamed.frames):
        if i > 0 and frame.type != pin.FrameType.JOINT:
            unique = f"{i}\n{frame.name}"
            names[unique], frame.name = frame.name, unique
    reduced = pin.buildReducedModel(renamed, ids, position)
    for frame in reduced.frames:
        frame.name = names.get(frame.name, frame.name)
    return reduced


def _set_position(model: pin.Model, i: int, value: float, position: Array) -> None:
    """Write a joint position into a configuration. Pinocchio stores cos and sin of a continuous joint."""
    joint, name = model.joints[i], model.names[i]
    if i in set(model.mimicking_joints):
        leader = model.names[leader_of(model, i)]
        raise RobotError(f"joint '{name}' mimics joint '{leader}', expected an independent joint: {remedy(leader)}")
    if joint.nv != 1:
        if value != 0:
            raise RobotError(
                f"locked position of joint '{name}' is {value:g}, expected 0: "
                f"a joint with {joint.nv} degrees of freedom can only be locked at its neutral position"
            )
        return
    position[joint.idx_q : joint.idx_q + joint.nq] = (np.cos(value), np.sin(value)) if joint.nq == 2 else value
