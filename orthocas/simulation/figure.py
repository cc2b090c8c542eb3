"""Figure of a run: controlled quantities with their references, joints, commands and storage over time."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from orthocas.control.controller import FROM_THE_LAW, ControlStatus
from orthocas.tasks.problem import Problem
from orthocas.tools.checks import Array
from orthocas.tools.picture import Picture

if TYPE_CHECKING:
    from orthocas.simulation.trajectory import Trajectory

ACTUAL, FALLBACK = "#3d85c6", "#d62728"
_WANTED, _STORAGE = "#222222", "#1b9e77"
_SMALL = 8.0  # font size [pt]
_NARROWEST = 1e-2  # smallest range of a panel, relative to the widest, so that a quantity at rest looks at rest


def units_of(problem: Problem) -> dict[str, str]:
    """Units of task components and joints, by label. Extra coordinates have none."""
    joints = {"revolute": "rad", "prismatic": "m"}
    tree = problem.robot.tree
    units = {name: joints[kind] for name, kind in zip(tree.joint_names, tree.joint_kinds, strict=True)}
    return units | {label: unit for label, unit in zip(problem.task.labels, problem.task.units, strict=True) if unit}


def trajectory_figure(trajectory: "Trajectory", units: Mapping[str, str] | None = None) -> Figure:
    """Draw controlled quantities on the left; joints, commands and storage on the right. Red: not the law.

    Args:
        trajectory: the run.
        units: units of the quantities by label, see `units_of`; quantities without an entry are shown without a unit.
    """
    k = len(trajectory.labels)
    figure = Picture(figsize=(10.5, max(5.4, 1.05 * k + 0.9)), layout="constrained")
    halves: Any = figure.subfigures(1, 2)
    left, right = halves
    units = units or {}
    quantities = left.subplots(k, 1, sharex=True, squeeze=False)[:, 0]
    draw_quantities(quantities, trajectory, units)
    for axes, label, worst in zip(quantities, trajectory.labels, trajectory.tracking_error, strict=True):
        axes.set_title(f"largest error {worst:.2g} {units.get(label, '')}", loc="right", fontsize=7.5, pad=2)
    quantities[0].legend(fontsize=_SMALL, loc="lower left", bbox_to_anchor=(0, 1), ncols=2, frameon=False)
    others = right.subplots(2 + (trajectory.kind == "torque"), 1, sharex=True)
    _draw_others(others, trajectory, units)
    for axes in (*quantities, *others):
        shade_fallback(axes, trajectory)
    for axes in (quantities[-1], others[-1]):
        axes.set_xlabel("time [s]", fontsize=9)
    for column in (left, right):
        column.align_ylabels()
    figure.suptitle(_title(trajectory), fontsize=10.5)
    return figure


def draw_quantities(panels: Array, trajectory: "Trajectory", units: Mapping[str, str], drawn: bool = True) -> None:
    """Draw the reference and, if `drawn`, the actual value of each quantity in its own axes."""
    good = ~trajectory.fell_back & np.isfinite(trajectory.value).all(axis=1)
    seen = np.vstack(
        [trajectory.value[good], trajectory.reference]
    )  # chart coordinates are meaningless outside the domain
    lows, highs = seen.min(axis=0), seen.max(axis=0)
    spans = np.maximum(highs - lows, max(_NARROWEST * (highs - lows).max(), 1e-9))
    middles = (lows + highs) / 2
    for i, (axes, label) in enumerate(zip(panels, trajectory.labels, strict=True)):
        if drawn:
            axes.plot(trajectory.times, trajectory.value[:, i], color=ACTUAL, linewidth=2.2, label="actual")
        axes.plot(trajectory.times, trajectory.reference[:, i], "--", color=_WANTED, linewidth=1, label="reference")
        axes.set_ylim(middles[i] - 0.58 * spans[i], middles[i] + 0.58 * spans[i])
        unit = f" [{units[label]}]" if label in units else ""
        axes.set_ylabel(f"{_in_mathematics(label)}{unit}", fontsize=9)
        _style(axes, trajectory)


def shade_fallback(axes: Axes, trajectory: "Trajectory") -> None:
    """Shade in red where the controller used its fallback."""
    edges = np.flatnonzero(np.diff(trajectory.status)) + 1
    for start, end in zip([0, *edges], [*edges, len(trajectory.times) - 1], strict=True):
        status = ControlStatus(int(trajectory.status[start]))
        if status not in FROM_THE_LAW:
            axes.axvspan(trajectory.times[start], trajectory.times[end], color=FALLBACK, alpha=0.15, linewidth=0)


def _draw_others(panels: Array, trajectory: "Trajectory", units: Mapping[str, str]) -> None:
    """Draw joints, commands and, for torque controllers, the storage."""
    torque = trajectory.kind == "torque"
    unit = " or ".join(sorted({units.get(name, "rad or m") for name in trajectory.joint_names}, reverse=True))
    force = " or ".join({"rad": "N m", "m": "N"}[part] for part in unit.split(" or "))
    speed = " or ".join(f"{part}/s" for part in unit.split(" or "))
    panels[0].plot(trajectory.times, trajectory.q, linewidth=1.3, label=trajectory.joint_names)
    panels[0].set_ylabel(f"joints q [{unit}]", fontsize=9)
    names = len(trajectory.joint_names)
    panels[0].legend(fontsize=7, loc="lower left", bbox_to_anchor=(0, 1), ncols=min(names, 4), frameon=False)
    panels[1].plot(trajectory.times, trajectory.command, linewidth=1.3)
    panels[1].set_ylabel(f"torque [{force}]" if torque else f"velocity [{speed}]", fontsize=9)
    if torque:
        storage = np.where(trajectory.fell_back, np.nan, trajectory.storage)
        panels[2].plot(trajectory.times, storage, color=_STORAGE, linewidth=1.3)
        panels[2].set_ylabel("storage V [J]", fontsize=9)
    for axes in panels:
        _style(axes, trajectory)


def _style(axes: Axes, trajectory: "Trajectory") -> None:
    axes.set_xlim(trajectory.times[0], max(trajectory.times[-1], 1e-9))
    axes.ticklabel_format(useOffset=False)
    axes.tick_params(labelsize=_SMALL)
    axes.grid(alpha=0.3)


def _title(trajectory: "Trajectory") -> str:
    text = f"{trajectory.controller}, {trajectory.times[-1]:.4g} s"
    if trajectory.outcome.value != "complete":
        text += f": {trajectory.outcome.value}, run ended early"
    lasting = trajectory.seconds_in_status
    cut, red = ([status for status in lasting if (status in FROM_THE_LAW) == kind] for kind in (True, False))
    if red:
        text += f"\nred: {'catcher' if trajectory.catches else 'fallback'}, {_durations(lasting, red)}"
    if cut := [status for status in cut if status is not ControlStatus.OK]:
        text += f"\n{_durations(lasting, cut)}"
    return text


def _durations(lasting: Mapping[ControlStatus, float], chosen: Sequence[ControlStatus]) -> str:
    return ", ".join(f"{status.words} {lasting[status]:.3g} s" for status in chosen)


def _in_mathematics(label: str) -> str:
    """A label such as xi1 as a mathematical symbol; other labels unchanged."""
    number = label.removeprefix("xi")
    return rf"$\xi_{{{number}}}$" if label.startswith("xi") and number.isdigit() else label
