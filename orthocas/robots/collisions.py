"""Distances between the links of a robot and to a scene, by coal: least distance, gradient, and checks of motions."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from threading import local
from typing import Any

import casadi as ca
import coal
import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from orthocas.errors import InvalidValueError
from orthocas.robots.kinematics import build_body_poses
from orthocas.robots.obstacles import Scene, Solid
from orthocas.robots.shapes import Shape
from orthocas.robots.spatial import constant
from orthocas.robots.tree import KinematicTree
from orthocas.tools.batch import Batched, dense_function
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import (
    Array,
    Flags,
    Indices,
    as_float_array,
    as_number,
    as_point,
    as_point_set,
    require_count,
    require_kind,
    require_known,
    require_text,
)
from orthocas.tools.display import Shown, listed

__all__ = ["Collisions", "Contact", "LeastDistance", "NearPairs"]

Pair = tuple[str, str]  #: names of two links, or of a link and an object of the scene


@dataclass(frozen=True, slots=True)
class CollisionRules:
    """Numbers of collision checks."""

    tolerance: float = 1e-10  #: relative tolerance of distances between separate solids; overlaps keep coal's 1e-6
    iterations: int = 1000  #: largest number of iterations of coal's distance search
    deepening: int = 255  #: iterations for the depth of overlaps; 64 leave an error of 1e-5 m between round solids
    piece: int = 256  #: postures per batch of bounds
    first: int = 24  #: number of pairs, by nearest balls, whose bounds by capsules are computed first
    slack: float = 2e-6  #: subtracted from lower bounds [m]
    same_place: float = 1e-6  #: [m], largest distance of equal joints of two robots
    parallel: float = 1e-12  #: squared sine of an angle below which axes count as parallel
    longest: float = 100.0  #: [rad] or [m], largest step of a joint between two postures
    resolution: float = 1e-6  #: [m]; closer pairs count as touching when motions are checked


RULES = CollisionRules()


@dataclass(frozen=True, eq=False)
class Part:
    """A solid that a body carries; a link or an object has one or several."""

    name: str  #: of the link, or of the object
    body: int  #: index of the body, -1 for the base and the world
    shape: Shape  #: in the frame of the body


@dataclass(frozen=True, eq=False, repr=False)
class LeastDistance(Shown):
    """The least distance over all pairs at one posture, or at N postures; see `Collisions.distance`."""

    distance: Any  #: [m], a number or (N,); negative: depth of the overlap
    pair: Any  #: names of the nearest pair, or a list of N
    points: Array  #: nearest points of the two solids in the world, (2, 3) or (N, 2, 3) [m]
    gradient: Array  #: d distance / dq, (n,) or (N, n) [m/rad] or [m/m]

    def facts(self) -> dict[str, str]:
        """The least distance and its pair."""
        if np.ndim(self.distance) == 0:
            return {"least distance": f"{self.distance:.4g} m, between {_name_pair(self.pair)}"}
        if not len(self.distance):
            return {"least distance": "of no postures"}
        k = int(np.argmin(self.distance))
        return {
            "least distance": f"{self.distance[k]:.4g} m in {len(self.distance)} postures",
            "pair": _name_pair(self.pair[k]),
        }


@dataclass(frozen=True, eq=False, repr=False)
class NearPairs(Shown):
    """Pairs that are near each other at one posture, nearest first; see `Collisions.find_near`."""

    pairs: tuple[Pair, ...]  #: names
    distance: Array  #: (P,) [m]; negative: depth of the overlap
    gradient: Array  #: d distance / dq, (P, n) [m/rad] or [m/m]
    points: Array  #: nearest points in the world, (P, 2, 3) [m]

    def facts(self) -> dict[str, str]:
        """The nearest pairs."""
        near = [f"{_name_pair(pair)} {value:.4g} m" for pair, value in zip(self.pairs, self.distance, strict=True)]
        return {"near": listed(near) or "no pair"}


@dataclass(frozen=True, eq=False)
class Contact:
    """Where a straight motion between postures cannot be shown to be free of contacts."""

    segment: int  #: the contact lies between this posture and the next one
    fraction: float  #: of the way between them
    pair: Pair
    distance: float  #: of the pair there [m]


class Collisions(Shown):
    """Collision model: solids of a robot's links and of objects around it, and the pairs to check.

    `robot.collisions` reads it from the <collision> elements of the robot's URDF file. Boxes, cylinders and spheres
    keep their shapes, meshes become their convex hulls. The library coal computes the distances of all `pairs`.

    Args:
        tree: the robot's kinematics.
        parts: the solids.
        pairs: the two names (links or objects) of each pair to check.
        missing: names of links whose mesh cannot be found or read, so that they are not checked.
        origin: where the pairs come from, in a few words.

    Example:
        >>> import orthocas as oc
        >>> robot = oc.Robot.from_name("panda", tip="panda_hand")  # doctest: +SKIP
        >>> robot.collisions.distance(robot.sample(1)[0]).pair  # doctest: +SKIP
        ('panda_link2', 'panda_hand')
    """

    def __init__(
        self,
        tree: KinematicTree,
        parts: Sequence[Part],
        pairs: Sequence[Pair],
        missing: Sequence[str] = (),
        origin: str = "given",
    ) -> None:
        require_kind("tree", tree, KinematicTree)
        require_kind("parts", parts, Sequence)
        for part in parts:
            require_kind("entry of parts", part, Part)
            require_count("body of a part", part.body + 1, least=0, most=tree.bodies)
        require_kind("missing", missing, Sequence)
        self.tree = tree
        self.parts = tuple(parts)
        self.missing = tuple(missing)  #: links whose mesh cannot be found or read
        self.origin = require_text("origin", origin)
        self.pairs = _check_pairs("pairs", pairs, [part.name for part in parts])  #: checked pairs, by names
        # coal cannot measure the distance of an ellipsoid from a point cloud.
        shut = {part.name for part in parts if not part.shape.geometry.knows_clouds}
        clouds = {part.name for part in parts if part.shape.geometry.reported_first}
        for pair in self.pairs if shut and clouds else ():
            if set(pair) & shut and set(pair) & clouds:
                raise InvalidValueError(
                    "pairs",
                    _name_pair(pair),
                    "pairs without an ellipsoid and a point cloud: list this one in `allowed`",
                )

    def facts(self) -> dict[str, str]:
        """Links, pairs, and what is not checked."""
        names = list(dict.fromkeys(part.name for part in self.parts))
        return {
            "collisions": f"{len(self.pairs)} pairs of {len(names)} links and objects, {self.origin}",
            "solids": listed(names),
            **({"unchecked": f"{listed(self.missing)}: no mesh"} if self.missing else {}),
        }

    def distance(self, q: ArrayLike) -> LeastDistance:
        """The least distance over all pairs, with its pair, nearest points and gradient.

        With nearest points p1, p2 on the two bodies and the unit normal u from the first to the second,
        d = u . (p2 - p1) and grad d = u^T (J_p2 - J_p1). Where nearest points are not unique, it is the gradient of one
        choice. Without pairs, the distance is infinite.

        Args:
            q: (n,) or (N, n) [rad] or [m].

        Raises:
            ShapeError, InvalidValueError: if q has another number of joints, or is not finite.
        """
        points, single = as_point_set("q", q, self.tree.n)
        values, index, ends, normals = self._find_least(points)
        gradients = self._build_gradients(points, index, ends, normals)
        names = [self.pairs[self._owners[k]] if k >= 0 else ("", "") for k in index]
        if single:
            return LeastDistance(float(values[0]), names[0], ends[0], gradients[0])
        return LeastDistance(values, names, ends, gradients)

    def pair_distances(self, q: ArrayLike) -> Array:
        """The distances of all pairs [m], (K,) or (N, K) in the order of `pairs`, at q (n,) or (N, n)."""
        points, single = as_point_set("q", q, self.tree.n)
        values = np.full((len(points), len(self.pairs)), np.inf)
        scratch = self._scratch
        for row, position in zip(values, points, strict=True):
            scratch.place(position)
            # A pair's distance is the least one of its parts. Bounds save nothing when every distance is needed.
            for k, owner in enumerate(self._owners.tolist()):
                found = scratch.measure(k).min_distance
                row[owner] = min(row[owner], found)
        return values[0] if single else values

    def check_free(self, q: ArrayLike) -> Any:
        """Whether no pair touches at q (n,) or (N, n): a bool, or (N,)."""
        points, single = as_point_set("q", q, self.tree.n)
        free = np.ones(len(points), dtype=bool)
        scratch = self._scratch
        # A posture is free if all lower bounds are above zero. Otherwise coal measures the pairs, the most likely
        # contacts first.
        for start in range(0, len(points), RULES.piece):
            some = points[start : start + RULES.piece]
            bounds = self._bound_distances(some, 0.0)
            for i in np.flatnonzero((bounds <= 0).any(axis=1)).tolist():
                scratch.place(some[i])
                near = np.flatnonzero(bounds[i] <= 0)
                for k in near[np.argsort(bounds[i][near])].tolist():
                    if scratch.measure(k).min_distance <= 0:
                        free[start + i] = False
                        break
        return bool(free[0]) if single else free

    def find_near(self, q: ArrayLike, within: float) -> NearPairs:
        """The pairs nearer than a distance at one posture, with their gradients: constraints for an optimiser.

        Args:
            q: (n,) [rad] or [m].
            within: [m].

        Raises:
            ShapeError, InvalidValueError: if q is not a posture of the robot, or `within` is not a number.
        """
        point, limit = as_point("q", q, self.tree.n), as_number("within", within)
        index = self.list_near_parts(point, limit)
        values, gradients, ends = self.measure_parts(point, index)
        # A pair of several parts is listed once, with its nearest parts.
        order = [int(k) for k in np.argsort(values, kind="stable") if values[k] < limit]
        names = [self.pairs[self._owners[index[k]]] for k in order]
        kept: dict[Pair, int] = {}
        for name, k in zip(names, order, strict=True):
            kept.setdefault(name, k)
        rows = list(kept.values())
        return NearPairs(tuple(kept), values[rows], gradients[rows], ends[rows])

    def find_contact(self, q: ArrayLike, clearance: float = 0.0, bend: ArrayLike = 0.0) -> Contact | None:
        """The first place on straight motions between postures where a pair may be nearer than a clearance.

        Between two postures, a pair cannot get nearer than (d1 + d2 - L . |dq|) / 2, where L bounds how fast each joint
        moves the two solids against each other. A motion for which this bound is too small is halved (conservative
        advancement), until a pair is too near at a posture, or the bound is less than 1e-6 m below the clearance. So a
        motion without a contact is free everywhere, not only at its postures.

        Args:
            q: postures (N, n), joined by straight lines in joint space.
            clearance: smallest allowed distance [m].
            bend: largest deviation of the true motion from the straight one, (n,) or one number [rad] or [m].

        Returns:
            The contact, or None if the motion is free.

        Raises:
            ShapeError, InvalidValueError: if an argument is invalid, or a joint moves by over 100 rad or m at once.
        """
        points, _ = as_point_set("q", q, self.tree.n)
        gap = as_number("clearance", clearance)
        away = as_float_array("bend", bend)
        if away.shape not in ((), (self.tree.n,)) or not (away >= 0).all():
            raise InvalidValueError("bend", away.tolist(), f"one number >= 0, or {self.tree.n} of them")
        extra = self.rates @ np.broadcast_to(away, (self.tree.n,))
        if not self._owners.size or not len(points):
            return None
        # Longer steps would be halved too often.
        if np.abs(np.diff(points, axis=0)).max(initial=0.0) > RULES.longest:
            raise InvalidValueError(
                "q",
                "too long a step between two postures",
                f"steps of at most {RULES.longest:g} rad or m in each joint",
            )
        # First compare balls around the parts, for many steps at once. A single posture is a step of length zero.
        for start in range(0, max(len(points) - 1, 1), RULES.piece):
            some = points[start : start + RULES.piece + 1]
            later = slice(1, None) if len(some) > 1 else slice(None)
            moves = np.abs(some[later] - some[:-1]) if len(some) > 1 else np.zeros_like(some)
            bounds, ends = self._bound_by_balls(some)
            loss = moves @ self.rates.T / 2 + extra

            def find_room(bounds: Array = bounds, loss: Array = loss, later: slice = later) -> Array:
                return np.asarray((bounds[: len(loss)] + bounds[later]) / 2 - loss)

            # Where balls are too close, compare capsules at both ends of the step. Halve the steps that are still too
            # close.
            rows, pairs = np.nonzero(find_room() <= gap)
            near = np.zeros(bounds.shape, dtype=bool)
            near[rows, pairs] = near[np.minimum(rows + 1, len(some) - 1), pairs] = True
            self._refine_bounds(bounds, ends, *np.nonzero(near))
            room = find_room()
            for i in np.flatnonzero((room <= gap).any(axis=1)).tolist():
                suspects = np.flatnonzero(room[i] <= gap)
                contact = self._halve(some[i], some[min(i + 1, len(some) - 1)], suspects, gap, extra)
                if contact is not None:
                    return replace(contact, segment=start + i)
        return None

    def with_scene(self, scene: Scene, allowed: Sequence[Pair] = ()) -> Collisions:
        """The same model with objects around the robot. Every moving link is checked against every object.

        Args:
            scene: the objects, in the frame of the world.
            allowed: pairs that may touch, by names of a link and an object.

        Raises:
            InvalidValueError: if a name is taken.
        """
        require_kind("scene", scene, Scene)
        return self._add([Part(name, -1, solid.shape) for name, solid in scene.solids.items()], allowed)

    def with_attached(self, frame: str, solids: Mapping[str, Solid], allowed: Sequence[Pair] = ()) -> Collisions:
        """The same model with solids that a link carries, such as a tool or a box in the hand.

        They are checked against all links and objects except those on the same body.

        Args:
            frame: name of the link, or of another frame that the robot knows.
            solids: solids by name, placed in that frame.
            allowed: further pairs that may touch, by names.

        Raises:
            UnknownNameError: if the robot has no such frame.
            InvalidValueError: if a name is taken.
        """
        carrier = self.tree.frame(frame)
        # A half-space is infinite, so a link cannot carry it.
        for name, solid in Scene(solids).solids.items():
            if not solid.shape.bounded:
                raise InvalidValueError(
                    f"solid '{name}'", solid.heading, "a bounded solid: a link cannot carry a half-space"
                )
        shapes = {name: solid.shape for name, solid in Scene(solids).solids.items()}
        return self._add(
            [
                Part(name, carrier.parent, shape.move(carrier.rotation, carrier.translation))
                for name, shape in shapes.items()
            ],
            allowed,
        )

    def _add(self, parts: Sequence[Part], allowed: Sequence[Pair]) -> Collisions:
        """The same model with further parts, each checked against all existing parts of other bodies."""
        # Pairs of existing parts are checked already, and parts of one body never move against each other.
        bodies = {part.name: part.body for part in self.parts}
        both = [*bodies, *(part.name for part in parts)]
        touching = {frozenset(pair) for pair in _check_pairs("allowed", allowed, both)}
        pairs = list(self.pairs)
        for part in parts:
            if part.name in bodies:
                raise InvalidValueError("name", part.name, "one that no link or object has")
            pairs += [
                (name, part.name)
                for name, body in bodies.items()
                if body != part.body and frozenset((name, part.name)) not in touching
            ]
        return Collisions(self.tree, (*self.parts, *parts), pairs, self.missing, self.origin)

    def scan_near(self, points: Array, least: float, asked: Flags) -> Iterator[tuple[int, float]]:
        """Pairs that are nearer than some distance, with their distances, at postures (N, n).

        Args:
            points: the postures.
            least: the distance [m].
            asked: (pairs,), whether to check each pair.
        """
        scratch = self._scratch
        bounds = self._bound_distances(points, least)
        bounds[:, np.flatnonzero(asked[self._owners] == 0)] = np.inf
        for i in np.flatnonzero((bounds < least).any(axis=1)).tolist():
            scratch.place(points[i])
            distances: dict[int, float] = {}
            for k in np.flatnonzero(bounds[i] < least).tolist():
                found = scratch.measure(k).min_distance
                owner = int(self._owners[k])
                distances[owner] = min(found, distances.get(owner, np.inf))
            yield from ((owner, found) for owner, found in distances.items() if found < least)

    def measure_nearest(self, points: Array, count: int) -> tuple[Array, Array]:
        """Distances (N, k) and gradients (N, k, n) of the `count` nearest pairs of parts at postures (N, n).

        They are chosen by the distances of their capsules, among the pairs with the nearest balls.
        """
        N, most = len(points), len(self._owners)
        k = min(count, most)
        if not k or not N:
            return np.zeros((N, 0)), np.zeros((N, 0, self.tree.n))
        # Bound all pairs by balls, the nearest of them by capsules, and measure the k nearest of these with coal.
        bounds, capsules = self._bound_by_balls(points)
        first = min(RULES.first, most)
        chosen = np.argpartition(bounds, first - 1, axis=1)[:, :first]
        self._refine_bounds(bounds, capsules, np.repeat(np.arange(N), first), chosen.ravel())
        order = np.argsort(np.take_along_axis(bounds, chosen, axis=1), axis=1)[:, :k]
        measured = [
            self.measure_parts(q, row) for q, row in zip(points, np.take_along_axis(chosen, order, 1), strict=True)
        ]
        return np.array([row[0] for row in measured]), np.array([row[1] for row in measured])

    def list_near_parts(self, q: Array, within: float | Array) -> Indices:
        """Indices (K,) of pairs of parts whose lower bounds at q (n,) are below a distance (a number, or one each)."""
        return np.flatnonzero(self._bound_distances(q[None], within)[0] < within)

    def measure_parts(self, q: Array, index: Indices) -> tuple[Array, Array, Array]:
        """Distances (P,), gradients (P, n), nearest points (P, 2, 3) of the pairs of parts `index` (P,), at q (n,)."""
        scratch = self._scratch
        scratch.place(q)
        values, ends, normals = np.empty(len(index)), np.empty((len(index), 2, 3)), np.empty((len(index), 3))
        for row, k in enumerate(index.tolist()):
            result = scratch.measure(k)
            values[row], normals[row] = result.min_distance, result.normal
            ends[row, 0], ends[row, 1] = result.getNearestPoint1(), result.getNearestPoint2()
        # coal reports the cloud first in pairs with a point cloud.
        swapped = self._swapped[index]
        ends[swapped], normals[swapped] = ends[swapped, ::-1], -normals[swapped]
        gradients = self._build_gradients(np.broadcast_to(q, (len(index), len(q))), index, ends, normals)
        return values, gradients, ends

    def require_for(self, tree: KinematicTree) -> None:
        """Raise InvalidValueError unless the model belongs to the robot of another tree."""
        mine = self.tree
        same = mine.joint_names == tree.joint_names and np.allclose(
            mine.translations, tree.translations, rtol=0.0, atol=RULES.same_place
        )
        if not same:
            raise InvalidValueError(
                "collisions", f"those of a robot with joints {listed(mine.joint_names)}", "those of the chart's robot"
            )

    @cached_property
    def rates(self) -> Array:
        """Largest speed of the two parts of each pair against each other, per joint speed, (K, n) [m/rad] or [m/m].

        A joint that carries one of the two parts turns it about its axis. So no point of the part moves faster than its
        largest distance from that axis, over all postures between the limits.
        """
        tree, parts = self.tree, self.parts
        reach = np.zeros((len(parts), tree.bodies))
        # Largest displacements of sliding joints, including mimic joints.
        strokes = np.maximum(*(np.abs(tree.expand(end)) for end in (tree.lower, tree.upper)))
        for k, part in enumerate(parts):
            start, end, radius = part.shape.bound()
            # Go from the farthest point of the part towards the base, along the joints that carry it.
            length = max(float(np.linalg.norm(start)), float(np.linalg.norm(end))) + radius
            across = max(float(np.hypot(*start[:2])), float(np.hypot(*end[:2]))) + radius
            body = part.body
            while body >= 0:
                slides = tree.body_kinds[body] == "prismatic"
                reach[k, body] = 1.0 if slides else across
                ends = strokes[body] if slides else 0.0
                length += float(np.linalg.norm(tree.translations[body])) + ends
                across, body = length, tree.parents[body]
        first, second = self._pair_parts.T
        # A joint that carries both moves neither against the other.
        moves = (reach[first] > 0) != (reach[second] > 0)
        return np.where(moves, reach[first] + reach[second], 0.0) @ np.abs(tree.coupling)

    def _halve(self, a: Array, b: Array, suspects: Indices, gap: float, extra: Array) -> Contact | None:
        """The first contact of some pairs on the straight motion from a to b (n,); None if it is free."""
        waiting = [(0.0, 1.0, suspects)]
        known: dict[float, Array] = {}
        whole = self.rates @ np.abs(b - a)

        def measure(s: float, pairs: Indices) -> Array:
            """Distances of pairs at a fraction of the motion."""
            values = known.setdefault(s, np.full(len(self._owners), np.nan))
            scratch = self._scratch
            scratch.place(a + s * (b - a))
            for k in pairs[np.isnan(values[pairs])].tolist():
                values[k] = scratch.measure(k).min_distance
            return values[pairs]

        while waiting:
            low, high, pairs = waiting.pop()
            first, second = measure(low, pairs), measure(high, pairs)
            room = (first + second - (high - low) * whole[pairs]) / 2 - extra[pairs]
            near = np.flatnonzero(room < gap)
            if not near.size:
                continue
            if (high - low) * whole[pairs[near]].max() < RULES.resolution:
                k = near[np.argmin(room[near])]
                return Contact(0, low, self.pairs[self._owners[pairs[k]]], float(min(first[k], second[k])))
            # Check the earlier half first.
            middle = (low + high) / 2
            waiting += [(middle, high, pairs[near]), (low, middle, pairs[near])]
        return None

    def _find_least(self, points: Array) -> tuple[Array, Indices, Array, Array]:
        """Least distances (N,), pairs of parts (N,), nearest points (N, 2, 3) and normals (N, 3).

        Pairs of parts are measured in the order of their lower bounds, until the next bound is above the least
        distance. Capsules bound the pairs whose balls are nearest, and later the others that may still be nearest.
        """
        N = len(points)
        found = np.full(N, np.inf), np.full(N, -1), np.full((N, 2, 3), np.nan), np.zeros((N, 3))
        if not self._owners.size:
            return found
        for start in range(0, N, RULES.piece):
            rows = np.arange(start, min(start + RULES.piece, N))
            bounds, capsules = self._bound_by_balls(points[rows])
            count = min(RULES.first, bounds.shape[1])
            chosen = np.argpartition(bounds, count - 1, axis=1)[:, :count]
            own = np.repeat(np.arange(len(rows)), count)
            self._refine_bounds(bounds, capsules, own, chosen.ravel())
            orders = np.take_along_axis(chosen, np.argsort(np.take_along_axis(bounds, chosen, axis=1), axis=1), axis=1)
            self._evaluate_rows(points, rows, orders, bounds, found)
            # Then the other pairs whose balls are nearer than the least distance so far.
            bounds[own, chosen.ravel()] = np.inf
            self._refine_bounds(bounds, capsules, *np.nonzero(bounds < found[0][rows, None]))
            left = np.flatnonzero((bounds < found[0][rows, None]).any(axis=1))
            self._evaluate_rows(points, rows[left], np.argsort(bounds[left], axis=1), bounds[left], found)
        values, index, ends, normals = found
        # coal reports the cloud first in pairs with a point cloud.
        swapped = np.flatnonzero(self._swapped[index])
        ends[swapped], normals[swapped] = ends[swapped, ::-1], -normals[swapped]
        return values, index, ends, normals

    def _evaluate_rows(
        self, points: Array, rows: Indices, orders: Indices, bounds: Array, found: tuple[Array, Indices, Array, Array]
    ) -> None:
        """Measure pairs in orders (R, k) at rows (R,) of the points, until bounds exceed the least distance found."""
        values, index, ends, normals = found
        scratch = self._scratch
        sorted_bounds = np.take_along_axis(bounds, orders, axis=1).tolist()
        for row, order, own in zip(rows.tolist(), orders.tolist(), sorted_bounds, strict=True):
            scratch.place(points[row])
            least, nearest = values[row], -1
            # Bounds ascend, so the search ends at the first one above the least distance.
            for bound, k in zip(own, order, strict=True):
                if bound >= least:
                    break
                distance = scratch.measure(k).min_distance
                if distance < least:
                    least, nearest = distance, k
            if nearest >= 0:
                result = scratch.placed.distanceResults[nearest]
                values[row], index[row], normals[row] = least, nearest, result.normal
                ends[row, 0], ends[row, 1] = result.getNearestPoint1(), result.getNearestPoint2()

    def _build_gradients(self, points: Array, index: Indices, ends: Array, normals: Array) -> Array:
        """u^T (J_p2 - J_p1), (N, n), for nearest points (N, 2, 3) and unit normals u (N, 3)."""
        N, n = len(points), self.tree.bodies
        gradients = np.zeros((N, n))
        if not self._owners.size or not N:
            return gradients
        # For an axis a through o, u . (a x (p - o)) = a . (p x u) - (a x o) . u if it turns, and u . a if it slides.
        same = points.strides[0] == 0
        twists = self._twists(points[:1] if same else points)[0].reshape(-1, n, 6)
        for side, sign in ((0, -1.0), (1, 1.0)):
            carried = sign * self._carried[self._pair_parts[index, side]]
            wrenches = np.concatenate([_cross(ends[:, side], normals), -normals], axis=1)
            rates = wrenches @ twists[0].T if same else np.einsum("nij,nj->ni", twists, wrenches)
            gradients += carried * rates
        # Mimic joints move with their leaders.
        return gradients @ self.tree.coupling if self.tree.mimic_names else gradients

    def _bound_distances(self, points: Array, within: float | Array = np.inf) -> Array:
        """Lower bounds of the distances of pairs of parts, (N, K): where they may be within a distance, by capsules."""
        bounds, ends = self._bound_by_balls(points)
        self._refine_bounds(bounds, ends, *np.nonzero(bounds <= within))
        return bounds

    def _bound_by_balls(self, points: Array) -> tuple[Array, Array]:
        """Lower bounds (N, K) by balls around the parts, and the ends (N, parts, 2, 3) of the parts' capsules."""
        N = len(points)
        places = self._places(points)[0].reshape(N, len(self.parts), 3, 3)
        centres = places[:, :, 2]
        first, second = self._pair_parts.T
        # |c_1 - c_2|^2 of all parts at once; rounding is far below the slack.
        squares = np.einsum("npi,npi->np", centres, centres)
        products = centres @ centres.transpose(0, 2, 1)
        apart = squares[:, first] + squares[:, second] - 2 * products[:, first, second]
        bounds = np.sqrt(np.maximum(apart, 0.0)) - (self._ball_radii[first] + self._ball_radii[second] + RULES.slack)
        for k in np.flatnonzero(~self._bounded[second]):
            # The distance from a half-space is that of the capsule's nearer end.
            shape = self.parts[second[k]].shape
            heights = (places[:, first[k], :2] - shape.translation) @ shape.rotation[:, 2]
            bounds[:, k] = heights.min(axis=1) - self._radii[first[k]] - RULES.slack
        return bounds, places[:, :, :2]

    def _refine_bounds(self, bounds: Array, ends: Array, rows: Indices, pairs: Indices) -> None:
        """Replace bounds by balls with bounds by capsules, for given postures `rows` (M,) and `pairs` (M,)."""
        kept = self._bounded[self._pair_parts[pairs, 1]]
        rows, pairs = rows[kept], pairs[kept]
        first, second = self._pair_parts[pairs].T
        a, b = ends[rows, first], ends[rows, second]
        squares = _measure_segments(a[:, 0], a[:, 1], b[:, 0], b[:, 1])
        own = np.sqrt(squares) - (self._radii[first] + self._radii[second] + RULES.slack)
        bounds[rows, pairs] = np.maximum(bounds[rows, pairs], own)

    @cached_property
    def _pair_parts(self) -> Indices:
        """The two parts of each pair of parts, (K, 2); a half-space comes second."""
        return self._combinations[:, :2]

    @cached_property
    def _owners(self) -> Indices:
        """The pair of names that each pair of parts belongs to, (K,)."""
        return self._combinations[:, 2]

    @cached_property
    def _combinations(self) -> Indices:
        carriers: dict[str, list[int]] = {}
        for k, part in enumerate(self.parts):
            carriers.setdefault(part.name, []).append(k)
        # Every part of a link is paired with every part of the other link.
        rows = [
            (i, k, owner)
            for owner, (first, second) in enumerate(self.pairs)
            for i in carriers[first]
            for k in carriers[second]
            if self.parts[i].body != self.parts[k].body
        ]
        return np.array(rows, dtype=np.int64).reshape(-1, 3)

    @cached_property
    def _swapped(self) -> Array:
        """Whether coal reports the two parts of a pair in reverse order, (K,)."""
        return np.array([self.parts[k].shape.geometry.reported_first for k in self._pair_parts[:, 1]], dtype=bool)

    @cached_property
    def _bounded(self) -> Array:
        return np.array([part.shape.bounded for part in self.parts], dtype=bool)

    @cached_property
    def _radii(self) -> Array:
        return np.array([part.shape.bound()[2] for part in self.parts])

    @cached_property
    def _carried(self) -> Array:
        """Whether each joint carries each part, (parts, n)."""
        carried = np.zeros((len(self.parts), self.tree.bodies))
        for row, part in zip(carried, self.parts, strict=True):
            row[self.tree.carriers(part.body)] = 1.0
        return carried

    @cached_property
    def _places(self) -> Batched:
        """q -> ends of the capsules around all parts, and centres of the balls, in the world, (9 parts, 1)."""
        q = ca.SX.sym("q", self.tree.n)
        poses = [*build_body_poses(self.tree, q), (ca.SX.eye(3), ca.SX.zeros(3))]
        places = []
        for part, (centre, _) in zip(self.parts, self._balls, strict=True):
            rotation, translation = poses[part.body]
            points = (*part.shape.bound()[:2], centre)
            places += [translation + rotation @ constant(point) for point in points]
        return Batched(dense_function("places", [q], [ca.vertcat(*places)]))

    @cached_property
    def _balls(self) -> list[tuple[Array, float]]:
        """Balls around all parts: centres in the frames of the bodies, and radii."""
        return [part.shape.bound_by_ball() for part in self.parts]

    @cached_property
    def _ball_radii(self) -> Array:
        return np.array([radius for _, radius in self._balls])

    @cached_property
    def _twists(self) -> Batched:
        """q -> axis a, and a x o for a point o of the axis in the world, of all joints (0, -a of slides), (6 N, 1)."""
        q = ca.SX.sym("q", self.tree.n)
        rows = []
        for kind, (rotation, translation) in zip(self.tree.body_kinds, build_body_poses(self.tree, q), strict=True):
            axis = rotation[:, 2]
            rows += [ca.SX.zeros(3), -axis] if kind == "prismatic" else [axis, ca.cross(axis, translation)]
        return Batched(dense_function("twists", [q], [ca.vertcat(*rows)]))

    @cached_property
    def _models(self) -> tuple[pin.Model, pin.GeometryModel]:
        """The robot and its solids for Pinocchio."""
        tree, model, geometry = self.tree, pin.Model(), pin.GeometryModel()
        # Pinocchio gets all joints as independent ones, parents first. `place` computes their positions.
        ids = {-1: 0}
        for i in tree.order:
            joint = pin.JointModelPZ() if tree.body_kinds[i] == "prismatic" else pin.JointModelRZ()
            pose = pin.SE3(tree.rotations[i], tree.translations[i])
            ids[i] = model.addJoint(ids[tree.parents[i]], joint, pose, tree.body_joints[i])
        for k, part in enumerate(self.parts):
            pose = pin.SE3(part.shape.rotation, part.shape.translation)
            solid = part.shape.geometry.build()
            geometry.addGeometryObject(pin.GeometryObject(f"{k} {part.name}", ids[part.body], pose, solid))
        for first, second in self._pair_parts.tolist():
            geometry.addCollisionPair(pin.CollisionPair(first, second))
        return model, geometry

    @cached_property
    def _threads(self) -> local:
        return local()

    @property
    def _scratch(self) -> _Scratch:
        """The models and the working memory of one thread."""
        mine = self._threads
        if not hasattr(mine, "scratch"):
            mine.scratch = _Scratch(self.tree, *self._models)
        scratch: _Scratch = mine.scratch
        return scratch


class _Scratch:
    """Pinocchio's models, and working memory for one thread."""

    def __init__(self, tree: KinematicTree, model: pin.Model, geometry: pin.GeometryModel) -> None:
        self.model, self.geometry = model, geometry
        self.data, self.placed = model.createData(), geometry.createData()
        for request in self.placed.distanceRequests:
            request.gjk_tolerance, request.gjk_max_iterations = RULES.tolerance, RULES.iterations
            request.epa_max_iterations = RULES.deepening
            request.gjk_initial_guess = coal.GJKInitialGuess.CachedGuess
        self._requests, self._guess, self._corners = (
            list(self.placed.distanceRequests),
            np.eye(3)[0],
            np.zeros(2, np.int32),
        )
        self._tree, self._order = tree, list(tree.order)

    def place(self, q: Array) -> None:
        """Place all solids at joint positions (n,)."""
        positions = self._tree.expand(q)[self._order] if self._tree.mimic_names else q
        pin.updateGeometryPlacements(self.model, self.data, self.geometry, self.placed, positions)

    def measure(self, k: int) -> Any:
        """Distance of pair k as placed. Every search starts alike, so that results do not depend on earlier ones."""
        request = self._requests[k]
        request.cached_gjk_guess, request.cached_support_func_guess = self._guess, self._corners
        return pin.computeDistance(self.geometry, self.placed, k)


def _cross(a: Array, b: Array) -> Array:
    """Cross products of rows (N, 3); NumPy's own takes ten times as long for a few."""
    (x, y, z), (u, v, w) = a.T, b.T
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u], axis=1)


def _measure_segments(a0: Array, a1: Array, b0: Array, b1: Array) -> Array:
    """Squared distances of segments (..., 3), which may have zero length."""
    a, b, between = a1 - a0, b1 - b0, a0 - b0
    aa, ab, bb = (np.einsum("...i,...i->...", u, v) for u, v in ((a, a), (a, b), (b, b)))
    ac, bc = (np.einsum("...i,...i->...", u, between) for u in (a, b))
    # Take the nearest points of the two lines, then clip each to its segment. For parallel lines any point will do.
    volume = aa * bb - ab * ab
    s = np.where(volume > RULES.parallel * aa * bb, ab * bc - ac * bb, 0.0) / np.where(volume > 0, volume, 1.0)
    t = (ab * np.clip(s, 0.0, 1.0) + bc) / np.where(bb > 0, bb, 1.0)
    t = np.clip(t, 0.0, 1.0)
    s = np.clip((ab * t - ac) / np.where(aa > 0, aa, 1.0), 0.0, 1.0)
    gap = between + s[..., None] * a - t[..., None] * b
    return np.asarray(np.einsum("...i,...i->...", gap, gap))


def _check_pairs(name: str, pairs: Sequence[Pair], known: Sequence[str]) -> tuple[Pair, ...]:
    """Pairs of known names.

    Raises:
        InvalidValueError, UnknownNameError: for anything else.
    """
    require_kind(name, pairs, Sequence)
    for pair in pairs:
        if not isinstance(pair, tuple | list) or len(pair) != 2:
            raise InvalidValueError(f"entry of {name}", repr(pair)[:80], "two names")
        for part in pair:
            require_known("link or object", part, known)
    return tuple((first, second) for first, second in pairs)


def _name_pair(pair: Pair) -> str:
    return f"'{pair[0]}' and '{pair[1]}'"
