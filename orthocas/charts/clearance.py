"""Clearance of streams of postures: what trackers ask of a collision model at each call."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from orthocas.errors import InvalidValueError
from orthocas.robots.collisions import Collisions
from orthocas.robots.tree import KinematicTree
from orthocas.tools.checks import Array, Indices, as_number, require_kind


@dataclass(frozen=True, slots=True)
class ClearanceRules:
    """Numbers of trackers that keep clear of contacts."""

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


RULES = ClearanceRules()


def require_collisions(collisions: object, tree: KinematicTree) -> None:
    """Raise InvalidValueError for what is neither None nor a collision model of the robot of a tree."""
    if collisions is not None:
        require_kind("collisions", collisions, Collisions)
        assert isinstance(collisions, Collisions)
        collisions.require_for(tree)


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
            if self._allow(q, least, place):
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

    def _allow(self, q: Array, least: float, new: Array) -> bool:
        """Whether a step from q with a least distance to a new posture keeps clear; if so, it is the last posture."""
        # the distance at the end of the step
        value = self.measure(new)
        if value < float(self.floor(np.array(least))):
            return False
        # and between both ends, where the links may move farther than half of what is left
        speed = self._reach(new - q)
        kept = RULES.between * min(self.margin, least, value)
        if (least + value - speed) / 2 <= kept and self.collisions.find_contact(np.array([q, new]), kept) is not None:
            return False
        self._q, self._least, self._exact = new.copy(), value, value <= max(RULES.zone * self.margin, self.avoid or 0.0)
        return True
