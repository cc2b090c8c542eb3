"""Idle joints: joints that the task does not feel give exact coordinates xi = q_k (ours)."""

import numpy as np

from orthocas.problem import Problem
from orthocas.samples import Samples

_NEGLIGIBLE = 1e-10  # angles with ten decimals in robot files


def idle_joints(problem: Problem, samples: Samples) -> list[int]:
    """Joints k that the task does not feel and the metric keeps apart.

    The column of J_x vanishes and the row of A^-1 is zero off the diagonal at every sample, and A does not depend on
    q_k. Then J_x A^-1 e_k = 0, so xi = q_k is exact, orthogonal to every coordinate of the other joints, and the rest
    of the problem does not know of joint k.
    """
    J = samples.task_jacobian
    size = np.abs(J).max(axis=(0, 1))
    idle = size <= _NEGLIGIBLE * size.max()
    if samples.metric_inverse is not None:
        B = np.abs(samples.metric_inverse).max(axis=0)
        off_diagonal = (B - np.diag(B.diagonal())).max(axis=1)
        idle &= off_diagonal <= _NEGLIGIBLE * B.diagonal()
        felt_by_metric = problem.metric.function.jac_sparsity(0, 0).get_col()
        idle[felt_by_metric] = False
    return [int(k) for k in np.flatnonzero(idle)]
