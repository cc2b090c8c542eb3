"""Fills the self-motions of a joint position with points on a lattice in xi (ours)."""

from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from orthocas.checks import Array, Indices
from orthocas.reaching.intervals import XiRange

if TYPE_CHECKING:
    from orthocas.chart import Chart

_ITERATIONS = 12
_TOLERANCE = 1e-10  # of phi, relative to `Chart.phi_sizes`
_FARTHEST = 3.0  # distance of a point from its neighbour, in lengths of the predicted step
_SINGULAR = 1e12  # condition number of J
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
    q, sizes = starts.copy(), chart.phi_sizes
    first = np.zeros(len(q))
    for k in range(_ITERATIONS):
        change = _newton_step(chart, q, targets)
        if k == 0:
            first = np.linalg.norm(change, axis=1)
        q = q + change
        if np.linalg.norm(change, axis=1).max() < 1e-13:
            break
    error = np.abs((chart.phi(q) - targets) / sizes).max(axis=1)
    near = np.linalg.norm(q - starts, axis=1) <= _FARTHEST * first + 1e-9
    rows = np.flatnonzero((error < _TOLERANCE) & near & chart.problem.domain.contains(q))
    same = np.sign(np.linalg.det(_jacobian(chart, q[rows]))) == sign
    return q, np.asarray(rows[same], dtype=np.int64)


def _newton_step(chart: "Chart", q: Array, targets: Array) -> Array:
    """J^-1 (target - phi), at most half a radian long; zero where J is singular or not finite."""
    J, error = _jacobian(chart, q), targets - chart.phi(q)
    rows = np.flatnonzero(np.isfinite(J).all(axis=(1, 2)) & np.isfinite(error).all(axis=1))
    rows = rows[np.linalg.cond(J[rows]) < _SINGULAR]
    change = np.zeros_like(q)
    change[rows] = np.linalg.solve(J[rows], error[rows][..., None])[..., 0]
    length = np.linalg.norm(change, axis=1, keepdims=True)
    return np.asarray(change * np.minimum(1.0, 0.5 / np.maximum(length, 1e-300)))


def _jacobian(chart: "Chart", q: Array) -> Array:
    """J at points (N, n), also where it is not finite."""
    J_x = chart.problem.task.batched_jacobian(q)[0].reshape(-1, chart.m, chart.n)
    return np.concatenate([J_x, chart.coordinates.jacobian(q)], axis=1)
