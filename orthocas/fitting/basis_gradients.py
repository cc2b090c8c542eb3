"""Gradients of basis functions at the samples: dense, sparse, or as tables of products."""

from abc import ABC, abstractmethod
from typing import Any

import casadi as ca
import numpy as np
import scipy
from numpy.typing import DTypeLike, NDArray

from orthocas.bases.family import LinearFamily
from orthocas.bases.products import ProductFamily
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array
from orthocas.tools.columns import ColumnFunction, arrange_blocks

# blocks of samples at a time, so that the memory never holds all of them twice
_PART = 16


class BasisGradients(ABC):
    """d psi / dq of a linear family xi = C psi(q) with K functions of n joints.

    At every sample some numbers X are known, in g groups of S, and J_xi = T X with a table T of coefficients
    (g, n r / g, S) that is linear in C. The rows of T X are the columns of J_xi, one joint after the other. Samples are
    stored in the blocks of `orthocas.tools.columns`, (B, g, S, c) for B blocks of c samples.

    Args:
        family: the basis.
        n: number of joints.
        dtype: type of the numbers X; they are computed in double precision.
    """

    def __init__(self, family: LinearFamily, n: int, dtype: DTypeLike = np.float64) -> None:
        self.family, self.n, self.dtype = family, n, np.dtype(dtype)

    def at(self, points: Array) -> Array:
        """The numbers X at points (N, n), (B, g, S, c)."""
        blocks = arrange_blocks(points)
        if self.dtype == np.float64:
            numbers = self._columns(blocks)[0]
        else:  # some blocks at a time, so that the memory never holds all of them in double precision
            parts = (self._columns(blocks[k : k + _PART])[0] for k in range(0, len(blocks), _PART))
            numbers = np.concatenate([part.astype(self.dtype) for part in parts])
        return numbers.reshape(len(numbers), self.groups, -1, numbers.shape[2])

    @property
    @abstractmethod
    def groups(self) -> int:
        """Number g of groups."""

    @abstractmethod
    def build_table(self, C: Array) -> Array:
        """T for coefficients C (r, K), with numbers of the type of X."""

    @abstractmethod
    def collect(self, slopes: Array) -> Array:
        """dL/dC, (r, K), of a function L with slopes dL/dT."""

    @abstractmethod
    def expand_part(
        self, X: Array, samples: int, kept: NDArray[np.bool_], every: int = 1, dtype: DTypeLike | None = None
    ) -> Array:
        """Gradients d psi_k / dq_i of some functions at some samples, zeros included, (samples, n, kept).

        Args:
            X: result of `at`, (B, g, S, c).
            samples: number of samples, without the padding of the last block.
            kept: the functions, (K,).
            every: take only every second, third, ... sample, a divisor of c.
            dtype: type of the numbers. Default: that of X.
        """

    def expand(self, X: Array, samples: int) -> Array:
        """All gradients at all samples, (N, n, K)."""
        return self.expand_part(X, samples, np.ones(self.family.width, dtype=bool))

    def jacobian(self, X: Array, C: Array, samples: int) -> Array:
        """J_xi = T X of coefficients C (r, K) at all samples, (N, r, n)."""
        rows = np.matmul(self.build_table(C), X)  # (B, g, n r / g, c)
        B, _, _, c = rows.shape
        J: Array = rows.reshape(B, self.n, len(C), c).transpose(0, 3, 2, 1).reshape(B * c, len(C), self.n)
        return J[:samples]

    def differentiate_along(self, X: Array, directions: Array) -> Array:
        """Derivatives a . d psi / dq along directions a (N, n) at samples, (N, K)."""
        products, c = [], X.shape[3]
        for b in range(0, len(X), _PART):
            part = slice(b * c, min((b + _PART) * c, len(directions)))
            G = self.expand(X[b : b + _PART], part.stop - part.start)
            products.append(np.einsum("si,sik->sk", directions[part], G))
        return np.concatenate(products)

    @abstractmethod
    def _numbers(self, q: ca.SX) -> ca.SX:
        """X of one sample, group by group."""

    @cached_property
    def _columns(self) -> ColumnFunction:
        q = ca.SX.sym("q", self.n)
        return ColumnFunction(ca.Function("basis_gradients", [q], [ca.densify(self._numbers(q))]))


class ProductGradients(BasisGradients):
    """X holds the functions psi' of (1, psi) that occur in derivatives: d psi / dq_i = D_i psi', in a single group.

    For polynomials of degree d in n joints these are the C(n + d - 1, n) terms up to degree d - 1, where the gradients
    have n C(n + d - 1, n) entries that are not zero. So X needs an n-th of the memory, and products with it take less
    time than to read the gradients.
    """

    def __init__(self, family: ProductFamily, n: int, dtype: DTypeLike = np.float64) -> None:
        super().__init__(family, n, dtype)
        matrices = [family.build_derivative_matrix(i)[1:] for i in range(n)]
        # places of psi' in (1, psi)
        self._places = np.unique(np.concatenate([D.indices for D in matrices]))
        matrices = [D[:, self._places] for D in matrices]
        # all D_i, (n K, S)
        self._upright = scipy.sparse.vstack(matrices).tocsr()
        # all D_i^T, (n S, K)
        self._lying = scipy.sparse.vstack([D.T for D in matrices]).tocsr()
        self._back = self._lying.T.tocsr()
        # rows of all D_i for some of the functions, so far
        self._parts: dict[tuple[bytes, str], Any] = {}

    @property
    def groups(self) -> int:
        """One."""
        return 1

    def build_table(self, C: Array) -> Array:
        """T = C D_i, (1, n r, S)."""
        rows = (self._lying @ C.T).reshape(self.n, -1, len(C)).transpose(0, 2, 1)
        return np.ascontiguousarray(rows, dtype=self.dtype).reshape(1, self.n * len(C), -1)

    def collect(self, slopes: Array) -> Array:
        """The sum over the joints of dL/dT D_i^T."""
        by_joint = slopes.reshape(self.n, -1, slopes.shape[2]).transpose(0, 2, 1)
        rows: Array = (self._back @ by_joint.reshape(-1, by_joint.shape[2])).T
        return rows

    def expand_part(
        self, X: Array, samples: int, kept: NDArray[np.bool_], every: int = 1, dtype: DTypeLike | None = None
    ) -> Array:
        """D_i psi'."""
        assert X.shape[3] % every == 0
        kind = X.dtype if dtype is None else np.dtype(dtype)
        values = X[:, 0, :, ::every].transpose(1, 0, 2).reshape(X.shape[2], -1)[:, : -(-samples // every)]
        # the rows of these functions in all D_i, (n kept, S), kept for the next time
        key = kept.tobytes(), kind.str
        if key not in self._parts:
            self._parts[key] = self._upright[np.tile(kept, self.n)].astype(kind)
        dense = self._parts[key] @ values.astype(kind, copy=False)  # (n kept, samples)
        return np.ascontiguousarray(dense.T).reshape(dense.shape[1], self.n, int(kept.sum()))

    def differentiate_along(self, X: Array, directions: Array) -> Array:
        """The sum over the joints of D_i (a_i psi')."""
        K, N = self.family.width, len(directions)
        values = X[:, 0].transpose(1, 0, 2).reshape(X.shape[2], -1)[:, :N]
        total = np.zeros((K, N))
        for i in range(self.n):
            D = self._upright[i * K : (i + 1) * K]
            if D.nnz:
                total += D @ (values * directions[:, i])
        return np.ascontiguousarray(total.T)

    def _numbers(self, q: ca.SX) -> ca.SX:
        return ca.vertcat(1, self.family.basis(q))[self._places.tolist()]


class SparseGradients(BasisGradients):
    """X holds d psi_k / dq_i for the functions that depend on joint i, a group for each joint.

    CasADi's sparsity pattern of the Jacobian lists the entries that are not zero.
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

    def build_table(self, C: Array) -> Array:
        """The coefficients of the functions of each joint, (n, r, S)."""
        return np.ascontiguousarray(C[:, self.terms_of_joints].transpose(1, 0, 2), dtype=self.dtype)

    def collect(self, slopes: Array) -> Array:
        """The sum over the joints."""
        total = np.zeros((slopes.shape[1], self.family.width))
        for places, part in zip(self.terms_of_joints, slopes, strict=True):
            used = places >= 0
            total[:, places[used]] += part[:, used]
        return total

    def expand_part(
        self, X: Array, samples: int, kept: NDArray[np.bool_], every: int = 1, dtype: DTypeLike | None = None
    ) -> Array:
        """The numbers in their places."""
        B, n, _, c = X.shape
        assert c % every == 0
        # each joint's numbers, at the places that its functions have among those asked for
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


def build_gradients(family: LinearFamily, n: int, dtype: DTypeLike = np.float64) -> BasisGradients:
    """Gradients of a family of n joints, with numbers of a type."""
    return (
        ProductGradients(family, n, dtype) if isinstance(family, ProductFamily) else SparseGradients(family, n, dtype)
    )
