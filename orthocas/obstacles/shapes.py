"""Spheres, capsules and planes, and their distances from line segments as CasADi expressions (ours)."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from orthocas.checks import Array, as_number, frozen_array
from orthocas.errors import InvalidValueError

_TINY = 1e-18  # [m^2], keeps square roots differentiable


@runtime_checkable
class Obstacle(Protocol):
    """A solid in the world."""

    @property
    def heading(self) -> str:
        """The obstacle in a few words."""
        ...

    def distance(self, start: ca.SX, end: ca.SX) -> ca.SX:
        """Distance of the segment between two points (3, 1) from the solid [m], a scalar; negative inside it."""
        ...


@dataclass(frozen=True, eq=False)
class Sphere:
    """A ball.

    Args:
        centre: (3,) in the world [m].
        radius: > 0 [m].

    Example:
        >>> import orthocas as oc
        >>> oc.obstacles.Sphere([0.5, 0.0, 0.3], 0.1).heading
        'sphere of radius 0.1 at (0.5, 0, 0.3)'
    """

    centre: Array
    radius: float

    def __init__(self, centre: ArrayLike, radius: float) -> None:
        object.__setattr__(self, "centre", frozen_array("centre", centre, (3,)))
        object.__setattr__(self, "radius", _size("radius", radius))

    @property
    def heading(self) -> str:
        """Radius and centre."""
        return f"sphere of radius {self.radius:.4g} at {_point(self.centre)}"

    def distance(self, start: ca.SX, end: ca.SX) -> ca.SX:
        """Distance of a segment from the ball."""
        return ca.sqrt(_square_to_segment(ca.SX(ca.DM(self.centre)), start, end) + _TINY) - self.radius


@dataclass(frozen=True, eq=False)
class Capsule:
    """All points within a radius of a segment.

    Args:
        start: one end of the segment, (3,) in the world [m].
        end: the other end.
        radius: > 0 [m].
    """

    start: Array
    end: Array
    radius: float

    def __init__(self, start: ArrayLike, end: ArrayLike, radius: float) -> None:
        object.__setattr__(self, "start", frozen_array("start", start, (3,)))
        object.__setattr__(self, "end", frozen_array("end", end, (3,)))
        object.__setattr__(self, "radius", _size("radius", radius))

    @property
    def heading(self) -> str:
        """Radius and ends."""
        return f"capsule of radius {self.radius:.4g} from {_point(self.start)} to {_point(self.end)}"

    def distance(self, start: ca.SX, end: ca.SX) -> ca.SX:
        """Distance of a segment from the capsule."""
        a, b = ca.SX(ca.DM(self.start)), ca.SX(ca.DM(self.end))
        return ca.sqrt(_square_of_segments(start, end, a, b) + _TINY) - self.radius


@dataclass(frozen=True, eq=False)
class Plane:
    """A half-space: a floor, a wall, a table. The robot is on the side to which the normal points.

    Args:
        normal: (3,) in the world, of any length > 0.
        point: a point of the surface, (3,) [m].
    """

    normal: Array
    point: Array

    def __init__(self, normal: ArrayLike, point: ArrayLike) -> None:
        given = frozen_array("normal", normal, (3,))
        length = float(np.linalg.norm(given))
        if not 1e-9 < length < np.inf:
            raise InvalidValueError("normal", given.tolist(), "a direction, of a length above 1e-9")
        object.__setattr__(self, "normal", frozen_array("normal", given / length, (3,)))
        object.__setattr__(self, "point", frozen_array("point", point, (3,)))

    @property
    def heading(self) -> str:
        """Point and normal."""
        return f"plane through {_point(self.point)} with normal {_point(self.normal)}"

    def distance(self, start: ca.SX, end: ca.SX) -> ca.SX:
        """Distance of a segment from the half-space: that of its nearer end."""
        normal, offset = ca.SX(ca.DM(self.normal)), float(self.normal @ self.point)
        return ca.fmin(ca.dot(normal, start), ca.dot(normal, end)) - offset


def _square_to_segment(point: ca.SX, start: ca.SX, end: ca.SX) -> ca.SX:
    """Squared distance of a point from a segment, which may have no length."""
    along = end - start
    share = _within(ca.dot(point - start, along) / (ca.dot(along, along) + _TINY))
    gap = point - start - share * along
    return ca.dot(gap, gap)


def _square_of_segments(a0: ca.SX, a1: ca.SX, b0: ca.SX, b1: ca.SX) -> ca.SX:
    """Squared distance of two segments: the least of five candidates, of which one has an end or none at its place."""
    a, b, between = a1 - a0, b1 - b0, a0 - b0
    aa, ab, bb = ca.dot(a, a), ca.dot(a, b), ca.dot(b, b)
    share = _within((ab * ca.dot(b, between) - bb * ca.dot(a, between)) / (aa * bb - ab**2 + _TINY))
    squares = [_square_to_segment(a0 + share * a, b0, b1)]
    squares += [_square_to_segment(point, b0, b1) for point in (a0, a1)]
    squares += [_square_to_segment(point, a0, a1) for point in (b0, b1)]
    least = squares[0]
    for square in squares[1:]:
        least = ca.fmin(least, square)
    return least


def _within(share: ca.SX) -> ca.SX:
    return ca.fmin(ca.fmax(share, 0), 1)


def _size(name: str, value: float) -> float:
    size = as_number(name, value)
    if not 0 < size < 1e6:
        raise InvalidValueError(name, value, "a length above 0 [m], at most 1e6")
    return size


def _point(point: Array) -> str:
    return f"({', '.join(f'{value:.4g}' for value in point)})"
