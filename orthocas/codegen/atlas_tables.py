"""The charts of a part of an atlas as C tables: tiles, cells, boxes, coefficients (ours).

Numbers of fitted charts are stored once. Charts that are images of them are told apart by their tile, with the signs of
its map, and by order, signs and constants of their coordinates.
"""

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import ceil, log2
from typing import TYPE_CHECKING, Any

import numpy as np

from orthocas.atlases.atlas_file import Turns
from orthocas.atlases.outcomes import Outcome
from orthocas.casadi_tools.cached import cached_property
from orthocas.checks import Array, Indices
from orthocas.codegen.numbers import numbers
from orthocas.codegen.words import words

if TYPE_CHECKING:
    from orthocas.atlases.part import AtlasPart

_NO_CELL = -1
_BORDER = 1e-12  # of a box, in half-widths, as in `Index.in_boxes`


@dataclass(frozen=True, eq=False)
class AtlasTables:
    """Tables of a part of an atlas."""

    part: "AtlasPart"

    def values(self) -> dict[str, str]:
        """Values of the placeholders of templates/tables.c.in, without sizes of work arrays."""
        tables = {**self._joints(), **self._tiles(), **self._charts()}
        digest = hashlib.sha256("\n".join(tables.values()).encode()).hexdigest()
        return {**tables, **self._sizes(), "fingerprint": digest}

    @cached_property
    def depth(self) -> int:
        """Most halvings on the way to a cell."""
        return int(self.part.index.stock.records["levels"].sum(axis=1, dtype=int).max())

    @cached_property
    def bytes(self) -> int:
        """Size of the tables."""
        k, active = len(self.part.plan.joints), len(self.part.plan.active)
        tiles, orbits, fits = len(self.tiles), len(self.orbits), len(self.fits)
        terms, fitted = self.part.evaluation.basis.width, self.part.plan.fitted
        of_tiles = tiles * (8 + 4 + 4 + 8 * k + active) + orbits * (8 * k + 8)
        return (
            of_tiles
            + 24 * len(self._cells[0])
            + fits * 8 * (2 * k + fitted * (1 + terms))
            + self._count * (9 * fitted + 4)
        )

    @cached_property
    def tiles(self) -> Indices:
        """Rows of the tiles of the part in `Orbits.tiles`, ascending."""
        return np.unique(self.part.index.rows(self.part.charts)[0])

    @cached_property
    def orbits(self) -> Indices:
        """The fitted tiles, ascending."""
        return np.unique(self.part.index.orbits.fitted[self.tiles])

    @cached_property
    def fits(self) -> Indices:
        """Numbers of the fitted charts, orbit by orbit, in the order in which charts of a tile count."""
        tiles, fitted = self.part.index.rows(self.part.charts)
        orbit = self.part.index.orbits.fitted[tiles]
        found = [list(dict.fromkeys(fitted[orbit == tile].tolist())) for tile in self.orbits.tolist()]
        return np.array([fit for row in found for fit in row], dtype=np.int64)

    @property
    def _count(self) -> int:
        return len(self.part.charts)

    def _sizes(self) -> dict[str, str]:
        plan, overlap = self.part.plan, self.part.plan.settings.overlap
        sizes = {
            "charts": self._count,
            "fits": len(self.fits),
            "tiles": len(self.tiles),
            "orbits": len(self.orbits),
            "divided_count": len(plan.joints),
            "active_count": len(plan.active),
            "fitted_count": plan.fitted,
            "terms": self.part.evaluation.basis.width,
            "cell_count": len(self._cells[0]),
            "table_bytes": self.bytes,
            "depth": self.depth,
            "certified": self.part.certified(self.fits),
            "tile_steps": ceil(log2(len(self.tiles))) if len(self.tiles) > 1 else 0,
            "cells_searched": 1 + 2 * len(plan.joints),
        }
        return {name: str(size) for name, size in sizes.items()} | {
            "border": repr(_BORDER),
            "overlap": numbers(overlap * plan.lattice.width / 2),
        }

    def _joints(self) -> dict[str, str]:
        plan, domain, robot = self.part.plan, self.part.plan.problem.domain, self.part.plan.problem.robot
        joints, active = list(plan.joints), list(plan.active)
        cyclic = np.array([joint in plan.cyclic for joint in active])
        idle = [plan.fitted + row for row in range(len(plan.idle))]
        return {
            "divided": _integers(joints),
            "active": _integers(active),
            "row": _integers(active.index(joint) for joint in joints),
            "column": _integers(-1 if joint in plan.cyclic else joints.index(joint) for joint in active),
            "cyclic_centre": numbers(np.where(cyclic, domain.centre[active], 0.0)),
            "cyclic_half_width": numbers(np.where(cyclic, domain.half_width[active], 1.0)),
            "limit_low": numbers(robot.lower[joints]),
            "limit_high": numbers(robot.upper[joints]),
            "lattice_low": numbers(plan.lattice.low),
            "lattice_width": numbers(plan.lattice.width),
            "lattice_count": _integers(plan.lattice.counts),
            "endless": _integers(plan.lattice.endless),
            "idle_values": "".join(
                f"  xi[{row}] = q[{joint}] - {numbers(domain.centre[[joint]])};\n"
                for row, joint in zip(idle, plan.idle, strict=True)
            ),
            "idle_slopes": "".join(
                f"  jacobian[{joint} * R + {row}] = 1.0;\n" for row, joint in zip(idle, plan.idle, strict=True)
            ),
        }

    def _tiles(self) -> dict[str, str]:
        index, plan = self.part.index, self.part.plan
        orbits = index.orbits.fitted[self.tiles]
        charts_of_tile = index.rows(self.part.charts)[0]
        cells, roots = self._cells
        return {
            "tile_number": _integers(index.orbits.tiles[self.tiles]),
            "tile_orbit": _integers(np.searchsorted(self.orbits, orbits)),
            "tile_first": _integers(np.searchsorted(charts_of_tile, self.tiles)),
            "tile_centre": _rows(index.centres[self.tiles]),
            "tile_sign": _rows(plan.maps.signs[index.orbits.maps[self.tiles]].astype(int)),
            "orbit_centre": _rows(plan.lattice.centres(self.orbits)),
            "orbit_root": _integers(roots),
            "orbit_first": _integers(np.searchsorted(self._orbit_of_fits, self.orbits)),
            "cells": ",\n".join(
                f"  {{{threshold!r}, {joint}, {{{low}, {high}}}}}" for threshold, joint, low, high in cells
            ),
        }

    def _charts(self) -> dict[str, str]:
        part, index = self.part, self.part.index
        turns = part.evaluation.turns
        if turns is None:
            count, fitted = index.count, part.plan.fitted
            turns = Turns(np.tile(np.arange(fitted), (count, 1)), np.ones((count, fitted)), np.zeros((count, fitted)))
        own = part.evaluation.numbers(self.fits)
        return {
            "box_centre": _rows(index.box_centres[self.fits]),
            "box_half_width": _rows(index.box_half_widths[self.fits]),
            "coefficients": ",\n".join(f"{{{_rows(table)}}}" for table in own),
            "turns": _rows(((turns.order + 1) * turns.signs)[part.charts].astype(int)),
            "constants": _rows(turns.constants[part.charts]),
            "atlas_charts": _integers(part.charts),
        }

    @cached_property
    def _orbit_of_fits(self) -> Indices:
        stock = self.part.index.stock
        return np.asarray(stock.records["tile"][stock.charts[self.fits]])

    @cached_property
    def _cells(self) -> tuple[list[tuple[float, int, int, int]], list[int]]:
        """Halved cells on the way to the charts of the part, and the cells that are the fitted tiles."""
        cells: list[tuple[float, int, int, int]] = []
        index, records = self.part.index, self.part.index.stock.records
        rank: dict[int, int] = dict(zip(index.stock.charts[self.fits].tolist(), self._ranks, strict=True))

        def place(record: int) -> int:
            """The number of a cell in the table, what stands for its chart, or nothing."""
            if record in rank:
                return -2 - rank[record]
            if record < 0 or records["outcome"][record] != Outcome.SPLIT:
                return _NO_CELL
            halves = [place(int(child)) for child in index.children[record].tolist()]
            if halves == [_NO_CELL, _NO_CELL]:
                return _NO_CELL
            cells.append((float(index.thresholds[record]), int(records["joint"][record]), halves[0], halves[1]))
            return len(cells) - 1

        root_of: dict[int, int] = dict(zip(index.orbits.fitted.tolist(), index.roots.tolist(), strict=True))
        roots = [place(int(root_of[tile])) for tile in self.orbits.tolist()]
        return cells or [(0.0, 0, _NO_CELL, _NO_CELL)], roots

    @property
    def _ranks(self) -> list[int]:
        """Number of each fitted chart in its tile."""
        firsts = np.searchsorted(self._orbit_of_fits, self._orbit_of_fits)
        return [row - int(first) for row, first in enumerate(firsts)]


def region_lines(part: "AtlasPart") -> str:
    """Where the boxes of a part reach, for the header."""
    index, plan = part.index, part.plan
    centres, _ = index.image_centres(part.charts)
    half = index.box_half_widths[index.rows(part.charts)[1]]
    low, high = (centres - half).min(axis=0), (centres + half).max(axis=0)
    names = words(plan.problem.robot.joint_names)
    lines = [
        f" *   {name}: {low[plan.joints.index(i)]:.6g} to {high[plan.joints.index(i)]:.6g}"
        if i in plan.joints
        else f" *   {name}: all positions"
        for i, name in enumerate(names)
    ]
    return "\n".join(lines)


def _integers(values: Iterable[Any]) -> str:
    return ", ".join(str(int(value)) for value in values)


def _rows(table: Array | Sequence[Sequence[int]]) -> str:
    """A matrix as C has it."""
    kind = _integers if np.asarray(table).dtype.kind == "i" else numbers
    return ",\n".join(f"{{{kind(row)}}}" for row in np.asarray(table))
