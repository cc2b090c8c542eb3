"""Capsules that contain the links of a robot: few for each link, and of small volume."""

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

    ratio: float = 1.5  #: volume of a link's capsules over that of its solids below which no piece is cut further
    most: int = 8  #: capsules of a small link
    more: int = 24  #: further capsules of a large link
    #: a link is large from this fraction of the volume of all links; smaller links get fewer capsules
    large: float = 0.2
    #: where cuts are tried, as fractions of the extent along a principal axis
    places: tuple[float, ...] = (0.3, 0.5, 0.7)
    steps: int = 300  #: largest number of steps of the search for the smallest capsule
    converged: float = 1e-6  #: the search ends at this relative change of volume ...
    turned: float = 1e-5  #: ... and at this step [rad] or [radii]
    first: float = 0.2  #: first steps of the search [rad] or [radii]
    room: float = 1e-9  #: [m] from a corner to the capsule's surface; rounding errors are a thousandth of it
    points: int = 20_000  #: random points that measure a volume
    few: int = 10_000  #: random points that compare cuts
    chunk: int = 1000  #: points per batch
    thickest: float = 1e6  #: [m], largest radius of rods
    point: float = 1e-9  #: [m]; a shorter rod becomes a ball
    seed: int = 0  #: of the random points and postures
    postures: int = 1000  #: random postures; a pair that touches in all of them is left out


RULES = CapsuleRules()


@dataclass(frozen=True, eq=False, repr=False)
class FittedCapsules(Shown):
    """Capsules that contain the links of a robot; see `fit_capsules`."""

    collisions: Collisions  #: the same pairs, with capsules as solids
    ratios: Mapping[str, float]  #: volume of the capsules over that of the solids, by link
    ratio: float  #: volume of all capsules over that of all links
    #: of each capsule: its link, the corners (K, 3) of its piece, and the capsule
    pieces: tuple[tuple[str, Array, Part], ...]
    dropped: tuple[Pair, ...] = ()  #: pairs that are not checked, because their capsules touch in all random postures

    def facts(self) -> dict[str, str]:
        """Number of capsules, and their volume relative to that of the links."""
        worst = max(self.ratios, key=lambda name: self.ratios[name], default="")
        return {
            "capsules": f"{len(self.pieces)} around {len(self.ratios)} links",
            "volume": f"{self.ratio:.3g} of that of the links, at most {self.ratios[worst]:.3g} ({worst})",
            "links": listed(self.ratios),
            **({"unchecked": listed([f"{a} and {b}" for a, b in self.dropped])} if self.dropped else {}),
        }


def fit_capsules(collisions: Collisions) -> FittedCapsules:
    """Fit capsules around the solids of each link and object, to compute distances quickly or in C.

    Planes across its principal axes cut the convex hull of a link into pieces, and each piece gets a capsule. Each cut
    is the best of nine candidates, on the piece whose capsule wastes most volume. Cutting stops when the union of the
    capsules has at most 1.5 times the volume of the link, or at the largest number of capsules: 8 for small links, up
    to 32 for links with a fifth of the robot's volume or more. A link of several solids that is not convex may start
    from these solids instead of its hull. The smaller result is kept.

    Every corner of a piece lies at least 1e-9 m inside its capsule. A capsule is convex, so it contains the whole
    piece, and the pieces together fill the hull. Therefore distances between capsules are never larger than those
    between hulls.

    Pairs of links whose capsules touch in all of 1,000 random postures carry no information. They are left out and
    listed in `dropped`. The hulls of `collisions` still check them.

    Args:
        collisions: for example `robot.collisions`. Half-spaces of a scene are kept as they are.

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
                "collisions", f"a model with the point cloud '{part.name}'", "solids that capsules can contain"
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
        # Large links get more pieces. Start from one hull of the whole link, or from one hull for each of its solids.
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
    # Find the pairs that always touch. Both must move, because objects of a scene are the user's to correct.
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
        InvalidValueError: if a radius is not above 0, or `radius` has neither one nor n values.
    """
    sizes = as_float_array("radius", radius)
    if sizes.shape not in ((), (tree.n,)):
        raise InvalidValueError("radius", f"an array of shape {sizes.shape}", f"one number, or {tree.n}")
    radii = np.broadcast_to(sizes, (tree.n,))
    if not ((radii > 0) & (radii < RULES.thickest)).all():
        raise InvalidValueError("radius", sizes.tolist(), "lengths above 0 [m]")
    # Body and far end of each rod on the ways to the tips, once each. The joints of a moving base get no rods.
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
        """Volume [m^3]."""
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
        """Depth of points (N, 3) below the surface, (N,) [m], negative outside."""
        along, offsets = self.end - self.start, points - self.start
        squared, ahead = float(along @ along), offsets @ along
        s = np.clip(ahead / squared, 0.0, 1.0) if squared > 0 else np.zeros(len(points))
        # |o - s a|^2, where s is the place of the nearest point on the segment
        away = np.einsum("ij,ij->i", offsets, offsets) + s * (s * squared - 2 * ahead)
        return np.asarray(self.radius - np.sqrt(np.maximum(away, 0.0)))


def _cover(
    hulls: Sequence[Array], rounding: float, volume: float, most: int
) -> tuple[list[tuple[Array, Capsule]], float]:
    """Cut hulls into pieces with a capsule around each; also returns the volume of the capsules' union.

    Args:
        hulls: corners of each hull, (K, 3).
        rounding: radius by which all hulls are rounded.
        volume: volume of the rounded hulls [m^3].
        most: number of pieces.
    """
    found = []
    first = [(hull, _fit_capsule(hull, rounding)) for hull in hulls]
    # Use the same random points for all unions, and test each capsule on them once.
    low, high = (np.array(corners) for corners in zip(*(capsule.list_box() for _, capsule in first), strict=True))
    low, high = low.min(axis=0), high.max(axis=0)
    points = np.random.default_rng(RULES.seed).uniform(low, high, (RULES.few, 3))
    each = float(np.prod(high - low)) / RULES.few
    # Try two criteria for cuts: the smallest union of all capsules, and the smallest sum of the two new ones.
    for overlaps in (True, False):
        pieces, held = list(first), [capsule.contains(points) for _, capsule in first]
        whole = each * np.any(held, axis=0).sum()
        while whole > RULES.ratio * volume and len(pieces) < most:
            # Take the piece whose capsule wastes most volume, and its best cut.
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
    # The search used quick fits; fit the final capsules precisely.
    pieces = min(found, key=lambda cover: cover[1])[0]
    pieces = [(hull, _fit_capsule(hull, rounding)) for hull, _ in pieces] if len(pieces) > len(hulls) else pieces
    return pieces, _measure_union([capsule for _, capsule in pieces])


def _fit_capsule(corners: Array, rounding: float, quick: bool = False) -> Capsule:
    """A capsule of small volume around points (K, 3), each at least 1e-9 m inside its surface."""
    centre = corners.mean(axis=0)
    # Start from the best principal axis, then search.
    axes = np.linalg.svd(corners - centre, full_matrices=False)[2] if len(corners) > 2 else np.eye(3)
    if len(corners) == 2:
        axes = (corners[1:] - corners[:1]) / max(float(np.linalg.norm(corners[1] - corners[0])), 1e-300)
    best = min((_enclose(corners, axis) for axis in axes), key=lambda capsule: capsule.volume)
    if not quick and len(corners) > 2:
        found = _refine(corners, best)
        best = found if found.volume < best.volume else best
    # Add room for rounding, and more if a corner still has too little.
    wide = Capsule(best.start, best.end, best.radius + rounding + RULES.room)
    short = float(wide.measure_rooms(corners).min()) - rounding - RULES.room / 2
    return wide if short >= 0 else Capsule(wide.start, wide.end, wide.radius - short)


def _enclose(corners: Array, axis: Array) -> Capsule:
    """The shortest capsule along an axis (3,) that contains the points, on the line through their middle."""
    across = corners - np.outer(corners @ axis, axis)
    middle = (across.min(axis=0) + across.max(axis=0)) / 2
    return _shorten(corners, middle, axis, 0.0)


def _shorten(corners: Array, place: Array, axis: Array, more: float) -> Capsule:
    """The shortest capsule about a given line that contains the points; its radius is the smallest one plus `more`."""
    offsets = corners - place
    along = offsets @ axis
    # Squared distances from the line.
    away = np.maximum(np.einsum("ij,ij->i", offsets, offsets) - along**2, 0.0)
    radius = math.sqrt(float(away.max())) + more
    depth = np.sqrt(np.maximum(radius**2 - away, 0.0))
    low, high = float((along + depth).min()), float((along - depth).max())
    low, high = (low, high) if low < high else ((low + high) / 2, (low + high) / 2)
    return Capsule(place + low * axis, place + high * axis, radius)


def _refine(corners: Array, start: Capsule) -> Capsule:
    """Search for a smaller capsule, over line and radius, from a given one."""
    middle, along = (start.start + start.end) / 2, start.end - start.start
    length = float(np.linalg.norm(along))
    axis = along / length if length > 0 else np.array([0.0, 0.0, 1.0])
    # Variables: two tilts, two shifts and the radius.
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
    """Candidate cuts of a hull by planes across its principal axes: the corners of both pieces of each cut."""
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
        for fraction in RULES.places:
            level = low + fraction * (high - low)
            a, b = edges.T
            crossed = (along[a] - level) * (along[b] - level) < 0
            a, b = a[crossed], b[crossed]
            s = ((level - along[a]) / (along[b] - along[a]))[:, None]
            # The plane cuts edges at new corners, which belong to both pieces.
            seam = corners[a] + s * (corners[b] - corners[a])
            sides = [corners[along <= level], corners[along >= level]]
            if min(map(len, sides)) and len(seam) > 2:
                cuts.append([np.concatenate([side, seam]) for side in sides])
    return cuts


def _measure_hull(corners: Array) -> float:
    return float(scipy.spatial.ConvexHull(corners, qhull_options="QJ").volume) if len(corners) > 3 else 0.0


def _measure_union(solids: Sequence[Shape | Capsule]) -> float:
    """Estimate the volume of a union from random points in a box around each solid."""
    rng, count, total = np.random.default_rng(RULES.seed), RULES.points, 0.0
    low, high = (np.array(corners) for corners in zip(*(solid.list_box() for solid in solids), strict=True))
    for k, solid in enumerate(solids):
        points = rng.uniform(low[k], high[k], (count, 3))
        inside = np.concatenate(
            [part[solid.contains(part)] for part in np.array_split(points, max(1, count // RULES.chunk))]
        )
        # A point in k solids counts 1/k in each of them. Solids whose boxes are apart share no point.
        shared = np.ones(len(inside))
        for other in np.flatnonzero(((low < high[k]) & (high > low[k])).all(axis=1)).tolist():
            if other != k:
                parts = np.array_split(inside, max(1, len(inside) // RULES.chunk))
                shared = shared + np.concatenate([solids[other].contains(part) for part in parts])
        total += float((1 / shared).sum()) / count * float(np.prod(high[k] - low[k]))
    return total
