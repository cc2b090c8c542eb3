"""Reads URDF and SRDF files, with limits on size and with checks for errors that Pinocchio's parser accepts."""

import logging
import math
import os
import re
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from copy import copy
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import PackageNotFoundError, files
from importlib.util import find_spec
from itertools import product
from pathlib import Path
from threading import Lock
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin

from orthocas.errors import RobotError, UnknownNameError, one_line
from orthocas.robots.pinocchio_model import Mimic, collect_postures, fix_joints, resolve_mimics, set_position
from orthocas.tools.checks import Array
from orthocas.tools.display import listed

_log = logging.getLogger(__name__)
_PACKAGES = Lock()  #: held while xacrodoc looks for packages, because its list of packages is global


@dataclass(frozen=True, slots=True)
class FileRules:
    """Limits on robot files: above what any robot has, and low enough for any machine."""

    bytes: int = 16 * 2**20  #: size of a file
    elements: int = 200_000  #: elements of a file, including its included files
    depth: int = 200  #: depth of nested elements
    links: int = 1000  #: links (URDF) or bodies (MJCF) of a robot
    largest: float = 1e20  #: largest number in an axis or a mimic element
    inertia: float = 1e-2  #: tolerance of the triangle inequality for rounded files, relative to the largest moment
    least_inertia: float = 1e-5  #: [kg m^2], further tolerance, for dummy inertias
    shortest_axis: float = 1e-12  #: shortest vector that is accepted as an axis


RULES = FileRules()
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?", re.ASCII)
_ARTICLE = {"URDF": "a", "xacro": "a", "MJCF": "an", "SRDF": "an"}
#: elements of xacro other than calls of macros
_XACRO = ("}macro", "}property", "}include", "}arg", "}if", "}unless", "}insert_block", "}element")
#: elements that kinematics and dynamics use
_USED = {"link": ("inertial",), "joint": ("origin", "parent", "child", "axis", "limit", "mimic")}
#: last line of urdfdom's message on every joint, without information
_CONTEXT = "joint xml is not initialized correctly"


def read_urdf(path: str | Path) -> tuple[pin.Model, dict[str, Mimic]]:
    """Read a URDF file: a model with all joints independent, and the mimic joints.

    Only what kinematics and dynamics need is read: links, their inertias, and joints. Errors elsewhere, such as in
    shapes and colours, are logged. Missing limits of effort and velocity are logged too; they count as unlimited.

    Joints that mimic a fixed joint, or have the multiplier 0, are locked at their offset.

    Raises:
        RobotError: if the file is missing or not a URDF model, a joint has a zero axis, or joints mimic each other in a
            loop.
    """
    root = read_urdf_xml(path)
    _check_macros(path, root)
    _add_lost_root(path, root)

    # Missing limits of effort and velocity become 0, which means unlimited, and so does -1, which some files use.
    # Joints without a limit element become unlimited.
    unlimited = []
    for joint in root.findall("joint"):
        if joint.get("type") in ("revolute", "prismatic") and joint.find("limit") is None:
            ElementTree.SubElement(joint, "limit", lower=f"{-RULES.largest:g}", upper=f"{RULES.largest:g}")
        for limit in joint.findall("limit"):
            missing = [what for what in ("effort", "velocity") if _read_number(limit.get(what, "-1")) == -1]
            limit.attrib.update(dict.fromkeys(missing, "0"))
            unlimited += [joint.get("name", "")] if missing else []

    # Build a document of links, inertias and joints only, and check and read it.
    used = ElementTree.Element("robot", name=root.get("name") or "robot")
    for element in root:
        if element.tag in _USED:
            part = ElementTree.SubElement(used, element.tag, element.attrib)
            part.extend(child for child in element if child.tag in _USED[element.tag])
    _check_urdf(path, used)
    text = ElementTree.tostring(used, "unicode")
    model, fault = _parse_urdf(text)
    if fault:
        raise RobotError(f"{path} is not a usable URDF model: {fault}")
    model, mimics = _read_mimics(model, used)

    if unlimited:
        text = "%s: limits are missing, or those of effort or velocity are -1, so there are none: %s"
        _log.warning(text, path, listed(unlimited))
    _note_impossible_inertias(path, used)
    _, beside = _parse_urdf(ElementTree.tostring(root, "unicode"))
    if beside:
        _log.warning("%s: what kinematics does not use is left out: %s", path, beside)
    return model, mimics


@contextmanager
def _own_packages(expander: Any, path: Path) -> Iterator[None]:
    """Let xacrodoc find the ROS packages in the same folder as the package of a file.

    The packages found for one file are not kept for others, because two workspaces may have packages of one name.
    """
    root = next((folder for folder in path.parents if (folder / "package.xml").exists()), None)
    beside = [] if root is None else [str(found.parent) for found in sorted(root.parent.glob("*/package.xml"))]
    with _PACKAGES:
        kept = expander.packages._finder
        own = copy(kept)
        own.finder_funcs, own.package_cache = list(kept.finder_funcs), dict(kept.package_cache)
        expander.packages._finder = own
        try:
            if beside:
                # Lowest priority: names that come from the user or from ROS come first.
                expander.packages.look_in(beside, priority=sys.maxsize)
            yield
        finally:
            expander.packages._finder = kept


def read_urdf_xml(path: str | Path) -> ElementTree.Element:
    """The root element of a URDF file; files whose names end in .xacro are first expanded by xacro.

    This needs xacrodoc or xacro, and runs expressions in the file.

    Raises:
        RobotError: as in `read_xml`; also if xacro is missing or fails.
    """
    if Path(path).suffix.lower() != ".xacro":
        return read_xml(path, "URDF", "robot")
    read_xml(path, "xacro")
    # xacrodoc finds packages above and beside the file's own. Plain xacro comes with ROS.
    name = next((name for name in ("xacrodoc", "xacro") if find_spec(name) is not None), None)
    if name is None:
        raise RobotError(f"{path} is a xacro file, which xacro expands first: pip install 'orthocas[xacro]'")
    expander: Any = import_module(name)
    try:
        if name == "xacrodoc":
            with _own_packages(expander, Path(path).resolve()):
                text = expander.XacroDoc.from_file(str(path)).to_urdf_string()
        else:
            text = expander.process_file(str(path)).toxml()
    # Expressions in the file may raise any error.
    except (Exception, SystemExit) as error:
        missing = re.search(r"[Pp]ackage not found: (\S+)", str(error))
        if missing:
            where = "expected beside the package of the file, or in a folder of ROS_PACKAGE_PATH"
            raise RobotError(f"{path} needs the ROS package '{missing[1]}', {where}") from None
        wanted = (
            "; give it its arguments yourself: xacro FILE NAME:=VALUE > arm.urdf" if "rgument" in str(error) else ""
        )
        cause = f"{type(error).__name__}: {one_line(str(error))[:300]}{wanted}"
        raise RobotError(f"xacro cannot expand {path}: {cause}") from None
    return read_xml(path, "URDF", "robot", text.encode())


def read_xml(path: str | Path, kind: str, tag: str | None = None, data: bytes | None = None) -> ElementTree.Element:
    """The root element of an XML file that may be broken or malicious.

    Args:
        path: the file.
        kind: expected kind of file for messages, "URDF", "xacro", "MJCF" or "SRDF".
        tag: expected name of the root element. None allows any name.
        data: bytes to parse in place of the file's content, such as the output of xacro.

    Raises:
        RobotError: if the file is missing, is not XML, has another root element, declares a document type (whose
            entities could fill the memory), or is larger or deeper than any robot file.
    """
    try:
        if data is None:
            with Path(path).open("rb") as file:
                data = file.read(RULES.bytes + 1)
        if len(data) > RULES.bytes:
            raise ValueError(f"it has more than {RULES.bytes} bytes")
        parser = ElementTree.XMLParser(target=_BoundedBuilder())
        parser.feed(data)
        root: ElementTree.Element = parser.close()
    except OSError as error:
        raise RobotError(f"cannot read {kind} file {path}: {error.strerror}") from None
    # LookupError: unknown encoding.
    except (ElementTree.ParseError, LookupError, ValueError) as error:
        raise RobotError(f"{path} is not {_ARTICLE[kind]} {kind} file: {error}") from None
    if tag is not None and root.tag != tag:
        raise RobotError(
            f"{path} is not {_ARTICLE[kind]} {kind} file: its root element is <{root.tag}>, expected <{tag}>"
        )
    return root


class _BoundedBuilder(ElementTree.TreeBuilder):
    """Builds the tree during parsing, and stops at anything that no robot file needs."""

    _depth = _elements = 0

    def doctype(self, name: str, pubid: str | None, system: str | None) -> None:
        raise ValueError(f"it declares a document type ({name}), which orthocas does not allow")

    def start(self, tag: Any, attrs: Any, /) -> Any:
        self._depth += 1
        self._elements += 1
        if self._depth > RULES.depth:
            raise ValueError(f"its elements nest more than {RULES.depth} deep")
        if self._elements > RULES.elements:
            raise ValueError(f"it has more than {RULES.elements} elements")
        return super().start(tag, attrs)

    def end(self, tag: Any, /) -> Any:
        self._depth -= 1
        return super().end(tag)


def _check_macros(path: str | Path, root: ElementTree.Element) -> None:
    """Refuse xacro files with another ending, and log calls of macros that the file does not define."""
    # URDF parsers skip macros silently. Files from some generators still contain calls of macros that were lost.
    macros = [element for element in root.iter() if element.tag.startswith("{") and "xacro}" in element.tag]
    names = (element.get("name", "") for kind in ("link", "joint") for element in root.iter(kind))
    if any(macro.tag.endswith(_XACRO) for macro in macros) or any("${" in name for name in names):
        raise RobotError(
            f"{path} is a xacro file, expected URDF: if you trust it, rename it to .xacro; xacro runs the code in it"
        )
    if macros:
        lost = listed(dict.fromkeys(macro.tag.rpartition("}")[2] for macro in macros), 3)
        _log.warning("%s calls xacro macros that it does not have, which are left out: %s", path, lost)


def _add_lost_root(path: str | Path, root: ElementTree.Element) -> None:
    """Add the root link if joints name it and the file lacks it, as in files that are parts of another robot."""
    links = {link.get("name", "") for link in root.findall("link")}
    parents = {end.get("link", "") for end in root.iterfind("joint/parent")}
    children = {end.get("link", "") for end in root.iterfind("joint/child")}
    if len(lost := parents - links - {""}) == 1 and links <= children:
        (name,) = lost
        ElementTree.SubElement(root, "link", name=name)
        _log.warning("%s: the link '%s' is missing, and taken as the base", path, name)


def _check_urdf(path: str | Path, root: ElementTree.Element) -> None:
    """Refuse zero axes, negative limits and masses, kinematic loops, and more links than any robot has.

    Pinocchio's parser checks lengths of vectors, numbers and limits.
    """
    links = root.findall("link")
    if len(links) > RULES.links:
        raise RobotError(f"{path} has {len(links)} links, expected at most {RULES.links}")
    # Check names first, because every message below uses names.
    names = [link.get("name", "") for link in links]
    for i, (name, link) in enumerate(zip(names, links, strict=True)):
        if not name or name in names[:i]:
            raise RobotError(f"{path}: two links are called '{name}'" if name else f"{path}: a link has no name")
        mass = link.find("inertial/mass")
        if mass is not None and _read_number(text := mass.get("value", "")) < 0:
            raise RobotError(f"{path}: link '{name}' has mass {text.strip()[:80]} kg, expected >= 0")
    for joint in root.findall("joint"):
        _check_joint(path, joint)
    _check_tree(path, root)


def _note_impossible_inertias(path: str | Path, root: ElementTree.Element) -> None:
    """Log links with a principal moment that is negative or larger than the sum of the others: no body has these."""
    odd = []
    for link in root.findall("link"):
        inertia = link.find("inertial/inertia")
        if inertia is not None:
            values = (float(inertia.get(name, 0)) for name in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz"))
            xx, yy, zz, xy, xz, yz = values
            # Moments of a mass distribution fulfil the triangle inequality.
            moments = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
            slack = RULES.inertia * np.abs(moments).max() + RULES.least_inertia
            if moments[0] < -slack or moments[2] > moments[0] + moments[1] + slack:
                odd.append(f"'{link.get('name')}' ({', '.join(f'{moment:.3g}' for moment in moments)} kg m^2)")
    if odd:
        _log.warning("%s: no body has the principal moments of inertia of these links: %s", path, listed(odd, 3))


def _check_joint(path: str | Path, joint: ElementTree.Element) -> None:
    """Check that the axis is not zero, that limits are not negative, and that mimic elements hold numbers."""
    name, axis, limit = joint.get("name"), joint.find("axis"), joint.find("limit")
    if axis is not None and joint.get("type") in ("revolute", "continuous", "prismatic"):
        if (text := axis.get("xyz")) is None:
            raise RobotError(f"{path}: <axis> of joint '{name}' has no attribute 'xyz'")
        words, unfit = text.split(), f"{path}: xyz of <axis> of joint '{name}' is '{text[:80]}', expected"
        if len(words) != 3 or not all(_NUMBER.fullmatch(word) for word in words):
            raise RobotError(f"{unfit} 3 numbers")
        # The square of a large number may overflow; math.hypot does not.
        length = math.hypot(*map(float, words))
        if not length <= RULES.largest:
            raise RobotError(f"{unfit} 3 numbers up to {RULES.largest:g}")
        if length < RULES.shortest_axis:
            raise RobotError(f"{unfit} a vector that is not zero")
    # Pinocchio's parser refuses some negative limits, but does not name the joint.
    for what in ("effort", "velocity"):
        text = "" if limit is None else limit.get(what, "")
        if _read_number(text) < 0:
            label = f"<limit> of joint '{name}'"
            raise RobotError(f"{path}: {what} of {label} is '{text[:80]}', expected a number >= 0 (0: unlimited)")
    # Pinocchio's parser does not read mimic elements here.
    for mimic, what in product(joint.findall("mimic"), ("multiplier", "offset")):
        text = mimic.get(what, "0").strip()
        if not _NUMBER.fullmatch(text) or abs(float(text)) > RULES.largest:
            label = f"{what} of <mimic> of joint '{name}'"
            raise RobotError(f"{path}: {label} is '{text[:80]}', expected a number up to {RULES.largest:g}")


def _read_number(text: str) -> float:
    """Convert a text to a number; NaN if it is none, which Pinocchio's parser then refuses."""
    try:
        return float(text)
    except ValueError:
        return math.nan


def _check_tree(path: str | Path, root: ElementTree.Element) -> None:
    """Check that joints connect links of the file, and that the links form one tree."""
    joints, names = [], [link.get("name", "") for link in root.findall("link")]
    for joint in root.findall("joint"):
        ends = (joint.find(end) for end in ("parent", "child"))
        parent, child = ("" if end is None else end.get("link", "") for end in ends)
        joints.append((joint.get("name", ""), parent, child))
    children: dict[str, list[str]] = {}
    #: link -> the joint that carries it
    carriers: dict[str, str] = {}
    for name, parent, child in joints:
        for end, link in (("parent", parent), ("child", child)):
            if link not in names:
                what = f"the {end} link '{link}', which the file does not have" if link else f"no {end} link"
                raise RobotError(f"{path}: joint '{name}' has {what}")
        if child in carriers:
            both = f"the joints '{carriers[child]}' and '{name}'"
            raise RobotError(
                f"{path}: link '{child}' hangs on {both}, expected a tree of links: "
                "closed chains are not possible, so leave out the joint that closes this one"
            )
        carriers[child] = name
        children.setdefault(parent, []).append(child)
    # Parsers would choose one of several roots and drop the other trees silently.
    roots = [link for link in names if link not in carriers]
    if len(roots) > 1:
        raise RobotError(f"{path}: the links '{roots[0]}' and '{roots[1]}' hang on no joint, expected one such link")
    # Links that no path from a root reaches are in a loop.
    reached = list(roots)
    for link in reached:
        reached += children.get(link, ())
    for name, parent, child in joints:
        if parent not in reached:
            raise RobotError(
                f"{path}: joint '{name}' hangs from link '{parent}' to link '{child}' "
                "in a loop of joints, expected a tree of links"
            )


def _parse_urdf(text: str) -> tuple[pin.Model, str]:
    """The model that Pinocchio reads from a text, and an error message, "" if nothing is wrong.

    The parser continues after many errors and skips what it cannot read, for example a mass. It writes these errors to
    standard error. They are captured here and joined into one message, from the outermost element inwards.
    """
    model, words, saved = pin.Model(), "", os.dup(2)
    with tempfile.TemporaryFile() as notes:
        os.dup2(notes.fileno(), 2)
        try:
            model = pin.buildModelFromXML(text, mimic=False)
        except (ValueError, RuntimeError) as error:
            # Remove the location in the C++ source.
            words = one_line(str(error).rpartition("message:")[2])
        finally:
            os.dup2(saved, 2)
            os.close(saved)
        notes.seek(0)
        lines = notes.read().decode(errors="replace").splitlines()
    errors = [line.removeprefix("Error:").strip() for line in lines if line.startswith("Error:")]
    if errors := [line.rstrip(".") for line in reversed(errors) if line != _CONTEXT]:
        words = one_line(": ".join(errors))[:300] or words
    return model, words


def _read_mimics(model: pin.Model, root: ElementTree.Element) -> tuple[pin.Model, dict[str, Mimic]]:
    """The mimic joints of a model, each with its independent leader, and the model with immobile joints locked.

    Joints that mimic a fixed joint, or have the factor 0, are locked in the returned model.

    Raises:
        RobotError: if joints follow each other in a loop.
    """
    # Pinocchio reads mimic joints as independent ones, so read them from the file.
    direct = {
        joint.get("name", ""): Mimic(
            mimic.get("joint", ""), float(mimic.get("multiplier", 1)), float(mimic.get("offset", 0))
        )
        for joint in root.findall("joint")
        for mimic in joint.findall("mimic")
    }
    mimics = {name: mimic for name, mimic in resolve_mimics(direct).items() if model.existJointName(name)}
    # Joints that never move.
    fixed = {joint.get("name", "") for joint in root.findall("joint") if joint.get("type") == "fixed"}
    still = [name for name, mimic in mimics.items() if mimic.leader in fixed or not mimic.factor]
    position, ids = pin.neutral(model), [model.getJointId(name) for name in still]
    for name, i in zip(still, ids, strict=True):
        set_position(model, i, mimics.pop(name).offset, position)
    return fix_joints(model, ids, position) if ids else model, mimics


def read_srdf_postures(urdf: Path, joint_names: Sequence[str]) -> dict[str, Array]:
    """Named postures (n,): group states of the SRDF file with the same stem, beside the URDF file or in ../srdf.

    States of several groups with the same name form one posture. Joints with several degrees of freedom are skipped.

    Raises:
        RobotError: if the SRDF file cannot be read.
    """
    path = find_srdf(urdf)
    if path is None:
        return {}
    states: dict[str, dict[str, float]] = {}
    # Skip values of joints with several degrees of freedom, which are not single numbers.
    for state in read_xml(path, "SRDF", "robot").iter("group_state"):
        joints = states.setdefault(state.get("name", ""), {})
        for joint in state.iter("joint"):
            with suppress(ValueError):
                if np.isfinite(value := float(joint.get("value", ""))):
                    joints[joint.get("name", "")] = value
    return collect_postures(states, joint_names)


def find_srdf(urdf: Path) -> Path | None:
    """The SRDF file with the same stem as a URDF file, beside it or in ../srdf; None if there is none."""
    name = f"{urdf.stem}.srdf"
    return next((p for p in (urdf.parent / name, urdf.parent.parent / "srdf" / name) if p.is_file()), None)


_DATA = "example-robot-data"


def list_robot_files() -> dict[str, Path]:
    """URDF files of example-robot-data by robot name, for example 'ur5' for ur5_robot.urdf."""
    try:
        found = [Path(str(file.locate())) for file in files(_DATA) or () if file.suffix == ".urdf"]
    except PackageNotFoundError:
        return {}
    named = {path.stem: path for path in sorted(found, reverse=True)}
    return {stem.removesuffix("_robot"): path for stem, path in named.items()} | named


def find_robot_file(name: str) -> Path:
    """The URDF file of a robot's name, such as 'panda'.

    example-robot-data comes first. robot_descriptions, if installed, downloads a description on first use.

    Raises:
        UnknownNameError: if no installed package knows the name. The message lists the known names.
    """
    known = list_robot_files()
    if name in known:
        return known[name]
    module = f"robot_descriptions.{name}_description"
    if name.isidentifier() and find_spec("robot_descriptions") and find_spec(module):
        return Path(import_module(module).URDF_PATH)
    hint = () if known else (f"none: pip install {_DATA}, or robot_descriptions",)
    raise UnknownNameError("robot", name, (*known, *hint))
