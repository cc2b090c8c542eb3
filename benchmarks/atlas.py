"""Atlases of arms: boxes, time, bytes and coverage against half-width and degree, from a random share of the tiles."""

import argparse
import time
from importlib.metadata import files
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

import orthocas as oc
from orthocas import problems
from orthocas.atlases.atlas_file import ATLAS, add_results, header_of, plan_terms
from orthocas.atlases.cells import Cell
from orthocas.atlases.outcomes import Outcome, Result
from orthocas.atlases.plan import make_plan
from orthocas.atlases.regions import joint_range_of
from orthocas.files.blocks import create

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
            add_results(path, plan, [(-1, False, Result(c, Outcome.CHART, numbers=numbers)) for c in cells], first)
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


def _memory() -> float:
    """Resident memory of this process [MiB]."""
    text = Path("/proc/self/status").read_text()
    return int(next(line.split()[1] for line in text.splitlines() if line.startswith("VmRSS"))) / 1024


def main(quick: bool, jobs: int | None) -> None:
    """Print the tables."""
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
