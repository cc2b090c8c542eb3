"""`build_atlas`, and the alignment of neighbouring charts."""

import time
from concurrent.futures import Executor
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path

import numpy as np
import scipy
from numpy.typing import ArrayLike

from orthocas.atlas.atlas import Atlas
from orthocas.atlas.atlas_file import Turns, add_turns, read_stock
from orthocas.atlas.build import Building, opened, workers
from orthocas.atlas.evaluation import Evaluation
from orthocas.atlas.index import Index
from orthocas.atlas.plan import AtlasSettings, make_plan
from orthocas.atlas.regions import Region, joint_range_of, surroundings
from orthocas.errors import Interrupted, InvalidValueError
from orthocas.tasks.problem import Problem
from orthocas.tools.checks import Array, Indices, as_number, as_path, require_at_least, require_count, require_kind
from orthocas.tools.progress import Monitor, Progress, silent

_FEW = 5  # coordinates whose orders are all tried
_SEED = 0
_MEETINGS = 2  # points of each face of a box where neighbours are looked for
_AHEAD = 1e-6  # of a half-width, beyond the face
MARGIN_DEG = 5.0
RADIUS = 0.2  # [rad]


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
    counts how often they do.
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


def build_atlas(
    problem: Problem,
    path: str | Path,
    settings: AtlasSettings | None = None,
    *,
    region: ArrayLike | None = None,
    radius: float = RADIUS,
    margin_deg: float = MARGIN_DEG,
    share: float = 1.0,
    time_limit: float | None = None,
    executor: Executor | None = None,
    jobs: int | None = None,
    monitor: Monitor = silent,
    force: bool = False,
) -> Atlas:
    """Fit charts of overlapping boxes over a region of joint space, and append them to a file as they come.

    Joints that the task does not see and cyclic joints are not divided: one box serves all their positions. The range
    of the other joints is cut into equal tiles. Each is fitted with polynomials from linear coordinates that are exact
    at its centre, and judged at other samples. A box whose leak or conditioning is worse than asked is halved along the
    joint where that helps most. Boxes without positions clear of task singularities are left out. Of boxes that are
    images of each other in a symmetry of the arm, one is fitted.

    If the file exists and belongs to the same problem, region and settings, the build goes on from it, also after the
    process was killed. If a worker dies, the boxes it had run again; one over which workers die three times is left to
    the next build.

    In scripts, call it under `if __name__ == "__main__"`: it starts processes.

    Args:
        problem: robot, task and metric; its domain is not used.
        path: the file, by custom `NAME.orthocas-atlas`.
        settings: what is asked of the charts; see `AtlasSettings`.
        region: postures (N, n) whose surroundings are covered. Default: the whole joint range.
        radius: how far these surroundings reach in every joint [rad] or [m].
        margin_deg: distance of the joint range to the limits [deg]; 2 % of the range for prismatic joints.
        share: build only this share of the tiles, a random choice; more of them can follow.
        time_limit: seconds after which no more boxes are begun.
        executor: any `concurrent.futures.Executor` (processes, threads, Dask, MPI, ...). Workers need no shared disk.
            Default: processes on this machine with one thread each.
        jobs: number of these processes. Default: one for each core.
        monitor: called with progress.
        force: replace a file of that name, whatever it is.

    Raises:
        AtlasFileError: if the file cannot be written, or belongs to something else.
        InvalidValueError, ShapeError, DomainError: if an argument is invalid.
        Interrupted: after Ctrl-C; `result` is the atlas so far.
    """
    asked = AtlasSettings() if settings is None else settings
    require_kind("settings", asked, AtlasSettings)
    if not 0 < as_number("share", share) <= 1:
        raise InvalidValueError("share", share, "a number above 0, at most 1")
    if time_limit is not None:
        require_at_least("time_limit", time_limit, 0)
    target = as_path("path", path).absolute()
    plan = make_plan(problem, asked, margin_deg)
    area: Region = joint_range_of(plan.problem.domain, plan.joints)
    if region is not None:
        area = surroundings(region, radius, plan.joints, plan.problem.domain)
    size = None if jobs is None else require_count("jobs", jobs)
    until = float("inf") if time_limit is None else time.monotonic() + time_limit
    with opened(target, plan, area, force) as stock:
        building = Building(target, plan, area, float(share), monitor)
        building.resume(stock)
        try:
            if building.waiting:
                with workers(executor, size, plan) as (shared, in_flight, content):
                    building.run(shared, in_flight, content, until)
        except KeyboardInterrupt:
            raise Interrupted(_aligned(target, silent)) from None
        return _aligned(target, monitor)


def _aligned(path: Path, monitor: Monitor) -> Atlas:
    """The atlas of a file, with turns for all its charts."""
    stock = read_stock(path)
    index = Index(stock)
    if index.count and (stock.turns is None or len(stock.turns.order) != index.count):
        monitor(Progress("alignment", 0.0, f"{index.count} charts"))
        add_turns(path, align(index).turns)
    return Atlas.load(path)
