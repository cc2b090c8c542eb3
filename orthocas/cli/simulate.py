"""`orthocas simulate`: a controller in the coordinates of a chart, run in closed loop."""

import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from orthocas.charts.chart import Chart
from orthocas.cli.controller_argument import (
    CONTROLLERS,
    Limit,
    build_controller,
    require_settings,
    require_torques,
    with_settings,
)
from orthocas.cli.output import AsJson, Force, note, number, print_json, print_rows, terminal_monitor, whole_number
from orthocas.cli.problem_argument import parse_numbers
from orthocas.cli.run_report import fallback_text, run_report, run_rows
from orthocas.control.controller import Controller
from orthocas.control.posture import posture_reference
from orthocas.control.reference import Reference
from orthocas.control.safety import Safety
from orthocas.errors import ArchiveError, Interrupted, InvalidValueError, OptionError
from orthocas.robots.robot import Robot
from orthocas.simulation.animation import FORMATS, require_format, save_animation
from orthocas.simulation.disturbances import Friction, Noise
from orthocas.simulation.figure import trajectory_figure, units_of
from orthocas.simulation.mujoco_scene import MUJOCO, MuJoCo
from orthocas.simulation.run import simulate as run_closed_loop
from orthocas.simulation.steps_file import Plan, read_steps
from orthocas.simulation.trajectory import Outcome, Trajectory
from orthocas.tools.checks import require_known
from orthocas.tools.files import is_listed, output_folder, published, require_replaceable_files, require_writable
from orthocas.tools.interrupts import deferred
from orthocas.tools.json import to_json
from orthocas.tools.progress import Monitor

_FILES = ("trajectory.npz", "coordinates.png", "report.json")
CVODES = "cvodes"  #: the default plant
_DIVERGED = 1  # exit code when the integrator gave up: the input was valid but the run failed


@with_settings(for_codegen=False)
def simulate(
    chart: Annotated[Path, typer.Argument(metavar="CHART", help="A chart file.")],
    controller: Annotated[str, typer.Option("--controller", help=f"Control law: {', '.join(CONTROLLERS)}.")],
    steps: Annotated[
        Path, typer.Option("--steps", help="JSON file with the motion of the robot, see docs/reference/simulation.md.")
    ],
    out: Annotated[Path, typer.Option("--out", help="Folder for the run, its pictures and the report.")],
    settings: dict[str, str],
    limit: Limit = None,
    rate: Annotated[
        float | None, typer.Option("--rate", parser=number, help="Control rate [Hz]; default: continuous control.")
    ] = None,
    plant: Annotated[
        str, typer.Option("--plant", help="Simulator: cvodes, or mujoco (needs --rate and the extra [mujoco]).")
    ] = CVODES,
    supervised: Annotated[
        bool,
        typer.Option("--supervised", help="Run the supervised law of the generated C (needs --rate and a C compiler)."),
    ] = False,
    compiled: Annotated[
        bool, typer.Option("--compiled", help="Compile law and robot first: for long runs; needs a C compiler.")
    ] = False,
    mass_factor: Annotated[
        float | None,
        typer.Option("--mass-factor", parser=number, help="True masses divided by those of the controller's model."),
    ] = None,
    friction: Annotated[
        str | None, typer.Option("--friction", help='Joint friction, "viscous,coulomb" [N m s/rad], [N m].')
    ] = None,
    noise: Annotated[
        str | None,
        typer.Option(
            "--noise", help='Standard deviation of the sensors, "position,velocity" [rad], [rad/s]; needs --rate.'
        ),
    ] = None,
    seed: Annotated[
        int | None, typer.Option("--seed", parser=whole_number, help="Seed of the noise; default: 0.")
    ] = None,
    animation: Annotated[
        str, typer.Option("--animation", help="Format of the animation: gif, mp4 (needs ffmpeg) or none.")
    ] = "gif",
    force: Force = False,
    json: AsJson = False,
) -> None:
    """Run a controller in a chart's coordinates; write the run, pictures, an animation and a report."""
    require_settings(controller, settings)
    require_torques(controller, mass_factor=mass_factor, friction=friction)
    _require_plant(plant, rate, supervised)
    _require_folder(out, animation, force)
    with deferred():  # CasADi may lose Ctrl-C while it builds functions
        loaded = Chart.load(chart)
        loaded.function("xi")  # raises for grown charts
        plan = read_steps(steps, loaded)
        law = build_controller(controller, loaded, settings, limit)
    conditions = {
        "control_rate": rate,
        "plant": _plant(plant, loaded.problem.robot, mass_factor),
        "friction": None if friction is None else Friction(*_pair("--friction", friction)),
        "noise": _noise(law, noise, seed, rate),
        "safety": Safety.of(law) if supervised else None,
        "compiled": compiled,
    }
    begin = time.perf_counter()
    with terminal_monitor() as monitor:
        run = _run(law, loaded, plan, conditions, monitor)
        finish = partial(_finish, law, loaded, plan, run, time.perf_counter() - begin, out, force)
        interrupted = run.outcome is Outcome.INTERRUPTED
        try:
            seen, report = finish()
            if animation != "none" and not interrupted:
                save_animation(out / f"animation.{animation}", seen, loaded.problem, monitor, force)
        except KeyboardInterrupt:  # the run is complete: keep it
            seen, report = finish()
            interrupted = True
    if json:
        print_json(report)
    else:
        print_rows(run_rows(report, loaded.problem) | {"files": str(out)})
    _notes(law, report, interrupted)
    if code := 130 if interrupted else _DIVERGED * (run.outcome is Outcome.DIVERGED):
        raise typer.Exit(code)


def _require_folder(out: Path, animation: str, force: bool) -> None:
    """Check, before anything is written, the format, and that the folder can be made or holds no files of others."""
    if animation != "none":
        require_format(animation)
    if out.exists() and not out.is_dir():
        raise InvalidValueError("--out", str(out), "a folder")
    require_writable(out / "report.json" if out.is_dir() else out, ArchiveError)
    names = [*_FILES] if animation == "none" else [*_FILES, f"animation.{animation}"]
    require_replaceable_files(out, names, force)


def _require_plant(plant: str, rate: float | None, supervised: bool) -> None:
    """Raise UnknownNameError for other plants, and InvalidValueError where a sampled controller is missing."""
    require_known("plant", plant, (CVODES, MUJOCO))
    if plant == MUJOCO and rate is None:
        raise OptionError("--plant mujoco requires --rate: MuJoCo runs with a sampled controller")
    if supervised and rate is None:
        raise OptionError("--supervised requires --rate: a supervised law runs tick by tick")


def _plant(plant: str, model: Robot, mass_factor: float | None) -> Robot | MuJoCo | None:
    """The true robot, or MuJoCo with it; None if it is the controller's model."""
    robot = None if mass_factor is None else model.with_scaled_masses(mass_factor)
    return MuJoCo(robot) if plant == MUJOCO else robot


def _pair(option: str, text: str) -> tuple[float, float]:
    """Parse "0.1,0.2"."""
    values = parse_numbers(option, text).tolist()
    if len(values) != 2:
        raise InvalidValueError(option, repr(text), "two numbers")
    return values[0], values[1]


def _noise(law: Controller, text: str | None, seed: int | None, rate: float | None) -> Noise | None:
    """The noise of the sensors; raises InvalidValueError for an option that would be ignored."""
    if text is None:
        if seed is not None:
            raise OptionError("--seed requires --noise: nothing else is random")
        return None
    if rate is None:
        raise OptionError("--noise requires --rate: white noise needs control ticks")
    position, velocity = _pair("--noise", text)
    if law.command == "velocity" and velocity != 0:
        raise InvalidValueError("--noise", text, f"a velocity deviation of 0, because {law.name} measures no velocity")
    return Noise(position, velocity, 0 if seed is None else seed)


def _run(law: Controller, chart: Chart, plan: Plan, conditions: dict[str, Any], monitor: Monitor) -> Trajectory:
    """Run the closed loop. Projectors follow the joint positions that correspond to the reference."""
    reference = plan.reference
    if law.labels != chart.labels:
        reference = posture_reference(chart, reference, plan.q_start)
    try:
        return run_closed_loop(law, reference, plan.q_start, pushes=plan.pushes, monitor=monitor, **conditions)
    except Interrupted as stop:
        run: Trajectory = stop.result
        return run


def _in_chart(chart: Chart, reference: Reference, run: Trajectory) -> Trajectory:
    """The run with the chart's coordinates as its quantities, even if the controller does not use them."""
    value, velocity, acceleration = reference.sample(run.times.clip(0, reference.duration))
    return replace(
        run,
        labels=chart.labels,
        value=chart.phi(run.q),
        reference=value,
        reference_velocity=velocity,
        reference_acceleration=acceleration,
    )


def _finish(
    law: Controller, chart: Chart, plan: Plan, run: Trajectory, seconds: float, out: Path, force: bool
) -> tuple[Trajectory, dict[str, Any]]:
    """Write the run, its picture and its report, and remove the animation of an earlier run.

    Returns:
        The run in the chart's coordinates, and the report.
    """
    seen = _in_chart(chart, plan.reference, run)
    report = run_report(law, chart, plan, seen, seconds)
    with output_folder("--out", out) as folder, published(folder, listed=True, force=force) as drafts:
        run.save(drafts / "trajectory.npz")
        trajectory_figure(seen, units_of(chart.problem)).savefig(drafts / "coordinates.png", dpi=130)
        (drafts / "report.json").write_text(to_json(report, indent=1) + "\n")
    for old in (out / f"animation.{kind}" for kind in FORMATS):
        if is_listed(old):
            old.unlink()
    return seen, report


def _notes(law: Controller, report: dict[str, Any], interrupted: bool) -> None:
    """Print remarks about the run on standard error."""
    for remark in law.remarks():
        note(remark)
    fallback = fallback_text(report)
    if fallback is not None:
        note(fallback)
    if report["outcome"] == Outcome.DIVERGED.value:
        note(f"the run diverged: the integrator gave up at t = {report['duration']:.4g} s, the run so far is saved")
    if interrupted:
        note("interrupted: the run so far is saved, without an animation")
