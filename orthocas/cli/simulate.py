"""`orthocas simulate`: a controller in the coordinates of a chart, run in closed loop."""

import time
from collections.abc import Iterator
from functools import partial
from math import isfinite
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from orthocas.charts.chart import Chart
from orthocas.charts.quality import evaluate
from orthocas.charts.ready import load
from orthocas.cli.codegen import CONTROLLERS, add_law_options, build_controller, require_settings
from orthocas.cli.options import AsJson, ChartPath, Force, Limit, Number, SolidOptions, parse_numbers, spread
from orthocas.cli.output import note, print_json, print_rows, terminal_monitor
from orthocas.control.controller import Controller, ControlStatus, law_of
from orthocas.control.reference import Reference
from orthocas.control.safety import Safety
from orthocas.errors import ArchiveError, Interrupted, InvalidValueError, OptionError, SingularTaskError
from orthocas.robots.collisions import Collisions
from orthocas.simulation.disturbances import Friction, Noise, Plan, read_steps
from orthocas.simulation.figure import FORMATS, require_format, save_animation, trajectory_figure, units_of
from orthocas.simulation.mujoco_plant import MUJOCO, MuJoCo
from orthocas.simulation.run import simulate as run_closed_loop
from orthocas.simulation.trajectory import Outcome, Trajectory, coupling_index
from orthocas.tasks.problem import Problem
from orthocas.tools.checks import require_known
from orthocas.tools.display import percent
from orthocas.tools.files import is_listed, open_output_folder, publish, require_replaceable_files, require_writable
from orthocas.tools.interrupts import INTERRUPTED, deferred
from orthocas.tools.json import clean, write_json

_FILES = ("trajectory.npz", "coordinates.png", "report.json")
CVODES = "cvodes"  #: name of the default plant
_NOISE = (
    'Standard deviation of the sensors, "position,velocity" [rad], [rad/s], or "position,velocity,seed"; needs --rate.'
)
# The run failed although the input was valid: exit code 1.
_FAILED = (Outcome.DIVERGED, Outcome.LOST)


@add_law_options(for_codegen=False)
@spread("solids", SolidOptions)
def simulate(
    chart: ChartPath,
    controller: Annotated[str, typer.Option("--controller", help=f"Control law: {', '.join(CONTROLLERS)}.")],
    steps: Annotated[
        Path, typer.Option("--steps", help="JSON file with the motion of the robot, see docs/reference/simulation.md.")
    ],
    out: Annotated[Path, typer.Option("--out", help="Folder for the run, its pictures and the report.")],
    settings: dict[str, str],
    limit: Limit = None,
    rate: Annotated[float | None, Number("--rate", help="Control rate [Hz]; default: continuous control.")] = None,
    plant: Annotated[
        str, typer.Option("--plant", help="Simulator: cvodes, or mujoco (needs --rate and the extra [mujoco]).")
    ] = CVODES,
    supervised: Annotated[
        bool,
        typer.Option("--supervised", help="Run the supervised law of the generated C (needs --rate and a C compiler)."),
    ] = False,
    mass_factor: Annotated[
        float | None, Number("--mass-factor", help="True masses divided by those of the controller's model.")
    ] = None,
    friction: Annotated[
        str | None, typer.Option("--friction", help='Joint friction, "viscous,coulomb" [N m s/rad], [N m].')
    ] = None,
    noise: Annotated[str | None, typer.Option("--noise", help=_NOISE)] = None,
    animation: Annotated[
        str, typer.Option("--animation", help="Format of the animation: gif, mp4 (needs ffmpeg) or none.")
    ] = "gif",
    *,
    solids: SolidOptions,
    force: Force = False,
    json: AsJson = False,
) -> None:
    """Run a controller in a chart's coordinates; write the run, pictures, an animation and a report."""
    # Check arguments before the chart is read.
    require_settings(controller, settings)
    _check_plant(controller, plant, rate, supervised, {"--mass-factor": mass_factor, "--friction": friction})
    _check_folder(out, animation, force)
    # CasADi may lose Ctrl-C while it builds functions.
    with deferred():
        loaded = load(chart)
        # Refuse grown charts.
        loaded.function("xi")
        plan = read_steps(steps, loaded)
        law = build_controller(controller, loaded, settings, limit)
    model = solids.build_model(loaded.problem.robot)
    robot = None if mass_factor is None else loaded.problem.robot.with_scaled_masses(mass_factor)
    conditions: dict[str, Any] = {
        "control_rate": rate,
        "plant": MuJoCo(robot) if plant == MUJOCO else robot,
        "friction": None if friction is None else Friction(*parse_numbers("--friction", friction, 2).tolist()),
        "noise": _build_noise(law, noise, rate),
        "safety": Safety.of(law) if supervised else None,
    }
    # Run, then write files and pictures. After Ctrl-C, the part so far is kept.
    begin = time.perf_counter()
    with terminal_monitor() as monitor:
        try:
            run = run_closed_loop(law, plan.reference, plan.q_start, pushes=plan.pushes, monitor=monitor, **conditions)
        except Interrupted as stop:
            run = stop.result
        finish = partial(_finish, law, loaded, plan, run, time.perf_counter() - begin, out, force)
        interrupted = run.outcome is Outcome.INTERRUPTED
        try:
            report = finish()
            if animation != "none" and not interrupted:
                save_animation(out / f"animation.{animation}", run, loaded.problem, monitor, force)
        except KeyboardInterrupt:
            # The run is complete, so keep it.
            report = finish()
            interrupted = True
    # Numbers go to standard output, remarks to standard error.
    if json:
        print_json(report)
    else:
        print_rows(format_report(report, loaded.problem) | {"files": str(out)}, f"orthocas view {out} --chart {chart}")
    for remark in (*law.remarks(), *_list_remarks(report, interrupted)):
        note(remark)
    if model is not None:
        note(_find_contact(model, run))
    if code := INTERRUPTED if interrupted else int(run.outcome in _FAILED):
        raise typer.Exit(code)


def _check_plant(controller: str, plant: str, rate: float | None, supervised: bool, of_torques: dict[str, Any]) -> None:
    """Refuse options that do not fit the law, or that need a control rate."""
    for option, value in of_torques.items():
        if value is not None and law_of(controller).command != "torque":
            takers = ", ".join(name for name in CONTROLLERS if law_of(name).command == "torque")
            raise OptionError(f"{controller} has no option {option}, which is for {takers}")
    require_known("plant", plant, (CVODES, MUJOCO))
    if plant == MUJOCO and rate is None:
        raise OptionError("--plant mujoco requires --rate: MuJoCo runs with a sampled controller")
    if supervised and rate is None:
        raise OptionError("--supervised requires --rate: a supervised law runs tick by tick")


def _check_folder(out: Path, animation: str, force: bool) -> None:
    """Check, before writing, the format, and that the folder can be created or holds no other files."""
    if animation != "none":
        require_format(animation)
    if out.exists() and not out.is_dir():
        raise InvalidValueError("--out", str(out), "a folder")
    require_writable(out / "report.json" if out.is_dir() else out, ArchiveError)
    names = [*_FILES] if animation == "none" else [*_FILES, f"animation.{animation}"]
    require_replaceable_files(out, names, force)


def _build_noise(law: Controller, text: str | None, rate: float | None) -> Noise | None:
    """The sensor noise; raises InvalidValueError for noise on a quantity that the law does not measure."""
    if text is None:
        return None
    if rate is None:
        raise OptionError("--noise requires --rate: white noise needs control ticks")
    position, velocity, *seed = parse_numbers("--noise", text, 3 if text.count(",") == 2 else 2).tolist()
    if law.command == "velocity" and velocity != 0:
        raise InvalidValueError("--noise", text, f"a velocity deviation of 0, because {law.name} measures no velocity")
    return Noise(position, velocity, int(seed[0]) if seed and seed[0].is_integer() else seed[0] if seed else 0)


def _finish(
    law: Controller, chart: Chart, plan: Plan, run: Trajectory, seconds: float, out: Path, force: bool
) -> dict[str, Any]:
    """Write the run, its picture and its report, and remove the animation of an earlier run; returns the report."""
    report = build_report(law, chart, plan, run, seconds)
    with open_output_folder("--out", out) as folder, publish(folder, listed=True, force=force) as drafts:
        run.save(drafts / "trajectory.npz")
        trajectory_figure(run, units_of(chart.problem)).savefig(drafts / "coordinates.png", dpi=130)
        (drafts / "report.json").write_text(write_json(report, indent=1) + "\n")
    # An animation of an earlier run would show another motion.
    for old in (out / f"animation.{kind}" for kind in FORMATS):
        if is_listed(old):
            old.unlink()
    return report


def _list_remarks(report: dict[str, Any], interrupted: bool) -> Iterator[str]:
    """Remarks about problems in a run."""
    if (fallback := format_fallback(report)) is not None:
        yield fallback
    if report["outcome"] == Outcome.LOST.value:
        yield f"the law lost the arm: {report['reason']}"
    if report["outcome"] == Outcome.DIVERGED.value:
        yield f"the run diverged: the integrator gave up at t = {report['duration']:.4g} s, the run so far is saved"
    if interrupted:
        yield "interrupted: the run so far is saved, without an animation"


def _find_contact(collisions: Collisions, run: Trajectory) -> str:
    """A sentence about the first contact of a run, also between its time stamps, or about the least distance."""
    # Rows after a run diverged are not finite.
    q = run.q[np.isfinite(run.q).all(axis=1)]
    contact = collisions.find_contact(q)
    if contact is not None:
        (first, second), at = contact.pair, run.times[contact.segment]
        return f"at t = {at:.4g} s '{first}' and '{second}' touch; the simulation knows no contacts"
    if not collisions.pairs:
        return "no contact: no pair of links is checked"
    least = collisions.distance(q)
    k = int(np.argmin(least.distance))
    first, second = least.pair[k]
    return f"no contact: '{first}' and '{second}' come nearest, {least.distance[k]:.3g} m at t = {run.times[k]:.4g} s"


_REASONS = {
    ControlStatus.OUTSIDE_DOMAIN: "the arm left the domain",
    ControlStatus.SINGULAR: "the coordinates became singular",
    ControlStatus.NOT_FINITE: "the controller received an input that was not finite",
    ControlStatus.BAD_INPUT: "a measurement or a reference could not be used",
    ControlStatus.TOO_FAST: "a joint exceeded its limit of velocity",
    ControlStatus.LATE: "a tick came too late",
    # initial status of a supervised law
    ControlStatus.OK: "the arm was not well inside the domain",
}


def build_report(controller: Controller, chart: Chart, plan: Plan, seen: Trajectory, seconds: float) -> dict[str, Any]:
    """Numbers of a run in SI units, ready for JSON.

    Args:
        controller: the controller that ran.
        chart: the chart whose coordinates measure the run.
        plan: the planned motion.
        seen: the run in the chart's coordinates.
        seconds: computing time [s].
    """
    bad = np.flatnonzero(seen.fell_back)
    first = int(bad[0]) if bad.size else None
    status, cause = (ControlStatus(int(column[first or 0])) for column in (seen.status, seen.cause))
    inside = np.asarray(chart.problem.domain.contains(seen.q))
    # Coupling is measured in complete runs of steps without other disturbances.
    evaluated = (
        plan.has_steps and not plan.pushes and seen.outcome is Outcome.COMPLETE and inside.all() and not bad.size
    )
    largest = np.abs(seen.command).max(axis=0)
    durations = {status.name: seconds for status, seconds in seen.seconds_in_status.items()}
    report = {
        "controller": controller.name,
        "coupling": controller.settings.get("coupling"),
        "gains": controller.gains,
        "outcome": seen.outcome.value,
        "reason": seen.reason or None,
        "duration": float(seen.times[-1]),
        "tracking_error": dict(zip(seen.labels, seen.tracking_error, strict=True)),
        "coupling_index": _evaluate_coupling(chart, plan.reference, seen) if evaluated else None,
        "angles_on_path": _evaluate_angles(chart, seen),
        "fallback": {
            "share": len(bad) / len(seen.times),
            "since": None if first is None else float(seen.times[first]),
            "reason": None if first is None else _REASONS[status if status in _REASONS else cause],
        },
        "seconds_in_status": durations,
        "catches": [{"time": time, "cause": cause.name} for time, cause in seen.catches],
        "saturated_share": float(seen.saturated.mean()),
        "share_inside_domain": float(inside.mean()),
        "command": seen.kind,
        "largest_command": dict(zip(seen.joint_names, largest, strict=True)),
        "energy": None,
        "seconds": seconds,
    }
    if seen.kind == "torque" and not bad.size:
        report["energy"] = {
            "storage_start": seen.storage[0],
            "storage_end": seen.storage[-1],
            "storage_largest": seen.storage.max(),
            "storage_rise": seen.storage_rise,
            # Energy that the controller's damping dissipates [J].
            "dissipated": seen.energy_balance[-1] - seen.storage[-1] + seen.storage[0],
        }
    return dict(clean(report))


def format_report(report: dict[str, Any], problem: Problem) -> dict[str, str]:
    """The report as rows of text."""
    units = units_of(problem)
    errors = [
        f"{label} {_format(value)} {units.get(label, '')}".strip() for label, value in report["tracking_error"].items()
    ]
    # Choose the unit of the largest command: torque or velocity, of a sliding or turning joint.
    joint, command = max(report["largest_command"].items(), key=lambda pair: pair[1])
    by_torque = report["command"] == "torque"
    lengths = units.get(joint) == "m"
    unit = ("N" if lengths else "N m") if by_torque else ("m/s" if lengths else "rad/s")
    rows = {
        "run": f"{report['controller']}, {report['duration']:.4g} s: {report['outcome']}",
        "largest error": ", ".join(errors),
    }
    if report["coupling_index"]:
        rows["coupling index"] = _find_worst_couplings(report["coupling_index"], problem.task.labels)
    if angles := report["angles_on_path"]:
        task, leak = angles["task_angle_deg"], angles["leak_deg"]
        rows["angles on path"] = (
            f"leak rms {leak['rms']:.2f}, largest {leak['max']:.1f} deg (in the metric); "
            f"task angle mean {task['mean']:.2f}, std {task['std']:.2f} deg (the paper's cosines)"
        )
    rows["command"] = f"at most {command:.4g} {unit}, {joint}"
    if report["saturated_share"]:
        rows["limit"] = f"reached for {percent(report['saturated_share'], fault=True)} of the run"
    if report["catches"]:
        rows["statuses"] = ", ".join(f"{name} {time:.3g} s" for name, time in report["seconds_in_status"].items())
    if energy := report["energy"]:
        rows["energy"] = (
            f"V at most {_format(energy['storage_largest'])} J, at the end {_format(energy['storage_end'])} J; "
            f"{_format(energy['dissipated'])} J dissipated"
        )
    rows["computed in"] = f"{report['seconds']:.2f} s"
    return rows


def format_fallback(report: dict[str, Any]) -> str | None:
    """A sentence about when and why the controller used its fallback; None if it did not."""
    fallback = report["fallback"]
    if fallback["since"] is None:
        return None
    # A supervised law catches the arm and may resume; other laws stay in their fallback.
    if report["catches"]:
        times = "once" if len(report["catches"]) == 1 else f"{len(report['catches'])} times"
        return (
            f"at t = {fallback['since']:.4g} s {fallback['reason']}: the catcher took over, {times} in all, "
            f"and commanded for {percent(fallback['share'], fault=True)} of the run"
        )
    what = "the gravity torque" if report["command"] == "torque" else "zero velocity"
    return (
        f"at t = {fallback['since']:.4g} s {fallback['reason']}: the controller commanded only {what} "
        f"for {percent(fallback['share'], fault=True)} of the run"
    )


def _evaluate_angles(chart: Chart, seen: Trajectory) -> dict[str, Any] | None:
    """The paper's angles and the leak along the run; None where no gradient is finite."""
    try:
        report = evaluate(chart, points=seen.q[np.isfinite(seen.q).all(axis=1)]).as_dict()
    except (SingularTaskError, InvalidValueError):
        return None
    return {name: report[name] for name in ("task_angle_deg", "mutual_angle_deg", "leak_deg")}


def _evaluate_coupling(chart: Chart, reference: Reference, seen: Trajectory) -> dict[str, dict[str, float]]:
    """Commanded -> disturbed -> coupling index, for quantities that are commanded alone."""
    coupling = coupling_index(chart, reference, seen)
    columns = {
        commanded: {to: float(value) for to, value in zip(coupling.labels, column, strict=True) if isfinite(value)}
        for commanded, column in zip(coupling.labels, coupling.index.T, strict=True)
    }
    return {commanded: column for commanded, column in columns.items() if column}


def _find_worst_couplings(index: dict[str, dict[str, float]], task: tuple[str, ...]) -> str:
    """The worst disturbance of the task by an extra coordinate, and the reverse."""
    pairs = [(value, to, by) for by, column in index.items() for to, value in column.items()]
    # Find the largest index of each direction: task by extra coordinates, and the reverse.
    texts = []
    for name, of_task in (("task <- extra", True), ("extra <- task", False)):
        chosen = [pair for pair in pairs if (pair[1] in task) == of_task and (pair[2] in task) != of_task]
        if chosen:
            value, to, by = max(chosen)
            texts.append(f"{name} {value:.3g} ({to} <- {by})")
    return ", ".join(texts) or "see report.json"


def _format(value: float | None) -> str:
    return "not finite" if value is None else f"{value:.3g}"
