"""Joint positions along a tool path, chosen one after the other, where coordinates cannot be held (ours)."""

from typing import TYPE_CHECKING

import numpy as np

from orthocas.checks import Array
from orthocas.following.costs import Costs

if TYPE_CHECKING:
    from orthocas.chart import Chart

_STEPS = 3  # at each place
_LONGEST = 0.1  # of a step [rad] or [m]
_DAMPING = 1e-2


def walk(chart: "Chart", costs: Costs, x: Array, q: Array) -> Array:
    """Joint positions (P, n) near task values x (P, m), from q (n,).

    At every place, steps of least norm towards x, and Gauss-Newton steps within the null space of J_x that lower the
    costs, as in resolved-rate control with gradient projection.
    """
    points = []
    for wanted in x:
        for _ in range(_STEPS):
            q = q + _step(chart, costs, wanted, q)
        points.append(q)
    return np.array(points)


def _step(chart: "Chart", costs: Costs, x: Array, q: Array) -> Array:
    J = chart.problem.task.batched_jacobian(q[None])[0].reshape(chart.m, chart.n)
    inner = np.linalg.svd(J)[2][chart.m :].T  # (n, r)
    residuals, gradients = (part[0] for part in costs(q[None]))
    G = gradients @ inner
    along = -inner @ np.linalg.solve(G.T @ G + _DAMPING * np.eye(chart.r), G.T @ residuals)
    task = np.linalg.pinv(J, rcond=1e-3) @ (x - chart.task(q))
    return _cut(task) + _cut(along)


def _cut(step: Array) -> Array:
    return np.asarray(step * min(1.0, _LONGEST / max(float(np.abs(step).max()), 1e-300)))
