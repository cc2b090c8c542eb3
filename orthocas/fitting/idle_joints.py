"""Idle joints: joints on which the task does not depend are exact coordinates xi = q_k (ours)."""

import numpy as np

from orthocas.problem import Problem
from orthocas.samples import Samples

_NEGLIGIBLE = 1e-10  # robot files give angles with ten decimals


def idle_joints(problem: Problem, samples: Samples) -> list[int]:
    """Joints k on which the task does not depend, and which the metric does not couple to the others.

    At every sample column k of J_x vanishes, row k of A^-1 is zero off the diagonal, and A does not depend on q_k. Then
    J_x A^-1 e_k = 0, so xi = q_k is exact and orthogonal to every coordinate of the other joints. The rest of the
    problem does not depend on joint k.
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
