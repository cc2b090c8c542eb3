"""`orthocas simulate`: a controller in the coordinates of a chart, run in closed loop."""

import json as json_format
import os
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from orthocas.archive import require_writable
from orthocas.chart import Chart
from orthocas.cli.controller_argument import CONTROLLERS, ControllerOptions, build_controller, require_options
from orthocas.cli.output import AsJson, note, number, print_json, print_rows, whole_number
from orthocas.cli.problem_argument import parse_numbers
from orthocas.cli.run_report import fallback_text, run_report, run_rows
from orthocas.control import Reference, posture_reference
from orthocas.errors import ArchiveError, InvalidValueError
from orthocas.progress import terminal_monitor
from orthocas.simulation import Friction, Noise, Outcome, Trajectory
from orthocas.simulation.animation import FORMATS, require_format, save_animation
from orthocas.simulation.figure import units_of
from orthocas.simulation.run import simulate as run_closed_loop
from orthocas.simulation.steps_file import read_steps

_DIVERGED = 1  # exit code of a run whose integrator gave up: good input, a run that failed


def simulate(
    chart: Annotated[Path, typer.Argument(metavar="CHART", help="A chart file.")],
    controller: Annotated[str, typer.Option("--controller", help=f"{', '.join(CONTROLLERS)}.")],
    steps: Annotated[Path, typer.Option("--steps", help="What the robot is to do: a JSON file, see docs/simulate.md.")],
    out: Annotated[Path, typer.Option("--out", help="Folder for the run, its pictures and its report.")],
    stiffness: Annotated[
        str | None, typer.Option("--stiffness", help='"100" or one for each; default 2 Hz with the median inertia.')
    ] = None,
    damping_ratio: Annotated[
        str | None, typer.Option("--damping-ratio", help="One number, or one for each; default 0.7.")
    ] = None,
    coupling: Annotated[
        str | None, typer.Option("--coupling", help="coupled or decoupled, default coupled; impedance and pd_plus.")
    ] = None,
    posture_stiffness: Annotated[
        str | None, typer.Option("--posture-stiffness", help="Of the joint springs of projector; default 2 Hz.")
    ] = None,
    feedback: Annotated[
        str | None, typer.Option("--feedback", help="[1/s], of kinematic and kinematic_projector; default 0.")
    ] = None,
    limit: Annotated[
        str | None, typer.Option("--limit", help="Largest torque or speed of all joints, or of each; default none.")
    ] = None,
    rate: Annotated[
        float | None, typer.Option("--rate", parser=number, help="Control rate [Hz]; default continuous control.")
    ] = None,
    mass_factor: Annotated[
        float | None,
        typer.Option("--mass-factor", parser=number, help="Masses of the robot over those the controller knows."),
    ] = None,
    friction: Annotated[
        str | None, typer.Option("--friction", help='"viscous,coulomb" in every joint [N m s/rad], [N m].')
    ] = None,
    noise: Annotated[
        str | None, typer.Option("--noise", help='"position,velocity" deviations [rad], [rad/s]; needs --rate.')
    ] = None,
    seed: Annotated[
        int | None, typer.Option("--seed", parser=whole_number, help="Seed of the noise; default 0.")
    ] = None,
    animation: Annotated[str, typer.Option("--animation", help="gif, mp4 (needs ffmpeg) or none.")] = "gif",
    json: AsJson = False,
) -> None:
    """Run a controller in a chart's coordinates; write the run, pictures, an animation and a report."""
    options = ControllerOptions(
        stiffness, damping_ratio, coupling, posture_stiffness, feedback, mass_factor, friction
    )
    require_options(controller, options)
    if animation != "none":
        require_format(animation)
    _require_folder(out)
    loaded = Chart.load(chart)
    plan = read_steps(steps, loaded)
    law = build_controller(controller, loaded, options, limit)
    robot = law.problem.robot
    conditions: dict[str, Any] = {
        "control_rate": rate,
        "plant": None if mass_factor is None else robot.with_scaled_masses(mass_factor),
        "pushes": plan.pushes,
        "friction": None if friction is None else Friction(*_pair("--friction", friction)),
        "noise": _noise(noise, seed),
    }
    began = time.perf_counter()
    with terminal_monitor() as monitor:
        follows = plan.reference if law.labels == loaded.labels else posture_reference(loaded, plan.reference, plan.q_start)
        run = run_closed_loop(law, follows, plan.q_start, **conditions, monitor=monitor)
    ...
