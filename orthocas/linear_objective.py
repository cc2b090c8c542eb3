"""The loss of families linear in theta: basis gradients are sampled once, then all is dense products (ours)."""

import numpy as np

from orthocas.batch import evaluate_batch
from orthocas.checks import Array
from orthocas.loss import Weights, pairs, residual_function
from orthocas.parametrisations.product_basis import LinearFamily
from orthocas.samples import Samples

_CHUNK = 512  # samples per block of the Gauss-Newton matrix: the rows stay in the cache


class LinearObjective:
    """Mean loss (25) of xi = C psi(q) on fixed samples, with gradient and Gauss-Newton matrix.

    With G = d psi / dq sampled once, (N, n, K), the coordinate gradients are J_xi = C G^T. Residuals rho and their
    derivatives with respect to J_xi come from CasADi, sample by sample. The residual of task i and coordinate j
    depends on row j of C only, so the Gauss-Newton matrix is built block by block from few rows per sample.
    """

    def __init__(self, family: LinearFamily, samples: Samples, weights: Weights) -> None:
        self.family = family
        self.r, self.K, self.N = family.outputs, len(family.terms), len(samples)
        self.m, self.n = samples.task_jacobian.shape[1:]
        self.G = family.basis_gradients(samples.points)  # (N, n, K)
        inverse = samples.metric_inverse
        self._data = (samples.unit_task_gradients, *(() if inverse is None else (inverse,)))
        both = residual_function(self.n, self.m, self.r, inverse is None, weights)
        self._residuals = both.factory("residuals_only", both.name_in(), both.name_out()[:1])
        self._residuals_and_derivative = both

    def coordinate_jacobians(self, theta: Array) -> Array:
        """J_xi at every sample, (N, r, n)."""
        C = theta.reshape(self.r, self.K)
        return (self.G.reshape(-1, self.K) @ C.T).reshape(self.N, self.n, self.r).transpose(0, 2, 1)

    def value(self, theta: Array) -> float:
        """L(theta)."""
        (rho,) = evaluate_batch(self._residuals, self.coordinate_jacobians(theta), *self._data)
        return float(np.sum(rho**2) / (2 * self.N))

    def value_and_gradient(self, theta: Array) -> tuple[float, Array]:
        """L(theta) and dL/dtheta."""
        rho, derivative = self._linearised_residuals(theta)
        return float(np.sum(rho**2) / (2 * self.N)), self._gradient(rho, derivative)

    def normal_equations(self, theta: Array) -> tuple[float, Array, Array]:
        """L(theta), its gradient, and the Gauss-Newton matrix, whose products are taken in single precision."""
        rho, derivative = self._linearised_residuals(theta)
        value = float(np.sum(rho**2) / (2 * self.N))
        return value, self._gradient(rho, derivative), self._gauss_newton_matrix(derivative)

    def _linearised_residuals(self, theta: Array) -> tuple[Array, Array]:
        """Residuals (N, p) and d rho / d J_xi as (N, p, r, n)."""
        rho, derivative = evaluate_batch(self._residuals_and_derivative, self.coordinate_jacobians(theta), *self._data)
        return rho, derivative.reshape(self.N, -1, self.r, self.n)

    def _gradient(self, rho: Array, derivative: Array) -> Array:
        forces = np.einsum("sp,sprn->snr", rho, derivative, optimize=True).reshape(-1, self.r)
        gradient: Array = (self.G.reshape(-1, self.K).T @ forces).T.ravel() / self.N
        return gradient

    def _gauss_newton_matrix(self, derivative: Array) -> Array:
        r, K = self.r, self.K
        blocks = np.zeros((r, r, K, K))
        rows = [_rows_of(j, self.m, r) for j in range(r)]
        D = [np.ascontiguousarray(derivative[:, rows[j], j, :], dtype=np.float32) for j in range(r)]
        for start in range(0, self.N, _CHUNK):
            part = slice(start, start + _CHUNK)
            G = self.G[part].astype(np.float32)
            X = [D[j][part] @ G for j in range(r)]  # d rho / d C_j, (chunk, rows, K)
            for j in range(r):
                flat = X[j].reshape(-1, K)
                blocks[j, j] += flat.T @ flat
            for p, (i, j) in enumerate(pairs(r)):
                row = r * self.m + p
                blocks[i, j] += X[i][:, rows[i].index(row)].T @ X[j][:, rows[j].index(row)]
        for i, j in pairs(r):
            blocks[j, i] = blocks[i, j].T
        return blocks.transpose(0, 2, 1, 3).reshape(r * K, r * K) / self.N


def _rows_of(j: int, m: int, r: int) -> list[int]:
    """Residuals that depend on coordinate j: its task cosines, and the pairs it is part of."""
    return [*range(j * m, (j + 1) * m), *(r * m + p for p, pair in enumerate(pairs(r)) if j in pair)]
