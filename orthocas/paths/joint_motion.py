"""Joint motions: the result of `orthocas.follow`, and recordings from CSV files or MCAP files of rosbag2."""

import csv
import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from orthocas.errors import MissingExtraError, PathFileError
from orthocas.robots.robot import Robot
from orthocas.tools.checks import Array, as_path, freeze_array, import_extra, require_kind
from orthocas.tools.display import Shown, listed
from orthocas.tools.files import RULES as FILE_RULES
from orthocas.tools.files import publish, read_table, require_replaceable, require_writable

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# First column of our files.
_HEAD = "time_s"
# [rad] or [m]; a closed loop returns up to this rounding error.
_CLOSED = 1e-6
# Largest number of instants.
_MOST = 5_000_000
_MAGIC = b"\x89MCAP0\r\n"
# [s]; times may count from 1970.
_LATEST = 1e11
_TIMES = ("time_s", "__time", "time", "timestamp", "t")
_JOINT_STATE = ("sensor_msgs/msg/JointState", "sensor_msgs/JointState")


@dataclass(frozen=True)
class Margins:
    """Margins of a motion to its limits, at its time stamps."""

    boundary: float  #: smallest distance of a joint to the boundary of the domain, in half-widths
    boundary_joint: str  #: the joint that comes closest, or ""
    velocity: float  #: largest used fraction of a velocity limit, at most 1
    acceleration: float  #: largest used fraction of an acceleration limit, at most 1
    singular_value: float  #: smallest relative singular value of the task, see `orthocas.ClearBox`
    distance: float  #: smallest distance of a pair [m]; inf without a collision model
    distance_pair: str  #: names of that pair, or ""


@dataclass(frozen=True, eq=False, repr=False)
class JointMotion(Shown):
    """A motion from rest to rest: N time stamps, n joints."""

    labels: tuple[str, ...]  #: names of the components of phi
    joint_names: tuple[str, ...]
    times: Array  #: (N,) [s], evenly spaced
    q: Array  #: (N, n) [rad] or [m]
    dq: Array  #: (N, n)
    ddq: Array  #: (N, n)
    x: Array  #: (N, m) task values
    xi: Array  #: (N, r)
    s: Array  #: (N,) parameter of the path, from 0 to 1
    #: (n,) change of the joints after the closed path, `ChartParts.left_over`; None: the path is open
    left_over: Array | None
    margins: Margins

    def __post_init__(self) -> None:
        N, n, m = len(self.times), len(self.joint_names), self.x.shape[1]
        shapes: dict[str, tuple[int, ...]] = dict.fromkeys(("q", "dq", "ddq"), (N, n))
        for name, shape in {**shapes, "times": (N,), "s": (N,), "x": (N, m), "xi": (N, n - m)}.items():
            object.__setattr__(self, name, freeze_array(name, getattr(self, name), shape))
        if self.left_over is not None:
            object.__setattr__(self, "left_over", freeze_array("left_over", self.left_over, (n,)))

    @property
    def closed(self) -> bool:
        """Whether x, xi and the joints end where they began; endless joints may differ by full turns."""
        return self.left_over is not None and bool(np.abs(self.left_over).max() < _CLOSED)

    @property
    def kind(self) -> str:
        """Open, closed, or "around a turn": x and xi return, but the joints do not."""
        if self.left_over is None or self.closed:
            return f"{'closed' if self.closed else 'open'} path"
        k = int(np.argmax(np.abs(self.left_over)))
        return (
            "path around a turn: x and xi end where they began, "
            f"joint '{self.joint_names[k]}' {self.left_over[k]:.4g} away"
        )

    @property
    def duration(self) -> float:
        """Length [s]."""
        return float(self.times[-1])

    @property
    def period(self) -> float:
        """Interval between time stamps [s]."""
        return float(self.times[1])

    def facts(self) -> dict[str, str]:
        """Duration, motion, and margins to the limits."""
        kept, r = self.margins, self.xi.shape[1]
        ranges = zip(self.labels[-r:], self.xi.min(axis=0), self.xi.max(axis=0), strict=True)
        near = f" (joint '{kept.boundary_joint}')" if kept.boundary_joint else ""
        return {
            "motion": f"{self.duration:.4g} s in {len(self.times)} time stamps, {self.kind}",
            "coordinates": listed(f"{label} from {low:.4g} to {high:.4g}" for label, low, high in ranges),
            "boundary": f"{kept.boundary:.3g} half-widths away{near}",
            "speed": f"{100 * kept.velocity:.3g} % of the limits, acceleration {100 * kept.acceleration:.3g} %",
            "task": f"relative singular value at least {kept.singular_value:.3g}",
            **({"collisions": f"{kept.distance:.3g} m between {kept.distance_pair}"} if kept.distance_pair else {}),
        }

    def plot(self) -> "Figure":
        """Joints, speeds, task values and coordinates over time, as a matplotlib figure."""
        # Left: joint positions and speeds; right: task values and coordinates.
        # matplotlib takes a third of a second to import.
        from orthocas.tools.picture import Picture

        figure = Picture(figsize=(10.5, 5.0), layout="constrained")
        grid: Any = figure.subplots(2, 2, sharex=True)
        m, names = self.x.shape[1], self.joint_names
        _draw(grid[0, 0], self.times, self.q, names, "joints q [rad or m]")
        _draw(grid[1, 0], self.times, self.dq, (), "speeds [rad/s or m/s]")
        _draw(grid[0, 1], self.times, self.x, self.labels[:m], "task x")
        _draw(grid[1, 1], self.times, self.xi, self.labels[m:], "coordinates ξ")
        for axes in grid[1]:
            axes.set_xlabel("time [s]", fontsize=9)
        figure.suptitle(self.heading, fontsize=10.5)
        return figure

    def save_csv(self, path: str | Path, force: bool = False) -> None:
        """Write a CSV file: time_s, then q, dq and ddq of each joint, task values, and coordinates.

        The file appears complete or not at all. It replaces a file that this method wrote, and with `force` any file.

        Raises:
            PathFileError: if the folder is missing or not writable, or the path is a symbolic link or any other file.
        """
        target = as_path("path", path)
        require_place(target, force)
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        rates = [f"{order}_{name}" for order in ("d", "dd") for name in self.joint_names]
        writer.writerow([_HEAD, *self.joint_names, *rates, *self.labels])
        table = np.column_stack([self.times, self.q, self.dq, self.ddq, self.x, self.xi])
        writer.writerows([repr(float(value)) for value in row] for row in table)
        with publish(target.parent) as drafts:
            (drafts / target.name).write_text(text.getvalue(), encoding="utf-8", newline="")


def require_place(path: Path, force: bool) -> None:
    """Check, before long work, that `JointMotion.save_csv` can write a file.

    Raises:
        PathFileError: if the folder is missing or not writable, or the path is a symbolic link or a file of other
            origin.
    """
    require_writable(path, PathFileError)
    # Files of ours begin with the header of `save_csv`.
    try:
        with path.open("rb") as stream:
            ours = stream.read(len(_HEAD) + 1) == f"{_HEAD},".encode()
    except OSError:
        ours = False
    require_replaceable(path, ours, force, PathFileError)


def _draw(axes: Any, times: Array, values: Array, names: Sequence[str], label: str) -> None:
    """Draw one line for each column."""
    lines = axes.plot(times, np.asarray(values), linewidth=1.4)
    axes.set_ylabel(label, fontsize=9)
    axes.set_xlim(times[0], times[-1])
    axes.tick_params(labelsize=8)
    axes.grid(alpha=0.3)
    if names:
        axes.legend(lines, names, fontsize=7, ncols=4, frameon=False, loc="lower left", bbox_to_anchor=(0, 1))


def read_joints(path: str | Path, robot: Robot, topic: str | None = None) -> tuple[Array, Array]:
    """Read times and joint positions of a robot from a recording, in the order of its joints.

    - A CSV file has a column of times in seconds, named time_s, __time, time, timestamp or t, and one column per joint.
      Its name is the joint's name, or a path that ends in that name, or in that name and "position", such as
      PlotJuggler's `/joint_states/panda_joint1/position`.
    - An MCAP file of rosbag2 has sensor_msgs/JointState messages. Joints may be spread over several messages: once all
      joints are known, each message adds a row.

    Args:
        path: the file.
        robot: the robot; other columns and joints are ignored.
        topic: topic of the messages in an MCAP file; default: all topics with JointState messages.

    Returns:
        Times (N,) since the first one [s], not decreasing, and positions (N, n) [rad] or [m].

    Raises:
        PathFileError: names the file and the error.
        MissingExtraError: if an MCAP file needs a package that is not installed.
    """
    require_kind("robot", robot, Robot)
    file = as_path("path", path)
    joints = robot.joint_names
    try:
        with file.open("rb") as stream:
            is_mcap = stream.read(len(_MAGIC)) == _MAGIC
    except OSError as error:
        raise PathFileError(f"recording {file}: cannot be read, {error.strerror}") from None
    # Read messages of rosbag2, or columns of a table.
    if is_mcap:
        rows = np.array(list(_read_messages(file, joints, topic))).reshape(-1, robot.n + 1)
    else:
        rows = read_table(file, "recording", "instants", _MOST, lambda names: _find_columns(names, joints), 1, _LATEST)
    if not len(rows):
        raise PathFileError(f"recording {file}: no JointState messages with all of the joints {', '.join(joints)}")
    if not (np.abs(rows) <= [_LATEST, *(robot.n * [FILE_RULES.largest])]).all() or (np.diff(rows[:, 0]) < 0).any():
        raise PathFileError(f"recording {file}: times decrease, or a position is not finite")
    return freeze_array("times", rows[:, 0] - rows[0, 0], (None,)), freeze_array("q", rows[:, 1:], (None, robot.n))


def _find_columns(names: Sequence[str], joints: Sequence[str]) -> list[int]:
    """Indices of the columns of time and of each joint; raises ValueError if one is missing or ambiguous."""
    times = [names.index(name) for name in _TIMES if name in names]
    if not times:
        raise ValueError(f"line 1: a column of times is missing, expected one of {', '.join(_TIMES)}")
    columns = times[:1]
    # Each joint needs one column, named JOINT, TOPIC/JOINT, or .../JOINT/position, with dots or slashes.
    parts = [name.replace(".", "/").split("/") for name in names]
    for joint in joints:
        found = [
            k
            for k, (name, path) in enumerate(zip(names, parts, strict=True))
            if joint in (name, path[-1]) or path[-2:] == [joint, "position"]
        ]
        if len(found) != 1:
            came = "is missing" if not found else "comes twice"
            raise ValueError(f"line 1: column {joint!r} {came}, expected {joint} or .../{joint}/position once")
        columns += found
    return columns


def _read_messages(file: Path, joints: Sequence[str], topic: str | None) -> Iterator[list[float]]:
    """Rows of a time and all joints, from the messages of an MCAP file in the order of time."""
    reading: Any = import_extra("mcap.reader", "reading MCAP files", "recordings")
    decoding: Any = import_extra("mcap_ros2.decoder", "reading MCAP files", "recordings")
    known: dict[str, float] = {}
    try:
        with file.open("rb") as stream:
            reader = reading.make_reader(stream, decoder_factories=[decoding.DecoderFactory()])
            topics = None if topic is None else [topic]
            for schema, _, record, message in reader.iter_decoded_messages(topics=topics):
                if schema is None or schema.name not in _JOINT_STATE:
                    continue
                known |= dict(zip(message.name, map(float, message.position), strict=False))
                stamp = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
                if all(joint in known for joint in joints):
                    yield [stamp or 1e-9 * record.log_time, *(known[joint] for joint in joints)]
    except MissingExtraError:
        raise
    except OSError as error:
        raise PathFileError(f"recording {file}: cannot be read, {error.strerror}") from None
    except Exception as error:
        # The libraries raise many kinds of errors for damaged files.
        raise PathFileError(f"recording {file}: not an MCAP file of rosbag2, or damaged: {error}") from None
