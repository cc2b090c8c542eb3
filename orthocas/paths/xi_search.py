"""A search of all xi along a tool path: where a descent from held coordinates ends in a contact."""

from collections.abc import Callable

import numpy as np

from orthocas.charts.chart import Chart
from orthocas.paths.tool_path import RULES, ToolPath
from orthocas.robots.collisions import Collisions
from orthocas.tools.checks import Array, Indices


def search_xi(
    chart: Chart, path: ToolPath, collisions: Collisions, clearance: float, cost: Callable[[Array], Array]
) -> tuple[Array, Array] | None:
    """Stations s (S,) along a tool path, and postures there (S, n) that are clear of contacts; None if there are none.

    Of all postures with the x of a station and an xi of a lattice, in the domain and clear, one is chosen at every
    station: the sum of the costs of postures and of the squared steps between them is least, by dynamic programming.
    Between stations, no joint moves by more than `RULES.lattice_step`. Closed paths end at the xi where they begin.

    Args:
        chart: with r = 1.
        path: the tool path.
        collisions: of the chart's robot.
        clearance: smallest distance of their pairs [m].
        cost: of postures (N, n), (N,).

    Source:
        ours; the recursion is Viterbi's.
    """
    # At each station, the postures with x and one of the values of xi, where nothing touches.
    s, lattice = np.linspace(0.0, 1.0, RULES.stations), _list_values(chart)
    S, K = len(s), len(lattice)
    goals = np.hstack([np.repeat(path.x(s), K, axis=0), np.tile(lattice, S)[:, None]])
    found = chart.solve(goals)
    good = np.flatnonzero(found.found)
    clear = np.asarray(collisions.distance(found.q[good]).distance) > clearance
    costs, good = np.full(S * K, np.inf), good[clear]
    costs[good] = cost(found.q[good])
    table, q = costs.reshape(S, K), np.where(np.isfinite(found.q), found.q, 0.0).reshape(S, K, -1)

    # least[i, j]: from value i at the first station to value j at this one.
    least, before = np.where(np.eye(K, dtype=bool), table[0], np.inf), list[Indices]()
    for k in range(1, S):
        # Edges between stations cost the squared step of the joints; long ones are none.
        steps = q[k][None] - q[k - 1][:, None]
        edges = np.where(np.abs(steps).max(axis=2) < RULES.lattice_step, (steps**2).sum(axis=2) * S, np.inf) + table[k]
        totals = least[:, :, None] + edges[None]
        before.append(np.argmin(totals, axis=1))
        least = np.take_along_axis(totals, before[-1][:, None, :], axis=1)[:, 0]
    # A closed path ends with the xi of its begin. From the best end, back along what led there.
    ends = np.where(np.eye(K, dtype=bool), least, np.inf) if path.closed else least
    first, last = np.unravel_index(int(np.argmin(ends)), ends.shape)
    if not np.isfinite(ends[first, last]):
        return None
    chosen = [int(last)]
    for back in reversed(before):
        chosen.append(int(back[first, chosen[-1]]))
    return s, q[np.arange(S), chosen[::-1]]


def _list_values(chart: Chart) -> Array:
    """A lattice of xi over what it is in the domain, (K,)."""
    xi = chart.xi(chart.problem.domain.sample(RULES.lattice_samples, 0))[:, 0]
    if chart.parts.turns[chart.m]:
        return np.linspace(-np.pi, np.pi, RULES.lattice, endpoint=False)
    return np.linspace(xi.min(), xi.max(), RULES.lattice)
