"""The loss of families linear in theta: basis gradients are sampled once, then all is dense products (ours)."""

from collections.abc import Iterator
from copy import copy
from dataclasses import replace
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray

from orthocas.batch import Batched
from orthocas.checks import Array
from orthocas.loss import LossShape, Weights, loss_hessian_function, pairs, residual_functions
from orthocas.parametrisations.product_basis import LinearFamily
from orthocas.samples import Draw, Samples

_CHUNK = 512  # samples per block of the Gauss-Newton matrix: the rows stay in the cache
_STRIDE = 2  # the Gauss-Newton matrix is a mean too, and half of the samples tell it well enough


class LinearObjective:
    """Mean loss (25) of xi = C psi(q) on fixed samples, with gradient, Gauss-Newton matrix and Hessian.

    With G = d psi / dq sampled once, (N, n, K), the coordinate gradients are J_xi = C G^T. Residuals rho and their
    derivatives with respect to J_xi come from CasADi, sample by sample. The residual of task i and coordinate j
    depends on row j of C only, so the Gauss-Newton matrix is built block by block from few rows per sample.

    Args:
        family: the coordinates.
        samples: fixed samples of the family's joints.
        weights: of the loss.
        start: parameters, (size,), whose orientation the regularity term keeps.
        draw: where fresh samples come from.
    """

    def __init__(self, family: LinearFamily, samples: Samples, weights: Weights, start: Array, draw: Draw) -> None:
        self.family, self._draw = family, draw
        self.r, self.K = family.outputs, len(family.terms)
        m, self.n = samples.task_jacobian.shape[1:]
        self._use(LossShape(self.n, m, self.r, samples.metric_inverse is None, weights))
        self._put(samples)
        self._orientation = samples.orientation(self.coordinate_jacobians(start)) if self._shape.regular else None
        self._data = samples.loss_data(self._orientation)

    def _use(self, shape: LossShape) -> None:
        self._shape = shape
        self._residuals, self._linearised = (Batched(function) for function in residual_functions(shape))

    @cached_property
    def _curvature(self) -> Batched:
        return Batched(loss_hessian_function(self._shape))

    def _put(self, samples: Samples) -> None:
        self.N, self.G = len(samples), self.family.basis_gradients(samples.points)  # (N, n, K)

    def batches(self, size: int, count: int, seed: tuple[int, ...]) -> Iterator[Self]:
        """The same loss on `count` fresh sample sets of `size` each."""
        samples = self._draw(size * count, seed)
        for start in range(0, len(samples), size):
            part, other = samples[start : start + size], copy(self)
            other._put(part)
            other._data = part.loss_data(self._orientation)
            yield other

    def coordinate_jacobians(self, theta: Array) -> Array:
        """J_xi at every sample, (N, r, n)."""
        C = theta.reshape(self.r, self.K)
        return (self.G.reshape(-1, self.K) @ C.T).reshape(self.N, self.n, self.r).transpose(0, 2, 1)

    def value(self, theta: Array) -> float:
        """L(theta)."""
        (rho,) = self._residuals(self.coordinate_jacobians(theta), *self._data)
        return self._mean_loss(rho)

    def value_and_gradient(self, theta: Array) -> tuple[float, Array]:
        """L(theta) and dL/dtheta."""
        rho, *derivatives = self._linearised(self.coordinate_jacobians(theta), *self._data)
        return self._mean_loss(rho), self._gradient(rho, derivatives)

    def normal_equations(self, theta: Array) -> tuple[float, Array, Array]:
        """L(theta), its gradient, and the Gauss-Newton matrix, whose products are taken in single precision."""
        rho, *derivatives = self._linearised(self.coordinate_jacobians(theta), *self._data)
        H = self._gauss_newton_matrix(derivatives[: self.r])
        if self._shape.regular:
            H += self._regularity_matrix(derivatives[-1], rho[:, -1] > 0)
        return self._mean_loss(rho), self._gradient(rho, derivatives), H

    def hessian(self, theta: Array) -> Array:
        """d^2L/dtheta^2, exact, (size, size)."""
        r, n, K = self.r, self.n, self.K
        (W,) = self._curvature(self.coordinate_jacobians(theta), *self._data)
        W = W.reshape(-1, r, n, r, n)
        H = np.empty((r, K, r, K))
        for i in range(r):
            for j in range(i + 1):
                raised = W[:, i, :, j] @ self.G  # (N, n, K)
                H[i, :, j] = self.G.reshape(-1, K).T @ raised.reshape(-1, K) / self.N
                H[j, :, i] = H[i, :, j].T
        return H.reshape(r * K, r * K)

    @property
    def weights(self) -> Weights:
        """Weights of the loss."""
        return self._shape.weights

    def reweighted(self, weights: Weights) -> Self:
        """The same loss on the same samples with other weights; a regularity term cannot be added later."""
        assert self._shape.regular or weights.regularity == 0
        other = copy(self)
        other.__dict__.pop("_curvature", None)
        other._use(replace(self._shape, weights=weights))
        other._data = self._data[: len(other._shape.symbols())]  # the null basis is the last
        return other

    def _mean_loss(self, rho: Array) -> float:
        return float(np.vdot(rho, rho) / (2 * self.N))

    def _gradient(self, rho: Array, derivatives: list[Array]) -> Array:
        forces = np.stack([self._along(rho, D, j) for j, D in enumerate(derivatives[: self.r])], axis=2)  # (N, n, r)
        if self._shape.regular:
            forces += (rho[:, -1, None, None] * derivatives[-1]).transpose(0, 2, 1)
        gradient: Array = (self.G.reshape(-1, self.K).T @ forces.reshape(-1, self.r)).T.ravel() / self.N
        return gradient

    def _along(self, rho: Array, derivative: Array, j: int) -> Array:
        """rho^T d rho / d(row j of J_xi), (N, n)."""
        product: Array = (rho[:, None, self._shape.rows_of(j)] @ derivative)[:, 0]
        return product

    def _gauss_newton_matrix(self, derivatives: list[Array]) -> Array:
        """Part of the residuals of (24), block by block for pairs of coordinates, from every second sample."""
        r, K = self.r, self.K
        blocks = np.zeros((r, r, K, K))
        rows = [self._shape.rows_of(j) for j in range(r)]
        D = [derivative[::_STRIDE].astype(np.float32) for derivative in derivatives]
        used = len(D[0])
        for start in range(0, used, _CHUNK):
            part = slice(start, start + _CHUNK)
            G = self.G[::_STRIDE][part].astype(np.float32)
            X = [D[j][part] @ G for j in range(r)]  # d rho / d C_j, (chunk, rows, K)
            for j in range(r):
                flat = X[j].reshape(-1, K)
                blocks[j, j] += flat.T @ flat
            for p, (i, j) in enumerate(pairs(r)):
                row = r * self._shape.m + p
                blocks[i, j] += X[i][:, rows[i].index(row)].T @ X[j][:, rows[j].index(row)]
        for i, j in pairs(r):
            blocks[j, i] = blocks[i, j].T
        return blocks.transpose(0, 2, 1, 3).reshape(r * K, r * K) / used

    def _regularity_matrix(self, derivative: Array, active: NDArray[np.bool_]) -> Array:
        """Part of the regularity residual, which couples all coordinates but acts at few samples."""
        rows = (derivative[active].astype(np.float32) @ self.G[active].astype(np.float32)).reshape(-1, self.r * self.K)
        product: Array = (rows.T @ rows).astype(float) / self.N
        return product
