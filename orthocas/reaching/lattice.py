"""Fills the self-motions of a joint position with points on a lattice in xi (ours)."""

from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from orthocas.checks import Array, Indices
from orthocas.inverting.newton import Newton
from orthocas.inverting.phi_map import largest
from orthocas.reaching.intervals import XiRange

if TYPE_CHECKING:
    from orthocas.chart import Chart

_TOLERANCE = 1e-10  # of phi, relative to `Chart.phi_sizes`
_FARTHEST = 3.0  # distance of a point from its neighbour, in lengths of the predicted step
_MOST = 4  # times as many points as wanted, at most


def filled(chart: "Chart", q: Array, alone: XiRange, samples: int) -> Array:
    """Joint positions (N, n) with the task value of q (n,), inside the domain, q first.

    Their coordinates lie on a lattice around xi(q). Its spacing divides the range of each coordinate alone so that
    about `samples` points result. The fill goes from point to neighbour, so that all points can be reached from q.
    """
    cells = max(2, round(samples ** (1 / chart.r)))
    spacing = _spans(alone) / cells
    known: dict[tuple[int, ...], Array] = {(0,) * chart.r: q}
    front, tried = list(known), set(known)
    start, sign = chart.phi(q), np.sign(np.linalg.det(chart.jacobian(q)))
    while front and len(known) < _MOST * samples:
        pairs = _neighbours(front, tried, cells)
        if not pairs:
            break
        places = np.array([place for _, place in pairs])
        targets = np.tile(start, (len(pairs), 1))
        targets[:, chart.m :] += places * spacing
        found, good = _solved(chart, np.array([known[origin] for origin, _ in pairs]), targets, float(sign))
        front = [pairs[row][1] for row in good]
        known.update(zip(front, found[good], strict=True))
    return np.array(list(known.values()))


def _spans(alone: XiRange) -> Array:
    """The widths of the ranges; a full turn for endless coordinates."""
    span = alone.high - alone.low
    return np.where(np.isfinite(span) & (span > 0), span, 2 * np.pi)


def _neighbours(
    front: list[tuple[int, ...]], tried: set[tuple[int, ...]], cells: int
) -> list[tuple[tuple[int, ...], tuple[int, ...]]]:
    """Pairs of a point and a neighbour of it that was not tried before."""
    pairs = []
    for origin, axis, move in product(front, range(len(front[0])), (-1, 1)):
        place = (*origin[:axis], origin[axis] + move, *origin[axis + 1 :])
        if place not in tried and abs(place[axis]) <= 2 * cells:
            tried.add(place)
            pairs.append((origin, place))
    return pairs


def _solved(chart: "Chart", starts: Array, targets: Array, sign: float) -> tuple[Array, Indices]:
    """Newton's method from all starts (N, n), and the rows where it found a point of the domain on the same sheet."""
    phi_map = chart.phi_map
    found = Newton(phi_map)(targets, starts)
    step = np.linalg.solve(phi_map.jacobian(starts), (targets - phi_map.phi(starts))[..., None])[..., 0]
    near = np.linalg.norm(found.q - starts, axis=1) <= _FARTHEST * np.linalg.norm(step, axis=1) + 1e-9
    rows = np.flatnonzero((largest(found.residual) < _TOLERANCE) & near & chart.problem.domain.contains(found.q))
    same = np.sign(np.linalg.det(phi_map.jacobian(found.q[rows]))) == sign
    return found.q, np.asarray(rows[same], dtype=np.int64)
