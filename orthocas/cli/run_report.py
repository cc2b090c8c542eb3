"""The report of `orthocas simulate` about a run: plain data for JSON, and rows for people."""

from math import isfinite
from typing import Any

import numpy as np

from orthocas.charts.chart import Chart
from orthocas.charts.quality import evaluate
from orthocas.control.controller import Controller, ControlStatus
from orthocas.control.reference import Reference
from orthocas.errors import InvalidValueError, SingularTaskError
from orthocas.simulation.coupling import coupling_index
from orthocas.simulation.figure import units_of
from orthocas.simulation.steps_file import Plan
from orthocas.simulation.trajectory import Outcome, Trajectory
from orthocas.tasks.domains import contains
from orthocas.tasks.problem import Problem
from orthocas.tools.json import plain

_REASONS = {
    ControlStatus.OUTSIDE_DOMAIN: "the arm left the domain",
    ControlStatus.SINGULAR: "the coordinates became singular",
    ControlStatus.NOT_FINITE: "the controller received an input that was not finite",
    ControlStatus.BAD_INPUT: "a measurement or a reference could not be used",
    ControlStatus.TOO_FAST: "a joint exceeded its limit of velocity",
    ControlStatus.LATE: "a tick came too late",
    ControlStatus.OK: "the arm was not well inside the domain",  # where a supervised law begins
}


def run_report(controller: Controller, chart: Chart, plan: Plan, seen: Trajectory, seconds: float) -> dict[str, Any]:
    """Numbers of a run, SI units, ready for JSON.

    Args:
        controller: the controller that ran.
        chart: the chart whose coordinates the run is measured in.
        plan: the motion that it was to follow.
        seen: the run in the chart's coordinates.
        seconds: computing time [s].
    """
    bad = np.flatnonzero(seen.fell_back)
    first = int(bad[0]) if bad.size else None
    inside = np.asarray(contains(chart.problem.domain, seen.q))
    judged = plan.has_steps and not plan.pushes and seen.outcome is Outcome.COMPLETE and inside.all() and not bad.size
    largest = np.abs(seen.command).max(axis=0)
    lasting = {status.name: seconds for status, seconds in seen.seconds_in_status.items()}
    report = {
        "controller": controller.name,
        "coupling": controller.settings.get("coupling"),
        "second": controller.settings.get("second"),
        "gains": controller.gains,
        "outcome": seen.outcome.value,
        "duration": float(seen.times[-1]),
        "tracking_error": dict(zip(seen.labels, seen.tracking_error, strict=True)),
        "coupling_index": _coupling(chart, plan.reference, seen) if judged else None,
        "angles_on_path": _angles(chart, seen),
        "fallback": {
            "share": len(bad) / len(seen.times),
            "since": None if first is None else float(seen.times[first]),
            "reason": None if first is None else _REASONS[_cause(seen, first)],
        },
        "seconds_in_status": lasting,
        "catches": [{"time": time, "cause": cause.name} for time, cause in seen.catches],
        "saturated_share": float(seen.saturated.mean()),
        "share_inside_domain": float(inside.mean()),
        "command": seen.kind,
        "largest_command": dict(zip(seen.joint_names, largest, strict=True)),
        "energy": _energy(seen) if seen.kind == "torque" and not bad.size else None,
        "seconds": seconds,
    }
    return dict(plain(report))


def run_rows(report: dict[str, Any], problem: Problem) -> dict[str, str]:
    """The report as rows of text."""
    units = units_of(problem)
    errors = [
        f"{label} {_text(value)} {units.get(label, '')}".strip() for label, value in report["tracking_error"].items()
    ]
    joint, command = max(report["largest_command"].items(), key=lambda pair: pair[1])
    by_torque = report["command"] == "torque"
    lengths = units.get(joint) == "m"
    unit = ("N" if lengths else "N m") if by_torque else ("m/s" if lengths else "rad/s")
    rows = {
        "run": f"{report['controller']}, {report['duration']:.4g} s: {report['outcome']}",
        "largest error": ", ".join(errors),
    }
    if report["coupling_index"]:
        rows["coupling index"] = _worst_couplings(report["coupling_index"], problem.task.labels)
    if angles := report["angles_on_path"]:
        task, leak = angles["task_angle_deg"], angles["leak_deg"]
        rows["angles on path"] = (
            f"leak rms {leak['rms']:.2f}, largest {leak['max']:.1f} deg (in the metric); "
            f"task angle mean {task['mean']:.2f}, std {task['std']:.2f} deg (the paper's cosines)"
        )
    rows["command"] = f"at most {command:.4g} {unit}, {joint}"
    if report["saturated_share"]:
        rows["limit"] = f"reached for {report['saturated_share']:.1%} of the run"
    if report["catches"]:
        rows["statuses"] = ", ".join(f"{name} {time:.3g} s" for name, time in report["seconds_in_status"].items())
    if energy := report["energy"]:
        rows["energy"] = (
            f"V at most {_text(energy['storage_largest'])} J, at the end {_text(energy['storage_end'])} J; "
            f"{_text(energy['dissipated'])} J dissipated"
        )
    rows["computed in"] = f"{report['seconds']:.2f} s"
    return rows


def fallback_text(report: dict[str, Any]) -> str | None:
    """A sentence that says when and why the controller used its fallback; None if it never did."""
    fallback = report["fallback"]
    if fallback["since"] is None:
        return None
    if report["catches"]:
        times = "once" if len(report["catches"]) == 1 else f"{len(report['catches'])} times"
        return (
            f"at t = {fallback['since']:.4g} s {fallback['reason']}: the catcher took over, {times} in all, "
            f"and commanded for {fallback['share']:.1%} of the run"
        )
    what = "the gravity torque" if report["command"] == "torque" else "zero velocity"
    return (
        f"at t = {fallback['since']:.4g} s {fallback['reason']}: the controller commanded only {what} "
        f"for {fallback['share']:.1%} of the run"
    )


def _cause(seen: Trajectory, k: int) -> ControlStatus:
    """Why the law did not command at an instant."""
    status = ControlStatus(int(seen.status[k]))
    return status if status in _REASONS else ControlStatus(int(seen.cause[k]))


def _angles(chart: Chart, seen: Trajectory) -> dict[str, Any] | None:
    """The paper's angles and the leak along the run; None where no gradient has a value."""
    try:
        found = evaluate(chart, points=seen.q[np.isfinite(seen.q).all(axis=1)]).as_dict()
    except (SingularTaskError, InvalidValueError):
        return None
    return {name: found[name] for name in ("task_angle_deg", "mutual_angle_deg", "leak_deg")}


def _coupling(chart: Chart, reference: Reference, seen: Trajectory) -> dict[str, dict[str, float]]:
    """Commanded -> disturbed -> index, for quantities that were commanded alone."""
    found = coupling_index(chart, reference, seen)
    return {
        commanded: {
            disturbed: float(found.index[i, j])
            for i, disturbed in enumerate(found.labels)
            if isfinite(found.index[i, j])
        }
        for j, commanded in enumerate(found.labels)
        if np.isfinite(found.index[:, j]).any()
    }


def _worst_couplings(index: dict[str, dict[str, float]], task: tuple[str, ...]) -> str:
    """The worst disturbance of the task by an extra coordinate, and the reverse."""
    pairs = [(value, to, by) for by, column in index.items() for to, value in column.items()]
    texts = []
    for name, of_task in (("task <- extra", True), ("extra <- task", False)):
        chosen = [pair for pair in pairs if (pair[1] in task) == of_task and (pair[2] in task) != of_task]
        if chosen:
            value, to, by = max(chosen)
            texts.append(f"{name} {value:.3g} ({to} <- {by})")
    return ", ".join(texts) or "see report.json"


def _energy(seen: Trajectory) -> dict[str, float]:
    """Storage, and the energy dissipated by the controller's damping, [J]."""
    taken = seen.energy_balance[-1] - seen.storage[-1] + seen.storage[0]
    return {
        "storage_start": seen.storage[0],
        "storage_end": seen.storage[-1],
        "storage_largest": seen.storage.max(),
        "storage_rise": seen.storage_rise,
        "dissipated": taken,
    }


def _text(value: float | None) -> str:
    return "not finite" if value is None else f"{value:.3g}"
