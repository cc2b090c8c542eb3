"""Spectral start: the best coordinates of a linear family for a quadratic loss, without an initial guess (ours)."""

import numpy as np

from orthocas.checks import Array
from orthocas.fitting.basis_gradients import BasisGradients
from orthocas.parametrisations import LinearFamily
from orthocas.samples import Samples

_MUTUAL_WEIGHT = 1.0
_MIXING_ANGLE = np.radians(10)
_RIDGE = 1e-10  # relative; keeps the pencil definite if basis functions coincide on the samples


def spectral_start(family: LinearFamily, samples: Samples) -> Array:
    """Coefficients (r K,) of coordinates, found one after the other from generalised eigenproblems.

    Each coordinate minimises E |Pi_x grad xi|^2 subject to E |grad xi|^2 = 1, with the A-orthogonal projector Pi_x on
    the task gradients. A function of a coordinate xi_j that is already found would be a minimiser too, so each xi_j
    adds the term E (grad xi_j . grad xi)^2 / |grad xi_j|^2. All products are taken in the metric A^-1.

    Source:
        ours, docs/derivations.md#spectral-start.
    """
    gradients = BasisGradients(family, samples.points.shape[1])
    G = gradients.dense(gradients.at(samples.points), len(samples))  # (N, n, K)
    N, _, K = G.shape
    along_task = (samples.task_basis @ G).reshape(-1, K)  # e_i^T d psi, the components along the task gradients
    S = along_task.T @ along_task / N
    raised = G if samples.metric_inverse is None else samples.metric_inverse @ G
    T = G.reshape(-1, K).T @ raised.reshape(-1, K) / N
    T += _RIDGE * np.trace(T) / K * np.eye(K)
    whitening = np.linalg.inv(np.linalg.cholesky(T)).T  # W^T T W = I
    found = []
    for _ in range(family.outputs):
        c = whitening @ np.linalg.eigh(whitening.T @ S @ whitening)[1][:, 0]
        found.append(c)
        gradient = raised @ c  # (N, n)
        length = np.sqrt(np.maximum(np.einsum("sn,sn->s", gradient, G @ c), 1e-300))
        along = np.einsum("sn,snk->sk", gradient / length[:, None], G)
        S = S + _MUTUAL_WEIGHT * along.T @ along / N
    return _mixed(np.array(found), G).ravel()


def _mixed(C: Array, G: Array) -> Array:
    """Scale coordinates to a mean gradient length of 1, and mix neighbours slightly.

    The spectral solution inherits the symmetries of the problem, and a symmetric point is often a saddle of the loss.
    """
    C = C / np.linalg.norm(G @ C.T, axis=1).mean(axis=0)[:, None]
    c, s = np.cos(_MIXING_ANGLE), np.sin(_MIXING_ANGLE)
    for j in range(len(C) - 1):
        C[j], C[j + 1] = c * C[j] + s * C[j + 1], c * C[j + 1] - s * C[j]
    return C
