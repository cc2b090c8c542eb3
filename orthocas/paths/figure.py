"""Pictures of joint motions: positions, speeds, and the quantities along the tool path."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure

from orthocas.tools.checks import Array
from orthocas.tools.picture import Picture

if TYPE_CHECKING:
    from orthocas.paths.joint_motion import JointMotion


def motion_figure(motion: "JointMotion") -> Figure:
    """Joint positions and speeds on the left, task values and coordinates on the right, all over time."""
    figure = Picture(figsize=(10.5, 5.0), layout="constrained")
    grid: Any = figure.subplots(2, 2, sharex=True)
    m, names = motion.x.shape[1], motion.joint_names
    _draw(grid[0, 0], motion.times, motion.q, names, "joints q [rad or m]")
    _draw(grid[1, 0], motion.times, motion.dq, (), "speeds [rad/s or m/s]")
    _draw(grid[0, 1], motion.times, motion.x, motion.labels[:m], "task x")
    _draw(grid[1, 1], motion.times, motion.xi, motion.labels[m:], "coordinates ξ")
    for axes in grid[1]:
        axes.set_xlabel("time [s]", fontsize=9)
    figure.suptitle(motion.heading, fontsize=10.5)
    return figure


def _draw(axes: Any, times: Array, values: Array, names: Sequence[str], label: str) -> None:
    """One line for each column."""
    lines = axes.plot(times, np.asarray(values), linewidth=1.4)
    axes.set_ylabel(label, fontsize=9)
    axes.set_xlim(times[0], times[-1])
    axes.tick_params(labelsize=8)
    axes.grid(alpha=0.3)
    if names:
        axes.legend(lines, names, fontsize=7, ncols=4, frameon=False, loc="lower left", bbox_to_anchor=(0, 1))
