"""The loss of families linear in theta: basis gradients are sampled once, then all is dense products (ours)."""

from collections.abc import Iterator
from copy import copy
from dataclasses import replace
from functools import cached_property
from typing import Self

import numpy as np

from orthocas.casadi_tools.columns import blocked, by_sample, shares
from orthocas.checks import Array
from orthocas.fitting.loss import (
    LossShape,
    Weights,
    curvature_columns,
    loss_columns,
    pairs,
    residual_columns,
    value_columns,
)
from orthocas.parametrisations.product_basis import LinearFamily
from orthocas.samples import Draw, Samples, even_parts

_CHUNK = 512  # samples per block of the Gauss-Newton matrix: the rows stay in the cache
_STRIDE = 2  # the Gauss-Newton matrix is a mean too, and half of the samples tell it well enough


class BasisObjective:
    """Mean loss (25) of xi = C psi(q) on fixed samples, with gradient, Gauss-Newton matrix and Hessian.

    With the basis gradients G = d psi / dq sampled once, the coordinate gradients are J_xi = C G^T. The loss of one
    sample and its derivatives with respect to J_xi come from CasADi. The residual of task i and coordinate j depends on
    row j of C only, so the Gauss-Newton matrix is built block by block from few rows per sample.

    Samples lie in blocks as `orthocas.casadi_tools.columns` has them, and of G only the entries of the terms that
    depend on a joint are stored: G is (B, n, W, c), J_xi is (B, n, r, c).

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
        self._shape = LossShape(self.n, m, self.r, samples.metric_inverse is None, weights)
        self._put(samples)
        self._orientation = samples.orientation(self.coordinate_jacobians(start)) if self._shape.regular else None
        self._data = [blocked(part) for part in samples.loss_data(self._orientation)]

    def _put(self, samples: Samples) -> None:
        self.N, self.G = len(samples), self.family.basis_gradients(samples.points)
        self._share = shares(self.N)

    def batches(self, size: int, count: int, seed: tuple[int, ...]) -> Iterator[Self]:
        """The same loss on `count` fresh sample sets of `size` each."""
        for part in even_parts(self._draw(size * count, seed), count):
            other = copy(self)
            for stale in ("_dense", "_half"):
                other.__dict__.pop(stale, None)
            other._put(part)
            other._data = [blocked(data) for data in part.loss_data(self._orientation)]
            yield other

    def coordinate_jacobians(self, theta: Array) -> Array:
        """J_xi at every sample, (N, r, n)."""
        return by_sample(self._jacobian_entries(theta).reshape(-1, self.n, self.r, self.G.shape[3]), self.N)

    def value(self, theta: Array) -> float:
        """L(theta)."""
        (losses,) = value_columns(self._shape)(self._jacobian_entries(theta), *self._data)
        return float(np.vdot(losses[:, 0], self._share))

    def value_and_gradient(self, theta: Array) -> tuple[float, Array]:
        """L(theta) and dL/dtheta."""
        C, value, gradient = self._by_joint(theta), 0.0, np.zeros((self.n, self.r, self.G.shape[2]))
        on_block = loss_columns(self._shape).on_one_block()
        for G, share, *data in zip(self.G, self._share, *self._data, strict=True):  # G leaves memory only once
            losses, slopes = on_block((C @ G).reshape(self.n * self.r, -1), *data)
            value += float(losses[0] @ share)
            gradient += (slopes * share).reshape(self.n, self.r, -1) @ G.transpose(0, 2, 1)
        return value, self._collected(gradient)

    def normal_equations(self, theta: Array) -> tuple[float, Array, Array]:
        """L(theta), its gradient, and the Gauss-Newton matrix, whose products are taken in single precision."""
        value, gradient = self.value_and_gradient(theta)
        derivatives = residual_columns(self._shape)(self._jacobian_entries(theta), *self._data)
        H = self._gauss_newton_matrix(derivatives[: self.r])
        if self._shape.regular:
            H += self._regularity_matrix(*derivatives[self.r :])
        return value, gradient, H

    def hessian(self, theta: Array) -> Array:
        """d^2L/dtheta^2, exact, (size, size)."""
        r, n, K = self.r, self.n, self.K
        (curvature,) = curvature_columns(self._shape)(self._jacobian_entries(theta), *self._data)
        W = by_sample(curvature.reshape(-1, n * r, n * r, curvature.shape[2]), self.N).reshape(-1, n, r, n, r)
        G, H = self._dense, np.empty((r, K, r, K))
        for i in range(r):
            for j in range(i + 1):
                raised = W[:, :, i, :, j] @ G  # (N, n, K)
                H[i, :, j] = G.reshape(-1, K).T @ raised.reshape(-1, K) / self.N
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
        other._shape = replace(self._shape, weights=weights)
        other._data = self._data[: len(other._shape.symbols())]  # the null basis is the last
        return other

    @property
    def gram(self) -> Array:
        """E[d psi^T d psi], (K, K)."""
        G = self._dense.reshape(-1, self.K)
        product: Array = G.T @ G / self.N
        return product

    @cached_property
    def _dense(self) -> Array:
        """G sample by sample, (N, n, K)."""
        return self.family.dense_gradients(self.G, self.N)

    @cached_property
    def _half(self) -> Array:
        """G at every second sample, (N / 2, n, K), in single precision."""
        return self.family.dense_gradients(self.G.astype(np.float32), self.N, _STRIDE)

    def _by_joint(self, theta: Array) -> Array:
        """Coefficients of the terms that depend on each joint, (n, r, W)."""
        C = theta.reshape(self.r, self.K)[:, self.family.terms_of_joints]
        return np.ascontiguousarray(C.transpose(1, 0, 2))

    def _collected(self, gradient: Array) -> Array:
        """Slopes with respect to theta, (size,), from those of `_by_joint`."""
        total = np.zeros((self.r, self.K))
        for places, slopes in zip(self.family.terms_of_joints, gradient, strict=True):
            known = places >= 0
            total[:, places[known]] += slopes[:, known]
        return total.ravel()

    def _jacobian_entries(self, theta: Array) -> Array:
        """J_xi, (B, n r, c)."""
        J = self._by_joint(theta) @ self.G
        return J.reshape(len(J), self.n * self.r, -1)

    def _gauss_newton_matrix(self, derivatives: list[Array]) -> Array:
        """Part of the residuals of (24), block by block for pairs of coordinates, from every second sample."""
        r, K = self.r, self.K
        blocks = np.zeros((r, r, K, K))
        rows = [self._shape.rows_of(j) for j in range(r)]
        D = [self._rows(derivative) for derivative in derivatives]
        used = len(self._half)
        for start in range(0, used, _CHUNK):
            part = slice(start, start + _CHUNK)
            X = [D[j][part] @ self._half[part] for j in range(r)]  # d rho / d C_j, (chunk, rows, K)
            for j in range(r):
                flat = X[j].reshape(-1, K)
                blocks[j, j] += flat.T @ flat
            for p, (i, j) in enumerate(pairs(r)):
                row = r * self._shape.m + p
                blocks[i, j] += X[i][:, rows[i].index(row)].T @ X[j][:, rows[j].index(row)]
        for i, j in pairs(r):
            blocks[j, i] = blocks[i, j].T
        return blocks.transpose(0, 2, 1, 3).reshape(r * K, r * K) / used

    def _rows(self, derivative: Array) -> Array:
        """Derivatives of residuals (B, n rows, c) at every second sample, (N / 2, rows, n), in single precision."""
        blocks = derivative.reshape(len(derivative), self.n, -1, derivative.shape[2])
        return by_sample(blocks, self.N, _STRIDE).astype(np.float32)

    def _regularity_matrix(self, residual: Array, derivative: Array) -> Array:
        """Part of the regularity residual, which couples all coordinates but acts at few samples."""
        block, column = np.nonzero((residual[:, 0] > 0) & (self._share > 0))
        D = derivative[block, :, column].reshape(-1, self.n, self.r).transpose(0, 2, 1).astype(np.float32)
        chosen: Array = self.G[block, :, :, column]  # (active, n, W)
        G = self.family.dense_gradients(chosen.transpose(1, 2, 0)[None], len(chosen))
        rows = (D @ G.astype(np.float32)).reshape(-1, self.r * self.K)
        product: Array = (rows.T @ rows).astype(float) / self.N
        return product
