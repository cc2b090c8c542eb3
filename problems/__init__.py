"""Named problems: the planar arms and the KUKA LBR iiwa 7 R800 of [AS2023], and a hexarotor (`propellers`).

The links of the planar arms weigh 3 kg, as those of the paper's 3R arm. They are 1 m long, which is our choice.
"""

from collections.abc import Callable
from contextlib import AbstractContextManager
from importlib.resources import as_file, files
from pathlib import Path

import numpy as np

from orthocas.problems import propellers
from orthocas.robots.robot import Robot
from orthocas.tasks.domains import Box, Torus
from orthocas.tasks.problem import Problem
from orthocas.tasks.task import Task
from orthocas.tools.checks import require_known

__all__ = ["get", "names"]

CENTRE = (0.0, 0.52, 0.0, -1.05, 0.0, 0.79, 0.0)  #: centre q0 of the iiwa's box [rad]
HALF_WIDTH = np.pi / 4  #: half-width of the iiwa's box [rad]
_BENT = Box((0.6, 0.8, 0.8), np.pi / 8)  #: domain of the planar 3R arm [rad], on which neither task is singular


def names() -> tuple[str, ...]:
    """Names of all named problems."""
    return tuple(_PROBLEMS)


def get(name: str) -> Problem:
    """Build a named problem.

    Raises:
        UnknownNameError: if there is no such problem.
    """
    require_known("problem", name, _PROBLEMS)
    return _PROBLEMS[name]()


def _arm(joints: int) -> Robot:
    """A planar arm with links of 1 m and 3 kg."""
    return Robot.planar(lengths=[1.0] * joints, masses=[3.0] * joints)


def planar_2r() -> Problem:
    """Planar arm with two joints, task x of the tip, A = I, domain the whole torus ([AS2023] Sec. 6.1).

    Self-motion manifolds are circles here, so no smooth coordinate is good everywhere. Expect bad regions near the
    singularities of the task.
    """
    robot = _arm(2)
    return Problem(robot, Task.position(robot, "x"), "euclidean", Torus(2), "planar_2r")


def planar_3r_x() -> Problem:
    """Planar arm with three joints, task x of the tip, A = M; exact coordinates exist. The box is our choice."""
    robot = _arm(3)
    return Problem(robot, Task.position(robot, "x"), "inertia", _BENT, "planar_3r_x")


def planar_3r_xy() -> Problem:
    """Planar arm with three joints, task (x, y) of the tip, A = M; no exact coordinates exist. Box: our choice."""
    robot = _arm(3)
    return Problem(robot, Task.position(robot, "xy"), "inertia", _BENT, "planar_3r_xy")


def urdf_path() -> AbstractContextManager[Path]:
    """The path of the iiwa's URDF file, valid while the context is open."""
    return as_file(files(__package__) / "data" / "iiwa7_r800.urdf")


def iiwa_robot() -> Robot:
    """The KUKA LBR iiwa 7 R800 with its tip at the flange (link_ee)."""
    with urdf_path() as path:
        return Robot.from_urdf(path, tip="link_ee")


def iiwa() -> Problem:
    """KUKA iiwa, task position of the flange, A = I, hypercube with edges of pi/2 rad around q0 ([AS2023] Sec. 9)."""
    arm = iiwa_robot()
    return Problem(arm, Task.position(arm), "euclidean", Box(CENTRE, HALF_WIDTH), "iiwa")


_PROBLEMS: dict[str, Callable[[], Problem]] = {
    **{build.__name__: build for build in (planar_2r, planar_3r_x, planar_3r_xy, iiwa)},
    "hexarotor": propellers.hexarotor,
}
