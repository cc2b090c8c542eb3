"""Alignment: neighbouring charts get the same order and signs of coordinates, and meet without a jump (ours)."""

from dataclasses import dataclass
from itertools import permutations

import numpy as np
import scipy

from orthocas.atlases.atlas_file import Turns
from orthocas.atlases.evaluation import Evaluation
from orthocas.atlases.index import Index
from orthocas.checks import Array, Indices

_FEW = 5  # coordinates whose orders are all tried
_SEED = 0
_MEETINGS = 2  # points of each face of a box where neighbours are looked for
_AHEAD = 1e-6  # of a half-width, beyond the face


@dataclass(frozen=True, eq=False)
class Alignment:
    """The turns of all charts, and how well neighbours fit together with them."""

    turns: Turns
    meetings: int  #: places where two neighbouring charts were compared
    jump: float  #: root mean square difference of unit gradients there, in the best order and signs for each pair
    left: float  #: the same with the turns of the whole atlas
    consistent: float  #: share of the places where the turns are the best for the pair, too


def align(index: Index) -> Alignment:
    """Walk from chart to chart along the pairs that fit best, and give each the order and signs of the one before.

    Coordinates of neighbours a and b are compared where the face of one box meets the other: M_ij is the cosine between
    gradients of xi_i of a and xi_j of b. The pairs form a graph. The walk follows a spanning tree of it with the
    greatest sum of |M_ij| over matched coordinates. Around a loop of charts the turns need not close; `consistent`
    tells how often they do.
    """
    raw = Evaluation(index, None)
    q, first, second = _meetings(index)
    fitted = index.plan.fitted
    gradients = [_unit(raw.jacobian(q, charts)[:, :fitted]) for charts in (first, second)]
    cosines = gradients[0] @ gradients[1].transpose(0, 2, 1)
    order, signs, match = _best(cosines)
    turns = _walked(index.count, fitted, first, second, order, signs, match)
    constants = _constants(raw, turns, q, first, second, match)
    turns = Turns(turns.order, turns.signs, constants)
    own = _taken(cosines, order, signs)
    joint = _relative(turns, first, second)
    common = _taken(cosines, *joint)
    agree = ((joint[0] == order) & (joint[1] == signs)).all(axis=1)
    return Alignment(turns, len(q), _jump(own), _jump(common), float(agree.mean()) if len(q) else 1.0)


def _meetings(index: Index) -> tuple[Array, Indices, Indices]:
    """Points just beyond faces of boxes' cells where another chart takes over, with both charts."""
    plan, charts = index.plan, np.arange(index.count)
    centres, _ = index.image_centres(charts)
    half = index.box_half_widths[index.rows(charts)[1]] / (1 + plan.settings.overlap)
    rng = np.random.default_rng(_SEED)
    points, owners = [], []
    for joint in range(len(plan.joints)):
        for _ in range(_MEETINGS):
            u = rng.uniform(-0.9, 0.9, half.shape)
            u[:, joint] = 1 + _AHEAD
            points.append(centres + half * u)
            owners.append(charts)
    places, first = np.concatenate(points), np.concatenate(owners)
    second = index.find(places)
    kept = (second >= 0) & (second != first) & index.in_boxes(places, first)
    q = np.repeat(plan.problem.domain.centre[None], int(kept.sum()), axis=0)
    q[:, list(plan.joints)] = places[kept]
    return q, first[kept], second[kept]


def _unit(J: Array) -> Array:
    return np.asarray(J / np.linalg.norm(J, axis=2, keepdims=True))


def _best(cosines: Array) -> tuple[Indices, Array, Array]:
    """For coordinates i of the first charts, the order and signs of those of the second, and the mean |cosine|."""
    r = cosines.shape[1]
    sizes, rows = np.abs(cosines), np.arange(r)
    if r <= _FEW:
        orders = np.array(list(permutations(range(r))))
        chosen = orders[np.argmax(sizes[:, rows, orders].sum(axis=2), axis=1)] if len(cosines) else orders[:0]
    else:
        chosen = np.array([scipy.optimize.linear_sum_assignment(-size)[1] for size in sizes]).reshape(-1, r)
    picked = np.take_along_axis(cosines, chosen[:, :, None], axis=2)[:, :, 0]
    return chosen, np.where(picked < 0, -1.0, 1.0), np.abs(picked).mean(axis=1)


def _walked(count: int, r: int, first: Indices, second: Indices, order: Indices, signs: Array, match: Array) -> Turns:
    """Turns along a spanning tree of the greatest match; every part of the graph begins with a chart as it is."""
    turned, flipped = np.tile(np.arange(r), (count, 1)), np.ones((count, r))
    if len(first):
        for before, now, k, forward in _tree(count, first, second, match):
            if forward:  # xi_i of the first is signs_i times xi_order_i of the second
                turned[now] = order[k][turned[before]]
                flipped[now] = flipped[before] * signs[k][turned[before]]
            else:
                back = np.argsort(order[k])
                turned[now] = back[turned[before]]
                flipped[now] = flipped[before] * signs[k][back][turned[before]]
    return Turns(turned, flipped, np.zeros((count, r)))


def _tree(count: int, first: Indices, second: Indices, match: Array) -> list[tuple[int, int, int, bool]]:
    """Steps of the walk: chart before, chart now, number of the meeting, and whether the first of it comes before."""
    weights = 2.0 - match  # positive; the least sum is the greatest match
    best: dict[tuple[int, int], int] = {}
    for k in np.argsort(weights)[::-1].tolist():
        best[min(first[k], second[k]), max(first[k], second[k])] = k
    pairs = np.array(list(best), dtype=np.int32)  # older versions of SciPy walk through no others
    graph = scipy.sparse.coo_array((weights[list(best.values())], pairs.T), shape=(count, count))
    tree = scipy.sparse.csgraph.minimum_spanning_tree(graph.tocsr())
    tree = (tree + tree.T).tocsr()
    steps, seen = [], np.zeros(count, dtype=bool)
    for root in np.flatnonzero(np.diff(tree.indptr)).tolist():
        if seen[root]:
            continue
        nodes, before = scipy.sparse.csgraph.breadth_first_order(tree, root, directed=False)
        seen[nodes] = True
        for now in nodes[1:].tolist():
            k = best[min(before[now], now), max(before[now], now)]
            steps.append((int(before[now]), now, k, bool(first[k] == before[now])))
    return steps


def _relative(turns: Turns, first: Indices, second: Indices) -> tuple[Indices, Array]:
    """Order and signs between charts of pairs that the turns of all charts mean."""
    back = np.argsort(turns.order[first], axis=1)
    order = np.take_along_axis(turns.order[second], back, axis=1)
    signs = np.take_along_axis(turns.signs[first] * turns.signs[second], back, axis=1)
    return order, signs


def _constants(raw: Evaluation, turns: Turns, q: Array, first: Indices, second: Indices, match: Array) -> Array:
    """Constants with the least jumps of xi where charts meet: a least-squares problem on the graph."""
    count, r = turns.order.shape
    if not len(q):
        return np.zeros((count, r))
    turned = Evaluation(raw.index, turns)
    jumps = (turned.xi(q, second) - turned.xi(q, first))[:, :r] * match[:, None]
    rows = np.arange(len(q))
    gaps = scipy.sparse.coo_array(
        (np.concatenate([match, -match]), (np.tile(rows, 2), np.concatenate([first, second]))), shape=(len(q), count)
    ).tocsr()
    return np.column_stack([scipy.sparse.linalg.lsqr(gaps, jumps[:, j], iter_lim=500)[0] for j in range(r)])


def _taken(cosines: Array, order: Indices, signs: Array) -> Array:
    return np.asarray(np.take_along_axis(cosines, order[:, :, None], axis=2)[:, :, 0] * signs)


def _jump(cosines: Array) -> float:
    """Root mean square of |v - w| for unit vectors with these cosines."""
    return float(np.sqrt(np.mean(2 - 2 * np.clip(cosines, -1, 1)))) if cosines.size else 0.0
