"""URDF files: checks for errors that Pinocchio's parser accepts, reading, and locked joints."""

import logging
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

from orthocas.errors import InvalidValueError, RobotError, degrees_hint, one_line
from orthocas.robots.pinocchio_model import LINKS, frame_index, joint_axis, leader_of, remedy
from orthocas.robots.xml import MOST_LINKS, read_xml
from orthocas.tools.checks import Array, require_known
from orthocas.tools.display import listed

_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?", re.ASCII)
_LARGEST, _SHORTEST = 1e20, 1e-12  # of the vector along an axis
_GRIPPER = re.compile("gripper|finger|jaw", re.IGNORECASE)
_FINGER = re.compile("finger|jaw", re.IGNORECASE)
_SHAPE = re.compile("_sc$|collision", re.IGNORECASE)  # frames of shapes that stand for links in collision checks
_TOOL = re.compile("tool|tcp|end_?effector|eef|(^|_)ee(_|$)", re.IGNORECASE)
_WITH_AXIS = ("revolute", "continuous", "prismatic")
WORLD = "universe"  #: Pinocchio's name for what does not move
_log = logging.getLogger(__name__)
_USED = {  # what kinematics and dynamics use of a file
    "link": ("inertial",),
    "joint": ("origin", "parent", "child", "axis", "limit", "mimic"),
}
_CONTEXT = "joint xml is not initialized correctly"  # urdfdom's last words on every joint, which say nothing


def check_urdf(path: str | Path, root: ElementTree.Element) -> None:
    """Refuse zero axes, negative limits and masses, what is not a tree, and more links than any robot has.

    Pinocchio's parser checks lengths of vectors, numbers and limits.

    Raises:
        RobotError: if a check fails. The message names the file and the joint or link.
    """
    links = root.findall("link")
    if len(links) > MOST_LINKS:
        raise RobotError(f"{path} has {len(links)} links, expected at most {MOST_LINKS}")
    for link in links:
        mass = link.find("inertial/mass")
        if mass is not None and _is_negative(text := mass.get("value", "")):
            raise RobotError(f"{path}: link '{link.get('name')}' has mass {text.strip()[:80]} kg, expected >= 0")
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
    """Every joint connects two links of the file, every link but one hangs on one joint, and none on itself."""
    names = [link.get("name", "") for link in root.findall("link")]
    for i, name in enumerate(names):
        if not name or name in names[:i]:
            raise RobotError(f"{path}: two links are called '{name}'" if name else f"{path}: a link has no name")
    joints = [(joint.get("name", ""), _link(joint, "parent"), _link(joint, "child")) for joint in root.findall("joint")]
    children: dict[str, list[str]] = {}
    carriers: dict[str, str] = {}  # of a link: the joint that it hangs on
    for name, parent, child in joints:
        for end, link in (("parent", parent), ("child", child)):
            if link not in names:
                what = f"the {end} link '{link}', which the file does not have" if link else f"no {end} link"
                raise RobotError(f"{path}: joint '{name}' has {what}")
        if child in carriers:
            both = f"the joints '{carriers[child]}' and '{name}'"
            raise RobotError(f"{path}: link '{child}' hangs on {both}, expected a tree of links")
        carriers[child] = name
        children.setdefault(parent, []).append(child)
    roots = [link for link in names if link not in carriers]
    if len(roots) > 1:
        raise RobotError(f"{path}: the links '{roots[0]}' and '{roots[1]}' hang on no joint, expected one such link")
    _require_no_loop(path, joints, children, roots)


def _require_no_loop(
    path: str | Path, joints: Sequence[tuple[str, str, str]], children: Mapping[str, list[str]], roots: list[str]
) -> None:
    """Every joint (name, parent, child) can be reached from a root."""
    reached, waiting = set(roots), list(roots)
    while waiting:
        found = [child for child in children.get(waiting.pop(), ()) if child not in reached]
        reached.update(found)
        waiting += found
    for name, parent, child in joints:
        if parent not in reached:
            raise RobotError(
                f"{path}: joint '{name}' hangs from link '{parent}' to link '{child}' "
                "in a loop of joints, expected a tree of links"
            )


def _link(joint: ElementTree.Element, end: str) -> str:
    """The link at one end of a joint; "" if it is not given."""
    element = joint.find(end)
    return "" if element is None else element.get("link", "")


def read_urdf(path: str | Path, tips: Sequence[str] = (), locked: Mapping[str, float] | None = None) -> pin.Model:
    """Read a URDF file. Mimic joints are kept, so that they can be refused or locked later.

    Only what kinematics and dynamics use is read: links, their inertias, and joints. Faults elsewhere, such as in
    shapes and colours, are logged. So are missing limits of effort and velocity, which count as unlimited.

    Pinocchio cannot keep joints that mimic a fixed joint, another mimic joint, or a joint which comes later in its
    order. In files with such joints, all mimic joints are locked where their leaders are, at 0, at the limit closest to
    0, or as `locked` says.

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
    unlimited = _with_all_limits(root)
    used = _used_part(root)
    check_urdf(path, used)
    text = ElementTree.tostring(used, "unicode")
    model, fault = _parsed(text, mimic=True)
    if fault and used.find("joint/mimic") is not None:
        model, fault = _parsed(text, mimic=False)
        model = model if fault else _with_locked_mimics(model, used, tips, locked or {})
    if fault:
        raise RobotError(f"{path} is not a usable URDF model: {fault}")
    if unlimited:
        _log.warning("%s: limits of effort or velocity are missing, so there are none: %s", path, listed(unlimited))
    _, beside = _parsed(ElementTree.tostring(root, "unicode"), mimic=False)
    if beside:
        _log.warning("%s: what kinematics does not use is left out: %s", path, beside)
    return model


def _with_all_limits(root: ElementTree.Element) -> list[str]:
    """Write 0, which means unlimited, for each missing limit of effort or velocity; the names of these joints."""
    changed = []
    for joint in root.findall("joint"):
        for limit in joint.findall("limit"):
            missing = [what for what in ("effort", "velocity") if what not in limit.attrib]
            limit.attrib.update(dict.fromkeys(missing, "0"))
            changed += [joint.get("name", "")] if missing else []
    return changed


def _used_part(root: ElementTree.Element) -> ElementTree.Element:
    """The links, inertias and joints of a file."""
    used = ElementTree.Element("robot", name=root.get("name") or "robot")
    for element in root:
        if element.tag in _USED:
            part = ElementTree.SubElement(used, element.tag, element.attrib)
            part.extend(child for child in element if child.tag in _USED[element.tag])
    return used


def _parsed(text: str, mimic: bool) -> tuple[pin.Model, str]:
    """The model that Pinocchio reads from a text, and what is wrong with it: "" if nothing.

    The parser goes on after many errors and skips what it cannot read, for example a mass.
    """
    model, words = pin.Model(), ""
    with _captured_stderr() as notes:
        try:
            model = pin.buildModelFromXML(text, mimic=mimic)
        except (ValueError, RuntimeError) as error:
            words = one_line(str(error).rpartition("message:")[2])  # without its place in the C++ source
        said = _said(notes)
    return model, said or words


def _with_locked_mimics(
    model: pin.Model, root: ElementTree.Element, tips: Sequence[str], locked: Mapping[str, float]
) -> pin.Model:
    """The model with every mimic joint locked at multiplier x position of its leader + offset."""
    mimics = {joint.get("name", ""): mimic for joint in root.findall("joint") for mimic in joint.findall("mimic")}
    joints = {joint.get("name", "") for joint in root.findall("joint")}
    carriers = [model.frames[frame_index(model, tip)].parentJoint for tip in tips or (default_tip(model),)]
    chain = {i for carrier in carriers for i in model.supports[carrier]}
    position, ids = pin.neutral(model), []
    for name in mimics:
        leader, factor, offset = _followed(name, mimics)
        i = model.getJointId(name)
        if i >= model.njoints:
            continue  # of a fixed joint
        if i in chain and leader not in joints:
            raise RobotError(f"joint '{name}' mimics joint '{leader}', which the file does not have")
        if i in chain and leader not in locked:
            raise RobotError(f"joint '{name}' is a mimic joint, expected independent joints: {remedy(leader)}")
        if name in locked:
            raise RobotError(f"joint '{name}' mimics joint '{leader}', expected an independent joint: {remedy(leader)}")
        _set_position(model, i, offset + factor * _leading(model, leader, locked), position)
        ids.append(i)
    return _without_joints(model, ids, position)


def _followed(name: str, mimics: Mapping[str, ElementTree.Element]) -> tuple[str, float, float]:
    """The independent joint that a joint follows, along all leaders; the multiplier and the offset."""
    factor, offset, followed = 1.0, 0.0, set()
    while name in mimics:
        if name in followed:
            raise RobotError(f"joint '{name}' mimics itself")
        followed.add(name)
        mimic = mimics[name]
        offset += factor * float(mimic.get("offset", 0))
        factor *= float(mimic.get("multiplier", 1))
        name = mimic.get("joint", "")
    return name, factor, offset


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
        InvalidValueError: if a position is not finite, or an angle looks like degrees.
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
    part of a finger and no shape for collision checks.

    Raises:
        RobotError: if the robot branches. The message lists the frames to choose from, chain by chain.
    """
    ids = [i for i in range(1, model.njoints) if not _is_of_gripper(model, i)] or list(range(1, model.njoints))
    carriers = {model.parents[i] for i in ids}
    ends = [_ends_of(model, i) for i in ids if i not in carriers]
    if not ends:
        raise RobotError("the robot has no movable joint, expected at least one")
    if len(ends) > 1:
        listing = "; ".join(", ".join(names) for names in ends)
        raise RobotError(f"the robot has {len(ends)} chains, name the tip frame: {listing}")
    return ends[0][0]


def _is_of_gripper(model: pin.Model, i: int) -> bool:
    """Whether a joint is called after a gripper, or its link after a finger, as are all that it carries."""
    link = next((frame.name for frame in model.frames if frame.parentJoint == i and frame.type in LINKS), "")
    own = _GRIPPER.search(model.names[i]) or _FINGER.search(link)
    return bool(own) and all(_is_of_gripper(model, k) for k in range(i + 1, model.njoints) if model.parents[k] == i)


def _ends_of(model: pin.Model, i: int) -> list[str]:
    """The frames of a body that stand for its end: the best one, then the others that carry no further frame."""
    frames = {k: frame for k, frame in enumerate(model.frames) if frame.parentJoint == i}
    links = [k for k in frames if frames[k].type in LINKS] or list(frames)
    plain = [k for k in links if not (_FINGER.search(frames[k].name) or _SHAPE.search(frames[k].name))]
    best = [*links, *plain, *(k for k in plain if _TOOL.search(frames[k].name))][-1]
    inner = {model.frames[frames[k].parentFrame].parentFrame for k in plain}  # of a link: a fixed joint, then a link
    return [frames[best].name, *(frames[k].name for k in plain if k != best and k not in inner)]


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


def _said(notes: IO[bytes]) -> str:
    """The captured errors, from the outermost element to the fault in it; "" if there are none."""
    notes.seek(0)
    lines = notes.read().decode(errors="replace").splitlines()
    said = [line.removeprefix("Error:").strip() for line in lines if line.startswith("Error:")]
    return one_line(": ".join(line.rstrip(".") for line in reversed(said) if line != _CONTEXT))[:300]


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
    turns = joint.shortname().startswith("JointModelR")
    if turns and (hint := degrees_hint(value)):
        raise InvalidValueError(f"locked position of joint '{name}'", f"{value:g}", f"an angle in radians{hint}")
    position[joint.idx_q : joint.idx_q + joint.nq] = (np.cos(value), np.sin(value)) if joint.nq == 2 else value
