"""Convert an MJCF file to a `pin.Model` with the mass matrix and bias of MuJoCo."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
import pinocchio as pin

from orthocas.errors import RobotError
from orthocas.robots.mjcf_document import MAIN, Document
from orthocas.robots.mjcf_efforts import Ranges, effort_of_actuators
from orthocas.robots.mjcf_inertias import MassRules, Placed, body_inertia
from orthocas.robots.mjcf_poses import Angles, pose, shape_pose
from orthocas.robots.xml import MOST_LINKS, Attributes

_GRAVITY = (0.0, 0.0, -9.81)  # [m/s^2], MuJoCo's default
_LEAST_TOTAL = 1e-15  # [kg], as in MuJoCo
_SEEN = ("camera", "light")  # elements without mass or motion
_READ = ("inertial", "joint", "freejoint", "geom", "site", "body")


def model_from_mjcf(path: str | Path) -> pin.Model:
    """Read the kinematics, masses, armatures, limits of position and effort, and gravity of an MJCF file.

    The model has a frame for every body, named site and joint. If they share a name, `frame_index` prefers the body to
    the site, and the site to the joint. Bodies and joints without a name are called body<i> and joint<i>, with MuJoCo's
    indices i.

    Mass matrix and bias are those of MuJoCo (qM and qfrc_bias). A `Robot` has no passive and constraint forces:
    springs, damping, friction, gravity compensation (gravcomp), fluids, actuators, contacts and <equality>.

    Raises:
        RobotError: if the file is not MJCF, or contains elements that are not supported: masses that depend on meshes,
            armatures of tendons and actuators, scaled frames, flexible bodies, and elements that generate others
            (attach, replicate, composite, ...). The message gives file, element and reason.
    """
    document = Document(path)
    _refuse_unread(document)
    model = _Builder(document).build()
    if model.njoints == 1:
        raise RobotError(f"{path} has no joint, expected at least one")
    return model


def _refuse_unread(document: Document) -> None:
    """Refuse elements outside the bodies that change the mass matrix."""
    for section in ("default", "tendon", "actuator"):
        for top in document.sections(section):
            for element in top.iter():
                label = document.label(element)
                if element.tag != "joint" and label.number("armature", 0) != 0:
                    raise label.error("has an armature, which orthocas supports on joints only")
    for top in document.sections("deformable"):
        for element in top.findall("flex"):
            raise document.label(element).error("is a flexible body, which orthocas does not support")


@dataclass(frozen=True, slots=True)
class _Part:
    """An element of a body, with the frames around it resolved."""

    element: Element
    frame: pin.SE3  # pose of the frame around it, in the body
    childclass: str


class _Builder:
    """Adds bodies to a model, from the world outwards."""

    def __init__(self, document: Document) -> None:
        compiler = document.settings("compiler")
        if compiler.text("coordinate", "local") != "local":
            raise compiler.error("has global coordinates, which MuJoCo and orthocas do not support")
        self._document = document
        self._angles = Angles.of(compiler)
        self._rules = MassRules.of(compiler)
        self._ranges = Ranges(compiler.flag("autolimits", True))
        self._efforts = effort_of_actuators(document, self._ranges)
        self._model = pin.Model()
        self._names: dict[str, set[str]] = {"body": {"world"}, "joint": set(), "site": set()}
        self._masses: list[tuple[int, pin.SE3, pin.Inertia]] = []

    def build(self) -> pin.Model:
        """Build the model of the whole file."""
        off = self._document.settings("option/flag").keyword("gravity", ("enable", "disable"), "enable") == "disable"
        gravity = self._document.settings("option").numbers("gravity", 3, _GRAVITY)
        self._model.gravity.linear = np.zeros(3) if off else gravity
        for world in self._document.sections("worldbody"):
            parts = list(self._parts(world, pin.SE3.Identity(), MAIN, "world"))
            for part in parts:
                if part.element.tag in ("joint", "freejoint", "inertial"):
                    raise self._document.label(part.element).error("is in the world, expected it in a body")
            self._add_sites(parts, 0, pin.SE3.Identity(), "world")
            self._add_bodies(parts, 0, pin.SE3.Identity())
        total = sum(inertia.mass for _, _, inertia in self._masses)
        scale = self._rules.total / max(total, _LEAST_TOTAL) if self._rules.total > 0 else 1.0
        for joint, placement, inertia in self._masses:
            scaled = pin.Inertia(scale * inertia.mass, inertia.lever, scale * inertia.inertia)
            self._model.appendBodyToJoint(joint, scaled, placement)
        self._add_keyframes()
        return self._model

    def _add_keyframes(self) -> None:
        """Add keyframes as reference configurations. The numbers of free and ball joints stay in MuJoCo's order."""
        for section in self._document.sections("keyframe"):
            for key in section.findall("key"):
                if "name" in key.attrib and "qpos" in key.attrib:
                    position = self._document.label(key).numbers("qpos", self._model.nq, ())
                    self._model.referenceConfigurations[key.attrib["name"]] = np.array(position)

    def _add_bodies(self, parts: list[_Part], joint: int, placement: pin.SE3) -> None:
        for part in parts:
            if part.element.tag == "body":
                self._add_body(part, joint, placement * part.frame)

    def _add_body(self, part: _Part, joint: int, placement: pin.SE3) -> None:
        """Add a body and all its children to a joint. `placement` is that of the frame around it."""
        body = self._document.attributes(part.element)
        name = self._take_name(body, "body", f"body{len(self._names['body'])}")
        if len(self._names["body"]) - 1 > MOST_LINKS:
            raise RobotError(f"{body.file} has more than {MOST_LINKS} bodies")
        childclass = self._childclass(body, part.childclass)
        parts = list(self._parts(part.element, pin.SE3.Identity(), childclass, name))
        placement = placement * pose(body, self._angles)
        for child in parts:
            if child.element.tag in ("joint", "freejoint"):
                joint, placement = self._add_joint(child, joint, placement, name)
        self._model.addFrame(pin.Frame(name, joint, placement, pin.FrameType.BODY))
        self._add_sites(parts, joint, placement, name)
        if joint or self._rules.total > 0:  # bodies fixed to the world load no joint
            self._masses.append((joint, placement, self._inertia(body, parts, name)))
        self._add_bodies(parts, joint, placement)

    def _parts(self, parent: Element, frame: pin.SE3, childclass: str, body: str) -> Iterator[_Part]:
        """The elements of a body, including those inside its frames."""
        for element in parent:
            if element.tag == "frame":
                inner = self._document.attributes(element, body=body)
                if any(name in inner.values for name in ("scale", "scaling", "massscale")):
                    raise inner.error("scales its content, which orthocas does not support")
                below = frame * pose(inner, self._angles)
                yield from self._parts(element, below, self._childclass(inner, childclass), body)
            elif element.tag in _READ:
                yield _Part(element, frame, childclass)
            elif element.tag not in _SEEN:
                raise self._document.label(element, body).error("is an element that orthocas does not support")

    def _childclass(self, label: Attributes, inherited: str) -> str:
        return self._document.known_class(label.text("childclass", inherited), label)

    def _add_joint(self, part: _Part, parent: int, placement: pin.SE3, body: str) -> tuple[int, pin.SE3]:
        """Add a joint to a body at `placement`. Returns its index, and the placement of the body after the joint."""
        joint = self._document.attributes(part.element, part.childclass, body)
        name = self._take_name(joint, "joint", f"joint{len(self._names['joint'])}")
        kind = joint.keyword("type", ("hinge", "slide", "ball", "free"), "hinge")
        armature = joint.number("armature", 0)
        if armature < 0:
            raise joint.error(f"has armature {armature:g}, expected >= 0")
        if kind == "free" or part.element.tag == "freejoint":
            anchor, index = pin.SE3.Identity(), self._model.addJoint(parent, pin.JointModelFreeFlyer(), placement, name)
        else:
            anchor = pin.SE3(np.eye(3), part.frame.act(joint.numbers("pos", 3, (0, 0, 0))))
            if kind == "ball":
                index = self._model.addJoint(parent, pin.JointModelSpherical(), placement * anchor, name)
            else:
                index = self._add_axis(joint, kind, part.frame.rotation, parent, placement * anchor, name)
        self._model.addJointFrame(index)
        first = self._model.joints[index].idx_v
        self._model.armature[first : first + self._model.joints[index].nv] = armature
        return index, anchor.inverse()

    def _add_axis(
        self, joint: Attributes, kind: str, turn: np.ndarray, parent: int, placement: pin.SE3, name: str
    ) -> int:
        """Add a hinge or a slide. In the pose of the file its position is `ref`."""
        axis = turn @ joint.direction("axis", (0, 0, 1))
        unit = self._angles.unit if kind == "hinge" else 1.0
        lower, upper = self._ranges.of(joint) * unit
        back = -axis * joint.number("ref", 0) * unit
        shift = pin.SE3(pin.exp3(back), np.zeros(3)) if kind == "hinge" else pin.SE3(np.eye(3), back)
        make = pin.JointModelRevoluteUnaligned if kind == "hinge" else pin.JointModelPrismaticUnaligned
        effort = min(
            self._ranges.reach(joint, "actuatorfrcrange", "actuatorfrclimited"), self._efforts.get(name, np.inf)
        )
        limits = np.array([effort]), np.full(1, np.inf), np.array([lower]), np.array([upper])
        return int(self._model.addJoint(parent, make(axis), placement * shift, name, *limits))

    def _add_sites(self, parts: list[_Part], joint: int, placement: pin.SE3, body: str) -> None:
        for part in parts:
            if part.element.tag == "site" and "name" in part.element.attrib:
                site = self._document.attributes(part.element, part.childclass, body)
                name = self._take_name(site, "site", "")
                there = placement * part.frame * shape_pose(site, self._angles)[0]
                self._model.addFrame(pin.Frame(name, joint, there, pin.FrameType.OP_FRAME))

    def _inertia(self, body: Attributes, parts: list[_Part], name: str) -> pin.Inertia:
        def placed(tag: str) -> list[Placed]:
            found = (part for part in parts if part.element.tag == tag)
            return [(part.frame, self._document.attributes(part.element, part.childclass, name)) for part in found]

        inertials = placed("inertial")
        if len(inertials) > 1:
            raise body.error(f"has {len(inertials)} <inertial> elements, expected at most one")
        return body_inertia(body, next(iter(inertials), None), placed("geom"), self._rules, self._angles)

    def _take_name(self, element: Attributes, kind: str, default: str) -> str:
        name = element.text("name", default)
        if name in self._names[kind]:
            raise element.error(f"has the name of another {kind}, expected different names")
        self._names[kind].add(name)
        return name
