"""Recorded joint positions by name: CSV of robots, loggers and PlotJuggler, and MCAP files of rosbag2."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from orthocas.errors import MissingExtraError, PathFileError
from orthocas.robots.robot import Robot
from orthocas.tools.checks import Array, as_path, freeze_array, import_extra, require_kind
from orthocas.tools.files import RULES, read_table

_MOST = 5_000_000  # instants
_MAGIC = b"\x89MCAP0\r\n"
_LATEST = 1e11  # [s]; times may count from 1970
_TIMES = ("time_s", "__time", "time", "timestamp", "t")
_JOINT_STATE = ("sensor_msgs/msg/JointState", "sensor_msgs/JointState")


def read_joints(path: str | Path, robot: Robot, topic: str | None = None) -> tuple[Array, Array]:
    """Times and joint positions of a recording, for the joints of a robot in its order.

    - A CSV file has a column of times in seconds, named time_s, __time, time, timestamp or t, and one for each joint:
      its name, or a path that ends in it or in it and "position", such as PlotJuggler's
      `/joint_states/panda_joint1/position`.
    - An MCAP file of rosbag2 has sensor_msgs/JointState messages. Joints may come in several messages: a row is added
      with each message once all joints are known.

    Args:
        path: the file.
        robot: whose joints are read; other columns and joints are left out.
        topic: of the messages in an MCAP file; default: all topics with JointState messages.

    Returns:
        Times (N,) from the first one [s], not decreasing, and positions (N, n) [rad] or [m].

    Raises:
        PathFileError: names the file, and what is wrong there.
        MissingExtraError: if an MCAP file needs a package that is not installed.
    """
    require_kind("robot", robot, Robot)
    file = as_path("path", path)
    joints = robot.joint_names
    # messages of rosbag2, or columns of a table
    if _is_mcap(file):
        rows = np.array(list(_read_messages(file, joints, topic))).reshape(-1, robot.n + 1)
    else:
        rows = read_table(file, "recording", "instants", _MOST, lambda names: _find_columns(names, joints), 1, _LATEST)
    if not len(rows):
        raise PathFileError(f"recording {file}: no JointState messages with all of the joints {', '.join(joints)}")
    if not (np.abs(rows) <= [_LATEST, *(robot.n * [RULES.largest])]).all() or (np.diff(rows[:, 0]) < 0).any():
        raise PathFileError(f"recording {file}: times decrease, or a position is not finite")
    return freeze_array("times", rows[:, 0] - rows[0, 0], (None,)), freeze_array("q", rows[:, 1:], (None, robot.n))


def _is_mcap(file: Path) -> bool:
    """Whether a file begins as MCAP files do."""
    try:
        with file.open("rb") as stream:
            return stream.read(len(_MAGIC)) == _MAGIC
    except OSError as error:
        raise PathFileError(f"recording {file}: cannot be read, {error.strerror}") from None


def _find_columns(names: Sequence[str], joints: Sequence[str]) -> list[int]:
    """The columns of the times and of each joint; raises ValueError if one is missing or not the only one."""
    times = [names.index(name) for name in _TIMES if name in names]
    if not times:
        raise ValueError(f"line 1: a column of times is missing, expected one of {', '.join(_TIMES)}")
    columns = times[:1]
    # each joint once, by its name or a path that ends with it
    for joint in joints:
        found = [k for k, name in enumerate(names) if _is_of_joint(name, joint)]
        if len(found) != 1:
            came = "is missing" if not found else "comes twice"
            raise ValueError(f"line 1: column {joint!r} {came}, expected {joint} or .../{joint}/position once")
        columns += found
    return columns


def _is_of_joint(name: str, joint: str) -> bool:
    """Whether a column has the positions of a joint."""
    # Columns are called JOINT, TOPIC/JOINT, or .../JOINT/position, with dots or slashes.
    *_, last = parts = name.replace(".", "/").split("/")
    return joint in (name, last) or (last == "position" and parts[-2:-1] == [joint])


def _read_messages(file: Path, joints: Sequence[str], topic: str | None) -> Iterator[list[float]]:
    """Rows of a time and all joints, from the messages of an MCAP file in the order of their times."""
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
        # The libraries raise errors of many kinds for damaged files.
        raise PathFileError(f"recording {file}: no MCAP file of rosbag2, or damaged: {error}") from None
