"""Capsules around the links of a robot: few for each, of little volume, that contain them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import scipy
from numpy.typing import ArrayLike

from orthocas.errors import InvalidValueError
from orthocas.robots.collisions import Collisions, Pair, Part
from orthocas.robots.shapes import BallGeometry, CapsuleGeometry, CloudGeometry, Geometry, Shape
from orthocas.robots.spatial import rotate_z_to
from orthocas.robots.tree import BASE_JOINTS, KinematicTree
from orthocas.tools.checks import Array, Flags, as_float_array, require_kind
from orthocas.tools.display import Shown, listed

__all__ = ["FittedCapsules", "fit_capsules"]


@dataclass(frozen=True, slots=True)
class CapsuleRules:
    """Numbers of fitted capsules."""

    ratio: float = 1.5  #: volume of a link's capsules over that of its solids: with less, it is divided no more
    most: int = 8  #: capsules of a small link
    more: int = 24  #: further capsules of a large link
    large: float = 0.2  #: of the volume of all links: of a large link; others have further capsules in proportion
    places: tuple[float, ...] = (0.3, 0.5, 0.7)  #: of cuts, as fractions of the extent along a principal axis
    steps: int = 300  #: of a search for the smallest capsule
    converged: float = 1e-6  #: of its volume, relative
    turned: float = 1e-5  #: [rad] and radii: smaller steps end it
    first: float = 0.2  #: its first steps
    room: float = 1e-9  #: [m] between a corner and the surface; rounding takes a thousandth of it
    points: int = 20_000  #: by which volumes are measured
    few: int = 10_000  #: by which cuts are chosen
    chunk: int = 1000  #: of these points, at once
    thickest: float = 1e6  #: [m], of rods
    point: float = 1e-9  #: [m]: shorter rods are balls
    seed: int = 0  #: of these points, and of postures
    postures: int = 1000  #: in which pairs touch that are left out


RULES = CapsuleRules()


@dataclass(frozen=True, eq=False, repr=False)
class FittedCapsules(Shown):
    """Capsules that contain the links of a robot; see `fit_capsules`."""

    collisions: Collisions  #: the same pairs, with capsules as solids
    ratios: Mapping[str, float]  #: volume of the capsules over that of the solids, by link
    ratio: float  #: the same of all links together
    pieces: tuple[tuple[str, Array, Part], ...]  #: links, corners (K, 3) of their pieces, and the capsules of these
    dropped: tuple[Pair, ...] = ()  #: pairs whose capsules touch in all seeded postures, and are not checked

    def facts(self) -> dict[str, str]:
        """How many there are, and how much larger than the links."""
        worst = max(self.ratios, key=lambda name: self.ratios[name], default="")
        return {
            "capsules": f"{len(self.pieces)} around {len(self.ratios)} links",
            "volume": f"{self.ratio:.3g} of that of the links, at most {self.ratios[worst]:.3g} ({worst})",
            "links": listed(self.ratios),
            **({"unchecked": listed([f"{a} and {b}" for a, b in self.dropped])} if self.dropped else {}),
        }


def fit_capsules(collisions: Collisions) -> FittedCapsules:
    """Capsules around the solids of each link and object, for distances in C and for quick ones.

    The convex hull of a link is cut by planes across its principal axes until the union of the capsules around all
    pieces has at most 1.5 times the volume of the link, or there are eight, and up to 32 of links that have a fifth of
    the robot's volume; each cut is the best of nine, of the piece with the most to lose. A link of several solids that
    is not convex is cut into these first, if that is smaller.

    Every corner of a piece lies within its capsule, by 1e-9 m or more. A capsule is convex, so it contains the piece;
    the pieces of a hull are all of it. So distances of capsules are never larger than those of the hulls.

    Pairs of links whose capsules touch in all of 1,000 seeded postures would never report anything else. They are left
    out and named in `dropped`; the hulls of `collisions` still check them.

    Args:
        collisions: such as `robot.collisions`. Half-spaces of a scene stay what they are.

    Raises:
        InvalidValueError: for a point cloud.

    Source:
        ours: docs/how-to/collisions.md.
    """
    require_kind("collisions", collisions, Collisions)
    solids: dict[str, list[Part]] = {}
    for part in collisions.parts:
        if isinstance(part.shape.geometry, CloudGeometry):
            raise InvalidValueError(
                "collisions", f"with the point cloud '{part.name}'", "solids that capsules can hold"
            )
        solids.setdefault(part.name, []).append(part)
    held = {
        name: _measure_union([part.shape for part in parts]) for name, parts in solids.items() if parts[0].shape.bounded
    }
    kept, pieces, ratios, volumes = list[Part](), list[tuple[str, Array, Part]](), dict[str, float](), np.zeros(2)
    for name, parts in solids.items():
        if not parts[0].shape.bounded:
            kept += parts
            continue
        volume = held[name]
        # Large links have more pieces. All of the link as one hull, or each of its solids for itself.
        most = RULES.most + round(RULES.more * min(1.0, volume / (RULES.large * max(sum(held.values()), 1e-300))))
        corners = [part.shape.list_corners() for part in parts]
        rounding = max(radius for _, radius in corners)
        found = _cover([np.concatenate([points for points, _ in corners])], rounding, volume, most)
        if len(parts) > 1 and found[1] > RULES.ratio * volume:
            found = min(
                found, _cover([points for points, _ in corners], rounding, volume, most), key=lambda cover: cover[1]
            )
        for hull, capsule in found[0]:
            pieces.append((name, hull, Part(name, parts[0].body, capsule.shape)))
        ratios[name] = found[1] / volume
        volumes += [found[1], volume]
    parts, origin = [*kept, *(part for _, _, part in pieces)], f"capsules around those {collisions.origin}"
    model = Collisions(collisions.tree, parts, collisions.pairs, collisions.missing, origin)
    # Pairs that always touch, of links that are not solid in the world: scenes are for the user to correct.
    touching = model.pair_distances(collisions.tree.centre_posture) <= 0
    for q in collisions.tree.draw_postures(RULES.postures, RULES.seed):
        if not touching.any():
            break
        touched = [owner for owner, _ in model.scan_near(q[None], 0.0, touching)]
        touching &= np.isin(np.arange(len(touching)), touched)
    fixed = {part.name for part in parts if part.body < 0}
    dropped = [pair for pair, always in zip(model.pairs, touching, strict=True) if always and not fixed & set(pair)]
    if dropped:
        left = [pair for pair in model.pairs if pair not in dropped]
        model = Collisions(collisions.tree, parts, left, collisions.missing, origin)
    ratio = float(volumes[0] / volumes[1]) if volumes[1] else 1.0
    return FittedCapsules(model, ratios, ratio, tuple(pieces), tuple(dropped))


def build_rods(tree: KinematicTree, radius: ArrayLike) -> Collisions:
    """Capsules from each joint's origin to the next one's, or to a tip; see `Robot.with_rods`.

    Raises:
        InvalidValueError: if a radius is not above 0, or there are neither one nor n.
    """
    sizes = as_float_array("radius", radius)
    if sizes.shape not in ((), (tree.n,)):
        raise InvalidValueError("radius", f"an array of shape {sizes.shape}", f"one number, or {tree.n}")
    radii = np.broadcast_to(sizes, (tree.n,))
    if not ((radii > 0) & (radii < RULES.thickest)).all():
        raise InvalidValueError("radius", sizes.tolist(), "lengths above 0 [m]")
    # Body and far end of the rods on the ways to the tips, each once; nothing solid is between the joints of a base.
    ends: dict[tuple[int, int | str], Array] = {}
    for frame in (tree.tip, *map(tree.frame, tree.tips)):
        for start, end in pairwise(tree.carriers(frame.parent)):
            if tree.body_joints[end] not in BASE_JOINTS:
                ends[start, end] = np.asarray(tree.translations[end])
        ends[frame.parent, frame.name] = np.asarray(frame.translation)
    parts = []
    for (body, _), far in ends.items():
        if body < 0:
            continue
        length, thick = float(np.linalg.norm(far)), float(radii[tree.leaders[body]])
        solid: Geometry = BallGeometry(thick) if length < RULES.point else CapsuleGeometry(thick, length)
        turn = np.eye(3) if length < RULES.point else rotate_z_to(far / length)
        parts.append(Part(f"link of {tree.body_joints[body]}", body, Shape(solid, turn, far / 2)))
    return Collisions(tree, parts, (), origin="rods")


@dataclass(frozen=True, eq=False)
class Capsule:
    """All points within a radius of a segment."""

    start: Array  #: (3,) [m]
    end: Array  #: (3,) [m]
    radius: float  #: [m]

    @property
    def volume(self) -> float:
        """[m^3]."""
        return float(np.pi * self.radius**2 * (float(np.linalg.norm(self.end - self.start)) + 4 / 3 * self.radius))

    @property
    def shape(self) -> Shape:
        """The capsule as a solid."""
        length = float(np.linalg.norm(self.end - self.start))
        rotation = rotate_z_to((self.end - self.start) / length) if length > 0 else np.eye(3)
        return Shape(CapsuleGeometry(self.radius, length), rotation, (self.start + self.end) / 2)

    def list_box(self) -> tuple[Array, Array]:
        """Lowest and highest coordinates, (3,) each."""
        return np.minimum(self.start, self.end) - self.radius, np.maximum(self.start, self.end) + self.radius

    def contains(self, points: Array) -> Flags:
        """Whether points (N, 3) belong to it, (N,)."""
        return np.asarray(self.measure_rooms(points) >= 0)

    def measure_rooms(self, points: Array) -> Array:
        """Distances of points (N, 3) from the surface, (N,), positive inside."""
        along, offsets = self.end - self.start, points - self.start
        squared, ahead = float(along @ along), offsets @ along
        s = np.clip(ahead / squared, 0.0, 1.0) if squared > 0 else np.zeros(len(points))
        # |o - s a|^2, with the nearest point of the segment at s
        away = np.einsum("ij,ij->i", offsets, offsets) + s * (s * squared - 2 * ahead)
        return np.asarray(self.radius - np.sqrt(np.maximum(away, 0.0)))


def _cover(
    hulls: Sequence[Array], rounding: float, volume: float, most: int
) -> tuple[list[tuple[Array, Capsule]], float]:
    """Pieces of hulls with a capsule around each, and the volume of their union.

    Args:
        hulls: corners of each, (K, 3).
        rounding: radius by which all of them are rounded.
        volume: of what they hold [m^3].
        most: number of pieces.
    """
    found = []
    first = [(hull, _fit_capsule(hull, rounding)) for hull in hulls]
    # Unions are compared by the same points in a box, of which each capsule is asked once.
    low, high = (np.array(corners) for corners in zip(*(capsule.list_box() for _, capsule in first), strict=True))
    low, high = low.min(axis=0), high.max(axis=0)
    points = np.random.default_rng(RULES.seed).uniform(low, high, (RULES.few, 3))
    each = float(np.prod(high - low)) / RULES.few
    # Covers of two kinds of cuts: of the smallest union of all capsules, and of the smallest sum of the two new ones.
    for overlaps in (True, False):
        pieces, held = list(first), [capsule.contains(points) for _, capsule in first]
        whole = each * np.any(held, axis=0).sum()
        while whole > RULES.ratio * volume and len(pieces) < most:
            # The piece whose capsule has most to lose, and its best cut.
            order = np.argsort([_measure_hull(hull) - capsule.volume for hull, capsule in pieces])
            k, cuts = next(((int(k), cuts) for k in order if (cuts := _list_cuts(pieces[k][0]))), (0, []))
            if not cuts:
                break
            parts = [[(side, _fit_capsule(side, rounding, quick=True)) for side in cut] for cut in cuts]
            within = [[capsule.contains(points) for _, capsule in cut] for cut in parts]
            others = np.logical_or.reduce([mask for row, mask in enumerate(held) if row != k], axis=0, initial=False)
            unions = [(others | one | other).sum() for one, other in within]
            values = unions if overlaps else [sum(capsule.volume for _, capsule in cut) for cut in parts]
            best = int(np.argmin(values))
            pieces[k : k + 1], held[k : k + 1] = parts[best], within[best]
            whole = each * unions[best]
        found.append((pieces, whole))
        if whole <= RULES.ratio * volume:
            break
    # The capsules of cuts were quick ones.
    pieces = min(found, key=lambda cover: cover[1])[0]
    pieces = [(hull, _fit_capsule(hull, rounding)) for hull, _ in pieces] if len(pieces) > len(hulls) else pieces
    return pieces, _measure_union([capsule for _, capsule in pieces])


def _fit_capsule(corners: Array, rounding: float, quick: bool = False) -> Capsule:
    """A capsule of little volume around points (K, 3), each at least 1e-9 m within its surface."""
    centre = corners.mean(axis=0)
    # the best of the principal axes, then a search from there
    axes = np.linalg.svd(corners - centre, full_matrices=False)[2] if len(corners) > 2 else np.eye(3)
    if len(corners) == 2:
        axes = (corners[1:] - corners[:1]) / max(float(np.linalg.norm(corners[1] - corners[0])), 1e-300)
    best = min((_enclose(corners, axis) for axis in axes), key=lambda capsule: capsule.volume)
    if not quick and len(corners) > 2:
        found = _refine(corners, best)
        best = found if found.volume < best.volume else best
    # room for rounding, and more if a corner still lacks some
    wide = Capsule(best.start, best.end, best.radius + rounding + RULES.room)
    short = float(wide.measure_rooms(corners).min()) - rounding - RULES.room / 2
    return wide if short >= 0 else Capsule(wide.start, wide.end, wide.radius - short)


def _enclose(corners: Array, axis: Array) -> Capsule:
    """A capsule along an axis (3,): the line through the middle of the points, and the shortest segment on it."""
    across = corners - np.outer(corners @ axis, axis)
    middle = (across.min(axis=0) + across.max(axis=0)) / 2
    return _shorten(corners, middle, axis, 0.0)


def _shorten(corners: Array, place: Array, axis: Array, more: float) -> Capsule:
    """The capsule about a line with the radius that its points need, and more, and the shortest segment on it."""
    offsets = corners - place
    along = offsets @ axis
    # squares of the distances from the line
    away = np.maximum(np.einsum("ij,ij->i", offsets, offsets) - along**2, 0.0)
    radius = math.sqrt(float(away.max())) + more
    depth = np.sqrt(np.maximum(radius**2 - away, 0.0))
    low, high = float((along + depth).min()), float((along - depth).max())
    low, high = (low, high) if low < high else ((low + high) / 2, (low + high) / 2)
    return Capsule(place + low * axis, place + high * axis, radius)


def _refine(corners: Array, start: Capsule) -> Capsule:
    """The smallest capsule that a search from another one finds, over line and radius."""
    middle, along = (start.start + start.end) / 2, start.end - start.start
    length = float(np.linalg.norm(along))
    axis = along / length if length > 0 else np.array([0.0, 0.0, 1.0])
    # two tilts, two shifts and the radius
    side = np.linalg.svd(axis[None])[2][1:]
    size = float(start.radius)

    def build(x: Array) -> Capsule:
        turned = axis + x[0] * side[0] + x[1] * side[1]
        place = middle + size * (x[2] * side[0] + x[3] * side[1])
        return _shorten(corners, place, turned / np.linalg.norm(turned), size * x[4] ** 2)

    simplex = np.vstack([np.zeros(5), 0.2 * np.eye(5)])
    options = {
        "maxiter": RULES.steps,
        "fatol": RULES.converged * start.volume,
        "xatol": 1e-5,
        "initial_simplex": simplex,
    }
    found = scipy.optimize.minimize(lambda x: build(x).volume, np.zeros(5), method="Nelder-Mead", options=options)
    return build(found.x)


def _list_cuts(corners: Array) -> list[list[Array]]:
    """Pairs of corners of the two pieces into which planes across the principal axes cut a hull."""
    if len(corners) < 4:
        return []
    try:
        hull = scipy.spatial.ConvexHull(corners)
    except scipy.spatial.QhullError:
        return []
    edges = np.concatenate([hull.simplices[:, pair] for pair in ([0, 1], [1, 2], [0, 2])])
    edges = np.unique(np.sort(edges, axis=1), axis=0)
    cuts = []
    for axis in np.linalg.svd(corners[hull.vertices] - corners[hull.vertices].mean(axis=0), full_matrices=False)[2]:
        along = corners @ axis
        low, high = float(along.min()), float(along.max())
        # planes at several places along each principal axis
        for fraction in RULES.places:
            level = low + fraction * (high - low)
            a, b = edges.T
            crossed = (along[a] - level) * (along[b] - level) < 0
            a, b = a[crossed], b[crossed]
            s = ((level - along[a]) / (along[b] - along[a]))[:, None]
            # where the plane cuts edges, both pieces get new corners
            seam = corners[a] + s * (corners[b] - corners[a])
            sides = [corners[along <= level], corners[along >= level]]
            if min(map(len, sides)) and len(seam) > 2:
                cuts.append([np.concatenate([side, seam]) for side in sides])
    return cuts


def _measure_hull(corners: Array) -> float:
    return float(scipy.spatial.ConvexHull(corners, qhull_options="QJ").volume) if len(corners) > 3 else 0.0


def _measure_union(solids: Sequence[Shape | Capsule]) -> float:
    """The volume of a union, by seeded points in a box around each solid, weighed by how many solids hold them."""
    rng, count, total = np.random.default_rng(RULES.seed), RULES.points, 0.0
    low, high = (np.array(corners) for corners in zip(*(solid.list_box() for solid in solids), strict=True))
    for k, solid in enumerate(solids):
        points = rng.uniform(low[k], high[k], (count, 3))
        inside = np.concatenate(
            [part[solid.contains(part)] for part in np.array_split(points, max(1, count // RULES.chunk))]
        )
        # a point in k solids counts one k-th in each of them; those whose boxes are apart share none
        shared = np.ones(len(inside))
        for other in np.flatnonzero(((low < high[k]) & (high > low[k])).all(axis=1)).tolist():
            if other != k:
                parts = np.array_split(inside, max(1, len(inside) // RULES.chunk))
                shared = shared + np.concatenate([solids[other].contains(part) for part in parts])
        total += float((1 / shared).sum()) / count * float(np.prod(high[k] - low[k]))
    return total
