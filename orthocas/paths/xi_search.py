"""A search of all xi along a tool path: where a descent from held coordinates ends in a contact."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from orthocas.charts.curve_tracer import without_turns
from orthocas.paths.joint_curve import PhiSolver
from orthocas.paths.tool_path import RULES, ToolPath
from orthocas.robots.collisions import Collisions
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array, Flags, Indices


@dataclass(frozen=True, eq=False)
class XiSearch:
    """Searches all xi along a tool path for a way that is clear of contacts, r = 1.

    Of all postures on the self-motions of a station, 0.05 rad or m apart, in the domain and clear, one is chosen at
    every station, of at most `RULES.station_postures`, evenly thinned: the sum of the costs of postures and of the
    squared steps between them is least, by dynamic programming. From station to station, no joint moves by more than
    `RULES.station_step`, and det J has the same sign. Where the way between two stations is not clear or leaves the
    domain, all edges between them are checked, and the next best way is sought. Closed paths end with the posture with
    which they begin.

    Source:
        ours; the recursion is Viterbi's, and edges are checked late as in lazy planners.
    """

    solver: PhiSolver
    path: ToolPath
    collisions: Collisions  #: of the chart's robot
    clearance: float  #: smallest distance of their pairs [m]
    cost: Callable[[Array], Array]  #: of postures (N, n), (N,)

    def find(self) -> tuple[Array, Array] | None:
        """Stations s (S,) and postures there (S, n); None if there is no such way."""
        s, closed = np.linspace(0.0, 1.0, RULES.stations), self.path.closed
        stations = [self._list_postures(x) for x in self.path.x(s[:-1] if closed else s)]
        stations += stations[:1] if closed else []
        if not all(len(q) for q in stations):
            return None
        costs, edges = self.cost(stations[0]), [self._weigh_edges(*pair) for pair in pairwise(stations)]
        checked = set[int]()
        while (chosen := _find_cheapest(costs, edges, closed)) is not None:
            way = np.array([q[k] for q, k in zip(stations, chosen, strict=True)])
            blocked = np.flatnonzero(~self._check_between(s[:-1], s[1:], way[:-1], way[1:]))
            if not len(blocked):
                # Joints that turn without end go on from one station to the next.
                way[:, self._endless] = np.unwrap(way[:, self._endless], axis=0)
                return s, way
            for k in blocked:
                if k in checked:
                    # rounding alone can block an edge that was clear
                    edges[k][chosen[k], chosen[k + 1]] = np.inf
                    continue
                i, j = np.nonzero(np.isfinite(edges[k]))
                bad = ~self._check_between(
                    np.full(len(i), s[k]), np.full(len(i), s[k + 1]), stations[k][i], stations[k + 1][j]
                )
                edges[k][i[bad], j[bad]] = np.inf
                checked.add(int(k))
        return None

    @cached_property
    def _endless(self) -> Flags:
        """Joints that turn without end, (n,)."""
        problem = self.solver.chart.problem
        return np.isin(np.arange(problem.robot.n), problem.turning)

    def _list_postures(self, x: Array) -> Array:
        """Postures (K, n) with a task value in the domain that are clear of contacts."""
        chart = self.solver.chart
        curves = chart.parts.inverse.curves
        assert curves is not None
        home = chart.problem.domain.home
        q = curves.list_points(np.append(x, chart.xi(home)), RULES.station_parts)
        # joints that turn without end count once, and memory grows with the square of the number, or its cube
        q = q[(np.abs(q - home)[:, self._endless] <= np.pi).all(axis=1)]
        q = q[self._check_clear(q)]
        kept: Array = q[np.linspace(0, len(q) - 1, min(len(q), RULES.station_postures)).astype(int)]
        return kept

    def _check_clear(self, q: Array) -> Flags:
        return np.asarray(self.collisions.distance(q).distance > self.clearance, dtype=bool)

    def _weigh_edges(self, q: Array, later: Array) -> Array:
        """Squared steps from postures (K, n) to later ones (L, n), and the costs of these, (K, L); inf for no edge."""
        steps = without_turns(later[None] - q[:, None], self._endless)
        signs, signs_later = (np.sign(np.linalg.det(self.solver.jacobian(points))) for points in (q, later))
        kept = (np.abs(steps).max(axis=2) < RULES.station_step) & (signs[:, None] == signs_later)
        return np.where(kept, (steps**2).sum(axis=2) * RULES.stations + self.cost(later), np.inf)

    def _check_between(self, s: Array, s_later: Array, q: Array, later: Array) -> Flags:
        """Whether ways between postures (E, n) at stations (E,), on which xi changes evenly, are clear, (E,)."""
        chart, kept = self.solver.chart, np.ones(len(q), dtype=bool)
        steps = without_turns(later - q, self._endless)
        xi = chart.xi(q)
        change = chart.parts.phi_map.difference(chart.phi(q + steps), chart.phi(q))[:, chart.m :]
        for share in np.arange(1, RULES.station_places + 1) / (RULES.station_places + 1):
            rows = np.flatnonzero(kept)
            x = self.path.x((1 - share) * s[rows] + share * s_later[rows])
            goals = np.hstack([x, xi[rows] + share * change[rows]])
            found = self.solver.solve(q[rows] + share * steps[rows], goals)
            good = np.asarray(np.isfinite(found).all(axis=1))
            good[good] = chart.problem.domain.contains(found[good])
            good[good] = self._check_clear(found[good])
            kept[rows[~good]] = False
        return kept


def _find_cheapest(costs: Array, edges: list[Array], closed: bool) -> list[int] | None:
    """The posture of each station on the cheapest way, by costs of the first ones (K,) and of edges; or None."""
    # least[i, j]: to posture j of this station, from posture i of the first one or, of open paths, from any.
    least, before = np.where(np.eye(len(costs), dtype=bool), costs, np.inf) if closed else costs[None], list[Indices]()
    for edge in edges:
        totals = least[:, :, None] + edge
        before.append(np.argmin(totals, axis=1))
        least = np.take_along_axis(totals, before[-1][:, None, :], axis=1)[:, 0]
    # From the best end, back along what led there.
    ends = np.where(np.eye(len(least), dtype=bool), least, np.inf) if closed else least
    first, last = np.unravel_index(int(np.argmin(ends)), ends.shape)
    if not np.isfinite(ends[first, last]):
        return None
    chosen = [int(last)]
    for back in reversed(before):
        chosen.append(int(back[first, chosen[-1]]))
    return chosen[::-1]
