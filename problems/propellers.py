"""A hexarotor whose spin rates produce a wrench: a problem without an arm, with exact coordinates for m = 4.

The thrusts are the squares of the spin rates w, so the wrench is h(w) = B f(w) with f_k = w_k^2. The task gradients are
the vector fields X_j with the components X_j,k = B_jk f_k'(w_k). Component k depends on w_k only, so
[X_i, X_j]_k = (B_ik B_jk - B_jk B_ik) f_k' f_k'' = 0. The fields commute, so exact coordinates exist ([F2026]). In the
variables s_k = int dw_k / f_k' = ln(w_k) / 2, the fields are the constant rows of B, which gives xi = N^T ln(w) with
B N = 0.
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
DRAG = 0.2  #: torque of a propeller about its axis, relative to thrust times distance from the centre
HALF_WIDTH = 0.4  #: half-width of the domain, relative to the spin rate of hovering


def allocation() -> Array:
    """The matrix B (4, 6): total thrust and roll, pitch and yaw torques of the propellers at unit spin rates.

    It is scaled so that the total thrust is 1 in hovering, where all spin rates are 1.
    """
    angle = np.arange(PROPELLERS) * np.pi / 3
    yaw = DRAG * (-1.0) ** np.arange(PROPELLERS)
    return np.stack([np.ones(PROPELLERS), np.sin(angle), -np.cos(angle), yaw]) / PROPELLERS


def logarithms(w: ca.SX) -> ca.SX:
    """The exact coordinates N^T ln(w), (2, 1), for spin rates w > 0 (6, 1)."""
    return ca.DM(scipy.linalg.null_space(allocation()).T) @ ca.log(w)


def hexarotor() -> Problem:
    """Hexarotor: six spin rates relative to hovering as joints, task thrust and three torques, A = I ([F2026])."""
    robot = Robot(_sliders(PROPELLERS))
    task = Task.custom(
        robot, "wrench", lambda w: ca.DM(allocation()) @ w**2, ("thrust", "roll", "pitch", "yaw"), ("", "", "", "")
    )
    return Problem(robot, task, "euclidean", Box(np.ones(PROPELLERS), HALF_WIDTH), "hexarotor")


def _sliders(count: int) -> KinematicTree:
    """A kinematic tree for independent variables: unit masses that slide along z from a common base."""
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
