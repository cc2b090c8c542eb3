"""What `solve` and `solutions` miss on the ready charts: round trips of points near corners, and 20,000 Newton starts.

Round trips: q is drawn near faces and corners of the domain, a quarter of the points on faces exactly and some in
corners; `solve(phi(q))` should find a q inside with this phi. Targets beyond: phi of points of a box 1.4 times as wide.
All solutions: for targets phi(q) with a uniform q, Newton's method starts from 20,000 uniform points; what it finds
inside the domain is compared with `solutions`. The nearest xi: wishes and task values of two uniform points each; what
damped least squares lead to from 4,000 uniform points is compared with `nearest_xi`. Ends: targets at 90 and 99 % of
`xi_range`, from its joint position. Times are processor times of one thread (30 min; quick: 20 s).
"""

import time

import numpy as np
from benchmark import run, table
from dense_search import STARTS, least_distance

import orthocas as oc
from orthocas.tasks.domains import Domain
from orthocas.tasks.samples import sample_uniform
from orthocas.tools.checks import Array

QUICK = ("panda-position", "ur5-position")
SEVERAL = ("iiwa7-position", "ur5-position", "ur10-position", "xarm7-position", "panda-pose")  # for all solutions
WIDE = ("panda-wide", "iiwa7-wide", "xarm7-wide", "baxter-left-wide", "pr2-left-wide")  # for the nearest xi
_STARTS, _SAME = 20_000, 1e-6

MISSES = (
    "| chart | missed, near corners | wrong | us a row | missed, uniform | us a row | us a row beyond | "
    "said to be out of reach |\n|" + " --- |" * 8
)
RECALL = "| chart | targets | solutions: mean | most | missed by 20,000 starts | missed by `solutions` | ms |\n|" + (
    " --- |" * 7
)
NEAREST = (
    "| chart | wishes | 4,000 starts lead nearer | less near | ms a wish | in C | near ends of ranges "
    "| of these missed |\n|" + " --- |" * 8
)


def near_corners(domain: Domain, count: int, seed: int) -> Array:
    """Points near faces and corners of a domain, (count, n)."""
    rng, n = np.random.default_rng(seed), len(domain.centre)
    unit = rng.uniform(-1, 1, (count, n))
    unit = np.sign(unit) * np.abs(unit) ** rng.choice([0.5, 0.25, 0.1, 0.0], (count, 1))
    faces = rng.uniform(-1, 1, (count // 4, n))
    held = rng.uniform(size=faces.shape) < rng.uniform(size=(len(faces), 1))
    unit[: len(faces)] = np.where(held, np.sign(faces), faces)
    return np.clip(domain.centre + domain.half_width * unit, *domain.bounds)


def misses(name: str, count: int) -> str:
    """One row of the first table."""
    chart = oc.charts.load(name)
    domain = chart.problem.domain
    chart.solve(chart.phi(near_corners(domain, 100, 1)))  # the first call measures the domain
    sets = near_corners(domain, count, 77), sample_uniform(domain, count, 5)
    cells = []
    for q in sets:
        phi = chart.phi(q)
        begin = time.process_time()
        solutions = chart.solve(phi)
        seconds = time.process_time() - begin
        found = solutions.found
        wrong = (np.abs(chart.phi(solutions.q[found]) - phi[found]) > 1e-8 * chart.parts.phi_sizes).any(axis=1)
        cells += [int((~found).sum()), int(wrong.sum() + (~domain.contains(solutions.q[found])).sum())]
        cells += [round(1e6 * seconds / count)]
    wide = domain.centre + 1.4 * (sample_uniform(domain, count // 25, 6) - domain.centre)
    begin = time.process_time()
    beyond = chart.solve(chart.phi(wide))
    per_row = 1e6 * (time.process_time() - begin) / len(wide)
    reach = int((beyond.status == oc.InverseStatus.OUT_OF_REACH).sum())
    missed, wrong_rows, micro, uniform, wrong_uniform, micro_uniform = cells
    return (
        f"| {name} | {missed} | {wrong_rows + wrong_uniform} | {micro} | {uniform} | {micro_uniform} | {per_row:.0f} "
        f"| {reach} |"
    )


def recall(name: str, targets: int) -> str:
    """One row of the second table."""
    chart = oc.charts.load(name)
    width = chart.problem.domain.half_width
    q = sample_uniform(chart.problem.domain, targets, 8)
    starts = sample_uniform(chart.problem.domain, _STARTS, 9)
    counts, missed_there, missed_here, seconds = [], 0, 0, 0.0
    for phi in chart.phi(q):
        tried = chart.solve(np.tile(phi, (_STARTS, 1)), starts)
        begin = time.process_time()
        mine = chart.solutions(phi)
        seconds += time.process_time() - begin
        theirs = different(tried.q[tried.found] / width)
        together = different(np.vstack([theirs, mine / width]))
        counts.append(len(together))
        missed_there += len(together) - len(theirs)
        missed_here += len(together) - len(mine)
    return (
        f"| {name} | {targets} | {np.mean(counts):.2f} | {max(counts)} | {missed_there} | {missed_here} "
        f"| {1e3 * seconds / targets:.0f} |"
    )


def different(points: Array) -> Array:
    """Points (N, n) that differ, (k, n)."""
    found: list[Array] = []
    left = points
    while len(left):
        found.append(left[0])
        left = left[np.abs(left - left[0]).max(axis=1) > _SAME]
    return np.array(found).reshape(-1, points.shape[1])


def nearest(name: str, count: int) -> str:
    """One row of the third table."""
    chart = oc.charts.load(name)
    domain = chart.problem.domain
    wishes, x = sample_uniform(domain, count, 0), chart.x(sample_uniform(domain, count, 1000))
    seconds = []
    for solver in (oc.compile_inverse(chart), chart):
        solver.nearest_xi(wishes[:20], x[:20])
        begin = time.process_time()
        found = solver.nearest_xi(wishes, x)
        seconds.append(1e3 * (time.process_time() - begin) / count)
    pool = sample_uniform(domain, STARTS, 77)
    least = np.array([least_distance(chart, wish, value, pool) for wish, value in zip(wishes, x, strict=True)])
    mine = np.where(found.status <= oc.InverseStatus.NEAREST, found.distance, np.inf)
    worse, better = int((mine > least + 1e-6).sum()), int((mine < least - 1e-6).sum())
    starts, targets = ends(chart, count // 4)
    missed = int((~chart.solve(targets, starts).found).sum())
    in_c, in_numpy = seconds
    return f"| {name} | {count} | {worse} | {better} | {in_numpy:.2f} | {in_c:.2f} | {len(targets)} | {missed} |"


def ends(chart: oc.Chart, count: int) -> tuple[Array, Array]:
    """Joint positions, and values near both ends of the range of each coordinate there."""
    starts, targets = [], []
    for q in sample_uniform(chart.problem.domain, count, 5):
        reach = chart.xi_range(q)
        for k in range(chart.r):
            for end in (reach.low[k], reach.high[k]):
                for share in (0.9, 0.99) if np.isfinite(end) else ():
                    target = chart.phi(q)
                    target[chart.m + k] += share * (end - target[chart.m + k])
                    starts.append(q)
                    targets.append(target)
    return np.array(starts), np.array(targets)


def main(quick: bool = False) -> list[str]:
    """All tables; `quick` takes two charts and few points."""
    rows = table(MISSES, (misses(name, 2_000 if quick else 50_000) for name in (QUICK if quick else oc.charts.names())))
    print()
    rows += table(RECALL, (recall(name, 2 if quick else 12) for name in (QUICK[1:] if quick else SEVERAL)))
    print()
    return rows + table(NEAREST, (nearest(name, 8 if quick else 400) for name in (WIDE[:1] if quick else WIDE)))


if __name__ == "__main__":
    run(main, __doc__)
