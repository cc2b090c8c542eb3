"""Gradients of any basis, stored without the zeros (ours)."""

import casadi as ca
import numpy as np
from numpy.typing import DTypeLike, NDArray

from orthocas.casadi_tools.cached import cached_property
from orthocas.checks import Array
from orthocas.fitting.basis_gradients import BasisGradients


class SparseGradients(BasisGradients):
    """X holds d psi_k / dq_i for the functions that depend on joint i, a group for each joint.

    CasADi's sparsity pattern of the Jacobian tells which entries are not zero.
    """

    @property
    def groups(self) -> int:
        """One for each joint."""
        return self.n

    @cached_property
    def terms_of_joints(self) -> NDArray[np.int_]:
        """Indices of the functions that depend on each joint, (n, S). Shorter rows are padded with -1."""
        functions, joints = self._jacobian.sparsity_out(0).get_triplet()
        rows: list[list[int]] = [[] for _ in range(self.n)]
        for k, i in zip(functions, joints, strict=True):
            rows[i].append(k)
        width = max(len(row) for row in rows)
        return np.array([sorted(row) + [-1] * (width - len(row)) for row in rows])

    def table(self, C: Array) -> Array:
        """The coefficients of the functions of each joint, (n, r, S)."""
        return np.ascontiguousarray(C[:, self.terms_of_joints].transpose(1, 0, 2), dtype=self.dtype)

    def collected(self, slopes: Array) -> Array:
        """The sum over the joints."""
        total = np.zeros((slopes.shape[1], self.family.width))
        for places, part in zip(self.terms_of_joints, slopes, strict=True):
            known = places >= 0
            total[:, places[known]] += part[:, known]
        return total

    def dense_part(
        self, X: Array, samples: int, kept: NDArray[np.bool_], every: int = 1, dtype: DTypeLike | None = None
    ) -> Array:
        """The numbers in their places."""
        B, n, _, c = X.shape
        assert c % every == 0
        place = np.cumsum(kept) - 1
        dense = np.zeros((B, c // every, n, kept.sum()), dtype=X.dtype if dtype is None else dtype)
        for i, functions in enumerate(self.terms_of_joints):
            rows = np.flatnonzero((functions >= 0) & kept[functions])
            columns = place[functions[rows]]
            for block, part in zip(dense, X[:, i, :, ::every], strict=True):
                block[:, i, columns] = part[rows].T
        return dense.reshape(-1, *dense.shape[2:])[: -(-samples // every)]

    def _numbers(self, q: ca.SX) -> ca.SX:
        J = self._jacobian(q)
        return ca.vertcat(*(J[int(k), i] if k >= 0 else 0 for i, row in enumerate(self.terms_of_joints) for k in row))

    @cached_property
    def _jacobian(self) -> ca.Function:
        q = ca.SX.sym("q", self.n)
        return ca.Function("jacobian", [q], [ca.jacobian(self.family.basis(q), q)])
