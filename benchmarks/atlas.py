"""Atlases of arms: boxes, time, bytes and coverage against half-width and degree, from a random share of the tiles.

Also corridors: leak against the radius, and what loops of the tool leave behind.
"""

import argparse
import time
from importlib.metadata import files
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

import orthocas as oc
from orthocas import problems
from orthocas.atlas.atlas_file import ATLAS, add_results, header_of, plan_terms
from orthocas.atlas.box_fit import BoxFitter
from orthocas.atlas.lattice import Cell, Outcome, Result
from orthocas.atlas.plan import make_plan
from orthocas.atlas.regions import joint_range_of
from orthocas.tools.block_file import create
from orthocas.tools.checks import Array

ROBOTS = {  # of the package example-robot-data: file and tip
    "panda": ("panda_description/urdf/panda.urdf", "panda_hand"),
    "xarm7": ("xarm_description/urdf/xarm7.urdf", "link_eef"),
    "tiago with its torso": ("tiago_description/robots/tiago.urdf", "arm_tool_link"),
}
HEADER = (
    "| robot, task | half-width, degree | tiles built | fits, charts | cells | seconds | MiB | coverage "
    "| leak rms, p99 | conditioning min |\n| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |"
)


def problem_of(name: str, task: str) -> oc.Problem:
    """A named problem, or a robot of example-robot-data."""
    if name in problems.names():
        return problems.get(name)
    file, tip = ROBOTS[name]
    path = next(Path(str(f.locate())).resolve() for f in files("example-robot-data") or [] if str(f).endswith(file))
    robot = oc.Robot.from_file(path, tip)
    return oc.Problem(robot, oc.Task.named(robot, task))


def row(name: str, task: str, settings: oc.AtlasSettings, share: float, jobs: int | None) -> str:
    """One row of the table: numbers of a share of the tiles, those of all by proportion."""
    with TemporaryDirectory() as folder:
        start = time.perf_counter()
        atlas = oc.build_atlas(
            problem_of(name, task), Path(folder) / "a.orthocas-atlas", settings, share=share, jobs=jobs
        )
        seconds = time.perf_counter() - start
        found, data = oc.evaluate_atlas(atlas, 20_000), atlas.as_dict()
    records = atlas.stock.records
    tiles = len(set(atlas.index.orbits.fitted.tolist()))
    done = int((records["parent"] < 0).sum())
    whole = tiles / done
    built = found.outcome != 5
    covered = float((found.chart >= 0)[built].mean()) if built.any() else 0.0
    values = found.as_dict()
    return (
        f"| {name}, {task} | {settings.half_width:g}, {settings.degree} | {done} of {tiles} "
        f"| {data['fitted'] * whole:.0f}, {len(atlas) * whole:.0f} | {len(records) * whole:.0f} "
        f"| {seconds:.0f}; all: {data['fit_seconds'] * whole:.0f} of one core | {data['bytes'] * whole / 2**20:.2f} "
        f"| {covered:.2%} of what is built | {values['leak_deg']['rms']:.2f}, {values['leak_deg']['p99']:.2f} "
        f"| {values['conditioning']['min']:.2f} |"
    )


def large(count: int) -> str:
    """Open a simulated atlas of so many fitted charts, and look positions up."""
    known = problems.get("iiwa")
    plan = make_plan(known, oc.AtlasSettings(half_width=0.25, symmetric=False), 5.0)
    region = joint_range_of(plan.problem.domain, plan.joints)
    numbers = np.random.default_rng(0).normal(size=(plan.fitted, 1 + plan_terms(plan)))
    with TemporaryDirectory() as folder:
        path = Path(folder) / "large.orthocas-atlas"
        create(path, header_of(plan, region), ATLAS)
        tiles = region.tiles(plan.lattice)[:count].tolist()
        for first in range(0, count, 500):
            cells = [Cell.whole(tile, len(plan.joints)) for tile in tiles[first : first + 500]]
            results = [Result(cell, Outcome.CHART, numbers=numbers, leak_deg=0.0, conditioning=1.0) for cell in cells]
            add_results(path, plan, [(-1, False, result) for result in results], first)
        start = time.perf_counter()
        atlas = oc.Atlas.load(path)
        opened = time.perf_counter() - start
        domain = atlas.problem.domain
        q = np.random.default_rng(1).uniform(-1, 1, (100_000, 7)) * domain.half_width + domain.centre
        seconds = []
        for _ in range(5):
            start = time.perf_counter()
            atlas.chart_at(q)
            seconds.append(time.perf_counter() - start)
        size = path.stat().st_size / 2**20
    return (
        f"{len(atlas)} charts, {size:.0f} MiB: opened in {opened:.2f} s; memory {_memory():.0f} MiB; "
        f"{min(seconds) * 10:.2f} us a position"
    )


def widths(name: str, task: str, boxes: int) -> str:
    """Leak and conditioning of boxes around random clear positions against their size, which an atlas halves to."""
    plan = make_plan(problem_of(name, task), oc.AtlasSettings(), 5.0)
    fitter, joints, domain = BoxFitter(plan), list(plan.joints), plan.problem.domain
    q = domain.centre + domain.half_width * np.random.default_rng(0).uniform(-1, 1, (50 * boxes, plan.problem.n))
    q = q[plan.singular_values(q) > plan.settings.least_singular_value][:boxes, joints]
    lines = [f"{name}, {task}: boxes divide {len(joints)} joints", "half-width: leak (median), conditioning (median)"]
    for half_width in (0.4, 0.2, 0.1, 0.05):
        found = [fitter.fit(plan.box_around(row - half_width, row + half_width))[0] for row in q]
        known = np.array([(chart.leak_deg, chart.conditioning) for chart in found if chart is not None])
        lines.append("{:g} rad: {:.1f} deg, {:.2f}".format(half_width, *np.median(known, axis=0)))
    return "\n".join(lines)


def pseudo_inverse(problem: oc.Problem, q: Array, x: Array) -> Array:
    """Postures along task values, by steps of least norm."""
    postures = []
    for wanted in x:
        for _ in range(4):
            J = problem.task.batched_jacobian(q[None])[0].reshape(problem.m, problem.n)
            q = q + np.linalg.pinv(J) @ (wanted - problem.task.batched(q[None])[0][0])
        postures.append(q)
    return np.array(postures)


def corridor(quick: bool) -> str:
    """Charts along a straight tool path of 0.98 m, and circles of the tool."""
    problem = problems.get("iiwa")
    ends = np.array([[0.25, -0.45, 0.55], [0.6, 0.4, 0.2]])
    start = np.array([-1.0, 0.5, 0.0, -1.4, 0.0, 0.9, 0.0])
    here = problem.task.batched(start[None])[0][0]
    start = pseudo_inverse(problem, start, np.linspace(here, ends[0], 50))[-1]
    postures = pseudo_inverse(problem, start, np.linspace(ends[0], ends[1], 200))
    lines = ["corridor of 0.98 m: radius, seconds of the fit, leak rms without idle joints, least conditioning"]
    for radius in (0.2,) if quick else (0.1, 0.2, 0.35, 0.5):
        begin = time.perf_counter()
        chart = oc.fit(oc.corridor_problem(problem, postures, radius), oc.Polynomial(3, "auto")).chart
        seconds, found = time.perf_counter() - begin, oc.evaluate(chart)
        leak = (found.without_idle or found).leak.rms
        lines.append(f"{radius:g} rad: {seconds:.1f} s, {leak:.2f} deg, {found.conditioning.min:.2f}")
    lines.append("circles of the tool: radius, left over by the pseudo-inverse, by a chart of a corridor")
    turn, home = np.linspace(0, 2 * np.pi, 160)[:, None], problem.domain.centre
    for size in (0.1,) if quick else (0.05, 0.1, 0.2):
        x = problem.task.batched(home[None])[0][0] + size * np.hstack([np.cos(turn) - 1, np.sin(turn), 0 * turn])
        postures = pseudo_inverse(problem, home, x)
        chart = oc.fit(oc.corridor_problem(problem, postures), oc.Polynomial(3, "auto"), samples=1500).chart
        q, xi = home, chart.xi(home)
        for wanted in x:
            q = chart.inverse(np.concatenate([wanted, xi]), q_start=q)
        left = [np.abs(last - home).max() for last in (postures[-1], q)]
        lines.append("{:g} m: {:.2g} rad, {:.1g} rad".format(size, *left))
    return "\n".join(lines)


def _memory() -> float:
    """Resident memory of this process [MiB]."""
    text = Path("/proc/self/status").read_text()
    return int(next(line.split()[1] for line in text.splitlines() if line.startswith("VmRSS"))) / 1024


def main(quick: bool, jobs: int | None) -> None:
    """Print the tables."""
    print(corridor(quick))
    print(widths("panda", "pose", 4 if quick else 12))
    print(large(2000 if quick else 100_000))
    print(HEADER)
    share = 0.02 if quick else 0.05
    for half_width in (0.8,) if quick else (0.4, 0.55, 0.8, 1.1):
        for degree in (3,) if quick else (2, 3, 4):
            print(
                row("iiwa", "position", oc.AtlasSettings(degree=degree, half_width=half_width), share, jobs), flush=True
            )
    for name in () if quick else ("panda", "xarm7", "tiago with its torso"):
        print(row(name, "position", oc.AtlasSettings(), share / 10, jobs), flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--jobs", type=int)
    words = parser.parse_args()
    main(words.quick, words.jobs)
