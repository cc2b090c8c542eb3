"""[AS2023] Fig. 28: a journey of the 7-DoF arm in task and extra coordinates, which ends where it began.

The control law is velocity control dq = J^-1 d_phi_d without feedback (Sec. 9), with A = I and polynomials instead of
the network. The paper shows measurements on a robot; here dq is integrated, and the steps are ours. `draw_log` does the
same for logged joints.
"""

from functools import lru_cache
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from orthocas import problems
from orthocas.bases import Polynomial
from orthocas.charts.chart import Chart
from orthocas.charts.quality import evaluate
from orthocas.control import Kinematic, Reference
from orthocas.simulation import coupling_index, simulate
from orthocas.tools.checks import Array

from .chosen_fit import USUAL, ChosenFit
from .drawing import Drawing
from .joint_log import read_joint_log
from .style import LABEL, TICK, new_figure

JOURNEY = (  # coordinate and target of each step, relative to the value at the start, [m] or [1]
    *(("xi1", -0.5), ("x", 0.12), ("xi3", -0.5), ("y", -0.25), ("xi4", 0.6), ("z", -0.15), ("xi2", 0.4)),
    *(("y", 0.3), ("xi1", 0.2), ("x", -0.2), ("xi3", 0.3), ("xi4", -0.45), ("z", 0.15), ("xi2", -0.25)),
    *(("y", -0.25), ("xi3", -0.5), ("x", 0.06), ("xi1", -0.45), ("z", -0.25), ("xi2", 0.6)),
    *(("y", 0.0), ("xi4", 0.0), ("xi3", 0.0), ("x", 0.0), ("xi1", 0.0), ("z", 0.0), ("xi2", 0.0)),
)
_FIRST, _PAUSE, _REST = 1.0, 2.0, 6.0  # time of the first step, between steps, and after the last step [s]
_TOLERANCE = 1e-10  # of CVODES; without feedback, its errors remain in the joints
_OF_TASK = ("#08306b", "#2b7bba", "#8ab8dd", "#08519c", "#5ba3cf", "#b0cfe6")  # blue
_OF_XI = ("#d94801", "#1b7837", "#c51b7d", "#c9a000")
_OF_JOINTS = ("#000000", "#4d4d4d", "#999999", "#762a83", "#af8dc3", "#8c510a", "#d8b365")  # grey, violet, brown


@lru_cache(maxsize=4)
def arm_chart(quick: bool, chosen: ChosenFit) -> Chart:
    """The coordinates of the 7-DoF arm that Figs. 27 and 28 show."""
    return chosen.chart(problems.get("iiwa"), Polynomial(4), quick)


def draw(quick: bool, chosen: ChosenFit = USUAL) -> Drawing:
    """Draw task, coordinates and joints over time; the numbers tell how exactly the arm returns."""
    chart = arm_chart(quick, chosen)
    reference = journey(chart)
    run = simulate(Kinematic(chart, 0.0, np.inf), reference, chart.problem.domain.centre, tolerance=_TOLERANCE)
    figure = _picture(chart, run.times, run.q, run.value, run.reference)
    quality = evaluate(chart, 5_000 if quick else 30_000)
    away = np.abs(run.q - run.q[0])
    numbers = {
        "steps": float(len(JOURNEY)),
        "seconds": reference.duration,
        "joint_error_at_the_end_rad": float(away[-1].max()),
        "largest_joint_excursion_rad": float(away.max()),
        "least_joint_excursion_rad": float(away.max(axis=0).min()),
        "largest_joint_speed_rad_s": float(np.abs(run.dq).max()),
        "largest_coupling_index": float(np.nanmax(coupling_index(chart, reference, run).index)),
        "instants_without_command": float(np.count_nonzero(run.status)),
        "task_angle_std_deg": quality.task_angle.std,
        "mutual_angle_std_deg": quality.mutual_angle.std,
    }
    return Drawing({"": figure}, numbers)


def journey(chart: Chart) -> Reference:
    """The steps of `JOURNEY` from the centre of the domain, through the low-pass filter."""
    start = chart.phi(chart.problem.domain.centre)
    times = _FIRST + _PAUSE * np.arange(len(JOURNEY))
    home = dict(zip(chart.labels, start, strict=True))
    changes = [(time, {label: home[label] + step}) for time, (label, step) in zip(times, JOURNEY, strict=True)]
    return Reference.steps(chart.labels, start, changes, times[-1] + _REST)


def draw_log(path: str | Path, chart: Chart) -> Drawing:
    """Draw logged joint positions, and the task and coordinates that they have on a chart.

    Args:
        path: CSV file, see `joint_log.py`.
        chart: a chart of the arm. Where the log leaves its domain, coordinates mean nothing; a number tells the share.

    Raises:
        PathFileError: if the file cannot be read.
    """
    log = read_joint_log(path, chart)
    phi, away = chart.phi(log.q), np.abs(log.q - log.q[0])
    numbers = {
        "instants": float(len(log.times)),
        "seconds": float(np.ptp(log.times)),
        "joint_difference_of_end_and_start_rad": float(away[-1].max()),
        "largest_joint_excursion_rad": float(away.max()),
        "share_outside_the_domain": float(1 - np.mean(chart.problem.domain.contains(log.q))),
    }
    for label, actual, wanted in zip(chart.labels, phi.T, log.desired.T, strict=True):
        numbers[f"difference_of_end_and_start_{label}"] = float(abs(actual[-1] - actual[0]))
        if np.isfinite(wanted).all():
            numbers[f"largest_error_{label}"] = float(np.abs(actual - wanted).max())
    return Drawing({"": _picture(chart, log.times, log.q, phi, log.desired)}, numbers)


def _picture(chart: Chart, times: Array, q: Array, actual: Array, desired: Array) -> Figure:
    """Draw phi, actual and desired (N, n), and the joints (N, n) over time."""
    figure = new_figure(6.2)
    panes = figure.subplots(3, 1, sharex=True)
    m, units = chart.m, sorted(set(chart.problem.task.units))
    names = [*chart.problem.task.labels, *(rf"$\xi_{k + 1}$" for k in range(chart.r))]
    for axes, which, colours, title in (
        (panes[0], slice(m), _OF_TASK, f"(a) task $x$ [{', '.join(units)}]; wide: desired, thin: actual"),
        (panes[1], slice(m, None), _OF_XI, r"(b) coordinates $\xi$ [1]"),
    ):
        _draw_values(
            axes,
            times,
            desired[:, which],
            actual[:, which],
            dict(zip(names[which], cycle(colours), strict=False)),
            title,
        )
    _draw_joints(panes[2], times, q)
    panes[2].set_xlabel("time [s]", fontsize=LABEL)
    return figure


def _draw_values(axes: Any, times: Array, desired: Array, actual: Array, colours: dict[str, str], title: str) -> None:
    """Draw desired values wide and pale, and actual values thin and dark on top, in the colours of their names."""
    for wanted, reached, (name, colour) in zip(desired.T, actual.T, colours.items(), strict=True):
        axes.plot(times, wanted, color=colour, linewidth=3.2, alpha=0.3)
        axes.plot(times, reached, color=colour, linewidth=0.9, label=name)
    _finish(axes, title)


def _draw_joints(axes: Any, times: Array, joints: Array) -> None:
    """Draw joint positions, with dotted lines at their start values."""
    for k, (q, colour) in enumerate(zip(joints.T, cycle(_OF_JOINTS), strict=False), 1):
        axes.plot(times, q, color=colour, linewidth=0.9, label=f"$q_{{{k}}}$")
        axes.axhline(q[0], color=colour, linewidth=0.9, linestyle=":")
    _finish(axes, "(c) joints $q$ [rad]; dotted: start values")


def _finish(axes: Any, title: str) -> None:
    axes.set_title(title, fontsize=LABEL, loc="left")
    axes.legend(fontsize=TICK, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False, handlelength=1.2)
    axes.margins(x=0)
    axes.tick_params(labelsize=TICK)
    axes.grid(alpha=0.3)
