"""`orthocas view`: a chart, a robot or a motion in the browser."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from orthocas import problems
from orthocas.charts.chart import Chart
from orthocas.charts.ready import load
from orthocas.cli.options import (
    AsJson,
    Force,
    ProblemOptions,
    SolidOptions,
    is_robot_file,
    parse_whole_number,
    spread,
)
from orthocas.cli.output import note, print_json, print_rows
from orthocas.errors import OptionError
from orthocas.paths.tool_path import read_path
from orthocas.robots.collisions import Collisions
from orthocas.robots.robot import Robot
from orthocas.tools.checks import Array
from orthocas.tools.interrupts import deferred
from orthocas.viewer import view as open_view
from orthocas.viewer.motion import cyclic_motions, read_joint_motion, read_run
from orthocas.viewer.view import PORT, export_page, require_page
from orthocas.viewer.window import LOCAL, is_local, require_free

_PORT = "0: any free one. HOST: the address to listen at; 0.0.0.0 is open to the network."
# File in the folders of `orthocas simulate`.
_RUN = "trajectory.npz"


@spread("words", ProblemOptions, "tip", "lock")
@spread("solids", SolidOptions)
def view(
    target: Annotated[
        str,
        typer.Argument(
            metavar="CHART|RUN|FILE.urdf",
            help="A chart file; trajectory.npz or folder of simulate; CSV file of follow; MCAP file; robot or problem.",
        ),
    ],
    words: ProblemOptions,
    chart: Annotated[Path | None, typer.Option("--chart", help="For runs: a chart of the robot that moved.")] = None,
    robot: Annotated[
        Path | None, typer.Option("--robot", metavar="FILE.urdf", help="Robot file with the meshes of the links.")
    ] = None,
    compare: Annotated[
        bool,
        typer.Option("--compare", help="Play a closed path with constant xi beside the pseudo-inverse, which drifts."),
    ] = False,
    path: Annotated[
        Path | None, typer.Option("--path", metavar="PATH.csv", help="For charts: waypoints to play.")
    ] = None,
    export: Annotated[
        Path | None,
        typer.Option("--export", metavar="PAGE.html", help="Write a page that moves by itself and works offline."),
    ] = None,
    *,
    solids: SolidOptions,
    port: Annotated[str, typer.Option("--port", metavar="[HOST:]PORT", help=_PORT)] = str(PORT),
    force: Force = False,
    json: AsJson = False,
) -> None:
    """Show a chart, a robot or a motion in the browser, until Ctrl-C."""
    place, _, text = port.rpartition(":")
    host, number = place.strip("[]") or LOCAL, parse_whole_number(text)
    if export is None:
        require_free(host, number)
    else:
        require_page(export, force)
    # CasADi may lose Ctrl-C while it builds functions.
    with deferred():
        scene = _read_scene(target, chart, robot, words)
    # Show a chart, optionally with a path, or a motion, or a robot.
    if compare:
        # Compare motions along a closed path.
        if not isinstance(scene.shown, Chart):
            raise OptionError("--compare requires a chart file, whose coordinates are compared")
        points = None if path is None else read_path(path, scene.shown)[0]
        scene, played = _Scene(cyclic_motions(scene.shown, points), scene.shown, scene.meshes, scene.locked), None
    else:
        played = _read_played(scene, path, export)
    arm, meshes, locks = scene.robot, scene.meshes, scene.locked
    model = _build_model(scene, solids, export)
    # Write a page that works offline, or serve a page until Ctrl-C.
    if export is not None:
        shape = export_page(scene.shown, export, robot=arm, robot_file=meshes, locked=locks, force=force)
        _note_missing(shape.missing)
        size = export.stat().st_size
        if json:
            print_json({"page": str(export), "bytes": size, "missing_meshes": list(shape.missing)})
        else:
            print_rows({"page": str(export), "size": f"{size / 2**20:.1f} MiB, with all it needs: it works offline"})
        return
    opened = open_view(
        scene.shown, robot=arm, robot_file=meshes, locked=locks, collisions=model, path=played, host=host, port=number
    )
    with opened as page:
        _note_missing(page.missing)
        local = is_local(host)
        only, others = "this machine only (--port 0.0.0.0:PORT opens it)", "all who reach it and know this address"
        if json:
            print_json({"url": page.url, "host": host, "local": local, "missing_meshes": list(page.missing)})
        else:
            print_rows({"page": page.url, "open to": only if local else others, "end": "Ctrl-C"})
        page.wait()


@dataclass(frozen=True)
class _Scene:
    """The object that the page shows, and its robot."""

    shown: Any
    robot: Robot | Chart | None
    meshes: Path | None
    locked: dict[str, float]


def _read_scene(target: str, chart: Path | None, meshes: Path | None, words: ProblemOptions) -> _Scene:
    """Read the target: a file by its suffix, the folder of a run, or the name of a problem."""
    place = Path(target)
    locked = words.parse_locks()
    # A robot without a chart gets a slider for each joint.
    if is_robot_file(target):
        meshes = place if meshes is None and place.suffix.lower() == ".urdf" else meshes
        return _Scene(words.build_robot(target), None, meshes, locked)
    if target in problems.names() and not place.exists():
        words.require_no_robot(f"the named problem '{target}'")
        return _Scene(problems.get(target).robot, None, meshes, locked)
    # Files of motions do not contain the robot.
    if place.is_dir() or place.suffix.lower() in (".npz", ".csv", ".mcap"):
        if chart is None and meshes is None:
            raise OptionError("files of motions do not contain a robot: give --chart or --robot")
        owner = words.build_robot(str(meshes)) if chart is None else load(chart)
        arm = owner.problem.robot if isinstance(owner, Chart) else owner
        file = place / _RUN if place.is_dir() else place
        motion = read_joint_motion(file, arm) if file.suffix.lower() in (".csv", ".mcap") else read_run(file, arm)
        return _Scene(motion, owner, meshes, locked)
    if chart is not None:
        raise OptionError(f"{target} is a chart: leave out --chart")
    return _Scene(load(place), None, meshes, locked)


def _read_played(scene: _Scene, path: Path | None, export: Path | None) -> Array | None:
    """The waypoints that the page of a chart plays, with coordinates if the file has them."""
    if path is None:
        return None
    if not isinstance(scene.shown, Chart) or export is not None:
        raise OptionError("--path requires a live page of a chart, or --compare: leave it out")
    x, xi = read_path(path, scene.shown)
    return x if xi is None else np.hstack([x, xi])


def _build_model(scene: _Scene, solids: SolidOptions, export: Path | None) -> Collisions | None:
    """The collision model that the page of a chart shows."""
    if isinstance(scene.shown, Chart) and export is None:
        return solids.build_model(scene.shown.robot)
    if solids != SolidOptions():
        raise OptionError("--collisions requires a live page of a chart: leave it out")
    return None


def _note_missing(missing: tuple[str, ...]) -> None:
    if missing:
        more = f" and {len(missing) - 1} more" if len(missing) > 1 else ""
        note(f"mesh file {missing[0]}{more} cannot be found or read; rods stand for these links")
