"""Motions to play: runs of `orthocas simulate`, joint motions of `orthocas follow`, and their files."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from orthocas.checks import Array, frozen_array
from orthocas.errors import InvalidValueError, PathFileError
from orthocas.files.csv_table import places, read_table
from orthocas.following.joint_motion import JointMotion
from orthocas.robots import Robot
from orthocas.simulation.trajectory import Trajectory

_MOST_INSTANTS = 1_000_000
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
    header: list[str] = []

    def columns(names: Sequence[str]) -> list[int]:
        places(names, (_TIME, *robot.joint_names))
        header.extend(names)
        return places(names, names)

    table = read_table(path, "motion file", "instants", _MOST_INSTANTS, columns)
    rates = {f"{order}_{name}" for order in ("d", "dd") for name in robot.joint_names}
    labels = tuple(name for name in header if name not in {_TIME, *robot.joint_names, *rates})
    times, q, values = (
        table[:, [header.index(name) for name in names]] for names in ([_TIME], robot.joint_names, labels)
    )
    if (np.diff(times[:, 0]) <= 0).any():
        raise PathFileError(f"motion file {path}: time_s does not increase in every line")
    arrays = (frozen_array("a column", part, (None, None)) for part in (q, values))
    return Motion(Path(path).stem, times[:, 0], next(arrays), labels, next(arrays))
