"""Collision models from robot files and chart files: solids of links, their places, and the pairs to check.

URDF files have <collision> elements, and their pairs come from an SRDF file or are found. MJCF files have geoms, and
MuJoCo's rules give the pairs.
"""

import os
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, fields
from itertools import combinations
from pathlib import Path
from typing import Any
from urllib.parse import unquote
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin

from orthocas.errors import InvalidValueError, RobotError
from orthocas.robots.collisions import Collisions, Pair, Part
from orthocas.robots.mjcf import build_pose, compile_mjcf, name_body, read_mjcf
from orthocas.robots.pinocchio_model import find_axis, find_frame, lock_joints, lock_others
from orthocas.robots.shapes import (
    BallGeometry,
    BoxGeometry,
    CapsuleGeometry,
    CloudGeometry,
    CylinderGeometry,
    EllipsoidGeometry,
    Geometry,
    HalfSpaceGeometry,
    HullGeometry,
    Shape,
    read_mesh,
)
from orthocas.robots.spatial import rotate_z_to
from orthocas.robots.tree import BASE_JOINTS, KinematicTree
from orthocas.robots.urdf import find_srdf, read_urdf, read_urdf_xml, read_xml
from orthocas.tools.checks import Array, Indices, require_known
from orthocas.tools.display import listed
from orthocas.tools.json import get_part

MJCF = ".xml"  #: ending of the names of MJCF files


@dataclass(frozen=True, slots=True)
class SolidRules:
    """Settings for reading solids and finding pairs of links."""

    seed: int = 0  #: of the postures
    first: int = 1000  #: random postures that find pairs which always touch
    postures: int = 10_000  #: random postures that find pairs which never come near
    always: float = 0.95  #: a pair that touches in this fraction of the postures touches by design
    near: float = 0.02  #: [m]; pairs that stay farther apart than this are left out
    smallest: float = 1e-9  #: size of a shape [m]
    same_place: float = 1e-6  #: [m], largest distance of equal joints in two files of one robot
    largest: float = 1e6  #: [m], largest size or position in chart files
    straight: float = 1e-6  #: largest entry of R^T R - I of poses in chart files


RULES = SolidRules()
_SOLIDS = "solids of the links: robot.with_rods(radius) takes rods in their place"


@dataclass(frozen=True)
class CollisionSource:
    """The files that describe the solids of a robot."""

    urdf: Path  #: or an MJCF file, whose name ends in .xml
    srdf: Path | None = None  #: None: the one beside the URDF file or in ../srdf with its stem or the robot's name
    locked: Mapping[str, float] = field(default_factory=dict)  #: joints that were locked, with their positions

    def read(self, tree: KinematicTree) -> Collisions:
        """Read the solids of a robot's links and the pairs to check.

        Boxes, cylinders, spheres and capsules keep their shapes; a mesh becomes its convex hull. If an SRDF file
        disables pairs, all other pairs of links on different bodies are checked. Otherwise the pairs are found: all
        pairs except neighbours, links that touch by design, and links that never come near each other (`SolidRules`).

        In an MJCF file, the solids are the geoms that can collide, named after their bodies. MuJoCo's rules select the
        pairs: contype and conaffinity must match, and parent-child pairs and excluded pairs are left out.

        Raises:
            RobotError: if a file cannot be read, no link has a shape, or the joints are not those of the robot.
        """
        return (_read_geoms if self.urdf.suffix.lower() == MJCF else _read_elements)(tree, self)


def _read_elements(tree: KinematicTree, source: CollisionSource) -> Collisions:
    """The solids and pairs of a URDF file, with its SRDF file."""
    root = read_urdf_xml(source.urdf)
    links = [link for link in root.findall("link") if link.find("collision") is not None]
    places = place_links(source.urdf, tree, [link.get("name", "") for link in links], source.locked)
    parts: list[Part] = []
    missing: dict[str, None] = {}
    for link, place in zip(links, places, strict=True):
        name = link.get("name", "")
        for element in link.findall("collision"):
            shape = _read_shape(source.urdf, element)
            if shape is None:
                missing[name] = None
            else:
                parts.append(Part(name, place.body, shape.move(place.pose.rotation, place.pose.translation)))
    if not parts:
        lost = f" that can be read: no mesh of {', '.join(missing)}" if missing else ""
        raise RobotError(f"{source.urdf} has no <collision> element{lost}, expected {_SOLIDS}")

    # Check all pairs of links on different bodies except those that an SRDF file disables.
    bodies = {part.name: part.body for part in parts}
    pairs = [(a, b) for a, b in combinations(bodies, 2) if bodies[a] != bodies[b]]
    srdf = _find_pairs_file(source.urdf, root.get("name", "")) if source.srdf is None else source.srdf
    disabled = set() if srdf is None else read_disabled_pairs(srdf)
    if srdf is not None and (disabled or source.srdf is not None):
        kept = [pair for pair in pairs if frozenset(pair) not in disabled]
        return Collisions(tree, parts, kept, tuple(missing), f"from {srdf.name}")
    apart = [pair for pair in pairs if frozenset(pair) not in _find_neighbours(root, set(bodies))]
    found = find_pairs(Collisions(tree, parts, apart))
    return Collisions(tree, parts, found, tuple(missing), f"found in {RULES.postures:,} postures")


def _read_geoms(tree: KinematicTree, source: CollisionSource) -> Collisions:
    """The solids and pairs of an MJCF file."""
    if source.srdf is not None:
        raise RobotError(
            f"{source.srdf} is given with {source.urdf}, expected a URDF file: MJCF files define their own pairs"
        )
    compiled = compile_mjcf(source.urdf)
    solid = [i for i in range(compiled.ngeom) if compiled.geom_contype[i] or compiled.geom_conaffinity[i]]
    bodies = sorted({int(compiled.geom_bodyid[i]) for i in solid})
    moved = [name_body(compiled, i) for i in bodies if i]
    places = dict(zip(moved, place_links(source.urdf, tree, moved, source.locked), strict=True))
    parts: list[Part] = []
    names: dict[int, str] = {}
    missing: dict[str, None] = {}
    for i in solid:
        body = int(compiled.geom_bodyid[i])
        name = name_body(compiled, body)
        # Geoms of the world keep their own names.
        names[i] = name if body else str(compiled.geom(i).name or name)
        place = places[name] if body else LinkPlace(-1, pin.SE3.Identity())
        geometry = _build_geom(compiled, i)
        if geometry is None or (place.body >= 0 and isinstance(geometry, HalfSpaceGeometry)):
            missing[names[i]] = None
            continue
        pose = place.pose * build_pose(compiled.geom_pos[i], compiled.geom_quat[i])
        parts.append(Part(names[i], place.body, Shape(geometry, pose.rotation, pose.translation)))
    if not parts:
        raise RobotError(f"{source.urdf} has no geom that can collide, expected {_SOLIDS}")
    known = {part.name: part.body for part in parts}
    pairs: dict[tuple[str, str], None] = {}
    for i, k in combinations(solid, 2):
        first, second = names[i], names[k]
        both = first in known and second in known and known.get(first) != known.get(second)
        if both and (second, first) not in pairs and _can_collide(compiled, i, k):
            pairs[first, second] = None
    # A half-space comes second in its pair.
    planes = {part.name for part in parts if not part.shape.bounded}
    ordered = [(b, a) if a in planes else (a, b) for a, b in pairs if not {a, b} <= planes]
    return Collisions(tree, parts, ordered, tuple(missing), f"from {source.urdf.name}")


def _can_collide(compiled: Any, i: int, k: int) -> bool:
    """Whether MuJoCo looks for contacts of two geoms."""
    first, second = (int(compiled.geom_bodyid[j]) for j in (i, k))
    low, high = sorted((first, second))
    if (low << 16) + high in compiled.exclude_signature.tolist():
        return False
    # Bodies without joints between them are one body for MuJoCo.
    a, b = (int(compiled.body_weldid[j]) for j in (first, second))
    parents = [int(compiled.body_weldid[compiled.body_parentid[j]]) for j in (a, b)]
    if a == b or (a and b and (parents[0] == b or parents[1] == a)):
        return False
    contype, conaffinity = compiled.geom_contype, compiled.geom_conaffinity
    return bool(contype[i] & conaffinity[k] or contype[k] & conaffinity[i])


def _build_geom(compiled: Any, i: int) -> Geometry | None:
    """The solid of a geom; None for height fields and meshes without a volume."""
    size, kind = np.array(compiled.geom_size[i], dtype=float), int(compiled.geom_type[i])
    if kind == _MESH:
        mesh = int(compiled.geom_dataid[i])
        first, count = int(compiled.mesh_vertadr[mesh]), int(compiled.mesh_vertnum[mesh])
        with suppress(ValueError):
            return HullGeometry.around(np.array(compiled.mesh_vert[first : first + count], dtype=float))
        return None
    return _GEOMS[kind](size) if kind in _GEOMS else None


_MESH = 7  #: MuJoCo's mjtGeom
#: by mjtGeom, from their sizes (3,)
_GEOMS: Mapping[int, Callable[[Array], Geometry]] = {
    0: lambda _: HalfSpaceGeometry(),
    2: lambda size: BallGeometry(float(size[0])),
    3: lambda size: CapsuleGeometry(float(size[0]), float(2 * size[1])),
    4: EllipsoidGeometry,
    5: lambda size: CylinderGeometry(float(size[0]), float(2 * size[1])),
    6: lambda size: BoxGeometry(2 * size),
}


def read_disabled_pairs(path: Path) -> set[frozenset[str]]:
    """The pairs of links that an SRDF file disables.

    Raises:
        RobotError: if the file cannot be read.
    """
    elements = read_xml(path, "SRDF", "robot").iter("disable_collisions")
    return {frozenset((element.get("link1", ""), element.get("link2", ""))) for element in elements}


def _find_pairs_file(urdf: Path, name: str) -> Path | None:
    """The SRDF file with the stem of a URDF file, or the only one for a robot of its name; None if there is none."""
    if (same := find_srdf(urdf)) is not None:
        return same
    named = []
    for path in sorted([*urdf.parent.glob("*.srdf"), *(urdf.parent.parent / "srdf").glob("*.srdf")]):
        with suppress(RobotError):
            if name and read_xml(path, "SRDF", "robot").get("name") == name:
                named.append(path)
    return named[0] if len(named) == 1 else None


def find_pairs(collisions: Collisions) -> list[Pair]:
    """The pairs of `collisions` that neither touch by their make nor stay apart, in seeded postures between limits."""
    postures = collisions.tree.draw_postures(RULES.postures, RULES.seed)
    count = len(collisions.pairs)
    touching, near = np.zeros(count), np.zeros(count, dtype=bool)
    # How often pairs touch, of the first postures.
    for owner, distance in collisions.scan_near(postures[: RULES.first], RULES.near, np.ones(count, dtype=bool)):
        near[owner] = True
        touching[owner] += distance <= 0
    always = touching >= RULES.always * RULES.first
    always |= collisions.pair_distances(collisions.tree.centre_posture) <= 0
    # Whether the others ever come near, in further ones.
    for start in range(RULES.first, len(postures), RULES.first):
        for owner, _ in collisions.scan_near(postures[start : start + RULES.first], RULES.near, ~near):
            near[owner] = True
    return [pair for pair, ever, made in zip(collisions.pairs, near, always, strict=True) if ever and not made]


def _find_neighbours(root: ElementTree.Element, solid: set[str]) -> set[frozenset[str]]:
    """Pairs of links with solids whose connection holds one joint, or several with only empty links between."""
    parents: dict[str, str] = {}
    for joint in root.findall("joint"):
        parent, child = joint.find("parent"), joint.find("child")
        if parent is not None and child is not None:
            parents[child.get("link", "")] = parent.get("link", "")
    # Go up from each solid, past frames and empty links, to the next solid.
    neighbours = set()
    for link in solid:
        above = parents.get(link)
        while above is not None and above not in solid:
            above = parents.get(above)
        if above is not None:
            neighbours.add(frozenset((link, above)))
    return neighbours


def _read_shape(path: Path, element: ElementTree.Element) -> Shape | None:
    """The solid of a collision element in the frame of its link; None if its mesh cannot be found or has no volume."""
    geometry = element.find("geometry")
    shape = next(iter(geometry if geometry is not None else ()), None)
    if shape is None:
        return None
    pose = read_pose(element)

    # A missing size reads as 0, so the check for 0 refuses it.
    def sizes(*names: str, count: int = 1) -> list[Array]:
        values = [read_numbers(shape, name, count, (0.0,) * count) for name in names]
        if min(float(value.min()) for value in values) < RULES.smallest:
            raise RobotError(f"{path}: <{shape.tag}> of a collision element has no size, expected numbers above 0")
        return values

    solid: Geometry
    match shape.tag:
        case "box":
            solid = BoxGeometry(sizes("size", count=3)[0])
        case "sphere":
            solid = BallGeometry(float(sizes("radius")[0][0]))
        case "cylinder" | "capsule":
            radius, length = (float(value[0]) for value in sizes("radius", "length"))
            solid = (CylinderGeometry if shape.tag == "cylinder" else CapsuleGeometry)(radius, length)
        # A flat or empty mesh encloses no volume that could touch.
        case "mesh":
            try:
                solid = HullGeometry.around(load_mesh(path, shape)[0])
            except ValueError:
                return None
        case _:
            return None
    return Shape(solid, pose.rotation, pose.translation)


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
        path: the robot file, MJCF if its name ends in .xml.
        tree: the robot.
        names: the links or bodies.
        locked: joints that were locked when the robot was built, with their positions [rad] or [m].

    Raises:
        RobotError: if the file cannot be read, or its joints are not those of the robot.
    """
    whole, mimics = read_mjcf(path, locked) if path.suffix.lower() == MJCF else read_urdf(path)
    model = lock_joints(whole, locked or {}, mimics)
    if lost := [name for name in tree.body_joints if name not in (*model.names, *BASE_JOINTS)]:
        raise RobotError(f"{path} has the joints {listed(list(model.names)[1:])}, expected {listed(lost)} among them")
    model = lock_others(model, [i for i in range(1, model.njoints) if model.names[i] in tree.body_joints], mimics)
    # Bodies that the model's joints move; the world counts as the base.
    carried = [-1, *(tree.body_joints.index(name) for name in list(model.names)[1:])]
    lengths = np.array([np.linalg.norm(place.translation) for place in list(model.jointPlacements)[1:]])
    apart = np.abs(lengths - np.linalg.norm(tree.translations[carried[1:]], axis=1))
    if apart.max(initial=0.0) > RULES.same_place:
        joint = model.names[1 + int(np.argmax(apart))]
        raise RobotError(f"{path} places joint '{joint}' elsewhere, expected the robot file that the chart was made of")
    # Our body frames have the joint axis as z; Pinocchio's frames are those of the file.
    turns = [np.eye(3), *(rotate_z_to(find_axis(model, i)[1]) for i in range(1, model.njoints))]
    places = []
    for name in names:
        frame = model.frames[find_frame(model, name)]
        turn = pin.SE3(turns[frame.parentJoint].T, np.zeros(3))
        places.append(LinkPlace(carried[frame.parentJoint], turn * frame.placement))
    return places


def load_mesh(path: Path, shape: ElementTree.Element) -> tuple[Array, Indices]:
    """Vertices (V, 3) [m] and triangles (F, 3) of the scaled mesh that a URDF file at `path` names.

    Raises:
        ValueError: if it cannot be found or read, or has no triangle, or a vertex is not finite.
    """
    file = find_mesh(path, shape.get("filename", ""))
    if file is None:
        raise ValueError("not found")
    return read_mesh(file, read_numbers(shape, "scale", 3, (1, 1, 1)))


def find_mesh(path: Path, name: str) -> Path | None:
    """Find the mesh file that a URDF file names: beside it, absolute, or in a package above or on ROS_PACKAGE_PATH."""
    name = unquote(name)
    scheme, _, rest = name.rpartition("://")
    folder = path.resolve().parent
    # Packages lie above the file, or in the folders of ROS.
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
    """Numbers of an attribute; the default if it is missing or does not hold `count` finite numbers."""
    try:
        values = np.array([float(word) for word in element.get(name, "").split()])
    except ValueError:
        values = np.empty(0)
    good = values.shape == (count,) and np.isfinite(values).all() and np.abs(values).max() < 1e6
    return values if good else np.array(default, dtype=float)


# What chart files hold of a collision model: plain data and arrays.

_ARRAYS = ("collisions_poses", "collisions_sizes", "collisions_points")


@dataclass(frozen=True, eq=False)
class KnownSolids:
    """Solids in memory, in place of a file."""

    collisions: Collisions
    locked: Mapping[str, float] = field(default_factory=dict)

    def read(self, tree: KinematicTree) -> Collisions:
        """The same solids on a robot with the same bodies."""
        known = self.collisions
        return Collisions(tree, known.parts, known.pairs, known.missing, known.origin)


#: words in files -> a geometry, its number of sizes, and a function of sizes and points that builds it
_KINDS: Mapping[str, tuple[type, int, Callable[[Array, Array], Geometry]]] = {
    "box": (BoxGeometry, 3, lambda size, _: BoxGeometry(size)),
    "ball": (BallGeometry, 1, lambda size, _: BallGeometry(float(size[0]))),
    "cylinder": (CylinderGeometry, 2, lambda size, _: CylinderGeometry(*size.tolist())),
    "capsule": (CapsuleGeometry, 2, lambda size, _: CapsuleGeometry(*size.tolist())),
    "ellipsoid": (EllipsoidGeometry, 3, lambda size, _: EllipsoidGeometry(size)),
    "half-space": (HalfSpaceGeometry, 0, lambda *_: HalfSpaceGeometry()),
    "hull": (HullGeometry, 0, lambda _, points: HullGeometry.around(points)),
    "cloud": (CloudGeometry, 1, lambda size, points: CloudGeometry(points, float(size[0]))),
}


def collisions_to_data(collisions: Collisions) -> tuple[dict[str, Any], dict[str, Array]]:
    """A collision model as plain data and arrays, with the solids that a pair names; corners in single precision."""
    # No distance to other solids is ever measured, so files need not store them.
    used = {name for pair in collisions.pairs for name in pair}
    parts, poses, sizes, points = list[dict[str, Any]](), list[Array](), list[float](), list[Array]()
    for part in collisions.parts:
        if part.name not in used:
            continue
        geometry = part.shape.geometry
        kind = next(word for word, (own, _, _) in _KINDS.items() if isinstance(geometry, own))
        # All fields of a geometry are sizes, except the corners of a hull (from which its faces follow) and the points
        # of a cloud.
        values = {part.name: getattr(geometry, part.name) for part in fields(geometry)}  # type: ignore[arg-type]
        corners = values.pop("points", np.zeros((0, 3)))
        values.pop("faces", None)
        parts.append({"name": part.name, "body": part.body, "kind": kind, "points": len(corners)})
        poses.append(np.column_stack([part.shape.rotation, part.shape.translation]))
        sizes += [float(value) for size in values.values() for value in np.ravel(size)]
        points.append(corners)
    # Store pairs as indices of names. Several parts of a link share its name.
    names = list(dict.fromkeys(part["name"] for part in parts))
    header = {
        "parts": parts,
        "pairs": [[names.index(first), names.index(second)] for first, second in collisions.pairs],
        "missing": list(collisions.missing),
        "origin": collisions.origin,
    }
    # Corners are most of the bytes. In single precision an error at 1 m is below 0.1 micrometre.
    corners = np.concatenate([np.zeros((0, 3)), *points]).astype(np.float32)
    arrays = (np.array(poses).reshape(-1, 3, 4), np.array(sizes, dtype=float), corners)
    return header, dict(zip(_ARRAYS, arrays, strict=True))


def collisions_from_data(tree: KinematicTree, data: Mapping[str, Any], arrays: Mapping[str, Any]) -> Collisions:
    """The collision model of a robot from plain data and arrays, which may be damaged.

    Raises:
        OrthocasError, and errors of Python and NumPy: if the data are damaged.
    """
    poses, sizes, points = (np.asarray(get_part(arrays, name, np.ndarray), dtype=float) for name in _ARRAYS)
    # Check everything, because a file may have been edited.
    for name, array in zip(_ARRAYS, (poses, sizes, points), strict=True):
        if not (np.abs(array) <= RULES.largest).all():
            raise InvalidValueError(name, "numbers that are not finite or too large", f"at most {RULES.largest:g}")
    if (sizes <= 0).any():
        raise InvalidValueError("collisions_sizes", float(sizes.min()), "numbers above 0")
    parts, size, point = list[Part](), 0, 0
    for description, pose in zip(get_part(data, "parts", list), poses, strict=True):
        kind = get_part(description, "kind", str)
        require_known("kind of solid", kind, _KINDS)
        _, length, build = _KINDS[kind]
        own = sizes[size : size + length]
        count = get_part(description, "points", int)
        corners = points[point : point + count]
        if count < 0 or len(own) != length or len(corners) != count:
            raise InvalidValueError("solids", f"too few numbers for a {kind}", "all of its sizes and corners")
        size, point = size + len(own), point + count
        # A scaled or mirrored pose would change distances without an error.
        R = pose[:, :3]
        if np.abs(R.T @ R - np.eye(3)).max() > RULES.straight:
            raise InvalidValueError("collisions_poses", R.tolist(), "rotation matrices")
        shape = Shape(build(own, corners), R, pose[:, 3])
        parts.append(Part(get_part(description, "name", str), get_part(description, "body", int), shape))
    names = list(dict.fromkeys(part.name for part in parts))
    pairs = []
    for i, k in get_part(data, "pairs", list):
        for index in (i, k):
            if isinstance(index, bool) or not isinstance(index, int) or not 0 <= index < len(names):
                raise InvalidValueError("pair of solids", repr(index)[:80], f"numbers below {len(names)}")
        pairs.append((names[i], names[k]))
    missing = [str(name) for name in get_part(data, "missing", list)]
    return Collisions(tree, parts, pairs, missing, get_part(data, "origin", str))
