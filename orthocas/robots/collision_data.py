"""Collision models as plain data and arrays, for chart files."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from orthocas.errors import InvalidValueError
from orthocas.robots.collisions import Collisions, Part
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
)
from orthocas.robots.tree import KinematicTree
from orthocas.tools.checks import Array, require_known
from orthocas.tools.json import get_part

_ARRAYS = ("collisions_poses", "collisions_sizes", "collisions_points")


@dataclass(frozen=True, slots=True)
class DataRules:
    """Bounds of collision models in files."""

    largest: float = 1e6  #: [m], of sizes and places
    straight: float = 1e-6  #: of R^T R - I


RULES = DataRules()


@dataclass(frozen=True, eq=False)
class KnownSolids:
    """Solids that are there already, in place of files."""

    collisions: Collisions
    locked: Mapping[str, float] = field(default_factory=dict)

    def read(self, tree: KinematicTree) -> Collisions:
        """The same on a robot with the same bodies."""
        known = self.collisions
        return Collisions(tree, known.parts, known.pairs, known.missing, known.origin)


_NONE: Array = np.zeros((0, 3))
#: by their words in files: sizes of a geometry, and points; and how it is made of these
_KINDS: Mapping[str, tuple[type, Callable[[Any], tuple[list[float], Array]], Callable[[Array, Array], Geometry]]] = {
    "box": (BoxGeometry, lambda g: ([*g.size], _NONE), lambda s, _: BoxGeometry(s)),
    "ball": (BallGeometry, lambda g: ([g.radius], _NONE), lambda s, _: BallGeometry(float(s[0]))),
    "cylinder": (
        CylinderGeometry,
        lambda g: ([g.radius, g.length], _NONE),
        lambda s, _: CylinderGeometry(float(s[0]), float(s[1])),
    ),
    "capsule": (
        CapsuleGeometry,
        lambda g: ([g.radius, g.length], _NONE),
        lambda s, _: CapsuleGeometry(float(s[0]), float(s[1])),
    ),
    "ellipsoid": (EllipsoidGeometry, lambda g: ([*g.radii], _NONE), lambda s, _: EllipsoidGeometry(s)),
    "half-space": (HalfSpaceGeometry, lambda g: ([], _NONE), lambda s, _: HalfSpaceGeometry()),
    "hull": (HullGeometry, lambda g: ([], g.points), lambda _, points: HullGeometry.around(points)),
    "cloud": (CloudGeometry, lambda g: ([g.cell], g.points), lambda s, points: CloudGeometry(points, float(s[0]))),
}
_SIZES = {"box": 3, "ball": 1, "cylinder": 2, "capsule": 2, "ellipsoid": 3, "half-space": 0, "hull": 0, "cloud": 1}


def collisions_to_data(collisions: Collisions) -> tuple[dict[str, Any], dict[str, Array]]:
    """A collision model as plain data and arrays; of solids that a pair needs. Corners have single precision."""
    # Solids that no pair names are never measured, so files need not carry them.
    used = {name for pair in collisions.pairs for name in pair}
    parts, poses, sizes, points = list[dict[str, Any]](), list[Array](), list[float](), list[Array]()
    for part in collisions.parts:
        if part.name not in used:
            continue
        geometry = part.shape.geometry
        kind = next(word for word, (own, _, _) in _KINDS.items() if isinstance(geometry, own))
        numbers, corners = _KINDS[kind][1](geometry)
        parts.append({"name": part.name, "body": part.body, "kind": kind, "points": len(corners)})
        poses.append(np.column_stack([part.shape.rotation, part.shape.translation]))
        sizes += [float(value) for value in numbers]
        points.append(corners)
    # Pairs as numbers of names: several parts of a link share its name.
    names = list(dict.fromkeys(part["name"] for part in parts))
    header = {
        "parts": parts,
        "pairs": [[names.index(first), names.index(second)] for first, second in collisions.pairs],
        "missing": list(collisions.missing),
        "origin": collisions.origin,
    }
    # Corners are most of the bytes; a float32 of a metre is off by less than a tenth of a micrometre.
    corners = np.concatenate([np.zeros((0, 3)), *points]).astype(np.float32)
    arrays = (np.array(poses).reshape(-1, 3, 4), np.array(sizes, dtype=float), corners)
    return header, dict(zip(_ARRAYS, arrays, strict=True))


def collisions_from_data(tree: KinematicTree, data: Mapping[str, Any], arrays: Mapping[str, Any]) -> Collisions:
    """The collision model of a robot of plain data and arrays that may be anything.

    Raises:
        OrthocasError, and the errors that Python and NumPy have for damaged data: if they make no sense.
    """
    poses, sizes, points = (np.asarray(get_part(arrays, name, np.ndarray), dtype=float) for name in _ARRAYS)
    # Nothing is trusted: a file may have been edited.
    for name, array in zip(_ARRAYS, (poses, sizes, points), strict=True):
        if not (np.abs(array) <= RULES.largest).all():
            raise InvalidValueError(name, "numbers that are not finite or too large", f"at most {RULES.largest:g}")
    if (sizes <= 0).any():
        raise InvalidValueError("collisions_sizes", float(sizes.min()), "numbers above 0")
    parts, size, point = list[Part](), 0, 0
    for description, pose in zip(get_part(data, "parts", list), poses, strict=True):
        kind = get_part(description, "kind", str)
        require_known("kind of solid", kind, _KINDS)
        own = sizes[size : size + _SIZES[kind]]
        count = get_part(description, "points", int)
        corners = points[point : point + count]
        if count < 0 or len(own) != _SIZES[kind] or len(corners) != count:
            raise InvalidValueError("solids", f"fewer numbers than a {kind} has", "as many")
        size, point = size + len(own), point + count
        # A scaled or mirrored pose would change distances without a word.
        R = pose[:, :3]
        if np.abs(R.T @ R - np.eye(3)).max() > RULES.straight:
            raise InvalidValueError("collisions_poses", R.tolist(), "rotations")
        shape = Shape(_KINDS[kind][2](own, corners), R, pose[:, 3])
        parts.append(Part(get_part(description, "name", str), get_part(description, "body", int), shape))
    names = list(dict.fromkeys(part.name for part in parts))
    pairs = [(names[_check_index(i, names)], names[_check_index(k, names)]) for i, k in get_part(data, "pairs", list)]
    missing = [str(name) for name in get_part(data, "missing", list)]
    return Collisions(tree, parts, pairs, missing, get_part(data, "origin", str))


def _check_index(value: Any, names: list[str]) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < len(names):
        raise InvalidValueError("pair of solids", repr(value)[:80], f"numbers below {len(names)}")
    return value
