"""Stiffness from a frequency, because the scales and inertias of coordinates differ by orders of magnitude."""

import casadi as ca
import numpy as np

from orthocas.casadi_tools.batch import Batched, dense_function
from orthocas.chart import Chart
from orthocas.checks import Array, require_kind
from orthocas.control.gains import positive_gains
from orthocas.control.inertia import block_inertia
from orthocas.domains import sample_uniform
from orthocas.problem import Problem

SPRING_FREQUENCY = 4 * np.pi  #: [rad/s], 2 Hz: twice the frequency of the paper's low-pass filter
_SAMPLES, _SEED = 256, 0


def matched_stiffness(chart: Chart, frequency: float = SPRING_FREQUENCY) -> Array:
    """Stiffness K_i = omega^2 m_i, with the median m_i over the domain of the inertia of each entry of [x; xi], (n,).

    The inertias are the diagonal entries of M_x and M_xi.

    Args:
        chart: a chart with a closed expression.
        frequency: omega > 0 of the springs [rad/s].

    Source:
        ours
    """
    require_kind("chart", chart, Chart)
    q = ca.MX.sym("q", chart.n)
    J, M = chart.function("jacobian")(q), chart.problem.robot.mass_matrix(q)
    inertia = ca.diag(block_inertia(chart.n, (chart.m, chart.r))(J, M)[1])
    return _springs(chart.problem, q, inertia, frequency)


def matched_posture_stiffness(problem: Problem, frequency: float = SPRING_FREQUENCY) -> Array:
    """Stiffness of springs in the joints, from the diagonal of M in the same way, (n,)."""
    require_kind("problem", problem, Problem)
    q = ca.MX.sym("q", problem.n)
    return _springs(problem, q, ca.diag(problem.robot.mass_matrix(q)), frequency)


def _springs(problem: Problem, q: ca.MX, inertia: ca.MX, frequency: float) -> Array:
    omega = positive_gains("frequency", frequency, 1)
    samples = Batched(dense_function("inertia", [q], [inertia]))(sample_uniform(problem.domain, _SAMPLES, _SEED))[0]
    return np.asarray(omega**2 * np.nanmedian(samples, axis=0))
