"""The lattice of an atlas: equal tiles in the joints that boxes divide, and which tiles are images of others (ours)."""

from dataclasses import dataclass
from itertools import product
from math import ceil

import numpy as np
from numpy.typing import NDArray

from orthocas.atlases.symmetry import Symmetries
from orthocas.checks import Array, Indices

_SLACK = 1e-9  # of a tile; points on a border belong to either side
_TURN = 2 * np.pi


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

    Joints that some map shifts by half a turn get tiles all around the circle with borders at multiples of their width
    from 0. Joints that some map reflects get an even number of tiles around 0 or pi / 2.

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
