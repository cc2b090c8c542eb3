"""Idle joints: joints that the task does not feel give exact coordinates xi = q_k (ours)."""

import numpy as np

from orthocas.samples import Samples

_NEGLIGIBLE = 1e-12


def idle_joints(samples: Samples) -> list[int]:
    """Joints k whose column of J_x vanishes and whose row of A^-1 is zero off the diagonal, at every sample.

    Then J_x A^-1 e_k = 0, so xi = q_k is exact, and orthogonal to every coordinate that does not use q_k.
    """
    J = samples.task_jacobian
    size = np.abs(J).max(axis=(0, 1))
    idle = size <= _NEGLIGIBLE * size.max()
    if samples.metric_inverse is not None:
        B = np.abs(samples.metric_inverse).max(axis=0)
        off_diagonal = (B - np.diag(B.diagonal())).max(axis=1)
        idle &= off_diagonal <= _NEGLIGIBLE * B.diagonal()
    return [int(k) for k in np.flatnonzero(idle)]
