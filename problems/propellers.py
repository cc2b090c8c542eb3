"""A hexarotor whose propellers make a wrench: a problem that is no arm, with exact coordinates for m = 4.

Thrusts grow with the square of the spin rates, so a wrench h(w) = B f(w) has components f_k(w_k) = w_k^2. Its gradients
are the fields X_j with X_j,k = B_jk f_k'(w_k). Each component depends on its own w_k only, so
[X_i, X_j]_k = (B_ik B_jk - B_jk B_ik) f_k' f_k'' = 0: they commute, and exact coordinates exist ([F2026]). In
s_k = int dw_k / f_k' = ln(w_k) / 2, the fields are the constant rows of B, and xi = N^T ln(w) with B N = 0.
"""

import casadi as ca
import numpy as np
import scipy

from orthocas.robots.robot import Robot
from orthocas.robots.tree import KinematicTree
from orthocas.tasks.domains import Box
from orthocas.tasks.problem import Problem
from orthocas.tasks.task import Task
from orthocas.tools.checks import Array

PROPELLERS = 6
DRAG = 0.2  #: torque of a propeller about its axis, relative to its thrust times the length of an arm
HALF_WIDTH = 0.4  #: of the spin rates, relative to those of hovering


def allocation() -> Array:
    """B: thrust, roll, pitch and yaw of unit thrusts, with those of hovering adding up to 1, (4, 6)."""
    angle = np.arange(PROPELLERS) * np.pi / 3
    yaw = DRAG * (-1.0) ** np.arange(PROPELLERS)
    return np.stack([np.ones(PROPELLERS), np.sin(angle), -np.cos(angle), yaw]) / PROPELLERS


def logarithms(w: ca.SX) -> ca.SX:
    """The exact coordinates N^T ln(w), (2, 1), for spin rates w > 0 (6, 1)."""
    return ca.DM(scipy.linalg.null_space(allocation()).T) @ ca.log(w)


def hexarotor() -> Problem:
    """Six spin rates relative to hovering, the wrench along the axes that they turn, A = I ([F2026])."""
    robot = Robot(_sliders(PROPELLERS))
    task = Task.custom(
        robot, "wrench", lambda w: ca.DM(allocation()) @ w**2, ("thrust", "roll", "pitch", "yaw"), ("", "", "", "")
    )
    return Problem(robot, task, "euclidean", Box(np.ones(PROPELLERS), HALF_WIDTH), "hexarotor")


def _sliders(count: int) -> KinematicTree:
    """Independent numbers as a tree: unit masses that slide along z from a common base."""
    unit, zeros, none = np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3)), np.full(count, np.inf)
    return KinematicTree(
        joint_names=tuple(f"w{k + 1}" for k in range(count)),
        joint_kinds=tuple("prismatic" for _ in range(count)),
        parents=(-1,) * count,
        rotations=unit,
        translations=zeros,
        masses=np.ones(count),
        centres=zeros,
        inertias=unit,
        armatures=np.zeros(count),
        lower=np.zeros(count),
        upper=none,
        effort_limits=none,
        velocity_limits=none,
        tip_name="propeller",
        tip_parent=count - 1,
        tip_rotation=np.eye(3),
        tip_translation=np.zeros(3),
        gravity=np.zeros(3),
    )
