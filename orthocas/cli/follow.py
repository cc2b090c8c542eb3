"""`orthocas follow`: joint motions along a tool path."""

import time
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from orthocas.charts.chart import Chart
from orthocas.charts.ready import load
from orthocas.cli.options import AsJson, ChartPath, Force, Number, SolidOptions, parse_numbers, parse_one_or_all, spread
from orthocas.cli.output import print_json, print_rows
from orthocas.errors import InvalidValueError, OptionError
from orthocas.paths.follow import HOLD, OBJECTIVE
from orthocas.paths.follow import follow as follow_path
from orthocas.paths.joint_motion import JointMotion, require_place
from orthocas.paths.tool_path import read_path
from orthocas.robots.obstacles import Capsule, Plane, Scene, Solid, Sphere
from orthocas.tools.checks import Array, require_known
from orthocas.tools.interrupts import deferred

SCHEDULE = "schedule"
_CHOICES = (HOLD, SCHEDULE, OBJECTIVE)


@spread("solids", SolidOptions)
def follow(
    chart: ChartPath,
    path: Annotated[Path, typer.Argument(metavar="PATH.csv", help="Waypoints of the tool, see docs/how-to/paths.md.")],
    out: Annotated[Path, typer.Option("--out", help="CSV file for times, positions, velocities and accelerations.")],
    xi: Annotated[
        str | None, typer.Option("--xi", help="Extra coordinates: hold, schedule (columns of PATH.csv) or objective.")
    ] = None,
    period: Annotated[float, Number("--period", help="Distance of the time stamps [s].")] = 0.01,
    velocity: Annotated[
        str | None, typer.Option("--velocity-limit", help="Of all joints or each [rad/s], [m/s]; default: the robot's.")
    ] = None,
    obstacle: Annotated[
        list[str] | None,
        typer.Option(
            "--obstacle",
            help="sphere:X,Y,Z,RADIUS, capsule:X,Y,Z,X,Y,Z,RADIUS or plane:NORMAL,POINT [m]; repeat for more.",
        ),
    ] = None,
    link_radius: Annotated[
        float | None, Number("--link-radius", help="Take rods of this radius for links, without --collisions [m].")
    ] = None,
    clearance: Annotated[
        float, Number("--clearance", help="Smallest distance of links, and of links and obstacles [m].")
    ] = 0.0,
    *,
    solids: SolidOptions,
    force: Force = False,
    json: AsJson = False,
) -> None:
    """Follow a tool path; write joint positions, velocities and accelerations on time stamps."""
    require_place(out, force)
    # CasADi may lose Ctrl-C while it builds functions.
    with deferred():
        loaded = load(chart)
        # Refuse grown charts.
        loaded.function("xi")
    # Read the path, and the solids to avoid: links (or rods in their place) and obstacles.
    waypoints, choice = _read_task(path, loaded, xi)
    model = solids.build_model(loaded.problem.robot)
    if link_radius is not None and (model is not None or not obstacle):
        raise OptionError("--link-radius requires --obstacle, and excludes --collisions, which has the true links")
    if obstacle:
        scene = Scene({f"obstacle {k}": _build_obstacle(text) for k, text in enumerate(obstacle)})
        if link_radius is None and model is None and loaded.problem.robot.solids is None:
            raise OptionError(
                "--obstacle requires --collisions FILE.urdf, or --link-radius: without them, the links have no solids"
            )
        robot = loaded.problem.robot if link_radius is None else loaded.problem.robot.with_rods(link_radius)
        model = (robot.collisions if model is None else model).with_scene(scene)
    # Compute the motion on time stamps, within limits of velocity and acceleration.
    begin = time.perf_counter()
    motion = follow_path(
        loaded,
        waypoints,
        choice,
        period=period,
        velocity_limits=None if velocity is None else parse_one_or_all("--velocity-limit", velocity),
        clearance=clearance,
        collisions=model,
    )
    seconds = time.perf_counter() - begin
    motion.save_csv(out, force)
    if json:
        print_json(_build_report(motion, seconds, out))
    else:
        print_rows(
            {**motion.facts(), "computed in": f"{seconds:.2f} s", "file": str(out)},
            f"orthocas view {out} --chart {chart}",
        )


def _read_task(path: Path, chart: Chart, xi: str | None) -> tuple[Array, Any]:
    """The waypoints, and the treatment of the coordinates: as requested, or according to the columns of the file."""
    # Columns of xi in the file are a schedule, which excludes any other choice.
    waypoints, schedule = read_path(path, chart)
    choice = xi or (HOLD if schedule is None else SCHEDULE)
    require_known("choice of --xi", choice, _CHOICES)
    if (choice == SCHEDULE) != (schedule is not None):
        columns = ", ".join(chart.labels[chart.m :])
        want = f"columns {columns} in {path} with schedule, and none of them otherwise"
        raise InvalidValueError("--xi", choice, want)
    return waypoints, choice if schedule is None else schedule


def _build_obstacle(text: str) -> Solid:
    """Read an obstacle such as sphere:X,Y,Z,RADIUS."""
    kind, _, numbers = text.partition(":")
    counts = {"sphere": 4, "capsule": 7, "plane": 6}
    require_known("kind of --obstacle", kind, counts)
    values = parse_numbers(f"--obstacle {kind}", numbers, counts[kind])
    if kind == "sphere":
        return Sphere(values[:3], values[3])
    if kind == "capsule":
        return Capsule(values[:3], values[3:6], values[6])
    return Plane(values[:3], values[3:])


def _build_report(motion: JointMotion, seconds: float, out: Path) -> dict[str, Any]:
    r = motion.xi.shape[1]
    return {
        "duration": motion.duration,
        "period": motion.period,
        "time_stamps": len(motion.times),
        "closed": motion.closed,
        "left_over": None if motion.left_over is None else motion.left_over.tolist(),
        "xi": {
            label: [float(values.min()), float(values.max())]
            for label, values in zip(motion.labels[-r:], motion.xi.T, strict=True)
        },
        "margins": asdict(motion.margins),
        "seconds": seconds,
        "file": str(out),
    }
