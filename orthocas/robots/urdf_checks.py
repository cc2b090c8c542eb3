"""Checks of URDF files for errors that Pinocchio's parser accepts."""

from pathlib import Path
from xml.etree import ElementTree

from orthocas.errors import RobotError
from orthocas.robots.xml_files import MOST_LINKS
from orthocas.robots.xml_values import Attributes

_WITH_AXIS = ("revolute", "continuous", "prismatic")


def check_urdf(path: str | Path, root: ElementTree.Element) -> None:
    """Refuse joints with a zero axis, and files with more links than any robot has.

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
