"""[AS2023] Fig. 9: orthogonal foliations of the plane of two joints for dynamic consistency, A = M.

M^-1 J_x^T is tangent to the leaves of xi, to which J_xi is orthogonal; M^-1 J_xi^T is tangent to the leaves of the task,
to which J_x is orthogonal. Arrows have one length: their sizes differ by an order of magnitude and more.
"""

from typing import Any

import numpy as np
from matplotlib.lines import Line2D

from orthocas.chart import Chart
from orthocas.checks import Array
from orthocas.reproduce.drawing import Drawing
from orthocas.reproduce.planar_flow import (
    EXTREME,
    cell_centres,
    flow_lines,
    grown_chart,
    planar_problem,
    task_grid,
)
from orthocas.reproduce.style import INK, LABEL, TASK, TICK, joint_axis, new_figure
from orthocas.samples import samples_at

_CENTRE, _HALF = np.array([3 * np.pi / 8, np.pi / 4]), np.pi / 4  # of the patch [rad]
_LEVELS = np.array([-0.2, 0.2, 0.6, 1.0, 1.4])  # of S_-3 to S_1 [m]
_VALUES = np.array([0.7, 1.05, 1.4, 1.75, 2.1, 2.45])  # of xi [rad]
_CROSSINGS = ((1.0, 0.7), (0.6, 1.75), (0.2, 1.05), (-0.2, 1.75))  # (x, xi) where arrows stand
_LENGTH = 0.26  # of arrows [rad]
_ARROWS = {  # text -> colour, as in the paper
    r"$J_x$": "#0b2f6b",
    r"$M^{-1}J_x^\mathsf{T}$": INK,
    r"$J_\xi$": "#f28e2b",
    r"$M^{-1}J_\xi^\mathsf{T}$": "#c8102e",
}
