"""Inertia in task and extra coordinates, in blocks, and a measure of how close the gradients are to dependent."""

import casadi as ca
import numpy as np

from orthocas.casadi_tools.batch import Batched, dense_function
from orthocas.control.linear_algebra import kind_of, spd_inverse
from orthocas.domains import sample_uniform
from orthocas.metrics import Metric
from orthocas.problem import Problem

_SAMPLES, _SEED = 256, 0


def block_inertia(n: int, blocks: tuple[int, ...]) -> ca.Function:
    """J (k, n), A (n, n) -> B = A^-1 J^T (n, k), Lambda (k, k), volume (1, 1).

    The rows of J are divided into blocks, k = sum(blocks). Lambda is block diagonal with (J_b A^-1 J_b^T)^-1, [AS2023]
    eqs. (30), (31); one block gives the full M_phi. The volume is the product of det(J_b A^-1 J_b^T), which is 0 in
    singularities.
    """
    k = sum(blocks)
    kind = kind_of(n)
    J, A = kind.sym("J", k, n), kind.sym("A", n, n)
    B = spd_inverse(A)[0] @ J.T
    parts, volume, start = [], kind(1), 0
    for size in blocks:
        rows = list(range(start, start + size))
        inverse, determinant = spd_inverse(J[rows, :] @ B[:, rows])
        parts.append(inverse)
        volume *= determinant
        start += size
    return ca.Function("inertia", [J, A], [ca.densify(B), ca.densify(ca.diagcat(*parts)), volume])


def median_volume(problem: Problem, jacobian: ca.Function, metric: str | Metric, blocks: tuple[int, ...]) -> float:
    """Median of the volume of `block_inertia` over the domain. It sets the scale for "near singular"."""
    metric = Metric.from_spec(problem.robot, metric) if isinstance(metric, str) else metric
    q = ca.MX.sym("q", problem.n)
    volume = block_inertia(problem.n, blocks)(jacobian(q), metric.function(q))[2]
    points = sample_uniform(problem.domain, _SAMPLES, _SEED)
    return float(np.nanmedian(Batched(dense_function("volume", [q], [volume]))(points)[0]))
