"""Recorded joints by name: CSV of several programs, and MCAP files of rosbag2."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import orthocas as oc
from orthocas.errors import MissingExtraError, PathFileError
from orthocas.paths import read_joints
from orthocas.tools import checks
from orthocas.viewer.motion import read_joint_motion

ROBOT = oc.Robot.planar(lengths=[1.0, 1.0], masses=[3.0, 3.0])
JOINT_STATE = """std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""


def message(seconds: float, **positions: float) -> dict[str, Any]:
    whole = int(seconds)
    stamp = {"sec": whole, "nanosec": round(1e9 * (seconds - whole))}
    names, values = list(positions), list(positions.values())
    return {"header": {"stamp": stamp, "frame_id": ""}, "name": names, "position": values, "velocity": [], "effort": []}


@pytest.fixture
def bag(tmp_path: Path) -> Callable[..., Path]:
    """Writes an MCAP file with messages on topics."""
    writing = pytest.importorskip("mcap_ros2.writer")

    def write(*messages: tuple[str, dict[str, Any]]) -> Path:
        path = tmp_path / "log.mcap"
        with path.open("wb") as stream:
            writer = writing.Writer(stream)
            schema = writer.register_msgdef("sensor_msgs/msg/JointState", JOINT_STATE)
            other = writer.register_msgdef("std_msgs/msg/String", "string data")
            for k, (topic, content) in enumerate(messages):
                writer.write_message(topic, other if "data" in content else schema, content, k, k)
            writer.finish()
        return path

    return write


@pytest.mark.parametrize(
    "header",
    [
        "time_s,q1,q2",
        "__time,/joint_states/q1/position,/joint_states/q2/position",
        "timestamp,state.q1.position,q2",
    ],
)
def test_csv_files_name_joints_in_several_ways(header: str, tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text(f"other,{header}\nx,1700000000.0,0.1,0.2\nx,1700000000.5,0.3,0.4\n")
    times, q = read_joints(path, ROBOT)
    np.testing.assert_allclose(times, [0, 0.5])
    np.testing.assert_array_equal(q, [[0.1, 0.2], [0.3, 0.4]])


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        ("q1,q2\n0,0\n", "a column of times is missing"),
        ("t,q1\n0,0\n", "column 'q2' is missing"),
        ("t,q1,a/q1,q2\n0,0,0,0\n", "column 'q1' comes twice"),
        ("t,q1,q2\n1,0,0\n0,0,0\n", "times decrease"),
        ("t,q1,q2\n1,0,1e9\n", "not finite"),
        ("t,q1,q2\n", "0 instants"),
    ],
)
def test_faults_of_csv_files_are_named(text: str, wrong: str, tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text(text)
    with pytest.raises(PathFileError, match=wrong):
        read_joints(path, ROBOT)


def test_joints_of_a_bag_come_in_several_messages_and_any_order(bag: Callable[..., Path]) -> None:
    path = bag(
        ("/arm", message(5.0, q2=0.2)),
        ("/note", {"data": "text"}),
        ("/arm", message(5.1, gripper=1.0, q1=0.1)),
        ("/arm", message(5.3, q2=0.4)),
        ("/other", message(6.0, q1=9.0, q2=9.0)),
    )
    times, q = read_joints(path, ROBOT, "/arm")
    np.testing.assert_allclose(times, [0, 0.2], atol=1e-9)
    np.testing.assert_array_equal(q, [[0.1, 0.2], [0.1, 0.4]])
    assert len(read_joints(path, ROBOT)[0]) == 3


def test_bags_without_the_joints_and_damaged_ones_are_named(bag: Callable[..., Path]) -> None:
    path = bag(("/arm", message(5.0, q1=0.2)))
    with pytest.raises(PathFileError, match="no JointState messages with all of the joints q1, q2"):
        read_joints(path, ROBOT)
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(PathFileError, match="damaged"):
        read_joints(path, ROBOT)


def test_without_the_library_the_extra_is_named(bag: Callable[..., Path], monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(name: str) -> None:
        raise ModuleNotFoundError(name)

    path = bag(("/arm", message(5.0, q1=0.2, q2=0.1)))
    monkeypatch.setattr(checks, "import_module", fail)
    with pytest.raises(MissingExtraError, match=r"orthocas\[recordings\]"):
        read_joints(path, ROBOT)


def test_the_viewer_plays_a_bag(bag: Callable[..., Path]) -> None:
    """Messages of one time count once."""
    path = bag(*(("/arm", message(5.0 + t, q1=t, q2=0.0)) for t in (0.0, 0.5, 0.5, 1.0)))
    motion = read_joint_motion(path, ROBOT)
    np.testing.assert_allclose(motion.times, [0, 0.5, 1.0], atol=1e-9)
    np.testing.assert_allclose(motion.at(1.0)[0], 1.0, atol=1e-6)
