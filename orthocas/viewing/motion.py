"""Motions to play: runs of `orthocas simulate`, joint motions of `orthocas follow`, and their files."""

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from orthocas.checks import Array, frozen_array
from orthocas.errors import InvalidValueError, PathFileError
from orthocas.following.joint_motion import JointMotion
from orthocas.robots import Robot
from orthocas.simulation.trajectory import Trajectory

_LARGEST_FILE = 2**28  # bytes
_TIME = "time_s"


@dataclass(frozen=True, eq=False)
class Motion:
    """Joint positions over time, and quantities that belong to them."""

    name: str
    times: Array  #: (N,) [s], increasing
    q: Array  #: (N, n) [rad] or [m]
    labels: tuple[str, ...]  #: names of the quantities
    values: Array  #: (N, k)
    references: Array | None = None  #: (N, k)
    marked: NDArray[np.bool_] | None = None  #: (N,) where the controller used its fallback
    cycles: tuple[float, ...] = ()  #: ends of the cycles of a motion that repeats a path [s]

    @classmethod
    def of_run(cls, run: Trajectory) -> "Motion":
        """The motion of a simulated run."""
        return cls(run.controller, run.times, run.q, run.labels, run.value, run.reference, run.fell_back)

    @classmethod
    def of_path(cls, motion: JointMotion) -> "Motion":
        """The motion along a tool path."""
        return cls("tool path", motion.times, motion.q, motion.labels, np.hstack([motion.x, motion.xi]))

    @property
    def duration(self) -> float:
        """Length [s]."""
        return float(self.times[-1] - self.times[0])

    def at(self, seconds: float) -> Array:
        """The joint position (n,) some seconds after the start."""
        t = self.times[0] + seconds
        return np.array([np.interp(t, self.times, column) for column in self.q.T])

    def index(self, seconds: float) -> int:
        """The row of the last instant up to some seconds after the start."""
        return int(np.clip(np.searchsorted(self.times, self.times[0] + seconds + 1e-9) - 1, 0, len(self.times) - 1))

    def returns(self, seconds: float) -> list[tuple[int, float]]:
        """For each cycle that is over: its number, and how far a joint then is from its start at most [deg]."""
        over = [(k, end) for k, end in enumerate(self.cycles, 1) if end <= seconds + 1e-9]
        return [(k, float(np.degrees(np.abs(self.at(end) - self.q[0]).max()))) for k, end in over]


def require_joints(names: tuple[str, ...], robot: Robot, what: str) -> None:
    """Raise InvalidValueError unless a motion has the joints of a robot."""
    if names != robot.joint_names:
        raise InvalidValueError(f"joints of {what}", ", ".join(names), ", ".join(robot.joint_names))


def read_run(path: Path, robot: Robot) -> Motion:
    """Read a file of `orthocas simulate`.

    Raises:
        TrajectoryFileError: if the file is no run.
        InvalidValueError: if its joints are not those of the robot.
    """
    run = Trajectory.load(path)
    require_joints(run.joint_names, robot, str(path))
    return Motion.of_run(run)


def read_joint_motion(path: Path, robot: Robot) -> Motion:
    """Read a file of `orthocas follow`: a header with time_s and the names of all joints, then one row an instant.

    Columns for velocities and accelerations are left out; others are quantities to show.

    Raises:
        PathFileError: names the file, and what is wrong there.
    """
    header, table = _table(path)
    lost = [name for name in (_TIME, *robot.joint_names) if name not in header]
    if lost:
        raise PathFileError(f"motion file {path}: column '{lost[0]}' is missing, expected time_s and all joints")
    rates = {f"{order}_{name}" for order in ("d", "dd") for name in robot.joint_names}
    labels = tuple(name for name in header if name not in {_TIME, *robot.joint_names, *rates})
    times, q, values = (
        table[:, [header.index(name) for name in names]] for names in ([_TIME], robot.joint_names, labels)
    )
    if (np.diff(times[:, 0]) <= 0).any():
        raise PathFileError(f"motion file {path}: time_s does not increase in every line")
    arrays = (frozen_array("a column", part, (None, None)) for part in (q, values))
    return Motion(path.stem, times[:, 0], next(arrays), labels, next(arrays))


def _table(path: Path) -> tuple[list[str], Array]:
    """Names of the columns, and at least two rows of finite numbers."""
    try:
        if path.stat().st_size > _LARGEST_FILE:
            raise PathFileError(f"motion file {path}: larger than {_LARGEST_FILE / 2**20:.0f} MiB")
        with path.open(encoding="utf-8-sig", newline="") as stream:
            rows = [(k, row) for k, row in enumerate(csv.reader(stream, strict=True), 1) if any(row)]
    except OSError as error:
        raise PathFileError(f"motion file {path}: cannot be read, {error.strerror}") from None
    except (ValueError, csv.Error) as error:
        raise PathFileError(f"motion file {path}: no CSV text, {str(error)[:60]}") from None
    if len(rows) < 3:
        raise PathFileError(
            f"motion file {path}: {max(len(rows) - 1, 0)} instants after the header, expected at least 2"
        )
    header = [cell.strip() for cell in rows[0][1]]
    if len(set(header)) < len(header):
        raise PathFileError(f"motion file {path}: a column comes twice")
    return header, np.array([_numbers(path, line, row, len(header)) for line, row in rows[1:]])


def _numbers(path: Path, line: int, row: list[str], count: int) -> list[float]:
    try:
        values = [float(cell) for cell in row]
    except ValueError:
        values = []
    if len(values) != count or not np.isfinite(values).all():
        raise PathFileError(f"motion file {path}, line {line}: expected {count} finite numbers")
    return values
