"""Cosines, leaks, conditioning and orientation of coordinates at few samples, or of many joints, by LAPACK."""

import numpy as np

from orthocas.checks import Array
from orthocas.judging.pairs import pairs
from orthocas.samples import Samples


def judge_by_lapack(samples: Samples, J: Array) -> dict[str, Array]:
    """Like `judge`."""
    gradients, covectors, unit = samples.raised(J), J.transpose(0, 2, 1), _unit(J)
    own = np.sqrt(np.einsum("sij,sij->si", gradients, J))
    first, second = (np.array([pair[k] for pair in pairs(J.shape[1])], dtype=int) for k in (0, 1))
    in_metric = gradients @ covectors / own[:, :, None] / own[:, None, :]
    along = samples.task_basis @ covectors / own[:, None]
    return {
        "task_cosines": samples.unit_task_gradients @ unit.transpose(0, 2, 1),
        "mutual_cosines": np.einsum("spi,spi->sp", _unit(gradients)[:, first], unit[:, second]),
        "metric_mutual_cosines": in_metric[:, first, second],
        "leak_sines": np.linalg.norm(along, axis=1),
        "conditioning": _conditioning(along, in_metric),
        "signs": np.sign(np.linalg.det(np.concatenate([samples.task_jacobian, J], axis=1))),
    }


def _conditioning(along: Array, in_metric: Array) -> Array:
    """Roots of the smallest eigenvalues of [[I, along], [along^T, in_metric]], (N,)."""
    m = along.shape[1]
    gram = np.block([[np.broadcast_to(np.eye(m), (len(along), m, m)), along], [along.transpose(0, 2, 1), in_metric]])
    return np.asarray(np.sqrt(np.maximum(np.linalg.eigvalsh(gram)[:, 0], 0.0)))


def _unit(rows: Array) -> Array:
    """Rows (N, k, n) of Euclidean length 1."""
    unit: Array = rows / np.linalg.norm(rows, axis=2, keepdims=True)
    return unit
