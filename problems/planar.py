"""The planar arms of [AS2023] (Fig. 5): links of 1 m and 3 kg with uniform mass (lengths are ours)."""

import numpy as np

from orthocas.robots.robot import Robot
from orthocas.tasks.domains import Box, Torus
from orthocas.tasks.problem import Problem
from orthocas.tasks.task import Task

_BENT = Box((0.6, 0.8, 0.8), np.pi / 8)  # [rad]; neither task is singular here


def _arm(joints: int) -> Robot:
    return Robot.planar(lengths=[1.0] * joints, masses=[3.0] * joints)


def planar_2r() -> Problem:
    """Two joints, task x of the tip, A = I, whole torus ([AS2023] Sec. 6.1).

    Self-motion manifolds are circles here, so no smooth coordinate is good everywhere. Expect bad regions near the
    singularities of the task.
    """
    robot = _arm(2)
    return Problem(robot, Task.position(robot, "x"), "euclidean", Torus(2), "planar_2r")


def planar_3r_x() -> Problem:
    """Three joints, task x of the tip, A = M. Exact coordinates exist. The box avoids singularities (ours)."""
    robot = _arm(3)
    return Problem(robot, Task.position(robot, "x"), "inertia", _BENT, "planar_3r_x")


def planar_3r_xy() -> Problem:
    """Three joints, task (x, y) of the tip, A = M. No exact coordinates exist. Same box as planar_3r_x (ours)."""
    robot = _arm(3)
    return Problem(robot, Task.position(robot, "xy"), "inertia", _BENT, "planar_3r_xy")
