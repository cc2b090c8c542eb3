"""Regions of joint space that an atlas covers: the joint range, or the neighbourhood of some postures."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from orthocas.atlas.lattice import Lattice
from orthocas.errors import InvalidValueError
from orthocas.tasks.domains import Domain
from orthocas.tools.checks import Array, Indices, as_float_array, as_number, frozen_array

_SLACK = 1e-9  # [rad] or [m]
_MOST_TILES = 2_000_000  # in the joint range; more would take days


class Region(Protocol):
    """What an atlas needs to know of a region, in the joints that boxes divide."""

    @property
    def low(self) -> Array:
        """Lowest positions, (k,)."""
        ...

    @property
    def high(self) -> Array:
        """Highest positions, (k,)."""
        ...

    def tiles(self, lattice: Lattice) -> Indices:
        """The tiles that the region touches, ascending."""
        ...

    def touches(self, low: Array, high: Array) -> NDArray[np.bool_]:
        """Whether the region touches boxes with these boundaries (boxes, k), (boxes,)."""
        ...

    def sample(self, samples: int, seed: int) -> Array:
        """Random points of the region, (samples, k)."""
        ...


@dataclass(frozen=True, eq=False)
class JointRange:
    """All positions between the joint limits, less a margin."""

    low: Array
    high: Array

    def tiles(self, lattice: Lattice) -> Indices:
        """All tiles that reach into the range."""
        if lattice.size > _MOST_TILES:
            raise InvalidValueError(
                "region", f"one of {lattice.size} boxes", "wider boxes, or the surroundings of postures"
            )
        tiles = np.arange(lattice.size)
        centres, half = lattice.centres(tiles), lattice.width / 2
        turns = lattice.turns(self.low, self.high)
        return tiles[np.any([self.touches(centres + turn - half, centres + turn + half) for turn in turns], axis=0)]

    def touches(self, low: Array, high: Array) -> NDArray[np.bool_]:
        """Whether boxes reach into the range."""
        return np.asarray(((high > self.low + _SLACK) & (low < self.high - _SLACK)).all(axis=1))

    def sample(self, samples: int, seed: int) -> Array:
        """Uniform points."""
        return np.random.default_rng(seed).uniform(self.low, self.high, (samples, len(self.low)))


@dataclass(frozen=True, eq=False)
class Surroundings:
    """All positions that differ from one of some postures by at most `radius` in every joint."""

    low: Array
    high: Array
    postures: Array  #: in the joints that boxes divide, (N, k)
    radius: float

    def tiles(self, lattice: Lattice) -> Indices:
        """All tiles that a posture or one of the corners and faces around it lies in."""
        found: set[int] = set()
        reach = np.ceil(self.radius / lattice.width).astype(int)
        steps = np.stack(np.meshgrid(*(np.arange(-k, k + 1) for k in reach), indexing="ij"), -1).reshape(-1, len(reach))
        for step in steps:
            offset = np.clip(step * lattice.width, -self.radius, self.radius)
            points = np.clip(self.postures + offset, self.low, self.high)
            found |= set(lattice.tiles(lattice.wrapped(points)).tolist())
        return np.array(sorted(found - {-1}), dtype=np.int64)

    def touches(self, low: Array, high: Array) -> NDArray[np.bool_]:
        """Whether some posture is within the radius of each box."""
        touched = np.zeros(len(low), dtype=bool)
        for k, (a, b) in enumerate(zip(low, high, strict=True)):
            near = (self.postures >= a - self.radius) & (self.postures <= b + self.radius)
            touched[k] = bool(near.all(axis=1).any())
        return touched

    def sample(self, samples: int, seed: int) -> Array:
        """Uniform points around postures drawn at random."""
        rng = np.random.default_rng(seed)
        chosen = self.postures[rng.integers(len(self.postures), size=samples)]
        points: Array = np.clip(chosen + rng.uniform(-self.radius, self.radius, chosen.shape), self.low, self.high)
        return points


def joint_range_of(domain: Domain, joints: tuple[int, ...]) -> JointRange:
    """The range that a domain has in some joints."""
    chosen = list(joints)
    return JointRange(*((domain.centre + side * domain.half_width)[chosen] for side in (-1, 1)))


def surroundings(postures: object, radius: float, joints: tuple[int, ...], domain: Domain) -> Surroundings:
    """The surroundings of postures (N, n) [rad] or [m], within the range of a domain.

    Raises:
        ShapeError, InvalidValueError: if the postures are not finite (N, n), or the radius is no positive number.
    """
    given = frozen_array("postures", as_float_array("postures", postures), (None, len(domain.centre)))
    if not len(given):
        raise InvalidValueError("postures", "empty", "at least one")
    size = as_number("radius", radius)
    if not 0 < size < np.pi:
        raise InvalidValueError("radius", radius, "a positive number below pi")
    whole = joint_range_of(domain, joints)
    return Surroundings(whole.low, whole.high, given[:, list(joints)], size)
