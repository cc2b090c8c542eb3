"""Gradients of the basis functions of a linear family at samples, stored so that few products give J_xi (ours)."""

from abc import ABC, abstractmethod

import casadi as ca
import numpy as np
from numpy.typing import DTypeLike, NDArray

from orthocas.casadi_tools.cached import cached_property
from orthocas.casadi_tools.columns import ColumnFunction, blocked
from orthocas.checks import Array
from orthocas.parametrisations import LinearFamily

_PART = 16  # blocks


class BasisGradients(ABC):
    """d psi / dq of a linear family xi = C psi(q) with K functions of n joints.

    At every sample some numbers X are known, in g groups of S, and J_xi = T X with a table T of coefficients
    (g, n r / g, S) that is linear in C. The rows of T X are the columns of J_xi, one joint after the other. Samples are
    stored in the blocks of `orthocas.casadi_tools.columns`, (B, g, S, c) for B blocks of c samples.

    Args:
        family: the basis.
        n: number of joints.
        dtype: type of the numbers X; they are computed in double precision.
    """

    def __init__(self, family: LinearFamily, n: int, dtype: DTypeLike = np.float64) -> None:
        self.family, self.n, self.dtype = family, n, np.dtype(dtype)

    def at(self, points: Array) -> Array:
        """The numbers X at points (N, n), (B, g, S, c)."""
        blocks = blocked(points)
        if self.dtype == np.float64:
            found = self._columns(blocks)[0]
        else:  # some blocks at a time, so that the memory never holds all of them in double precision
            parts = (self._columns(blocks[k : k + _PART])[0] for k in range(0, len(blocks), _PART))
            found = np.concatenate([part.astype(self.dtype) for part in parts])
        return found.reshape(len(found), self.groups, -1, found.shape[2])

    @property
    @abstractmethod
    def groups(self) -> int:
        """Number g of groups."""

    @abstractmethod
    def table(self, C: Array) -> Array:
        """T for coefficients C (r, K), with numbers of the type of X."""

    @abstractmethod
    def collected(self, slopes: Array) -> Array:
        """dL/dC, (r, K), of a function L with slopes dL/dT."""

    @abstractmethod
    def dense_part(
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

    def dense(self, X: Array, samples: int) -> Array:
        """All gradients at all samples, (N, n, K)."""
        return self.dense_part(X, samples, np.ones(self.family.width, dtype=bool))

    @abstractmethod
    def _numbers(self, q: ca.SX) -> ca.SX:
        """X of one sample, group by group."""

    @cached_property
    def _columns(self) -> ColumnFunction:
        q = ca.SX.sym("q", self.n)
        return ColumnFunction(ca.Function("basis_gradients", [q], [ca.densify(self._numbers(q))]))
