"""The KUKA LBR iiwa 7 R800 with the position of its flange as the task ([AS2023] Sec. 9)."""

from contextlib import AbstractContextManager
from importlib.resources import as_file, files
from pathlib import Path

import numpy as np

from orthocas.robots.robot import Robot
from orthocas.tasks.domains import Box
from orthocas.tasks.problem import Problem
from orthocas.tasks.task import Task

CENTRE = (0.0, 0.52, 0.0, -1.05, 0.0, 0.79, 0.0)  #: q0 [rad]
HALF_WIDTH = np.pi / 4  #: [rad]


def urdf_path() -> AbstractContextManager[Path]:
    """The path of the arm's URDF file, valid while the context is open."""
    return as_file(files(__package__) / "data" / "iiwa7_r800.urdf")


def robot() -> Robot:
    """The arm with its tip at the flange (link_ee)."""
    with urdf_path() as path:
        return Robot.from_urdf(path, tip="link_ee")


def iiwa() -> Problem:
    """Seven joints, flange position, A = I, hypercube with edges of pi/2 around q0."""
    arm = robot()
    return Problem(arm, Task.position(arm), "euclidean", Box(CENTRE, HALF_WIDTH), "iiwa")
