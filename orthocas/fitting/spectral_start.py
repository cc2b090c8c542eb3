"""Spectral start: the best coordinates of a linear family for a quadratic loss, without an initial guess (ours)."""

import numpy as np
from numpy.typing import NDArray

from orthocas.checks import Array
from orthocas.fitting.basis_gradients import BasisGradients
from orthocas.fitting.gradients_of import gradients_of
from orthocas.parametrisations import LinearFamily
from orthocas.samples import Samples

_MUTUAL_WEIGHT = 1.0
_MIXING_ANGLE = np.radians(10)
_RIDGE = 1e-10  # relative; keeps the pencil definite if basis functions coincide on the samples


def spectral_start(
    family: LinearFamily,
    samples: Samples,
    kept: NDArray[np.bool_] | None = None,
    gradients: BasisGradients | None = None,
) -> Array:
    """Coefficients (r K,) of coordinates, found one after the other from generalised eigenproblems.

    Each coordinate minimises E |Pi_x grad xi|^2 subject to E |grad xi|^2 = 1, with the A-orthogonal projector Pi_x on
    the task gradients. A function of a coordinate xi_j that is already found would be a minimiser too, so each xi_j
    adds the term E (grad xi_j . grad xi)^2 / |grad xi_j|^2. All products are taken in the metric A^-1.

    Args:
        family: the coordinates.
        samples: samples of the family's joints.
        kept: the coefficients (r, K) that may differ from zero. Default: all.
        gradients: gradients of the basis, if there are some already. Default: those of the family.

    Source:
        ours, docs/derivations.md#spectral-start.
    """
    basis = gradients_of(family, samples.points.shape[1]) if gradients is None else gradients
    G = basis.dense(basis.at(samples.points), len(samples)).astype(np.float64, copy=False)  # (N, n, K)
    N, _, K = G.shape
    along_task = (samples.task_basis @ G).reshape(-1, K)  # e_i^T d psi, the components along the task gradients
    S = along_task.T @ along_task / N
    raised = G if samples.metric_inverse is None else samples.metric_inverse @ G
    T = G.reshape(-1, K).T @ raised.reshape(-1, K) / N
    T += _RIDGE * np.trace(T) / K * np.eye(K)
    allowed = np.ones((family.outputs, K), dtype=bool) if kept is None else kept
    C, left = np.zeros(allowed.shape), list(range(family.outputs))
    while left:
        classes = {
            allowed[j].tobytes(): j for j in reversed(left)
        }.values()  # one coordinate for all that allow the same
        j, c = min(((j, _smallest(S, T, allowed[j])) for j in classes), key=lambda pair: pair[1] @ S @ pair[1])
        left.remove(j)
        C[j] = c
        gradient = raised @ c  # (N, n)
        length = np.sqrt(np.maximum(np.einsum("sn,sn->s", gradient, G @ c), 1e-300))
        along = np.einsum("sn,snk->sk", gradient / length[:, None], G)
        S = S + _MUTUAL_WEIGHT * along.T @ along / N
    return _mixed(C, G, allowed).ravel()


def _smallest(S: Array, T: Array, free: NDArray[np.bool_]) -> Array:
    """The c with c^T T c = 1 and the smallest c^T S c, zero where it is not free, (K,)."""
    block = np.ix_(free, free)
    whitening = np.linalg.inv(np.linalg.cholesky(T[block])).T  # W^T T W = I
    c = np.zeros(len(free))
    c[free] = whitening @ np.linalg.eigh(whitening.T @ S[block] @ whitening)[1][:, 0]
    return c


def _mixed(C: Array, G: Array, allowed: NDArray[np.bool_]) -> Array:
    """Scale coordinates to a mean gradient length of 1, and mix neighbours slightly that allow the same coefficients.

    The spectral solution inherits the symmetries of the problem, and a symmetric point is often a saddle of the loss.
    """
    C = C / np.linalg.norm(G @ C.T, axis=1).mean(axis=0)[:, None]
    c, s = np.cos(_MIXING_ANGLE), np.sin(_MIXING_ANGLE)
    for j in np.flatnonzero((allowed[1:] == allowed[:-1]).all(axis=1)):
        C[j], C[j + 1] = c * C[j] + s * C[j + 1], c * C[j + 1] - s * C[j]
    return C
