"""Gradients of the basis functions of any linear family at samples, stored without the zeros."""

import casadi as ca
import numpy as np
from numpy.typing import DTypeLike, NDArray

from orthocas.casadi_tools.cached import cached_property
from orthocas.casadi_tools.columns import ColumnFunction, blocked
from orthocas.checks import Array
from orthocas.parametrisations import LinearFamily

_PART = 16  # blocks


class BasisGradients:
    """d psi / dq of a linear family.

    Most entries are zero: of all polynomials of total degree d in n joints, a share of d / (n + d) depends on a given
    joint. CasADi's sparsity pattern of the Jacobian tells which entries are not zero.

    Args:
        family: the basis, with K functions of n joints.
        n: number of joints.
        dtype: type of the numbers that `at` returns; they are computed in double precision.
    """

    def __init__(self, family: LinearFamily, n: int, dtype: DTypeLike = np.float64) -> None:
        self._family, self._n, self._type = family, n, np.dtype(dtype)

    @cached_property
    def terms_of_joints(self) -> NDArray[np.int_]:
        """Indices of the functions that depend on each joint, (n, W). Shorter rows are padded with -1."""
        functions, joints = self._jacobian.sparsity().get_triplet()
        rows: list[list[int]] = [[] for _ in range(self._n)]
        for k, i in zip(functions, joints, strict=True):
            rows[i].append(k)
        width = max(len(row) for row in rows)
        return np.array([sorted(row) + [-1] * (width - len(row)) for row in rows])

    def at(self, points: Array) -> Array:
        """The nonzero gradients d psi_k / dq_i at points (N, n), in blocks of c samples, (B, n, W, c).

        Entry w of joint i belongs to function `terms_of_joints[i, w]`. `orthocas.casadi_tools.columns` describes the
        blocks.
        """
        blocks = blocked(points)
        if self._type == np.float64:
            gradients = self._columns(blocks)[0]
        else:  # some blocks at a time, so that the memory never holds all of them in double precision
            parts = (self._columns(blocks[k : k + _PART])[0] for k in range(0, len(blocks), _PART))
            gradients = np.concatenate([part.astype(self._type) for part in parts])
        return gradients.reshape(len(gradients), self._n, -1, gradients.shape[2])

    def dense(self, gradients: Array, samples: int) -> Array:
        """Expand the result of `at` to all gradients sample by sample, including zeros, (N, n, K).

        Args:
            gradients: result of `at`, (B, n, W, c).
            samples: number of samples, without the padding of the last block.
        """
        return self.dense_part(gradients, samples, np.ones(self._family.width, dtype=bool))

    def dense_part(
        self, gradients: Array, samples: int, kept: NDArray[np.bool_], every: int = 1, dtype: DTypeLike | None = None
    ) -> Array:
        """The same for some of the functions and samples, (samples, n, kept).

        Args:
            gradients: result of `at`, (B, n, W, c).
            samples: number of samples, without the padding of the last block.
            kept: the functions, (K,).
            every: take only every second, third, ... sample, a divisor of c.
            dtype: type of the numbers. Default: that of the gradients.
        """
        B, n, _, c = gradients.shape
        assert c % every == 0
        place = np.cumsum(kept) - 1
        dense = np.zeros((B, c // every, n, kept.sum()), dtype=gradients.dtype if dtype is None else dtype)
        for i, functions in enumerate(self.terms_of_joints):
            rows = np.flatnonzero((functions >= 0) & kept[functions])
            columns = place[functions[rows]]
            for block, part in zip(dense, gradients[:, i, :, ::every], strict=True):
                block[:, i, columns] = part[rows].T
        return dense.reshape(-1, *dense.shape[2:])[: -(-samples // every)]

    @cached_property
    def _columns(self) -> ColumnFunction:
        J = self._jacobian
        entries = [J[int(k), i] if k >= 0 else 0 for i, row in enumerate(self.terms_of_joints) for k in row]
        return ColumnFunction(ca.Function("basis_gradients", [self._q], [ca.densify(ca.vertcat(*entries))]))

    @cached_property
    def _q(self) -> ca.SX:
        return ca.SX.sym("q", self._n)

    @cached_property
    def _jacobian(self) -> ca.SX:
        return ca.jacobian(self._family.basis(self._q), self._q)


class BoxGradients(BasisGradients):
    """Those of a family on the cube [-1, 1]^n in the units of one box: d psi / dq_i = d psi / du_i / half_width_i.

    Boxes share the compiled basis, and the gradients at points of the cube that all of them use.

    Args:
        cube: gradients on the cube.
        half_width: of the box, (n,).
        shared: points of the cube, (N, n); `at` recognises this array.
        known: the result of `cube.at(shared)`.
    """

    def __init__(self, cube: BasisGradients, half_width: Array, shared: Array, known: Array) -> None:
        super().__init__(cube._family, cube._n)
        self._cube, self._scale, self._shared, self._known = cube, 1 / half_width[:, None, None], shared, known

    @property
    def terms_of_joints(self) -> NDArray[np.int_]:
        """As on the cube."""
        return self._cube.terms_of_joints

    def at(self, points: Array) -> Array:
        """The gradients at points of the cube (N, n), (B, n, W, c)."""
        found: Array = (self._known if points is self._shared else self._cube.at(points)) * self._scale
        return found
