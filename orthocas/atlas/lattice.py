"""The tiles of an atlas: a lattice in the joints that boxes divide, its symmetries, and outcomes of cells."""

from dataclasses import dataclass
from enum import IntEnum
from itertools import product
from math import ceil
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from orthocas.tasks.problem import Problem
from orthocas.tasks.samples import directions
from orthocas.tools.checks import Array, Indices

_TOLERANCE = 1e-6  # robot files give angles with ten decimals
_POINTS = 16
_MOST_CANDIDATES = 2**17
_SEED = 0
_SLACK = 1e-9  # of a tile; points on a boundary belong to either side
_TURN = 2 * np.pi


@dataclass(frozen=True, eq=False)
class Symmetries:
    """Maps g(q) = S q + t of the joints, S = diag(s), with Pi(g(q)) = S Pi(q) S and A(g(q)) = S A(q) S.

    Pi is the A-orthogonal projector on the task gradients. If xi are coordinates near g(q), then xi(g(.)) are
    coordinates near q with the same leak and conditioning. Signs s are +1 or -1, shifts t are 0 or pi. The first map is
    the identity. For an arm with a spherical shoulder, elbow and wrist and a position task there are 16: the mirror,
    and for each of the three bent joints the two postures with the same links.
    """

    joints: tuple[int, ...]  #: all that are not idle
    signs: Array  #: s, (maps, joints)
    shifts: Array  #: t, (maps, joints)

    def __len__(self) -> int:
        return len(self.signs)

    def of(self, joints: tuple[int, ...]) -> "Symmetries":
        """The same maps on some of the joints."""
        columns = [self.joints.index(joint) for joint in joints]
        return Symmetries(joints, self.signs[:, columns], self.shifts[:, columns])


def find_symmetries(problem: Problem, joints: tuple[int, ...], cyclic: tuple[int, ...]) -> Symmetries:
    """All such maps of a problem.

    Args:
        problem: robot, task, metric; the centre of its domain is where idle joints stay.
        joints: the joints that are not idle. The others stay as they are.
        cyclic: those among them at whose position nothing depends; they are not shifted.
    """
    turning = [i for i, joint in enumerate(joints) if joint not in cyclic and not problem.robot.tree.prismatic[joint]]
    signs, shifts = _candidates(len(joints), turning)
    q = np.random.default_rng(_SEED).uniform(-1.5, 1.5, (_POINTS, len(joints)))
    for points in (q[:1], q):
        kept = _symmetric(problem, joints, points, signs, shifts)
        signs, shifts = signs[kept], shifts[kept]
    return Symmetries(joints, signs, shifts)


def identity_only(joints: tuple[int, ...]) -> Symmetries:
    """No symmetry but the identity."""
    return Symmetries(joints, np.ones((1, len(joints))), np.zeros((1, len(joints))))


def _candidates(n: int, turning: list[int]) -> tuple[Array, Array]:
    """All signs with all half turns; signs alone for many joints, and the identity alone for even more."""
    if 2 ** (n + len(turning)) > _MOST_CANDIDATES:
        turning = []
    if 2**n > _MOST_CANDIDATES:
        return np.ones((1, n)), np.zeros((1, n))
    all_signs = np.array(list(product((1.0, -1.0), repeat=n)))
    all_shifts = np.zeros((2 ** len(turning), n))
    all_shifts[:, turning] = np.array(list(product((0.0, np.pi), repeat=len(turning))))
    signs = np.repeat(all_signs, len(all_shifts), axis=0)
    return signs, np.tile(all_shifts, (len(all_signs), 1))


def _symmetric(problem: Problem, joints: tuple[int, ...], points: Array, signs: Array, shifts: Array) -> Array:
    """For which maps the tensors at the images of the points are the images of those at the points, (maps,)."""
    here = directions(problem, joints, points)
    images = signs[:, None] * points + shifts[:, None]  # (maps, points, k)
    there = directions(problem, joints, images.reshape(-1, len(joints))).reshape(len(signs), *here.shape)
    wanted = signs[:, None, None, :, None] * here * signs[:, None, None, None, :]
    return np.asarray(np.abs(there - wanted).max(axis=(1, 2, 3, 4)) <= _TOLERANCE)


@dataclass(frozen=True, eq=False)
class Lattice:
    """Tiles of width `width` from `low` on in k joints; tile numbers run through the last joint first."""

    low: Array  #: (k,)
    width: Array  #: (k,)
    counts: Indices  #: tiles along each joint, (k,)
    endless: NDArray[np.bool_]  #: joints whose positions count modulo a full turn, (k,)

    @property
    def size(self) -> int:
        """Number of tiles."""
        return int(np.prod(self.counts))

    def wrapped(self, points: Array) -> Array:
        """The same positions within the range of the lattice, for endless joints, (N, k)."""
        if not self.endless.any():
            return points
        turns = np.where(self.endless, np.floor((points - self.low) / _TURN), 0.0)
        return np.asarray(points - _TURN * turns)

    def tiles(self, points: Array) -> Indices:
        """The tile of every (wrapped) point (N, k); -1 outside."""
        places = np.floor((points - self.low) / self.width)
        inside = ((places >= 0) & (places < self.counts)).all(axis=1)
        strides = np.append(np.cumprod(self.counts[::-1])[-2::-1], 1)
        found = places @ strides.astype(float)
        return np.where(inside, found, -1.0).astype(np.int64)

    def turns(self, low: Array, high: Array) -> Array:
        """Full turns that bring the lattice over all of a range, which may reach beyond half a turn, (turns, k)."""
        end = self.low + self.width * self.counts
        steps = [
            [-1] * bool(free and a < first - _SLACK) + [0] + [1] * bool(free and b > last + _SLACK)
            for free, a, b, first, last in zip(self.endless, low, high, self.low, end, strict=True)
        ]
        return _TURN * np.array(list(product(*steps)), dtype=float)

    def centres(self, tiles: Indices) -> Array:
        """Centres of tiles, (tiles, k)."""
        places = np.stack(np.unravel_index(tiles, tuple(self.counts)), axis=-1)
        return np.asarray(self.low + self.width * (places + 0.5))


def make_lattice(low: Array, high: Array, endless: NDArray[np.bool_], widest: Array, maps: Symmetries) -> Lattice:
    """Tiles of at most the given widths over a box, such that the maps carry tiles to tiles.

    Joints that some map shifts by half a turn get tiles all around the circle with boundaries at multiples of their
    width from 0. Joints that some map reflects get an even number of tiles around 0 or pi / 2.

    Args:
        low: lowest positions, (k,).
        high: highest positions, (k,).
        endless: joints that turn without end, (k,).
        widest: largest widths, (k,).
        maps: symmetries in these joints.
    """
    shifted: NDArray[np.bool_] = np.any(maps.shifts > 0, axis=0)
    mirrored: NDArray[np.bool_] = np.any(maps.signs < 0, axis=0)
    begins, widths, counts = low.copy(), np.zeros_like(low), np.zeros(len(low), dtype=np.int64)
    for i in range(len(low)):
        if shifted[i]:
            half = ceil(np.pi / widest[i] - _SLACK)
            begins[i], widths[i], counts[i] = -np.pi, np.pi / half, 2 * half
        elif mirrored[i]:
            reach = max(-low[i], high[i])
            half = ceil(reach / widest[i] - _SLACK)
            begins[i], widths[i], counts[i] = -reach, reach / half, 2 * half
        else:
            counts[i] = ceil((high[i] - low[i]) / widest[i] - _SLACK)
            widths[i] = (high[i] - low[i]) / counts[i]
    return Lattice(begins, widths, counts, endless | shifted)


@dataclass(frozen=True, eq=False)
class Orbits:
    """Every tile as the image of the one of its orbit whose chart is fitted: points q of a tile are S q + t there."""

    tiles: Indices  #: tiles that a region needs, ascending, (T,)
    fitted: Indices  #: the tile that is fitted for each, (T,)
    maps: Indices  #: the map, (T,)


def orbits(lattice: Lattice, tiles: Indices, maps: Symmetries, middle: Array) -> Orbits:
    """For each of some tiles, the tile of its orbit that is nearest to the middle of the joint limits."""
    centres = lattice.centres(tiles)
    best = np.full(len(tiles), np.inf)
    fitted, chosen = tiles.copy(), np.zeros(len(tiles), dtype=np.int64)
    for k, (s, t) in enumerate(zip(maps.signs, maps.shifts, strict=True)):
        images = lattice.wrapped(s * centres + t)
        found = lattice.tiles(images)
        distance = np.abs((lattice.centres(np.maximum(found, 0)) - middle) / lattice.width).max(axis=1)
        rank = distance + 1e-6 * found / lattice.size  # equal distances: the first tile
        better = (found >= 0) & (rank < best - 1e-12)
        best[better], fitted[better], chosen[better] = rank[better], found[better], k
    return Orbits(tiles, fitted, chosen)


@dataclass(frozen=True, order=True)
class Cell:
    """In joint i, the tile is cut into 2^levels[i] parts of equal width; the cell is number places[i] of them."""

    tile: int
    levels: tuple[int, ...]
    places: tuple[int, ...]

    @classmethod
    def whole(cls, tile: int, k: int) -> Self:
        """The whole tile."""
        return cls(tile, (0,) * k, (0,) * k)

    @property
    def depth(self) -> int:
        """Number of halvings."""
        return sum(self.levels)

    def halves(self, joint: int) -> tuple["Cell", "Cell"]:
        """The lower and the upper half in one joint."""
        levels = tuple(level + (i == joint) for i, level in enumerate(self.levels))
        lower = tuple(2 * place if i == joint else place for i, place in enumerate(self.places))
        upper = tuple(2 * place + 1 if i == joint else place for i, place in enumerate(self.places))
        return Cell(self.tile, levels, lower), Cell(self.tile, levels, upper)

    def bounds_of(self, lattice: Lattice) -> tuple[Array, Array]:
        """Lowest and highest position, (k,) each."""
        low, width = cell_boundaries(lattice, np.array([self.tile]), np.array([self.levels]), np.array([self.places]))
        return low[0], low[0] + width[0]


def cell_boundaries(
    lattice: Lattice, tiles: Indices, levels: NDArray[Any], places: NDArray[Any]
) -> tuple[Array, Array]:
    """Lowest positions and widths of cells, (cells, k) each."""
    width = lattice.width / 2.0**levels
    return lattice.centres(tiles) - lattice.width / 2 + width * places, width


class Outcome(IntEnum):
    """What became of a cell."""

    CHART = 0  #: it has a chart of the quality asked for
    SPLIT = 1  #: its halves are cells of their own
    SINGULAR = 2  #: all or most of it is too near to singular positions
    POOR = 3  #: no chart of the quality asked for, and no split is left
    FAILED = 4  #: the fit raised an error


@dataclass(frozen=True, eq=False)
class Result:
    """The outcome for one cell."""

    cell: Cell
    outcome: Outcome
    joint: int = -1  #: which of the joints that boxes divide is split
    numbers: Array | None = None  #: of the chart, (fitted, 1 + K), see `BoxChart`
    leak_deg: float = float("nan")
    conditioning: float = float("nan")
    clear: float = 1.0  #: share of the samples that are clear of singular positions
    certified: bool = False
    seconds: float = 0.0
