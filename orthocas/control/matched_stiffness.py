"""Stiffness from a frequency, because the scales and inertias of coordinates differ by orders of magnitude."""

import numpy as np
import scipy
from numpy.typing import ArrayLike

from orthocas.chart import Chart
from orthocas.checks import Array, require_kind
from orthocas.control.gains import positive_gains
from orthocas.domains import sample_uniform
from orthocas.problem import Problem
from orthocas.robots.robot import Robot

SPRING_FREQUENCY = 8 * np.pi  #: [rad/s], 4 Hz: holds arms whose masses are 20 % off within 20 mm (docs/control.md)
_SAMPLES, _SEED = 256, 0


def matched_stiffness(chart: Chart, frequency: float = SPRING_FREQUENCY) -> Array:
    """Stiffness of [x; xi], (n,), with which the closed loop has its modes around a frequency.

    At rest the loop is M_phi dde + D de + K e = 0 with M_phi = (J M^-1 J^T)^-1, so the squared frequencies lambda_i of
    its modes are the eigenvalues of K^1/2 J M^-1 J^T K^1/2. K minimises the mean of sum_i log^2(lambda_i / omega^2)
    over the domain. The geometric mean of all modes is then omega. Single modes lie on both sides of it, because M_phi
    is not diagonal and varies; `modes` of a law tells where.

    Args:
        chart: a chart with a closed expression.
        frequency: omega > 0 of the springs [rad/s].

    Source:
        ours, docs/derivations.md#stiffness
    """
    require_kind("chart", chart, Chart)
    chart.function("xi")  # raises for grown charts
    points = _points(chart.problem)
    return _matched(mobility(chart, points, chart.problem.robot), frequency)


def matched_posture_stiffness(problem: Problem, frequency: float = SPRING_FREQUENCY) -> Array:
    """Stiffness of springs in the joints, from the modes of (K_q, M) in the same way, (n,)."""
    require_kind("problem", problem, Problem)
    return _matched(np.linalg.inv(problem.robot.mass_matrix(_points(problem))), frequency)


def mobility(chart: Chart, points: ArrayLike, robot: Robot) -> Array:
    """M_phi^-1 = J M^-1 J^T of a robot at points (N, n), (N, n, n)."""
    J, M = chart.jacobian(points), robot.mass_matrix(points)
    return np.asarray(J @ np.linalg.solve(M, J.transpose(0, 2, 1)))


def _points(problem: Problem) -> Array:
    return sample_uniform(problem.domain, _SAMPLES, _SEED)


def _matched(mobilities: Array, frequency: float) -> Array:
    """The stiffness for M_phi^-1 at several postures, (N, n, n); singular postures are left out."""
    omega = positive_gains("frequency", frequency, 1)
    W = mobilities[np.isfinite(mobilities).all(axis=(1, 2))]
    W = W[np.linalg.eigvalsh(W)[:, 0] > 0]
    start = -np.log(np.median(np.diagonal(W, axis1=1, axis2=2), axis=0))  # the solution where W is diagonal
    return np.asarray(omega**2 * np.exp(scipy.optimize.minimize(_spread, start, (W,), method="BFGS", jac=True).x))


def _spread(log_stiffness: Array, W: Array) -> tuple[float, Array]:
    """Mean of sum_i log^2(lambda_i) for K = exp(log_stiffness), and its gradient.

    With unit eigenvectors v_i, d log(lambda_i) / d log(K_j) = v_ij^2.
    """
    root = np.exp(log_stiffness / 2)
    values, vectors = np.linalg.eigh(root[:, None] * W * root)
    logs = np.log(values.clip(np.finfo(float).tiny))
    return float((logs**2).sum(axis=1).mean()), 2 * (vectors**2 @ logs[..., None])[..., 0].mean(axis=0)
