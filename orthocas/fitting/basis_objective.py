"""The loss of bases, whose J_xi is linear in theta: value, gradient and Gauss-Newton matrix, built in blocks."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from functools import partial
from math import ceil
from typing import Any, Self

import casadi as ca
import numpy as np
import scipy
from numpy.typing import DTypeLike, NDArray

from orthocas.bases.family import LinearFamily
from orthocas.bases.products import ProductFamily
from orthocas.fitting.sample_loss import (
    Loss,
    LossByArrays,
    build_curvature_columns,
    build_loss_columns,
    build_residual_columns,
    build_value_columns,
)
from orthocas.fitting.terms import Pairs, Sizes, Weights
from orthocas.tasks.samples import Draw, Samples, split_samples
from orthocas.tools.batch import count_threads, run_in_threads, run_in_threads_with
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array
from orthocas.tools.columns import COLUMNS, ColumnFunction, Run, arrange_blocks, build_weights, split_by_sample


@dataclass(frozen=True, slots=True)
class ObjectiveRules:
    """Sizes and sample counts of the products that evaluate losses, chosen for short computing times."""

    chunk: int = 512  #: samples per matrix product, so that their rows stay in the cache
    blocks: int = 8  #: blocks of samples per thread: fixed, so that sums do not depend on the number of threads
    stride: int = 2  #: every second sample is enough for the Gauss-Newton matrix, which is a mean
    most_stride: int = 16  #: of rough estimates; a divisor of the samples in a block
    hinges: int = 1000  #: samples that estimate the Gauss-Newton matrix of a hinge, about
    coupled: int = 1500  #: coefficients up to which rough estimates contain blocks that couple coordinates
    rough: int = 12  #: residuals per coefficient in a rough estimate
    rough_in_metric: int = 6  #: the same in another metric than the identity, where more estimates are needed

    orienting: int = 200  #: samples that determine the orientation of a network's start
    piece: int = 2**18  #: entries of the largest array of a piece of samples; larger ones do not fit the cache
    products: int = 2**22  #: products of pairs of numbers of a basis at once
    least_piece: int = 100  #: samples in a piece; smaller products waste time
    graph: int = 2**20  #: entries of the largest matrix in a graph; larger ones do not fit the cache


RULES = ObjectiveRules()
Shared = Sequence[tuple[int, int, int, int]]


class BasisObjective:
    """Mean loss (25) of xi = C psi(q) on fixed samples, with gradient, Gauss-Newton matrix and Hessian.

    The numbers X of the basis gradients are computed once. The coordinate gradients are J_xi = T X, with a table T that
    is linear in C, see `BasisGradients`. The loss of one sample and its derivatives with respect to J_xi come from
    CasADi, or from arrays for many coordinates. The residual of task i and coordinate j depends only on row j of C, so
    the Gauss-Newton matrix is built block by block from few rows per sample.

    Samples are stored in the blocks of `orthocas.tools.columns`: X is (B, g, S, c) and J_xi is (B, n r, c).

    Args:
        family: the coordinates.
        samples: fixed samples of the family's joints.
        weights: weights of the loss.
        start: parameters, (size,). The regularity term keeps the orientation of their coordinates.
        draw: draws fresh samples.
        kept: the coefficients (r, K) that may differ from zero; theta holds only these. Default: all.
        exchanged: pairs of components whose sum and difference are coordinates, see `orthocas.fitting.starts`. Then
            C and J_xi are those of the components.
        gradients: gradients of the basis, if they exist already, or with numbers of another type than float64, which
            products with them then have too. Default: those of the family.
        orientation: sign of the coordinates' volume, which the regularity term keeps. Default: that of the start.
    """

    def __init__(
        self,
        family: LinearFamily,
        samples: Samples,
        weights: Weights,
        start: Array,
        draw: Draw,
        kept: NDArray[np.bool_] | None = None,
        exchanged: Pairs = (),
        gradients: BasisGradients | None = None,
        orientation: float | None = None,
    ) -> None:
        self.family, self.weights, self._draw = family, weights, draw
        self.r, self.K = family.outputs, family.width
        self.kept = np.ones((self.r, self.K), dtype=bool) if kept is None else kept
        m, self.n = samples.task_jacobian.shape[1:]
        self._gradients = build_gradients(family, self.n) if gradients is None else gradients
        self._loss = Loss.of(Sizes(self.n, m, self.r, samples.metric_inverse is None), weights.by_name, exchanged)
        self._orientation = orientation
        self._use(samples, start)

    def _use(self, samples: Samples, start: Array | None = None) -> None:
        """Use these samples: the numbers of the basis there, and the data of the loss in blocks.

        Args:
            samples: the samples.
            start: parameters whose coordinates give the orientation, unless it is set already.
        """
        self.N, self.X = len(samples), self._gradients.at(samples.points)
        self._share, self._expanded = build_weights(self.N), dict[str, Array]()
        if start is not None and self._orientation is None and (self._loss.oriented or self.weights.folds > 0):
            self._orientation = samples.orientation(self.coordinate_jacobians(start))
        data = samples.collect_data(self._loss.data, self._orientation)
        self._described = dict(zip(self._loss.data, map(arrange_blocks, data), strict=True))

    @property
    def _data(self) -> list[Array]:
        """Data of the samples in blocks, in the order of the loss."""
        return [self._described[name] for name in self._loss.data]

    def batches(self, size: int, count: int, seed: tuple[int, ...]) -> Iterator[Self]:
        """The same loss on `count` fresh sample sets of `size` each."""
        for part in split_samples(self._draw(size * count, seed), count):
            other = copy(self)
            other._use(part)
            yield other

    def coordinate_jacobians(self, theta: Array) -> Array:
        """J_xi at every sample, (N, r, n)."""
        return split_by_sample(self._evaluate_jacobians(theta).reshape(-1, self.n, self.r, COLUMNS), self.N)

    def value(self, theta: Array) -> float:
        """L(theta)."""
        (losses,) = build_value_columns(self._loss)(self._evaluate_jacobians(theta), *self._data)
        return float(np.vdot(losses[:, 0], self._share))

    def value_and_gradient(self, theta: Array) -> tuple[float, Array]:
        """L(theta) and dL/dtheta."""
        # For each block: J_xi = T X, the loss and its slopes dL/dJ_xi, and dL/dT, which is the slopes times X^T
        T, columns, parts = self._table(theta), build_loss_columns(self._loss), self._parts
        arrays = (self.X, self._share, *self._data)

        def sum_part(run: Run, part: slice) -> tuple[float, Array]:
            value, gradient = 0.0, np.zeros(T.shape)
            losses, slopes = np.empty(COLUMNS), np.empty((self.n * self.r, COLUMNS))
            # One block at a time, so that X is read from memory only once
            for X, share, *data in zip(*(array[part] for array in arrays), strict=True):
                run([(T @ X).astype(np.float64, copy=False), *data], [losses, slopes])
                value += float(losses @ share)
                shared = (slopes * share).astype(X.dtype, copy=False).reshape(*T.shape[:2], -1)
                gradient += shared @ X.transpose(0, 2, 1)
            return value, gradient

        with columns.borrow(min(count_threads(), len(parts))) as runs:
            sums = run_in_threads_with(runs, sum_part, parts)
        slopes = self._gradients.collect(np.sum([gradient for _, gradient in sums], axis=0))
        return sum(value for value, _ in sums), slopes[self.kept]

    def normal_equations(self, theta: Array) -> tuple[float, Array, Array]:
        """L(theta), its gradient, and the Gauss-Newton matrix, whose products are computed in single precision."""
        value, gradient = self.value_and_gradient(theta)
        return value, gradient, self._build_matrix(theta, RULES.stride)

    def curvature_estimate(self, theta: Array) -> list[Array]:
        """A rough Gauss-Newton matrix for quasi-Newton methods; beyond 1500 coefficients only its diagonal blocks.

        It is estimated from few samples. With n joints, r coordinates of degree 2 have about r n^2 / 2 coefficients.
        The whole matrix takes about n^6 operations, and n^9 to factor. Its blocks, one for each coordinate, take n^5
        and n^7.
        """
        # Double the stride as long as there are enough residuals for each coefficient
        residuals = self.N * (self._loss.smooth_count or 1)
        rough = RULES.rough if self._loss.sizes.identity_metric else RULES.rough_in_metric
        stride = RULES.stride
        while 2 * stride <= RULES.most_stride and residuals >= 2 * stride * rough * theta.size:
            stride *= 2
        return [self._build_matrix(theta, stride)] if theta.size <= RULES.coupled else self._build_blocks(theta, stride)

    def hessian(self, theta: Array) -> Array:
        """d^2L/dtheta^2, exact, (size, size)."""
        # With second derivatives W with respect to J_xi and basis gradients G, the Hessian is the mean of G^T W G
        r, n, K = self.r, self.n, self.K
        (curvature,) = build_curvature_columns(self._loss)(self._evaluate_jacobians(theta), *self._data)
        W = split_by_sample(curvature.reshape(-1, n * r, n * r, curvature.shape[2]), self.N).reshape(-1, n, r, n, r)
        G, H = self._dense, np.zeros((r, K, r, K))
        # Each pair of coordinates has a block, which one thread fills

        def fill(pair: tuple[int, int]) -> None:
            i, j = pair
            for start in range(0, self.N, RULES.chunk):
                part = slice(start, start + RULES.chunk)
                raised = W[part, :, i, :, j] @ G[part]  # (chunk, n, K)
                H[i, :, j] += G[part].reshape(-1, K).T @ raised.reshape(-1, K) / self.N
            H[j, :, i] = H[i, :, j].T

        run_in_threads(fill, [(i, j) for i in range(r) for j in range(i + 1)])
        # Take the rows and columns of coefficients that may differ from zero
        free = self.kept.ravel()
        block: Array = H.reshape(r * K, r * K)[np.ix_(free, free)]
        return block

    def reweigh(self, weights: Weights) -> Self:
        """The same loss on the same samples with other weights. It cannot add terms that need other sample data."""
        other = copy(self)
        other.weights, other._loss = weights, Loss.of(self._loss.sizes, weights.by_name, self._loss.exchanged)
        assert set(other._loss.data) <= set(self._described)
        return other

    def elsewhere(self, samples: Samples, weights: Mapping[str, float]) -> Self:
        """Other terms of the same coordinates at other samples, with the same orientation.

        Args:
            samples: the samples.
            weights: weights of the terms by name.
        """
        other = copy(self)
        other._loss = Loss.of(self._loss.sizes, weights, self._loss.exchanged)
        other._use(samples)
        return other

    def move_to(self, gradients: BasisGradients, samples: Samples, start: Array) -> Self:
        """The same loss of the same family on another box; its compiled functions are reused.

        Args:
            gradients: gradients of the basis there.
            samples: the samples.
            start: parameters; the regularity term keeps the orientation of their coordinates.
        """
        other = copy(self)
        other._gradients, other._orientation = gradients, None
        other._use(samples, start)
        return other

    @property
    def gram(self) -> Array:
        """E[d psi^T d psi], (K, K)."""
        G = self._dense.reshape(-1, self.K)
        product: Array = G.T @ G / self.N
        return product

    @property
    def _dense(self) -> Array:
        """Gradients sample by sample, (N, n, K)."""
        if "all" not in self._expanded:
            self._expanded["all"] = self._gradients.expand(self.X, self.N)
        return self._expanded["all"]

    def _thin(self, stride: int) -> list[Array]:
        """Gradients of the functions of each coordinate at some samples, (N / stride, n, K_j), in single precision."""
        names = [f"{stride} {row.tobytes().hex()}" for row in self.kept]
        for name, row in zip(names, self.kept, strict=True):
            if name not in self._expanded:
                self._expanded[name] = self._gradients.expand(self.X, self.N, row, stride, np.float32)
        return [self._expanded[name] for name in names]

    def _table(self, theta: Array) -> Array:
        """T, (g, n r / g, S)."""
        return self._gradients.build_table(expand(theta, self.kept).reshape(self.r, self.K))

    @property
    def _parts(self) -> list[slice]:
        """Slices of at most `RULES.blocks` samples."""
        return [slice(start, start + RULES.blocks) for start in range(0, len(self.X), RULES.blocks)]

    def _evaluate_jacobians(self, theta: Array) -> Array:
        """J_xi, (B, n r, c)."""
        T = self._table(theta)
        J = np.concatenate(run_in_threads(lambda part: T @ self.X[part], self._parts)).astype(np.float64, copy=False)
        return J.reshape(len(J), self.n * self.r, -1)

    def _build_matrix(self, theta: Array, stride: int) -> Array:
        """Gauss-Newton matrix, (size, size). Its smooth residuals are taken at every `stride`-th sample."""
        smooth, hinges = self._differentiate(theta, stride)
        free, rows = int(self.kept.sum()), self._loss.smooth_rows
        H = np.zeros((free, free))
        if smooth:
            # Blocks of coordinates and of pairs of them, from few rows per sample, in single precision
            shared = [(i, j, rows[i].index(row), rows[j].index(row)) for i, j, row in self._loss.shared_rows]
            gradients = self._thin(stride)
            H = build_normal_matrix(smooth, gradients, shared) / len(gradients[0])
        # A hinge couples all coordinates, so its rows are full, but it acts at few samples
        for D, G, count in hinges:
            active = (D @ G)[:, self.kept]
            H += (active.T @ active).astype(float) / count
        return H

    def _build_blocks(self, theta: Array, stride: int) -> list[Array]:
        """The diagonal blocks of the Gauss-Newton matrix, one for the coefficients of each coordinate."""
        if self._loss.all_by_arrays:
            return self._build_by_arrays(theta, stride)
        smooth, hinges = self._differentiate(theta, stride)

        def build(j: int) -> Array:
            H = np.zeros((int(self.kept[j].sum()),) * 2)
            if smooth:
                gradients = self._thin(stride)[j : j + 1]
                H = build_normal_matrix(smooth[j : j + 1], gradients, ()) / len(gradients[0])
            # Of a hinge, which couples coordinates, a diagonal block holds only the part of its own coordinate
            for D, G, count in hinges:
                active = (D[:, j : j + 1] @ G)[:, 0, self.kept[j]]
                H += (active.T @ active).astype(float) / count
            return H

        return [build(j) for j in range(self.r)]

    def _build_by_arrays(self, theta: Array, stride: int) -> list[Array]:
        """Like `_build_blocks`, from the squares D^T D of all residuals at every `stride`-th sample."""
        if not self._loss.smooth_count:
            # Hinges alone give one residual a sample, so more samples are needed
            stride = 1
            while stride * RULES.hinges < self.N:
                stride *= 2
        loss, X = build_loss_columns(self._loss), self.X[..., ::stride]
        assert isinstance(loss, LossByArrays)
        J = (self._table(theta) @ X).astype(np.float64, copy=False).reshape(len(X), self.n * self.r, -1)
        data = [array[..., ::stride] for array in self._data]
        blocks = [loss.build_curvatures(J[b], [array[b] for array in data]) for b in range(len(X))]
        # Leave out the padding of the last block
        count = -(-self.N // stride)
        squares = [np.concatenate(parts)[:count] for parts in zip(*blocks, strict=True)]
        return [total / count for total in self._gradients.square(X, squares, self.kept)]

    def _differentiate(self, theta: Array, stride: int) -> tuple[list[Array], list[tuple[Any, Any, float]]]:
        """Derivatives of residuals with respect to J_xi, in single precision.

        Returns:
            Two lists. The first has the derivatives of each coordinate's smooth residuals at every `stride`-th sample,
            (N / stride, rows, n); it is empty without smooth residuals. The second has, for each hinge, its
            derivatives (N', r, n) at some of the samples where it acts, the gradients of the basis there (N', n, K),
            and the number by which sums of their products are divided to give means.
        """
        derivatives = build_residual_columns(self._loss)(self._evaluate_jacobians(theta), *self._data)
        smooth, hinges = list[Array](), list[tuple[Any, Any, float]]()
        if any(self._loss.smooth_rows):
            for derivative in derivatives[: self.r]:
                blocks = derivative.reshape(len(derivative), self.n, -1, derivative.shape[2])
                smooth.append(split_by_sample(blocks, self.N, stride).astype(np.float32))
        for residual, derivative in zip(derivatives[self.r :: 2], derivatives[self.r + 1 :: 2], strict=True):
            # Take the samples at which the hinge acts, without the padding of the last block
            block, column = np.nonzero((residual[:, 0] > 0) & (self._share > 0))
            # If these are many, about 1000 of them are enough for the matrix
            every = max(1, len(block) // RULES.hinges)
            block, column = block[::every], column[::every]
            D = derivative[block, :, column].reshape(-1, self.n, self.r).transpose(0, 2, 1).astype(np.float32)
            chosen: Array = self.X[block, :, :, column]  # (active, g, S)
            G = self._gradients.expand(chosen.transpose(1, 2, 0)[None], len(chosen)).astype(np.float32)
            hinges.append((D, G, self.N / every))
        return smooth, hinges


def expand(theta: Array, kept: NDArray[np.bool_]) -> Array:
    """All coefficients, (r K,), from those that may differ from zero."""
    C = np.zeros(kept.shape)
    C[kept] = theta
    return C.ravel()


def build_normal_matrix(derivatives: Sequence[Array], gradients: Sequence[Array], shared: Shared) -> Array:
    """The matrix (size, size) whose blocks are sums over samples: X_j^T X_j, and x_i^T x_j of shared residuals.

    X_j = D_j G_j are the derivatives of the residuals of coordinate j with respect to its coefficients, and x_i, x_j
    the rows of a residual that depends on two coordinates. Products are taken over chunks of samples, and added in
    double precision in the order of the chunks.

    Args:
        derivatives: D_j of every coordinate, (N, rows, n).
        gradients: G_j of every coordinate, (N, n, K_j).
        shared: for every residual of two coordinates i > j: i, j, and its row in X_i and in X_j.
    """
    r, ends = len(derivatives), np.cumsum([G.shape[2] for G in gradients])
    places = [slice(end - G.shape[2], end) for G, end in zip(gradients, ends, strict=True)]
    H = np.zeros((ends[-1], ends[-1]))
    chunks = range(0, len(gradients[0]), RULES.chunk)
    # Take several chunks at a time, so that there is work for all threads
    together = ceil(count_threads() / r)
    for k in range(0, len(chunks), together):
        _add(H, places, chunks[k : k + together], derivatives, gradients, shared)
    for i, j, *_ in shared:
        H[places[j], places[i]] = H[places[i], places[j]].T
    return H


def _add(
    H: Array,
    places: Sequence[slice],
    starts: Sequence[int],
    derivatives: Sequence[Array],
    gradients: Sequence[Array],
    shared: Shared,
) -> None:
    """Add the products of some chunks to H. One thread fills each block, in the order of the chunks."""

    def rows(piece: tuple[int, int]) -> Array:
        start, j = piece
        part = slice(start, start + RULES.chunk)
        product: Array = derivatives[j][part] @ gradients[j][part]  # (chunk, rows, K_j)
        return product

    def square(j: int) -> None:
        for start in starts:
            flat = X[start, j].reshape(-1, X[start, j].shape[2])
            H[places[j], places[j]] += flat.T @ flat

    def mixed(pair: tuple[int, int]) -> None:
        i, j = pair
        for start in starts:
            for row, other in rows_of[i, j]:
                H[places[i], places[j]] += X[start, i][:, row].T @ X[start, j][:, other]

    # First the rows X_j = D_j G_j of all chunks, then their squares and mixed products, each in its block of H
    r = len(derivatives)
    rows_of: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for i, j, row, other in shared:
        rows_of.setdefault((i, j), []).append((row, other))
    pieces = [(start, j) for start in starts for j in range(r)]
    X = dict(zip(pieces, run_in_threads(rows, pieces), strict=True))
    work: list[Callable[[], None]] = [partial(square, j) for j in range(r)]
    work += [partial(mixed, pair) for pair in rows_of]
    run_in_threads(lambda block: block(), work)


# Number of blocks that are converted at a time, so that the memory never holds all of them twice
_PART = 16


class BasisGradients(ABC):
    """d psi / dq of a linear family xi = C psi(q) with K functions of n joints.

    Every sample has numbers X, g groups of S of them, such that J_xi = T X with a table T of coefficients
    (g, n r / g, S) that is linear in C. The rows of T X are the columns of J_xi, one joint after the other. Samples are
    stored in the blocks of `orthocas.tools.columns`, (B, g, S, c) for B blocks of c samples.

    Args:
        family: the basis.
        n: number of joints.
        dtype: type in which the numbers X are stored; they are computed in double precision.
    """

    def __init__(self, family: LinearFamily, n: int, dtype: DTypeLike = np.float64) -> None:
        self.family, self.n, self.dtype = family, n, np.dtype(dtype)

    def at(self, points: Array) -> Array:
        """The numbers X (B, g, S, c) at points (N, n)."""
        blocks = arrange_blocks(points)
        if self.dtype == np.float64:
            numbers = self._columns(blocks)[0]
        else:  # convert some blocks at a time, so that the memory never holds all of them in double precision
            parts = (self._columns(blocks[k : k + _PART])[0] for k in range(0, len(blocks), _PART))
            numbers = np.concatenate([part.astype(self.dtype) for part in parts])
        return numbers.reshape(len(numbers), self.groups, -1, numbers.shape[2])

    @property
    @abstractmethod
    def groups(self) -> int:
        """Number g of groups."""

    @abstractmethod
    def build_table(self, C: Array) -> Array:
        """T (g, n r / g, S) for coefficients C (r, K), in the number type of X."""

    @abstractmethod
    def collect(self, slopes: Array) -> Array:
        """dL/dC (r, K) of a function L, from its slopes dL/dT (g, n r / g, S)."""

    @abstractmethod
    def expand(
        self,
        X: Array,
        samples: int,
        kept: NDArray[np.bool_] | None = None,
        every: int = 1,
        dtype: DTypeLike | None = None,
    ) -> Array:
        """Gradients d psi_k / dq_i, zeros included, (samples / every, n, functions).

        Args:
            X: result of `at`, (B, g, S, c).
            samples: number of samples, without the padding of the last block.
            kept: the functions, (K,). Default: all.
            every: take only every second, third, ... sample, a divisor of c.
            dtype: type of the numbers. Default: that of X.
        """

    def square(self, X: Array, squares: Sequence[Array], kept: NDArray[np.bool_]) -> list[Array]:
        """Sums over samples of G^T W_j G for every coordinate j, with gradients G (n, K_j) of its functions.

        Products are computed in single precision.

        Args:
            X: numbers at the samples, (B, g, S, c).
            squares: symmetric W_j (N, n, n) of every coordinate, at the N samples of X without its padding.
            kept: the functions of every coordinate, (r, K).
        """
        found = []
        for W, own in zip(squares, kept, strict=True):
            G = self.expand(X, len(W), own, dtype=np.float32)
            rows = W.astype(np.float32) @ G
            found.append((G.reshape(-1, G.shape[2]).T @ rows.reshape(-1, G.shape[2])).astype(float))
        return found

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
        """The numbers X (g S, 1) of one sample, one group after the other."""

    @cached_property
    def _columns(self) -> ColumnFunction:
        q = ca.SX.sym("q", self.n)
        return ColumnFunction(ca.Function("basis_gradients", [q], [ca.densify(self._numbers(q))]))


class ProductGradients(BasisGradients):
    """X holds the functions psi' of (1, psi) that occur in derivatives: d psi / dq_i = D_i psi', in a single group.

    For polynomials of degree d in n joints these are the C(n + d - 1, n) terms up to degree d - 1, where the gradients
    have n C(n + d - 1, n) entries that are not zero. So X needs an n-th of the memory, and a product with X takes less
    time than reading the gradients would.
    """

    def __init__(self, family: ProductFamily, n: int, dtype: DTypeLike = np.float64) -> None:
        super().__init__(family, n, dtype)
        matrices = [family.build_derivative_matrix(i)[1:] for i in range(n)]
        # Indices of psi' in (1, psi)
        self._places = np.unique(np.concatenate([D.indices for D in matrices]))
        matrices = [D[:, self._places] for D in matrices]
        # All D_i below each other, (n K, S)
        self._upright = scipy.sparse.vstack(matrices).tocsr()
        # All D_i^T below each other, (n S, K)
        self._lying = scipy.sparse.vstack([D.T for D in matrices]).tocsr()
        self._back = self._lying.T.tocsr()
        # Cache: the rows of all D_i for a subset of the functions and a number type
        self._parts: dict[tuple[bytes, str], Any] = {}

    @property
    def groups(self) -> int:
        """One group holds all numbers."""
        return 1

    def build_table(self, C: Array) -> Array:
        """T = C D_i, (1, n r, S)."""
        rows = (self._lying @ C.T).reshape(self.n, -1, len(C)).transpose(0, 2, 1)
        return np.ascontiguousarray(rows, dtype=self.dtype).reshape(1, self.n * len(C), -1)

    def collect(self, slopes: Array) -> Array:
        """dL/dC = sum_i (dL/dT)_i D_i^T."""
        by_joint = slopes.reshape(self.n, -1, slopes.shape[2]).transpose(0, 2, 1)
        rows: Array = (self._back @ by_joint.reshape(-1, by_joint.shape[2])).T
        return rows

    def expand(
        self,
        X: Array,
        samples: int,
        kept: NDArray[np.bool_] | None = None,
        every: int = 1,
        dtype: DTypeLike | None = None,
    ) -> Array:
        """Gradients as D_i psi'."""
        assert X.shape[3] % every == 0
        kept = np.ones(self.family.width, dtype=bool) if kept is None else kept
        kind = X.dtype if dtype is None else np.dtype(dtype)
        values = X[:, 0, :, ::every].transpose(1, 0, 2).reshape(X.shape[2], -1)[:, : -(-samples // every)]
        # Take the rows of these functions from all D_i, (n kept, S), and keep them for the next call
        key = kept.tobytes(), kind.str
        if key not in self._parts:
            self._parts[key] = self._upright[np.tile(kept, self.n)].astype(kind)
        dense = self._parts[key] @ values.astype(kind, copy=False)  # (n kept, samples)
        return np.ascontiguousarray(dense.T).reshape(dense.shape[1], self.n, int(kept.sum()))

    def square(self, X: Array, squares: Sequence[Array], kept: NDArray[np.bool_]) -> list[Array]:
        """The sums of W_j times psi' psi'^T, with D_i on both sides; or those of gradients where that is less work."""
        n, S = self.n, X.shape[2]
        # If psi' has many functions, psi' psi'^T has more entries than the products of gradients
        if n * (n + 1) // 2 * (S * (S + 1) // 2) >= n * int(kept.sum(axis=1).max()) ** 2:
            return super().square(X, squares, kept)
        values = X[:, 0].transpose(0, 2, 1).reshape(-1, S)[: len(squares[0])].astype(np.float32)
        # W and psi' psi'^T are symmetric: their upper triangles are enough
        (i, j), (s, t) = np.triu_indices(n), np.triu_indices(S)
        entries = np.concatenate([W[:, i, j].astype(np.float32).T for W in squares])
        sums, piece = np.zeros((len(entries), len(s)), dtype=np.float32), max(1, RULES.products // len(s))
        for start in range(0, len(values), piece):
            part = slice(start, start + piece)
            sums += entries[:, part] @ (values[part][:, s] * values[part][:, t])
        found = []
        for own, row in zip(np.split(sums, len(squares)), kept, strict=True):
            half = np.empty((len(i), S, S), dtype=np.float32)
            half[:, s, t] = half[:, t, s] = own
            M = np.empty((n, S, n, S), dtype=np.float32)
            M[i, :, j] = M[j, :, i] = half
            D = self._lying[:, row]
            found.append(np.asarray(D.T @ (D.T @ M.reshape(n * S, n * S)).T, dtype=float))
        return found

    def differentiate_along(self, X: Array, directions: Array) -> Array:
        """Derivatives along a as sum_i D_i (a_i psi')."""
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
    """X holds d psi_k / dq_i for the functions that depend on joint i, one group for each joint.

    CasADi's sparsity pattern of the Jacobian tells which functions these are.
    """

    @property
    def groups(self) -> int:
        """One group for each joint."""
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
        """T with the coefficients of the functions that depend on each joint, (n, r, S)."""
        return np.ascontiguousarray(C[:, self.terms_of_joints].transpose(1, 0, 2), dtype=self.dtype)

    def collect(self, slopes: Array) -> Array:
        """dL/dC: slopes of all joints, added at the places of their functions."""
        total = np.zeros((slopes.shape[1], self.family.width))
        for places, part in zip(self.terms_of_joints, slopes, strict=True):
            used = places >= 0
            total[:, places[used]] += part[:, used]
        return total

    def expand(
        self,
        X: Array,
        samples: int,
        kept: NDArray[np.bool_] | None = None,
        every: int = 1,
        dtype: DTypeLike | None = None,
    ) -> Array:
        """Gradients with the numbers X in their places, and zeros elsewhere."""
        B, n, _, c = X.shape
        assert c % every == 0
        kept = np.ones(self.family.width, dtype=bool) if kept is None else kept
        # Put each joint's numbers at the places of its functions among the chosen ones
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
    """Gradients of a family of n joints, stored as numbers of type `dtype`."""
    return (
        ProductGradients(family, n, dtype) if isinstance(family, ProductFamily) else SparseGradients(family, n, dtype)
    )
