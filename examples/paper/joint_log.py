"""Logged joint positions for Fig. 28: CSV with a time, the joints by name, and desired values if they were logged."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from orthocas.charts.chart import Chart
from orthocas.errors import PathFileError
from orthocas.tools.checks import Array
from orthocas.tools.files import RULES, find_columns, read_table

_TIME, _WANTED = "time_s", "desired_"
_MOST = 1_000_000


@dataclass(frozen=True, eq=False)
class JointLog:
    """Measured joint positions of an arm, and desired coordinates where they are known."""

    times: Array  #: (N,) [s], rising
    q: Array  #: (N, n) [rad] or [m]
    desired: Array  #: (N, n) in the order of the chart's labels; NaN where a coordinate was not logged


def read_joint_log(path: str | Path, chart: Chart) -> JointLog:
    """Read a log: columns `time_s`, the names of the joints, and `desired_x`, `desired_xi1`, ... for those desired.

    Other columns of files of `orthocas follow` (velocities, accelerations and the values of phi) are not used.

    Raises:
        PathFileError: names the file, the line, and what is wrong there.
    """
    found: list[str] = []

    def columns(names: Sequence[str]) -> list[int]:
        order, labels = _columns(names, chart)
        found.extend(labels)
        return order

    table = read_table(path, "joint log", "instants", _MOST, columns)
    times, q = table[:, 0], table[:, 1 : 1 + chart.n]
    if not (np.diff(times) > 0).all():
        first = int(np.argmin(np.diff(times) > 0)) + 1
        raise PathFileError(
            f"joint log {path}: time_s is {times[first]:g} after {times[first - 1]:g}, expected it to rise"
        )
    desired = np.full((len(table), chart.n), np.nan)
    desired[:, [chart.labels.index(label) for label in found]] = table[:, 1 + chart.n :]
    return JointLog(times, q, desired)


def _columns(names: Sequence[str], chart: Chart) -> tuple[list[int], list[str]]:
    """Columns of time, joints and desired values, and the labels of the latter."""
    joints = chart.problem.robot.joint_names
    unused = {*chart.labels, *(f"{prefix}_{joint}" for prefix in ("d", "dd") for joint in joints)}
    desired = [label for label in chart.labels if _WANTED + label in names]
    needed = (_TIME, *joints)
    for name in names:
        if name not in {*needed, *unused, *(_WANTED + label for label in chart.labels)}:
            known = f"{', '.join(needed)}, and {_WANTED}{chart.labels[0]} and so on if they are known"
            raise ValueError(f"line 1: unknown column {name[: RULES.cell]!r}, expected {known}")
    return find_columns(names, (*needed, *(_WANTED + label for label in desired))), desired
