"""The log of main.c, and a figure of it."""

from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from orthocas.control import ControlStatus

_SHADES = {
    ControlStatus.NEAR_BOUNDARY: "#fff2b3",
    ControlStatus.CAUGHT: "#f6c6c3",
    ControlStatus.RETURNING: "#cfe3f5",
    ControlStatus.BAD_INPUT: "#d9c6e8",
}


@dataclass(frozen=True, eq=False)
class Log:
    """One row per tick: N ticks, n joints."""

    time: np.ndarray  #: (N,) [s]
    status: np.ndarray  #: (N,) `orthocas.control.ControlStatus`
    push: np.ndarray  #: (N,) [N]
    contact: np.ndarray  #: force between hand and wall (N,) [N]
    q: np.ndarray  #: (N, n) [rad]
    dq: np.ndarray  #: (N, n) [rad/s]
    torque: np.ndarray  #: (N, n) [N m]
    phi: np.ndarray  #: task and extra coordinates (N, n)
    reference: np.ndarray  #: (N, n)

    @classmethod
    def read(cls, path: Path, n: int) -> Self:
        """Read a log of n joints."""
        rows = np.loadtxt(path, delimiter=",", skiprows=1)
        single, arrays = rows[:, :4], np.split(rows[:, 4:], 5, axis=1)
        assert all(array.shape[1] == n for array in arrays)
        return cls(single[:, 0], single[:, 1].astype(int), single[:, 2], single[:, 3], *arrays)

    @property
    def speed(self) -> np.ndarray:
        """Of the fastest joint (N,) [rad/s]."""
        return np.asarray(np.abs(self.dq).max(axis=1))

    def caption(self, k: int) -> str:
        """Time, status and forces of a tick."""
        text = f"{self.time[k]:4.1f} s   {ControlStatus(int(self.status[k])).name}"
        if self.push[k] > 0:
            text += f"   push {self.push[k]:.0f} N"
        return text + (f"   wall {self.contact[k]:.0f} N" if self.contact[k] > 0 else "")


def figure(log: Log, task: int) -> Figure:
    """Draw coordinates with references, speeds, torques and forces; colours in the background are statuses.

    Args:
        log: of the run.
        task: number of task components.
    """
    picture = Figure(figsize=(9.0, 9.0), layout="constrained")
    rows = picture.subplots(5, 1, sharex=True)
    moved, wanted = log.phi - log.phi[0], log.reference - log.phi[0]
    _draw_with_reference(rows[0], log.time, 1e3 * moved[:, :task], 1e3 * wanted[:, :task], "xyz")
    _draw_with_reference(
        rows[1],
        log.time,
        moved[:, task:],
        wanted[:, task:],
        [rf"$\xi_{k + 1}$" for k in range(moved.shape[1] - task)],
    )
    joints = [f"joint {i + 1}" for i in range(log.q.shape[1])]
    rows[2].plot(log.time, log.dq, linewidth=1, label=joints)
    rows[3].plot(log.time, log.torque, linewidth=1, label=joints)
    rows[4].plot(log.time, log.push, color="#b2182b", label="push at the elbow")
    rows[4].plot(log.time, log.contact, color="#2166ac", label="wall on the hand")
    titles = ("flange from start [mm]", "extra coordinates", "joint speed [rad/s]", "torque [N m]", "force [N]")
    for axes, title in zip(rows, titles, strict=True):
        axes.set_ylabel(title)
        axes.grid(alpha=0.3)
        _shade(axes, log)
        axes.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    rows[4].set(xlabel="time [s]", xlim=(0, log.time[-1]))
    shown = [status for status in _SHADES if (log.status == status).any()]
    patches = [Patch(color=_SHADES[status], label=status.name) for status in shown]
    picture.legend(handles=patches, loc="outside upper center", ncols=len(patches), frameon=False, fontsize=9)
    return picture


def _draw_with_reference(
    axes: Axes, time: np.ndarray, values: np.ndarray, wanted: np.ndarray, labels: list[str] | str
) -> None:
    for value, reference, label in zip(values.T, wanted.T, labels, strict=True):
        (line,) = axes.plot(time, value, label=label)
        axes.plot(time, reference, "--", color=line.get_color(), linewidth=0.8)


def _shade(axes: Axes, log: Log) -> None:
    """Mark times with other statuses than OK and SATURATED."""
    edges = np.flatnonzero(np.diff(log.status)) + 1
    for start, end in zip([0, *edges], [*edges, len(log.time) - 1], strict=True):
        shade = _SHADES.get(ControlStatus(int(log.status[start])))
        if shade:
            axes.axvspan(log.time[start], log.time[end], color=shade, linewidth=0)
