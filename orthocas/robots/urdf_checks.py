"""Checks of URDF files for errors that Pinocchio's parser accepts."""

from pathlib import Path
from xml.etree import ElementTree

from orthocas.errors import RobotError
from orthocas.robots.xml_files import MOST_LINKS
from orthocas.robots.xml_values import Attributes

_WITH_AXIS = ("revolute", "continuous", "prismatic")


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
            Attributes(str(path), f"<axis> of joint '{joint.get('name')}'", axis.attrib).direction("xyz")
        _require_limits(path, joint)
    _require_tree(path, root)


def _require_limits(path: str | Path, joint: ElementTree.Element) -> None:
    """Limits of effort and velocity are not negative; Pinocchio's parser refuses some, and names no joint."""
    limit = joint.find("limit")
    label = f"<limit> of joint '{joint.get('name')}'"
    for what in ("effort", "velocity"):
        text = "" if limit is None else limit.get(what, "")
        if _is_negative(text):
            raise RobotError(f"{path}: {what} of {label} is '{text[:80]}', expected a number >= 0 (0: unlimited)")


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
