"""The search for the chart of a joint position: tiles, then halvings, then neighbours that reach across."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from orthocas.atlas.atlas_file import Stock
from orthocas.atlas.box_fit import widened
from orthocas.atlas.lattice import Orbits, Outcome, cell_boundaries
from orthocas.atlas.plan import Plan
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array, Indices

_NONE = -1
_UNBUILT = 5  # an outcome that is none, for cells without a record


@dataclass(frozen=True, eq=False)
class Placed:
    """Joint positions in the frames of the tiles that are fitted for them."""

    tile: Indices  #: row of `Orbits.tiles`; -1 outside the region, (N,)
    points: Array  #: in the joints that boxes divide, moved to the fitted tile, (N, k)


@dataclass(frozen=True, eq=False)
class Index:
    """Which chart covers a joint position. Charts have the numbers 0, 1, ..., tile by tile."""

    stock: Stock

    @property
    def plan(self) -> Plan:
        """The plan of the atlas."""
        return self.stock.plan

    @property
    def orbits(self) -> Orbits:
        """The tiles of the region, and which is fitted for each."""
        return self.stock.orbits

    @property
    def count(self) -> int:
        """Number of charts, images included."""
        return int(self._starts[-1])

    def placed(self, points: Array) -> Placed:
        """Positions (N, k), moved to the fitted tiles."""
        lattice, found = self.plan.lattice, self.orbits
        inside = lattice.wrapped(points)
        tiles = lattice.tiles(inside)
        rows = np.searchsorted(found.tiles, tiles)
        rows = np.minimum(rows, len(found.tiles) - 1)
        rows = np.where(found.tiles[rows] == tiles, rows, _NONE)
        return Placed(rows, (inside - self.centres[rows]) * self.signs[rows] + self._fitted_centres[rows])

    def nodes(self, placed: Placed) -> Indices:
        """The record of the smallest cell of every position; -1 for those outside, and where nothing is built, (N,)."""
        node = np.where(placed.tile >= 0, self.roots[placed.tile], _NONE)
        waiting = np.flatnonzero(node >= 0)
        waiting = waiting[self._split[node[waiting]]]
        while waiting.size:
            now = node[waiting]
            upper = placed.points[waiting, self._joint[now]] >= self.thresholds[now]
            node[waiting] = self.children[now, upper.astype(int)]
            waiting = waiting[node[waiting] >= 0]
            waiting = waiting[self._split[node[waiting]]]
        return node

    def find(self, points: Array) -> Indices:
        """The chart of every position (N, k); -1 where there is none.

        It is that of the cell where the position lies, or of a neighbour whose box reaches so far.
        """
        placed = self.placed(points)
        charts = self._charts_of(placed.tile, self.nodes(placed))
        missing = np.flatnonzero(charts < 0)
        if missing.size and self.count:
            charts[missing] = self._of_neighbours(points[missing])
        return charts

    def outcomes(self, points: Array) -> Indices:
        """The `Outcome` of the cell of every position (N, k); 5 where nothing is built yet."""
        node = self.nodes(self.placed(points))
        found = np.where(node >= 0, self.stock.records["outcome"][node], _UNBUILT)
        return np.asarray(found, dtype=np.int64)

    def rows(self, charts: Indices) -> tuple[Indices, Indices]:
        """For charts: the row of the tile in `Orbits.tiles`, and the number of the fitted chart."""
        tile = np.searchsorted(self._starts, charts, side="right") - 1
        rank = charts - self._starts[tile]
        return tile, self._by_tile[self._begins[tile] + rank]

    def in_boxes(self, points: Array, charts: Indices) -> Any:
        """Whether positions (N, k) lie in the boxes of given charts, (N,)."""
        u = self.on_cube(points, charts)
        limits = self.plan.problem.robot
        joints = list(self.plan.joints)
        allowed = (points >= limits.lower[joints]) & (points <= limits.upper[joints])
        return (np.abs(u) <= 1 + 1e-12).all(axis=1) & allowed.all(axis=1)

    def on_cube(self, points: Array, charts: Indices) -> Array:
        """u of positions (N, k) in the boxes of given charts."""
        tile, fitted = self.rows(charts)
        centres, signs = self.centres[tile], self.signs[tile]
        apart = points - centres
        turns = np.where(self.plan.lattice.endless, np.round(apart / (2 * np.pi)), 0.0)
        moved = (apart - 2 * np.pi * turns) * signs + self._fitted_centres[tile]
        return np.asarray((moved - self.box_centres[fitted]) / self.box_half_widths[fitted])

    def image_centres(self, charts: Indices) -> tuple[Array, Array]:
        """Centres and signs of the boxes of charts, in the joints that boxes divide, (charts, k) each."""
        tile, fitted = self.rows(charts)
        signs = self.signs[tile]
        return (self.box_centres[fitted] - self._fitted_centres[tile]) * signs + self.centres[tile], signs

    def map_signs(self, charts: Indices) -> Array:
        """Signs of the maps of charts for all active joints, (charts, active)."""
        return np.asarray(self.plan.maps.signs[self.orbits.maps[self.rows(charts)[0]]])

    @cached_property
    def box_centres(self) -> Array:
        """Centres of the boxes of the fitted charts, (fitted charts, k)."""
        low, high = self._boxes
        return np.asarray((low + high) / 2)

    @cached_property
    def box_half_widths(self) -> Array:
        """Half-widths of the boxes of the fitted charts, (fitted charts, k)."""
        low, high = self._boxes
        return np.asarray((high - low) / 2)

    def _of_neighbours(self, points: Array) -> Indices:
        found = np.full(len(points), _NONE)
        step = self.plan.settings.overlap * self.plan.lattice.width / 2
        for joint in range(points.shape[1]):
            for side in (-1.0, 1.0):
                left = np.flatnonzero(found < 0)
                moved = points[left].copy()
                moved[:, joint] += side * step[joint]
                placed = self.placed(moved)
                charts = self._charts_of(placed.tile, self.nodes(placed))
                known = np.flatnonzero(charts >= 0)
                reached = known[self.in_boxes(points[left[known]], charts[known])]
                found[left[reached]] = charts[reached]
        return found

    def _charts_of(self, tile: Indices, node: Indices) -> Indices:
        fitted = np.where(node >= 0, self._chart_of_node[node], _NONE)
        return np.where(fitted >= 0, self._starts[tile] + self._rank[fitted], _NONE) if len(self._rank) else fitted

    @cached_property
    def _boxes(self) -> tuple[Array, Array]:
        records = self.stock.records[self.stock.charts]
        low, width = cell_boundaries(self.plan.lattice, records["tile"], records["levels"], records["places"])
        return widened(self.plan, low, low + width)

    @cached_property
    def centres(self) -> Array:
        """Centres of the tiles, those of images included, (tiles, k)."""
        return self.plan.lattice.centres(self.orbits.tiles)

    @cached_property
    def _fitted_centres(self) -> Array:
        return self.plan.lattice.centres(self.orbits.fitted)

    @cached_property
    def signs(self) -> Array:
        """Signs of the joints in the map that brings a tile from the one that is fitted, (tiles, k)."""
        return np.asarray(self.plan.maps.of(self.plan.joints).signs[self.orbits.maps])

    @cached_property
    def roots(self) -> Indices:
        """Record of the fitted tile of every tile, -1 if it is not built."""
        records = self.stock.records
        whole = np.flatnonzero(records["parent"] < 0)
        order = whole[np.argsort(records["tile"][whole])]
        if not order.size:
            return np.full(len(self.orbits.tiles), _NONE)
        known = records["tile"][order]
        places = np.minimum(np.searchsorted(known, self.orbits.fitted), len(order) - 1)
        return np.where(known[places] == self.orbits.fitted, order[places], _NONE)

    @cached_property
    def _split(self) -> Any:
        return self.stock.records["outcome"] == Outcome.SPLIT

    @cached_property
    def _joint(self) -> Indices:
        return self.stock.records["joint"].astype(np.int64)

    @cached_property
    def thresholds(self) -> Array:
        """Middle of every cell in the joint that is halved."""
        records = self.stock.records
        low, width = cell_boundaries(self.plan.lattice, records["tile"], records["levels"], records["places"])
        return np.asarray((low + width / 2)[np.arange(len(records)), np.maximum(self._joint, 0)])

    @cached_property
    def children(self) -> Indices:
        """Records of both halves of every cell, -1 if there is none, (cells, 2)."""
        records = self.stock.records
        found = np.full((len(records), 2), _NONE)
        inner = np.flatnonzero(records["parent"] >= 0)
        found[records["parent"][inner], records["upper"][inner].astype(int)] = inner
        return found

    @cached_property
    def _chart_of_node(self) -> Indices:
        found = np.full(len(self.stock.records), _NONE)
        charts = self.stock.charts
        found[charts] = np.arange(len(charts))
        return found

    @cached_property
    def _by_tile(self) -> Indices:
        """Fitted charts, tile by tile."""
        return np.argsort(self._tile_of_chart, kind="stable")

    @cached_property
    def _tile_of_chart(self) -> Indices:
        return np.asarray(self.stock.records["tile"][self.stock.charts])

    @cached_property
    def _rank(self) -> Indices:
        """Place of every fitted chart among those of its tile."""
        order = self._by_tile
        tiles = self._tile_of_chart[order]
        rank = np.empty(len(order), dtype=np.int64)
        rank[order] = np.arange(len(order)) - np.searchsorted(tiles, tiles)
        return rank

    @cached_property
    def _begins(self) -> Indices:
        """Where the charts of every tile of the region begin in `_by_tile`, (tiles,)."""
        return np.searchsorted(self._tile_of_chart[self._by_tile], self.orbits.fitted)

    @cached_property
    def _starts(self) -> Indices:
        """First chart of every tile of the region, and the number of all charts, (tiles + 1,)."""
        tiles = self._tile_of_chart[self._by_tile]
        sizes = np.searchsorted(tiles, self.orbits.fitted, side="right") - self._begins
        return np.concatenate([[0], np.cumsum(sizes)])
