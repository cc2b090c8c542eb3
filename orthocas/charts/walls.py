"""What stops a motion: the boundaries of a domain, and contacts; and the clearance that trackers keep from contacts."""

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

    margin: float = 0.01  #: [m] default of the distance to contacts that is kept
    largest: float = 10.0  #: [m] upper bound of margin and `avoid`
    zone: float = 3.0  #: [margins] distance below which a call may use up only a part of the distance
    fall: float = 0.5  #: that part: how much of the distance above the margin a call may use up
    between: float = 0.5  #: part of the margin that is kept between two postures
    halvings: int = 6  #: number of postures tried on a step that comes too near, each half as far as the one before
    rounds: int = 4  #: largest number of changes of xi in a call
    sweeps: int = 8  #: passes over the pairs in a projection of the change of xi
    movable: float = 1e-3  #: [m per unit of xi] rate of a distance below which xi does not count as moving the pair
    settled: float = 1e-6  #: change of xi, relative to the desired change, at which the rounds end
    at_limit: float = 1e-9  #: [half-widths] a boundary that close to a joint limit counts as that limit
    grazing: float = 1e-4  #: [rad] or [m] shorter steps are not checked for contacts between their ends
    depth: float = 1e-4  #: [m] depth up to which a contact between two steps may be missed


RULES = ClearanceRules()


def require_collisions(collisions: object, tree: KinematicTree) -> None:
    """Raise InvalidValueError unless `collisions` is None or a collision model of the robot of a tree."""
    if collisions is not None:
        require_kind("collisions", collisions, Collisions)
        assert isinstance(collisions, Collisions)
        collisions.require_for(tree)


@dataclass(frozen=True)
class Stop:
    """What stops a motion, and where."""

    kind: StopKind
    joint: str = ""  #: name of the joint, for JOINT
    value: float = np.nan  #: position of that joint [rad] or [m], or value of the quantity that a condition bounds
    is_limit: bool = False  #: whether the boundary of the domain is also a joint limit
    condition: str = ""  #: the condition of the domain in one line, or the pair of a contact

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
        """What stops the motion, in a few words."""
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
    """The boundaries of a problem's domain as numbered functions of q that are positive inside.

    They are, in this order: (q_i - low_i) for all joints, then (high_i - q_i), both divided by the half-widths; the
    conditions that the domain lists as `Domain.walls`; and with a collision model, the distance to a contact.
    """

    def __init__(self, problem: Problem, collisions: Collisions | None = None) -> None:
        domain = problem.domain
        self._domain, self._robot, self._collisions = domain, problem.robot, collisions
        self._low, self._high = domain.bounds
        self.solid = collisions is not None  #: whether contacts are checked
        self._curved = domain.walls
        require_collisions(collisions, problem.robot.tree)
        if collisions is not None:
            self._curved = (*domain.walls, Wall(StopKind.CONTACT, lambda q: float(collisions.distance(q).distance)))
        endless = np.isinf(self._low) & ~np.array(problem.robot.tree.prismatic)
        self.turning = endless  #: whether each joint is revolute and unbounded, (n,)

    def values(self, q: Array) -> Array:
        """Values of all functions at q (n,), positive inside; infinite for unbounded joints, -1 for NaN."""
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
        """The `Stop` of the k-th function at q (n,)."""
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
        """Whether a contact deeper than `RULES.depth` may lie on the arc from q with tangent t to `new` with `onward`.

        The check is along the chord. An arc whose tangent turns by an angle a is at most (c / 2) tan(a / 2) away from
        its chord of length c.
        """
        chord = float(np.linalg.norm(new - q))
        if self._collisions is None or chord < RULES.grazing:
            return False
        bend = chord / 2 * float(np.tan(np.arccos(np.clip(t @ onward, 0.0, 1.0)) / 2))
        return self._collisions.find_contact(np.array([q, new]), -RULES.depth, bend) is not None

    def worst(self, q: Array) -> Stop:
        """The boundary that q (n,) violates most, or to which it is nearest."""
        return self.stop(int(np.argmin(self.values(q))), q)

    def gap(self, q: Array, start: Array) -> Array:
        """q - start (n,), wrapped to half a turn for unbounded revolute joints."""
        return np.asarray(wrap_shortest(q - start, 2 * np.pi * self.turning))


class Clearance:
    """Keeps a stream of postures at a distance from contacts.

    Let d be the least distance of all pairs and m the margin. If d > m, a step may lower it to
    m + (min(d, 3 m) - m) / 2, so that the stream comes to rest at the margin. If d <= m, a step may not lower it.
    Between its ends, a step is checked by conservative advancement for half of the margin, or of d if that is less.

    Args:
        collisions: collision model of the robot of the tree.
        tree: the robot.
        margin: distance that is kept [m]; None: 0.01.
        avoid: distance below which xi yields, > margin [m]; None: xi does not yield.

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
        #: least distance at that posture, and whether it is exact; otherwise it is a lower bound above what is kept
        self._least, self._exact = -np.inf, False

    @classmethod
    def build(
        cls, collisions: Collisions | None, tree: KinematicTree, margin: float | None, avoid: float | None
    ) -> Clearance | None:
        """The clearance of a tracker; None without a collision model.

        Raises:
            InvalidValueError: if a distance is given without a collision model.
        """
        if collisions is not None:
            return cls(collisions, tree, margin, avoid)
        for name, value in (("margin", margin), ("avoid", avoid)):
            if value is not None:
                raise InvalidValueError(name, value, "None, because no collision model is given")
        return None

    def copy(self) -> Clearance:
        """A clearance with the same settings for another stream."""
        return Clearance(self.collisions, self._tree, self.margin, self.avoid)

    def start(self, q: Array) -> None:
        """Begin at a posture (n,).

        Raises:
            InvalidValueError: if a pair touches.
        """
        found = self.collisions.distance(q)
        if found.distance <= 0:
            pair = f"'{found.pair[0]}' and '{found.pair[1]}'"
            raise InvalidValueError("q", f"a posture where {pair} touch", "a posture without a contact")
        self._q, self._least, self._exact = q.copy(), float(found.distance), True

    def measure(self, q: Array) -> float:
        """The least distance at q (n,) [m], or a lower bound of it if that already exceeds all distances to be kept."""
        if np.array_equal(q, self._q) and self._exact:
            return self._least
        bound = self._least - self._reach(q - self._q)
        kept = max(RULES.zone * self.margin, self.avoid or 0.0)
        return bound if bound > kept else float(self.collisions.distance(q).distance)

    def limit(self, q: Array, new: Array) -> tuple[Array, float]:
        """Shorten a step from q to `new` (n,) until it keeps clear.

        Returns:
            A posture (n,) on the straight line between them, and its fraction of the step: 1, 1/2, 1/4, ..., or 0.
        """
        least = self._least if np.array_equal(q, self._q) else self.measure(q)
        fraction = 1.0
        # halve the step until it keeps clear
        for _ in range(RULES.halvings):
            place = new if fraction == 1.0 else q + fraction * (new - q)
            value = self.measure(place)
            if value >= float(self.floor(np.array(least))):
                # Distances change by at most `_reach`, so those at both ends may vouch for those between. If they do
                # not, search the step for a contact.
                kept = RULES.between * min(self.margin, least, value)
                vouched = (least + value - self._reach(place - q)) / 2 > kept
                if vouched or self.collisions.find_contact(np.array([q, place]), kept) is None:
                    exact = value <= max(RULES.zone * self.margin, self.avoid or 0.0)
                    self._q, self._least, self._exact = place.copy(), value, exact
                    return place, fraction
            fraction /= 2
        # no posture on the step keeps clear: stay
        self._q, self._least = q.copy(), least
        return q, 0.0

    def hold(self, q: Array) -> None:
        """Continue from q (n,) instead of the posture that `limit` returned last."""
        if not np.array_equal(q, self._q):
            least = self.measure(q)
            self._q, self._least, self._exact = q.copy(), least, False

    def floor(self, distance: Array) -> Array:
        """Least distances [m] to which pairs at these distances may come in a call."""
        above = np.minimum(distance, RULES.zone * self.margin) - self.margin
        floor = np.where(above > 0, self.margin + (1 - RULES.fall) * above, distance)
        return np.asarray(floor)

    def list_rows(self, q: Array, limit: Array) -> tuple[Indices, Array]:
        """Pairs of parts that a step from q (n,) of at most `limit` (n,) may bring below the margin.

        Returns:
            Their indices, and the least distances to which they may come, see `floor`.
        """
        reach = self.collisions.rates @ limit
        index = self.collisions.list_near_parts(q, self.margin + reach)
        distance = self.collisions.measure_parts(q, index)[0]
        near = distance - reach[index] < self.margin
        return index[near], self.floor(distance[near])

    def yield_to(self, q: Array, slopes: Array, wish: Array) -> Array:
        """A change of xi (r,) near a desired one that keeps pairs at least `avoid` apart, to first order.

        With one pair, it is the nearest such change.

        Args:
            q: posture (n,).
            slopes: dq/dxi with x held, (n, r).
            wish: desired change of xi, (r,).

        Source:
            Cyclic projections onto half-spaces (Kaczmarz); ours.
        """
        assert self.avoid is not None
        # pairs that the desired change may bring nearer than `avoid`
        near = self.collisions.find_near(q, self.avoid + self._reach(slopes @ wish))
        rates = near.gradient @ slopes
        squares = np.einsum("pr,pr->p", rates, rates)
        change = wish.copy()
        # project onto the half-space that each pair allows, one pair after the other
        for _ in range(RULES.sweeps):
            for rate, square, room in zip(rates, squares, near.distance - self.avoid, strict=True):
                short = -room - float(rate @ change)
                if square > RULES.movable**2 and short > 0:
                    change = change + rate * short / square
        return change

    def _reach(self, change: Array) -> float:
        """Upper bound [m] of how much a change of q (n,) can change any distance."""
        return float((self.collisions.rates @ np.abs(change)).max(initial=0.0))
