"""`build_atlas`: charts for a whole region of joint space, on as many cores or machines as there are (ours)."""

import time
from concurrent.futures import Executor
from pathlib import Path

from numpy.typing import ArrayLike

from orthocas.atlases.align import align
from orthocas.atlases.atlas import Atlas
from orthocas.atlases.atlas_file import add_turns, read_stock
from orthocas.atlases.build import Building, opened, workers
from orthocas.atlases.index import Index
from orthocas.atlases.plan import AtlasSettings, make_plan
from orthocas.atlases.regions import Region, joint_range_of, surroundings
from orthocas.checks import as_number, as_path, require_at_least, require_count, require_kind
from orthocas.errors import Interrupted, InvalidValueError
from orthocas.minimising.watch import Monitor, Progress, silent
from orthocas.problem import Problem

MARGIN_DEG = 5.0
RADIUS = 0.2  # [rad]


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
    process was killed. If a worker dies, the boxes it had run again.

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
