"""The look of a robot from the visual elements of its URDF file: meshes where the files are there."""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import unquote
from xml.etree import ElementTree

import coal
import numpy as np
import pinocchio as pin

from orthocas.checks import Array
from orthocas.errors import RobotError
from orthocas.robots.files import lock_joints, lock_off_chain, read_urdf
from orthocas.robots.pinocchio_model import frame_index, joint_axis
from orthocas.robots.spatial import rotation_z_to
from orthocas.robots.tree import KinematicTree
from orthocas.robots.xml_files import read_xml
from orthocas.viewing.solids import Colour, Solid, ball, block, drum
from orthocas.viewing.stick_arm import SHELL, Look

_SAME = 1e-6  # [m] between the joints of two files of one robot
_MOST_TRIANGLES = 3_000_000  # of all meshes, more is slow to send and to draw


@dataclass(frozen=True)
class UrdfLook:
    """What a URDF file shows."""

    look: Look  #: empty where the file has nothing to show, or its mesh is missing
    missing: tuple[str, ...]  #: mesh files that cannot be found or read


def urdf_look(path: Path, tree: KinematicTree, locked: Mapping[str, float] | None = None) -> UrdfLook:
    """Solids of all links of a URDF file, carried by the bodies of a robot that was built from it.

    Joints off the chain to the tip are locked as in `Robot.from_urdf`, so their links are shown too.

    Args:
        path: the URDF file.
        tree: the robot.
        locked: joints that were locked when the robot was built, with their positions [rad] or [m].

    Raises:
        RobotError: if the file cannot be read, or its joints are not those of the robot.
    """
    root = read_xml(path, "URDF", "robot")
    model = lock_off_chain(lock_joints(read_urdf(path), locked or {}), tree.tip_name)
    _require_same(path, model, tree)
    turns = [np.eye(3), *(rotation_z_to(joint_axis(model, i)[1]) for i in range(1, model.njoints))]
    colours = _materials(root)
    look: Look = [[] for _ in range(tree.n + 2)]
    missing: list[str] = []
    for link in root.findall("link"):
        frame = model.frames[frame_index(model, link.get("name", ""))]
        body = frame.parentJoint
        for visual in link.findall("visual"):
            solid = _solid(path, visual, colours, missing)
            if solid is not None:
                place = frame.placement * _pose(visual)
                look[body].append(solid.moved(turns[body].T @ place.rotation, turns[body].T @ place.translation))
    triangles = sum(len(solid.faces) for solids in look for solid in solids)
    if triangles > _MOST_TRIANGLES:
        raise RobotError(f"{path} shows {triangles:,} triangles, expected at most {_MOST_TRIANGLES:,}")
    return UrdfLook(look, tuple(missing))


def _require_same(path: Path, model: pin.Model, tree: KinematicTree) -> None:
    """Raise RobotError unless a model has the joints of a tree at the same places."""
    names = tuple(model.names)[1:]
    if names != tree.joint_names:
        raise RobotError(f"{path} has the joints {', '.join(names)}, expected {', '.join(tree.joint_names)}")
    lengths = np.array([np.linalg.norm(model.jointPlacements[i + 1].translation) for i in range(tree.n)])
    apart = np.abs(lengths - np.linalg.norm(tree.translations, axis=1))
    if apart.max() > _SAME:
        joint = names[int(np.argmax(apart))]
        raise RobotError(f"{path} places joint '{joint}' elsewhere, expected the robot file that the chart was made of")


def _materials(root: ElementTree.Element) -> dict[str, Colour]:
    """Colours of the named materials of a file."""
    found = {}
    for material in root.iter("material"):
        colour = _colour_of(material)
        if colour is not None and material.get("name"):
            found[material.get("name", "")] = colour
    return found


def _colour_of(material: ElementTree.Element) -> Colour | None:
    """The colour that a material defines itself."""
    element = material.find("color")
    if element is None:
        return None
    red, green, blue, *_ = (round(255 * value) for value in np.clip(_numbers(element, "rgba", 4, (1, 1, 1, 1)), 0, 1))
    return red, green, blue


def _solid(path: Path, visual: ElementTree.Element, colours: Mapping[str, Colour], missing: list[str]) -> Solid | None:
    """The geometry of a visual element in its own frame; None if there is none to show."""
    material = visual.find("material")
    colour = SHELL
    if material is not None:
        colour = _colour_of(material) or colours.get(material.get("name", ""), SHELL)
    shape = next(iter(visual.find("geometry") if visual.find("geometry") is not None else ()), None)  # type: ignore[arg-type]
    if shape is None:
        return None
    if shape.tag == "box":
        return block(_numbers(shape, "size", 3, (0.1, 0.1, 0.1)), colour)
    if shape.tag == "sphere":
        return ball(float(_numbers(shape, "radius", 1, (0.1,))[0]), colour)
    if shape.tag == "cylinder":
        radius, length = (float(_numbers(shape, name, 1, (0.1,))[0]) for name in ("radius", "length"))
        return drum(radius, length / 2, colour)
    if shape.tag == "mesh":
        return _mesh(path, shape, colour, missing)
    return None


def _mesh(path: Path, shape: ElementTree.Element, colour: Colour, missing: list[str]) -> Solid | None:
    """The triangles of a mesh file; None if it cannot be found or read."""
    name = shape.get("filename", "")
    file = _located(path, name)
    try:
        if file is None:
            raise ValueError("not found")
        mesh: Any = coal.MeshLoader().load(str(file), _numbers(shape, "scale", 3, (1, 1, 1)))
        vertices = np.array(mesh.vertices(), dtype=float).reshape(-1, 3)
        faces = np.array([[t[0], t[1], t[2]] for t in map(mesh.tri_indices, range(mesh.num_tris))], dtype=np.intp)
        if not (len(faces) and np.isfinite(vertices).all()):
            raise ValueError("empty")
    except (ValueError, RuntimeError):
        missing.append(name)
        return None
    return Solid(vertices, faces, colour)


def _located(path: Path, name: str) -> Path | None:
    """The mesh file that a URDF file names: beside it, absolute, or in a package above it or on ROS_PACKAGE_PATH."""
    name = unquote(name)
    scheme, _, rest = name.rpartition("://")
    folder = path.resolve().parent
    if scheme in ("package", "model"):
        package, _, inside = rest.partition("/")
        roots = [*folder.parents, folder, *map(Path, filter(None, os.environ.get("ROS_PACKAGE_PATH", "").split(":")))]
        places = [root / package / inside for root in roots]
        places += [root / inside for root in roots if root.name == package]
    else:
        places = [folder / (rest if scheme == "file" else name)]
    return next((place for place in places if place.is_file()), None)


def _pose(visual: ElementTree.Element) -> Any:
    """The pose of a visual element in the frame of its link."""
    origin = visual.find("origin")
    if origin is None:
        return pin.SE3.Identity()
    roll, pitch, yaw = _numbers(origin, "rpy", 3, (0, 0, 0))
    return pin.SE3(pin.rpy.rpyToMatrix(roll, pitch, yaw), _numbers(origin, "xyz", 3, (0, 0, 0)))


def _numbers(element: ElementTree.Element, name: str, count: int, default: tuple[float, ...]) -> Array:
    """Numbers of an attribute; the default if it is missing or is not that many finite numbers."""
    try:
        values = np.array([float(word) for word in element.get(name, "").split()])
    except ValueError:
        values = np.empty(0)
    good = values.shape == (count,) and np.isfinite(values).all() and np.abs(values).max() < 1e6
    return values if good else np.array(default, dtype=float)
