"""Whole turns of joints that turn without end: they change the coordinates, but not the posture."""

from typing import Any

import casadi as ca
import numpy as np

from orthocas.bases.family import CyclicParametrisation
from orthocas.charts.chart import Chart
from orthocas.charts.coordinates import Coordinates
from orthocas.charts.phi import shortest
from orthocas.tools.checks import Array


def without_turns(chart: Chart, difference: Any) -> Any:
    """A difference of two phi (n, 1) without whole turns of unbounded joints, and of circle-valued coordinates.

    A turn of joint k changes phi by the constant 2 pi dphi/dq_k, a column of T (n, u), if the coordinates are linear in
    q_k. The difference becomes e - T round(T^+ e). So sensors may report angles with or without whole turns, and the
    spring takes the shorter way.

    Args:
        chart: the chart.
        difference: phi - phi_d, an expression.
    """
    difference = shortest(difference, chart.turns)
    T = _turns(chart)
    if T.shape[1] == 0:
        return difference
    whole = ca.floor(ca.DM(np.linalg.pinv(T)) @ difference + 0.5)
    return difference - ca.DM(T) @ whole


def _turns(chart: Chart) -> Array:
    """What a turn of each unbounded joint adds to phi, (n, u)."""
    problem, coordinates = chart.problem, chart.coordinates
    if problem.domain.full_turns or not isinstance(coordinates, Coordinates):
        return np.zeros((chart.n, 0))
    chosen = coordinates.parametrisation
    cyclic = chosen.cyclic if isinstance(chosen, CyclicParametrisation) else ()
    joints = [
        k
        for k in problem.domain.unbounded
        if not problem.robot.tree.prismatic[k] and (k in coordinates.idle or problem.robot.joint_names[k] in cyclic)
    ]
    T = 2 * np.pi * chart.jacobian(problem.domain.centre)[:, joints]
    T[: chart.m] = 0.0
    return np.asarray(T)
