"""Cells of an atlas: a tile, or a part of it after some halvings, each of one joint."""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from orthocas.atlases.lattice import Lattice
from orthocas.checks import Array, Indices


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

    def borders(self, lattice: Lattice) -> tuple[Array, Array]:
        """Lowest and highest position, (k,) each."""
        low, width = cell_borders(lattice, np.array([self.tile]), np.array([self.levels]), np.array([self.places]))
        return low[0], low[0] + width[0]


def cell_borders(lattice: Lattice, tiles: Indices, levels: NDArray[Any], places: NDArray[Any]) -> tuple[Array, Array]:
    """Lowest positions and widths of cells, (cells, k) each."""
    width = lattice.width / 2.0**levels
    return lattice.centres(tiles) - lattice.width / 2 + width * places, width
