"""Collisions from robot files: <collision> elements of URDF files with pairs of SRDF files or found, and MJCF geoms."""

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin

from orthocas.errors import RobotError
from orthocas.robots.collisions import Collisions, Pair, Part
from orthocas.robots.link_shapes import MJCF, LinkPlace, load_mesh, place_links, read_numbers, read_pose
from orthocas.robots.mjcf import build_pose, compile_mjcf, name_body
from orthocas.robots.shapes import (
    BallGeometry,
    BoxGeometry,
    CapsuleGeometry,
    CylinderGeometry,
    EllipsoidGeometry,
    Geometry,
    HalfSpaceGeometry,
    HullGeometry,
    Shape,
)
from orthocas.robots.tree import KinematicTree
from orthocas.robots.urdf import find_srdf, read_urdf_xml, read_xml
from orthocas.tools.checks import Array


@dataclass(frozen=True, slots=True)
class PairRules:
    """Numbers by which pairs of links are found."""

    seed: int = 0  #: of the postures
    first: int = 1000  #: postures by which pairs are found that always touch
    postures: int = 10_000  #: postures by which pairs are found that never come near
    always: float = 0.95  #: fraction of postures from which on a pair touches by its make
    near: float = 0.02  #: [m]; pairs that never come nearer are left out
    smallest: float = 1e-9  #: size of a shape [m]


RULES = PairRules()
_SOLIDS = "solids of the links: robot.with_rods(radius) takes rods in their place"


@dataclass(frozen=True)
class CollisionSource:
    """Where the solids of a robot are described."""

    urdf: Path  #: or an MJCF file, whose name ends in .xml
    srdf: Path | None = None  #: None: one beside the URDF file or in ../srdf, with its stem or the robot's name
    locked: Mapping[str, float] = field(default_factory=dict)  #: joints that were locked, with their positions

    def read(self, tree: KinematicTree) -> Collisions:
        """The solids on the links of a robot; see `read_collisions`."""
        return read_collisions(tree, self)


def read_collisions(tree: KinematicTree, source: CollisionSource) -> Collisions:
    """The solids of a robot's links and the pairs to check.

    Boxes, cylinders, spheres and capsules stay what they are; a mesh becomes its convex hull. With an SRDF file that
    disables pairs, all other pairs of links on different bodies are checked. Without one, pairs are found: all but
    neighbours, links that touch in the middle of the limits or in 95 % of 1,000 seeded postures, and links that never
    come nearer than 0.02 m in 10,000 postures.

    Of an MJCF file, geoms that can collide are the solids, named by their bodies, and pairs are those that MuJoCo's own
    rules let collide: by contype and conaffinity, without parents and their children, and without what is excluded.

    Args:
        tree: the robot.
        source: the files.

    Raises:
        RobotError: if a file cannot be read, no link has a shape, or the joints are not those of the robot.
    """
    if source.urdf.suffix.lower() == MJCF:
        return _read_geoms(tree, source)
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

    # All pairs of links on different bodies, less those that an SRDF file disables.
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
    """The same for an MJCF file."""
    if source.srdf is not None:
        raise RobotError(f"{source.srdf} is given with {source.urdf}, expected a URDF file with it: MJCF has own pairs")
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
        # Solids of the world have names of their own.
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
    # A half-space comes second.
    planes = {part.name for part in parts if not part.shape.bounded}
    ordered = [(b, a) if a in planes else (a, b) for a, b in pairs if not {a, b} <= planes]
    return Collisions(tree, parts, ordered, tuple(missing), f"from {source.urdf.name}")


def _can_collide(compiled: Any, i: int, k: int) -> bool:
    """Whether MuJoCo looks for contacts of two geoms."""
    first, second = (int(compiled.geom_bodyid[j]) for j in (i, k))
    low, high = sorted((first, second))
    if (low << 16) + high in compiled.exclude_signature.tolist():
        return False
    # Bodies without joints between them count as one.
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


_MESH = 7  #: of MuJoCo's mjtGeom
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
    """Pairs of links with solids that a joint connects, or joints with nothing but links without solids between."""
    parents: dict[str, str] = {}
    for joint in root.findall("joint"):
        parent, child = joint.find("parent"), joint.find("child")
        if parent is not None and child is not None:
            parents[child.get("link", "")] = parent.get("link", "")
    # From each solid upwards, past frames and empty links, to the next solid.
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

    # A missing size reads as 0, and is refused like one.
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
        # A flat or empty mesh encloses nothing that could touch.
        case "mesh":
            try:
                solid = HullGeometry.around(load_mesh(path, shape)[0])
            except ValueError:
                return None
        case _:
            return None
    return Shape(solid, pose.rotation, pose.translation)
