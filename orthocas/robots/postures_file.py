"""Postures of a robot in a CSV file."""

from pathlib import Path
from typing import TYPE_CHECKING

from orthocas.checks import Array
from orthocas.files.csv_table import places, read_table

if TYPE_CHECKING:
    from orthocas.robots.robot import Robot

_MOST_POSTURES = 1_000_000


def read_postures(path: Path, robot: "Robot") -> Array:
    """Postures (N, n) of a CSV file: a header with the names of joints in any order, and one posture a line.

    Columns of other names, such as those of time and velocities, are left alone.

    Raises:
        PathFileError: names the file, the line, and what is wrong there.
    """
    return read_table(
        path, "postures file", "postures", _MOST_POSTURES, lambda names: places(names, robot.joint_names), least=1
    )
