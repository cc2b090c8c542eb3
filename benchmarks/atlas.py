"""Atlases of arms, the first built in full and proved, others from a random share of the tiles (20 min of one core).

Also corridors: leak against the radius, and what circles of the tool leave behind.
"""

import time
from collections.abc import Iterator
from importlib.metadata import files
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from benchmark import run, table

import orthocas as oc
from orthocas import problems
from orthocas.atlas.atlas_file import ATLAS, add_results, header_of, plan_terms
from orthocas.atlas.lattice import Cell, Outcome, Result
from orthocas.atlas.plan import make_plan
from orthocas.atlas.regions import joint_range_of
from orthocas.tools.block_file import create
from orthocas.tools.checks import Array
from orthocas.tools.display import percent

ROBOTS = {  # of the package example-robot-data: file and tip
    "panda": ("panda_description/urdf/panda.urdf", "panda_hand"),
    "xarm7": ("xarm_description/urdf/xarm7.urdf", "link_eef"),
    "tiago with its torso": ("tiago_description/robots/tiago.urdf", "arm_tool_link"),
}
HEADER = (
    "| arm, task, leak asked for | tiles built | fits, charts with images | file [MiB] | CPU [s] "
    "| coverage of clear positions | leak there rms, p99 [deg] | conditioning there, least |\n"
    "| --- | --- | --- | --- | --- | --- | --- | --- |"
)
CORRIDOR = "| radius [rad] | fit [s CPU] | leak rms [deg] | least conditioning |\n| --- | --- | --- | --- |"
CIRCLES = "| circle | pseudo-inverse leaves [rad] | a chart of a corridor leaves [rad] |\n| --- | --- | --- |"
CASES = (  # robot, task, settings, share of the tiles
    ("iiwa", "position", oc.AtlasSettings(certify_seconds=6), 1.0),
    ("panda", "position", oc.AtlasSettings(), 0.02),
    ("tiago with its torso", "position", oc.AtlasSettings(), 0.02),
    ("panda", "pose", oc.AtlasSettings(leak_deg=12.0), 0.002),
)


def problem_of(name: str, task: str) -> oc.Problem:
    """A named problem, or a robot of example-robot-data."""
    if name in problems.names():
        return problems.get(name)
    file, tip = ROBOTS[name]
    path = next(Path(str(f.locate())).resolve() for f in files("example-robot-data") or [] if str(f).endswith(file))
    robot = oc.Robot.from_file(path, tip)
    return oc.Problem(robot, oc.Task.named(robot, task))


def row(name: str, task: str, settings: oc.AtlasSettings, share: float) -> str:
    """One row of the table."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "a.orthocas-atlas"
        atlas = oc.build_atlas(problem_of(name, task), path, settings, share=share, jobs=1)
        found, data = oc.evaluate_atlas(atlas, 20_000), atlas.as_dict()
    tiles, done = len(set(atlas.index.orbits.fitted.tolist())), int((atlas.stock.records["parent"] < 0).sum())
    built = found.outcome != 5
    covered, values = float((found.chart >= 0)[built].mean()), found.as_dict()
    return (
        f"| {name}, {task}, {settings.leak_deg:g} deg | {done} of {tiles} | {data['fitted']}, {len(atlas)} "
        f"| {data['bytes'] / 2**20:.2f} | {data['fit_seconds']:.0f} | {percent(covered, 2)} "
        f"| {values['leak_deg']['rms']:.2f}, {values['leak_deg']['p99']:.2f} | {values['conditioning']['min']:.2f} |"
    )


def looked_up(count: int) -> float:
    """Time for a position in a simulated atlas of so many fitted charts [us]."""
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
        atlas = oc.Atlas.load(path)
        domain = atlas.problem.domain
        q = np.random.default_rng(1).uniform(-1, 1, (100_000, 7)) * domain.half_width + domain.centre
        seconds = []
        for _ in range(5):
            start = time.process_time()
            atlas.chart_at(q)
            seconds.append(time.process_time() - start)
    return 1e6 * min(seconds) / len(q)


def pseudo_inverse(problem: oc.Problem, q: Array, x: Array) -> Array:
    """Postures along task values, by steps of least norm."""
    postures = []
    for wanted in x:
        for _ in range(4):
            J = problem.task.batched_jacobian(q[None])[0].reshape(problem.m, problem.n)
            q = q + np.linalg.pinv(J) @ (wanted - problem.task.batched(q[None])[0][0])
        postures.append(q)
    return np.array(postures)


def corridors(radii: tuple[float, ...]) -> Iterator[str]:
    """Charts along a straight tool path of 0.98 m."""
    problem = problems.get("iiwa")
    ends = np.array([[0.25, -0.45, 0.55], [0.6, 0.4, 0.2]])
    start = np.array([-1.0, 0.5, 0.0, -1.4, 0.0, 0.9, 0.0])
    here = problem.task.batched(start[None])[0][0]
    start = pseudo_inverse(problem, start, np.linspace(here, ends[0], 50))[-1]
    postures = pseudo_inverse(problem, start, np.linspace(ends[0], ends[1], 200))
    for radius in radii:
        begin = time.process_time()
        chart = oc.fit(oc.corridor_problem(problem, postures, radius), oc.Polynomial(3, "auto")).chart
        seconds, found = time.process_time() - begin, oc.evaluate(chart)
        leak = (found.without_idle or found).leak.rms
        yield f"| {radius:g} | {seconds:.1f} | {leak:.2f} | {found.conditioning.min:.2f} |"


def circles(sizes: tuple[float, ...]) -> Iterator[str]:
    """Circles of the tool: what the pseudo-inverse leaves over, and a chart of a corridor around its postures."""
    problem = problems.get("iiwa")
    turn, home = np.linspace(0, 2 * np.pi, 160)[:, None], problem.domain.centre
    for size in sizes:
        x = problem.task.batched(home[None])[0][0] + size * np.hstack([np.cos(turn) - 1, np.sin(turn), 0 * turn])
        postures = pseudo_inverse(problem, home, x)
        chart = oc.fit(oc.corridor_problem(problem, postures), oc.Polynomial(3, "auto"), samples=1500).chart
        q, xi = home, chart.xi(home)
        for wanted in x:
            q = chart.inverse(np.concatenate([wanted, xi]), q_start=q)
        left = [np.abs(last - home).max() for last in (postures[-1], q)]
        yield "| {:g} m | {:.2g} | {:.1g} |".format(size, *left)


def main(quick: bool = False) -> dict[str, float]:
    """Print three tables; `quick` takes one row of the small ones.

    Returns:
        Time that `chart_at` takes a position in an atlas of many charts [us].
    """
    table(CORRIDOR, corridors((0.2,) if quick else (0.1, 0.2, 0.35, 0.5)))
    print()
    table(CIRCLES, circles((0.1,) if quick else (0.05, 0.1, 0.2)))
    print()
    table(HEADER, (row(*case) for case in ([] if quick else CASES)))
    return {"chart_at us": looked_up(2_000 if quick else 100_000)}


if __name__ == "__main__":
    run(main, __doc__)
