"""Links of URDF files that carry shapes: where they are on a robot, where their meshes lie, and their numbers."""

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

from orthocas.errors import RobotError
from orthocas.robots.mjcf import read_mjcf
from orthocas.robots.pinocchio_model import find_axis, find_frame, lock_joints, lock_others
from orthocas.robots.spatial import rotate_z_to
from orthocas.robots.tree import BASE_JOINTS, KinematicTree
from orthocas.robots.urdf import read_urdf
from orthocas.tools.checks import Array, Indices
from orthocas.tools.display import listed

MJCF = ".xml"  #: how names of MJCF files end
SAME_PLACE = 1e-6  #: between the joints of two files of one robot [m]


@dataclass(frozen=True, eq=False)
class LinkPlace:
    """Where a link is: the body that carries it, and its pose in the frame of that body."""

    body: int  #: -1 for the base
    pose: Any  #: pin.SE3


def place_links(
    path: Path, tree: KinematicTree, names: list[str], locked: Mapping[str, float] | None = None
) -> list[LinkPlace]:
    """The places of links of a URDF file, or of bodies of an MJCF file, on a robot that was built from it.

    Joints that the robot does not have are locked as in `Robot.from_urdf`.

    Args:
        path: the file, of MJCF if its name ends in .xml.
        tree: the robot.
        names: of the links or bodies.
        locked: joints that were locked when the robot was built, with their positions [rad] or [m].

    Raises:
        RobotError: if the file cannot be read, or its joints are not those of the robot.
    """
    whole, mimics = read_mjcf(path, locked) if path.suffix.lower() == MJCF else read_urdf(path)
    model = lock_joints(whole, locked or {}, mimics)
    if lost := [name for name in tree.body_joints if name not in (*model.names, *BASE_JOINTS)]:
        raise RobotError(f"{path} has the joints {listed(list(model.names)[1:])}, expected {listed(lost)} among them")
    model = lock_others(model, [i for i in range(1, model.njoints) if model.names[i] in tree.body_joints], mimics)
    # Bodies that the model's joints move; the world is the base.
    carried = [-1, *(tree.body_joints.index(name) for name in list(model.names)[1:])]
    lengths = np.array([np.linalg.norm(place.translation) for place in list(model.jointPlacements)[1:]])
    apart = np.abs(lengths - np.linalg.norm(tree.translations[carried[1:]], axis=1))
    if apart.max(initial=0.0) > SAME_PLACE:
        joint = model.names[1 + int(np.argmax(apart))]
        raise RobotError(f"{path} places joint '{joint}' elsewhere, expected the robot file that the chart was made of")
    # Frames of our tree have the joint's axis as z; Pinocchio's have those of the file.
    turns = [np.eye(3), *(rotate_z_to(find_axis(model, i)[1]) for i in range(1, model.njoints))]
    places = []
    for name in names:
        frame = model.frames[find_frame(model, name)]
        turn = pin.SE3(turns[frame.parentJoint].T, np.zeros(3))
        places.append(LinkPlace(carried[frame.parentJoint], turn * frame.placement))
    return places


def load_mesh(path: Path, shape: ElementTree.Element) -> tuple[Array, Indices]:
    """Vertices (V, 3) [m] and triangles (F, 3) of the mesh that a URDF file at `path` names, scaled.

    Raises:
        ValueError: if it cannot be found or read, or has no triangle, or a vertex is not finite.
    """
    file = find_mesh(path, shape.get("filename", ""))
    if file is None:
        raise ValueError("not found")
    return read_mesh(file, read_numbers(shape, "scale", 3, (1, 1, 1)))


def read_mesh(file: Path, scale: Array) -> tuple[Array, Indices]:
    """Vertices and triangles of a mesh file; errors as in `load_mesh`."""
    try:
        mesh: Any = coal.MeshLoader().load(str(file), scale)
    except RuntimeError as error:
        raise ValueError(str(error)) from None
    # coal's arrays belong to the mesh, and end with it.
    vertices = np.array(mesh.vertices(), dtype=float).reshape(-1, 3)
    faces = np.array([[t[0], t[1], t[2]] for t in map(mesh.tri_indices, range(mesh.num_tris))], dtype=np.intp)
    if not (len(faces) and np.isfinite(vertices).all()):
        raise ValueError("empty")
    return vertices, faces


def find_mesh(path: Path, name: str) -> Path | None:
    """The mesh file that a URDF file names: beside it, absolute, or in a package above it or on ROS_PACKAGE_PATH."""
    name = unquote(name)
    scheme, _, rest = name.rpartition("://")
    folder = path.resolve().parent
    # Packages lie above the file, or where ROS looks for them.
    if scheme in ("package", "model"):
        package, _, inside = rest.partition("/")
        roots = [*folder.parents, folder, *map(Path, filter(None, os.environ.get("ROS_PACKAGE_PATH", "").split(":")))]
        places = [root / package / inside for root in roots]
        places += [root / inside for root in roots if root.name == package]
    else:
        places = [folder / (rest if scheme == "file" else name)]
    return next((place for place in places if place.is_file()), None)


def read_pose(element: ElementTree.Element) -> Any:
    """The pose of a visual or collision element in the frame of its link."""
    origin = element.find("origin")
    if origin is None:
        return pin.SE3.Identity()
    roll, pitch, yaw = read_numbers(origin, "rpy", 3, (0, 0, 0))
    return pin.SE3(pin.rpy.rpyToMatrix(roll, pitch, yaw), read_numbers(origin, "xyz", 3, (0, 0, 0)))


def read_numbers(element: ElementTree.Element, name: str, count: int, default: tuple[float, ...]) -> Array:
    """Numbers of an attribute; the default if it is missing or is not that many finite numbers."""
    try:
        values = np.array([float(word) for word in element.get(name, "").split()])
    except ValueError:
        values = np.empty(0)
    good = values.shape == (count,) and np.isfinite(values).all() and np.abs(values).max() < 1e6
    return values if good else np.array(default, dtype=float)
