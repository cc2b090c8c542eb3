"""Gradients of product families, whose derivatives are sums of their own functions (ours)."""

from typing import Any

import casadi as ca
import numpy as np
import scipy
from numpy.typing import DTypeLike, NDArray

from orthocas.checks import Array
from orthocas.fitting.basis_gradients import BasisGradients
from orthocas.parametrisations import ProductFamily


class ProductGradients(BasisGradients):
    """X holds the functions psi' of (1, psi) that occur in derivatives: d psi / dq_i = D_i psi', in a single group.

    For polynomials of degree d in n joints these are the C(n + d - 1, n) terms up to degree d - 1, where the gradients
    have n C(n + d - 1, n) entries that are not zero. So X needs an n-th of the memory, and products with it take less
    time than to read the gradients.
    """

    def __init__(self, family: ProductFamily, n: int, dtype: DTypeLike = np.float64) -> None:
        super().__init__(family, n, dtype)
        matrices = [family.derivative_matrix(i)[1:] for i in range(n)]
        self._places = np.unique(np.concatenate([D.indices for D in matrices]))  # of psi' in (1, psi)
        matrices = [D[:, self._places] for D in matrices]
        self._upright = scipy.sparse.vstack(matrices).tocsr()  # all D_i, (n K, S)
        self._lying = scipy.sparse.vstack([D.T for D in matrices]).tocsr()  # all D_i^T, (n S, K)
        self._back = self._lying.T.tocsr()
        self._parts: dict[tuple[bytes, str], Any] = {}  # of all D_i, for some of the functions

    @property
    def groups(self) -> int:
        """One."""
        return 1

    def table(self, C: Array) -> Array:
        """T = C D_i, (1, n r, S)."""
        rows = (self._lying @ C.T).reshape(self.n, -1, len(C)).transpose(0, 2, 1)
        return np.ascontiguousarray(rows, dtype=self.dtype).reshape(1, self.n * len(C), -1)

    def collected(self, slopes: Array) -> Array:
        """The sum over the joints of dL/dT D_i^T."""
        by_joint = slopes.reshape(self.n, -1, slopes.shape[2]).transpose(0, 2, 1)
        found: Array = (self._back @ by_joint.reshape(-1, by_joint.shape[2])).T
        return found

    def dense_part(
        self, X: Array, samples: int, kept: NDArray[np.bool_], every: int = 1, dtype: DTypeLike | None = None
    ) -> Array:
        """D_i psi'."""
        assert X.shape[3] % every == 0
        kind = X.dtype if dtype is None else np.dtype(dtype)
        values = X[:, 0, :, ::every].transpose(1, 0, 2).reshape(X.shape[2], -1)[:, : -(-samples // every)]
        found = self._part(kept, kind) @ values.astype(kind, copy=False)  # (n kept, samples)
        return np.ascontiguousarray(found.T).reshape(found.shape[1], self.n, int(kept.sum()))

    def _part(self, kept: NDArray[np.bool_], kind: "np.dtype[Any]") -> Any:
        """The rows of some functions in all D_i, (n kept, S)."""
        key = kept.tobytes(), kind.str
        if key not in self._parts:
            self._parts[key] = self._upright[np.tile(kept, self.n)].astype(kind)
        return self._parts[key]

    def _numbers(self, q: ca.SX) -> ca.SX:
        return ca.vertcat(1, self.family.basis(q))[self._places.tolist()]


class BoxGradients(BasisGradients):
    """Those of a family on the cube [-1, 1]^n in the units of one box: d psi / dq_i = d psi / du_i / half_width_i.

    Boxes share the compiled basis, and the numbers at points of the cube that all of them use.

    Args:
        cube: gradients on the cube.
        half_width: of the box, (n,).
        shared: points of the cube, (N, n); `at` recognises this array.
        known: the result of `cube.at(shared)`.
    """

    def __init__(self, cube: ProductGradients, half_width: Array, shared: Array, known: Array) -> None:
        super().__init__(cube.family, cube.n, cube.dtype)
        self._cube, self._scale, self._shared, self._known = cube, 1 / half_width, shared, known

    @property
    def groups(self) -> int:
        """As on the cube."""
        return self._cube.groups

    def at(self, points: Array) -> Array:
        """The numbers at points of the cube (N, n)."""
        return self._known if points is self._shared else self._cube.at(points)

    def table(self, C: Array) -> Array:
        """That of the cube, in the units of the box."""
        table = self._cube.table(C)
        return table * np.repeat(self._scale, len(C))[:, None]

    def collected(self, slopes: Array) -> Array:
        """The same for slopes."""
        r = slopes.shape[1] // self.n
        return self._cube.collected(slopes * np.repeat(self._scale, r)[:, None])

    def dense_part(
        self, X: Array, samples: int, kept: NDArray[np.bool_], every: int = 1, dtype: DTypeLike | None = None
    ) -> Array:
        """The gradients in the units of the box."""
        dense = self._cube.dense_part(X, samples, kept, every, dtype)
        dense *= self._scale[:, None].astype(dense.dtype)
        return dense

    def _numbers(self, q: ca.SX) -> ca.SX:
        return self._cube._numbers(q)
