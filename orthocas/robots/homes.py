"""Named postures of a robot from SRDF and MJCF files, and postures from CSV files."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

from orthocas.robots.tree import BASE_JOINTS
from orthocas.robots.xml import read_xml
from orthocas.tools.checks import Array
from orthocas.tools.files import column_places, read_table

if TYPE_CHECKING:
    from orthocas.robots.robot import Robot

_NOT_IN_THE_FILE = "qpos0"  # Pinocchio's name for the zero posture of an MJCF file
_MOST_POSTURES = 1_000_000

States = dict[str, dict[str, float]]  #: name of a posture -> joint -> position [rad] or [m]


def srdf_states(urdf: str | Path) -> States:
    """Group states of the SRDF file with the same stem, beside the URDF file or in ../srdf. Empty if there is none.

    States of several groups with the same name form one posture. Joints with several degrees of freedom are skipped.

    Raises:
        RobotError: if the SRDF file cannot be read.
    """
    urdf = Path(urdf)
    name = f"{urdf.stem}.srdf"
    path = next((p for p in (urdf.parent / name, urdf.parent.parent / "srdf" / name) if p.is_file()), None)
    if path is None:
        return {}
    root = read_xml(path, "SRDF", "robot")
    states: States = {}
    for state in root.iter("group_state"):
        joints = states.setdefault(state.get("name", ""), {})
        for joint in state.iter("joint"):
            value = _number(joint.get("value", ""))
            if value is not None:
                joints[joint.get("name", "")] = value
    return states


def model_states(model: pin.Model) -> States:
    """Reference configurations of a Pinocchio model, which are the keyframes of an MJCF file."""
    states: States = {}
    for entry in model.referenceConfigurations:
        position = entry.data()
        states[entry.key()] = {
            model.names[i]: _joint_position(position[joint.idx_q : joint.idx_q + joint.nq])
            for i, joint in enumerate(model.joints)
            if i > 0 and joint.nv == 1
        }
    states.pop(_NOT_IN_THE_FILE, None)
    return states


def postures(states: Mapping[str, Mapping[str, float]], joint_names: Sequence[str]) -> dict[str, Array]:
    """States as joint positions (n,), with a moving base at 0. States that lack another joint are skipped."""
    placed = {name: {**dict.fromkeys(BASE_JOINTS, 0.0), **joints} for name, joints in states.items()}
    return {
        name: np.array([joints[joint] for joint in joint_names])
        for name, joints in placed.items()
        if all(joint in joints for joint in joint_names)
    }


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if np.isfinite(value) else None


def _joint_position(part: Array) -> float:
    """The position of a joint. Pinocchio stores cos and sin of a continuous joint."""
    return float(part[0]) if len(part) == 1 else float(np.arctan2(part[1], part[0]))


def read_postures(path: Path, robot: "Robot") -> Array:
    """Postures (N, n) of a CSV file: a header with the names of joints in any order, and one posture a line.

    Columns of other names, such as those of time and velocities, are left alone.

    Raises:
        PathFileError: names the file, the line, and what is wrong there.
    """
    return read_table(
        path,
        "postures file",
        "postures",
        _MOST_POSTURES,
        lambda names: column_places(names, robot.joint_names),
        least=1,
    )
