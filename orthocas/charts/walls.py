"""What stops a motion: the boundaries of a domain and contacts, and what trackers keep clear of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from orthocas.errors import InvalidValueError
from orthocas.robots.collisions import Collisions
from orthocas.robots.tree import KinematicTree
from orthocas.tasks.domains import StopKind, Wall
from orthocas.tasks.problem import Problem
from orthocas.tools.checks import Array, Indices, as_number, require_kind
from orthocas.tools.expressions import wrap_shortest


@dataclass(frozen=True, slots=True)
class ClearanceRules:
    """Numbers of walls, and of trackers that keep clear of contacts."""

    margin: float = 0.01  #: [m], default of the distance that is kept
    largest: float = 10.0  #: [m], of distances to keep
    zone: float = 3.0  #: margins: nearer pairs may approach by a part of their distance only
    fall: float = 0.5  #: of the distance above the margin, in a call
    between: float = 0.5  #: of the margin that is kept between postures
    halvings: int = 6  #: of a step that comes too near
    rounds: int = 4  #: of the search for xi in a call
    sweeps: int = 8  #: over the pairs, of a projection onto what they allow
    movable: float = 1e-3  #: [m per unit of xi], of pairs that xi can move
    settled: float = 1e-6  #: of xi, relative to the wished change: the search has ended
    at_limit: float = 1e-9  #: half-widths: boundaries closer to a joint limit are that limit
    grazing: float = 1e-4  #: [rad] or [m]: shorter steps are not checked for contacts between their ends
    depth: float = 1e-4  #: [m] of contacts that may be passed between two steps


RULES = ClearanceRules()


def require_collisions(collisions: object, tree: KinematicTree) -> None:
    """Raise InvalidValueError for what is neither None nor a collision model of the robot of a tree."""
    if collisions is not None:
        require_kind("collisions", collisions, Collisions)
        assert isinstance(collisions, Collisions)
        collisions.require_for(tree)


@dataclass(frozen=True)
class Stop:
    """What ends a motion, and where."""

    kind: StopKind
    joint: str = ""  #: name of the joint, for JOINT
    value: float = np.nan  #: position of that joint [rad] or [m], or what a condition of the domain bounds
    is_limit: bool = False  #: whether the boundary of the domain is the limit of the joint
    condition: str = ""  #: in one line, for conditions of the domain; the pair, for contacts

    def __str__(self) -> str:
        if self.kind is StopKind.JOINT:
            return f"joint '{self.joint}' at {self.value:.4g}{', its limit' if self.is_limit else ''}"
        if self.kind is StopKind.NEAR_SINGULAR:
            return f"the task near singular, with a relative singular value of {self.value:.3g}"
        if self.kind is StopKind.CONDITION:
            return f"the boundary of the domain ({self.condition})"
        if self.kind is StopKind.CONTACT:
            return f"a contact of {self.condition}"
        return {
            StopKind.FOLD: "a fold of the chart",
            StopKind.SINGULAR: "a singularity or the end of the chart",
            StopKind.ENDLESS: "nothing",
        }[self.kind]

    @property
    def brief(self) -> str:
        """The same in a few words."""
        if self.kind is StopKind.JOINT:
            return f"{self.joint} at {'its limit ' if self.is_limit else ''}{self.value:.4g}"
        return {
            StopKind.NEAR_SINGULAR: "the task near singular",
            StopKind.CONDITION: self.condition,
            StopKind.CONTACT: f"a contact of {self.condition}",
            StopKind.FOLD: "a fold",
            StopKind.SINGULAR: "a singularity",
            StopKind.ENDLESS: "no end",
        }[self.kind]


class Walls:
    """The boundaries of a problem's domain as functions that are positive inside.

    They are (q_i - low_i) and (high_i - q_i), divided by the half-width of the domain, for every joint; then what the
    domain itself names as its `walls`; then the distance to a contact, if there are solids to hit.
    """

    def __init__(self, problem: Problem, collisions: Collisions | None = None) -> None:
        domain = problem.domain
        self._domain, self._robot, self._collisions = domain, problem.robot, collisions
        self._low, self._high = domain.bounds
        self.solid = collisions is not None  #: whether there is something to hit
        self._curved = domain.walls
        require_collisions(collisions, problem.robot.tree)
        if collisions is not None:
            self._curved = (*domain.walls, Wall(StopKind.CONTACT, lambda q: float(collisions.distance(q).distance)))
        endless = np.isinf(self._low) & ~np.array(problem.robot.tree.prismatic)
        self.turning = endless  #: unbounded revolute joints, (n,): they are at the same place after a full turn

    def values(self, q: Array) -> Array:
        """All functions at one joint position (n,), positive inside; infinite for unbounded joints."""
        width = self._domain.half_width
        rooms = np.array([wall.room(q) for wall in self._curved])
        parts = [
            (q - self._low) / width,
            (self._high - q) / width,
            np.where(np.isfinite(rooms) | (rooms > 0), rooms, -1.0),
        ]
        return np.concatenate(parts)

    def box_has(self, q: Array) -> bool:
        """Whether q (n,) lies in the box of the domain."""
        return bool(((q >= self._low) & (q <= self._high)).all())

    def stop(self, k: int, q: Array) -> Stop:
        """What the k-th function stands for, at q (n,)."""
        n = len(q)
        if k >= 2 * n:
            wall = self._curved[k - 2 * n]
            if wall.kind is StopKind.CONTACT and self._collisions is not None:
                first, second = self._collisions.distance(q).pair
                return Stop(wall.kind, condition=f"'{first}' and '{second}'")
            value = np.nan if wall.value is None else float(wall.value(q))
            return Stop(wall.kind, value=value, condition=wall.heading)
        i = k % n
        boundary, limit = (self._low, self._robot.lower) if k < n else (self._high, self._robot.upper)
        at_limit = bool(abs(boundary[i] - limit[i]) <= RULES.at_limit * self._domain.half_width[i])
        return Stop(StopKind.JOINT, self._robot.joint_names[i], float(boundary[i]), at_limit)

    def may_touch(self, q: Array, t: Array, new: Array, onward: Array) -> bool:
        """Whether a contact deeper than a tolerance may lie on an arc between joint positions (n,) with end tangents.

        An arc whose tangent turns by an angle a is no farther from its chord c than (c / 2) tan(a / 2).
        """
        chord = float(np.linalg.norm(new - q))
        if self._collisions is None or chord < RULES.grazing:
            return False
        bend = chord / 2 * float(np.tan(np.arccos(np.clip(t @ onward, 0.0, 1.0)) / 2))
        return self._collisions.find_contact(np.array([q, new]), -RULES.depth, bend) is not None

    def worst(self, q: Array) -> Stop:
        """The boundary that q (n,) has crossed farthest, or is nearest to."""
        return self.stop(int(np.argmin(self.values(q))), q)

    def gap(self, q: Array, start: Array) -> Array:
        """q - start (n,), up to full turns of unbounded revolute joints."""
        return np.asarray(wrap_shortest(q - start, 2 * np.pi * self.turning))


class Clearance:
    """Keeps a stream of postures at a distance from contacts.

    A step may lower the least distance d from above the margin m only to m + (min(d, 3 m) - m) / 2, so that it comes to
    rest at the margin, and never while it is below. The way of a step is checked between its ends, by conservative
    advancement, for half of the margin, or of d if that is less.

    Args:
        collisions: of the robot of the tree.
        tree: the robot.
        margin: [m].
        avoid: the distance below which xi gives way, > margin [m]; None if it does not.

    Raises:
        InvalidValueError: if a distance is out of range, or the collisions are those of another robot.
    """

    def __init__(self, collisions: Collisions, tree: KinematicTree, margin: float | None, avoid: float | None) -> None:
        require_collisions(collisions, tree)
        self.collisions, self._tree = collisions, tree
        self.margin = as_number("margin", RULES.margin if margin is None else margin)
        if not 0 <= self.margin < RULES.largest:
            raise InvalidValueError("margin", margin, f"a distance from 0 to {RULES.largest:g} m")
        self.avoid = None if avoid is None else as_number("avoid", avoid)
        if self.avoid is not None and not self.margin < self.avoid < RULES.largest:
            raise InvalidValueError("avoid", avoid, f"a distance above the margin of {self.margin:g} m")
        self._q = np.full(tree.n, np.nan)
        #: of the least distance at that posture: the value, or a lower bound above all that is kept
        self._least, self._exact = -np.inf, False

    @classmethod
    def build(
        cls, collisions: Collisions | None, tree: KinematicTree, margin: float | None, avoid: float | None
    ) -> Clearance | None:
        """The clearance of a tracker; None without a collision model.

        Raises:
            InvalidValueError: if a distance is given without one.
        """
        if collisions is not None:
            return cls(collisions, tree, margin, avoid)
        for name, value in (("margin", margin), ("avoid", avoid)):
            if value is not None:
                raise InvalidValueError(name, value, "collisions with it")
        return None

    def copy(self) -> Clearance:
        """Another one for another stream."""
        return Clearance(self.collisions, self._tree, self.margin, self.avoid)

    def start(self, q: Array) -> None:
        """Begin at a posture (n,).

        Raises:
            InvalidValueError: if a pair touches.
        """
        found = self.collisions.distance(q)
        if found.distance <= 0:
            pair = f"'{found.pair[0]}' and '{found.pair[1]}'"
            raise InvalidValueError("q", f"a posture where {pair} touch", "one without a contact")
        self._q, self._least, self._exact = q.copy(), float(found.distance), True

    def measure(self, q: Array) -> float:
        """The least distance at q (n,), or a lower bound of it that is more than what is kept."""
        if np.array_equal(q, self._q) and self._exact:
            return self._least
        bound = self._least - self._reach(q - self._q)
        kept = max(RULES.zone * self.margin, self.avoid or 0.0)
        return bound if bound > kept else float(self.collisions.distance(q).distance)

    def limit(self, q: Array, new: Array) -> tuple[Array, float]:
        """The farthest of some postures on the straight way from q to new (n,) that keeps clear, and its fraction."""
        least = self._least if np.array_equal(q, self._q) else self.measure(q)
        fraction = 1.0
        # halve the way until a posture on it keeps clear
        for _ in range(RULES.halvings):
            place = new if fraction == 1.0 else q + fraction * (new - q)
            value = self.measure(place)
            if value >= float(self.floor(np.array(least))):
                # The distances at both ends may not vouch for those between; then the way is searched for a contact.
                kept = RULES.between * min(self.margin, least, value)
                vouched = (least + value - self._reach(place - q)) / 2 > kept
                if vouched or self.collisions.find_contact(np.array([q, place]), kept) is None:
                    exact = value <= max(RULES.zone * self.margin, self.avoid or 0.0)
                    self._q, self._least, self._exact = place.copy(), value, exact
                    return place, fraction
            fraction /= 2
        # nowhere on the way: stay
        self._q, self._least = q.copy(), least
        return q, 0.0

    def hold(self, q: Array) -> None:
        """The stream goes on from q (n,), not from where the last step was allowed to go."""
        if not np.array_equal(q, self._q):
            least = self.measure(q)
            self._q, self._least, self._exact = q.copy(), least, False

    def floor(self, distance: Array) -> Array:
        """How near pairs at these distances may come in a call."""
        above = np.minimum(distance, RULES.zone * self.margin) - self.margin
        floor = np.where(above > 0, self.margin + (1 - RULES.fall) * above, distance)
        return np.asarray(floor)

    def list_rows(self, q: Array, limit: Array) -> tuple[Indices, Array]:
        """Pairs of parts that steps from q (n,) of at most `limit` (n,) may bring too near, and their floors."""
        reach = self.collisions.rates @ limit
        index = self.collisions.list_near_parts(q, self.margin + reach)
        distance = self.collisions.measure_parts(q, index)[0]
        near = distance - reach[index] < self.margin
        return index[near], self.floor(distance[near])

    def yield_to(self, q: Array, slopes: Array, wish: Array) -> Array:
        """A change of xi (r,) near a wished one that keeps pairs at `avoid`, to first order.

        With one pair it is the nearest.

        Args:
            q: posture (n,).
            slopes: dq/dxi with x held, (n, r).
            wish: wished change of xi, (r,).

        Source:
            Cyclic projections onto half-spaces (Kaczmarz); ours.
        """
        assert self.avoid is not None
        # pairs that the wished change may bring nearer than `avoid`
        near = self.collisions.find_near(q, self.avoid + self._reach(slopes @ wish))
        rates = near.gradient @ slopes
        squares = np.einsum("pr,pr->p", rates, rates)
        change = wish.copy()
        # one pair after the other, by Kaczmarz's projections
        for _ in range(RULES.sweeps):
            for rate, square, room in zip(rates, squares, near.distance - self.avoid, strict=True):
                short = -room - float(rate @ change)
                if square > RULES.movable**2 and short > 0:
                    change = change + rate * short / square
        return change

    def _reach(self, change: Array) -> float:
        """How much a change of q (n,) can change any distance, at most."""
        return float((self.collisions.rates @ np.abs(change)).max(initial=0.0))
