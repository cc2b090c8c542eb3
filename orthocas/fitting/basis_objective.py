"""The loss of bases as least squares: J_xi is linear in theta, normal equations come in blocks."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from functools import partial
from math import ceil
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from orthocas.bases.family import LinearFamily
from orthocas.fitting.basis_gradients import BasisGradients, build_gradients
from orthocas.fitting.loss import (
    Loss,
    build_curvature_columns,
    build_loss_columns,
    build_residual_columns,
    build_value_columns,
)
from orthocas.fitting.terms import Pairs, Sizes, Weights
from orthocas.tasks.samples import Draw, Samples, split_samples
from orthocas.tools.batch import count_threads, run_in_threads, run_in_threads_with
from orthocas.tools.checks import Array
from orthocas.tools.columns import COLUMNS, Run, arrange_blocks, build_weights, split_by_sample


@dataclass(frozen=True, slots=True)
class ObjectiveRules:
    """Numbers of the products that evaluate losses. They were chosen by the time that a product takes."""

    chunk: int = 512  #: samples per product of a matrix, so that the rows stay in the cache
    blocks: int = 8  #: blocks of samples per thread: fixed, so that sums do not depend on the number of threads
    stride: int = 2  #: every second sample estimates the Gauss-Newton matrix, which is a mean, well enough
    most_stride: int = 16  #: of rough estimates; a divisor of the samples in a block
    hinges: int = 1000  #: samples that estimate the Gauss-Newton matrix of a hinge, about
    coupled: int = 1500  #: coefficients up to which an estimate holds what couples coordinates
    rough: int = 12  #: residuals per coefficient in a rough estimate

    orienting: int = 200  #: samples that determine the orientation of a network's start
    piece: int = 2**18  #: entries of the largest array of a piece of samples; larger ones leave the cache
    least_piece: int = 100  #: samples in a piece; smaller products waste time
    graph: int = 2**20  #: entries of the largest matrix in a graph; larger ones leave the cache


RULES = ObjectiveRules()
Shared = Sequence[tuple[int, int, int, int]]


class BasisObjective:
    """Mean loss (25) of xi = C psi(q) on fixed samples, with gradient, Gauss-Newton matrix and Hessian.

    With the numbers X of the basis gradients sampled once, the coordinate gradients are J_xi = T X, with a table T that
    is linear in C, see `BasisGradients`. The loss of one sample and its derivatives with respect to J_xi come from
    CasADi. The residual of task i and coordinate j depends only on row j of C, so the Gauss-Newton matrix is built
    block by block from few rows per sample.

    Samples are stored in the blocks of `orthocas.tools.columns`: X is (B, g, S, c) and J_xi is (B, n r, c).

    Args:
        family: the coordinates.
        samples: fixed samples of the family's joints.
        weights: weights of the loss.
        start: parameters, (size,), whose orientation the regularity term keeps.
        draw: draws fresh samples.
        kept: the coefficients (r, K) that may differ from zero; theta holds only these. Default: all.
        exchanged: pairs of components whose sum and difference are coordinates, see `orthocas.fitting.starts`. Then
            C and J_xi are those of the components.
        gradients: gradients of the basis, if they are known already, or of another type than float64; products with
            them are computed with numbers of that type. Default: those of the family.
        orientation: sign of the volume of the coordinates that the regularity term keeps. Default: that of the start.
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
            start: parameters that give the orientation, unless it is known.
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
        # J_xi = T X block by block; the loss and its slopes there; and the slopes times X^T, which are dL/dT
        T, columns, parts = self._table(theta), build_loss_columns(self._loss), self._parts
        arrays = (self.X, self._share, *self._data)

        def sum_part(run: Run, part: slice) -> tuple[float, Array]:
            value, gradient = 0.0, np.zeros(T.shape)
            losses, slopes = np.empty(COLUMNS), np.empty((self.n * self.r, COLUMNS))
            # one block at a time, so that X leaves memory only once
            for X, share, *data in zip(*(array[part] for array in arrays), strict=True):
                run([_to_double(T @ X), *data], [losses, slopes])
                value += float(losses @ share)
                shared = (slopes * share).astype(X.dtype, copy=False).reshape(*T.shape[:2], -1)
                gradient += shared @ X.transpose(0, 2, 1)
            return value, gradient

        with columns.borrow(min(count_threads(), len(parts))) as runs:
            sums = run_in_threads_with(runs, sum_part, parts)
        slopes = self._gradients.collect(np.sum([gradient for _, gradient in sums], axis=0))
        return sum(value for value, _ in sums), slopes[self.kept]

    def normal_equations(self, theta: Array) -> tuple[float, Array, Array]:
        """L(theta), its gradient, and the Gauss-Newton matrix, computed with products in single precision."""
        value, gradient = self.value_and_gradient(theta)
        return value, gradient, self._build_matrix(theta, RULES.stride)

    def curvature_estimate(self, theta: Array) -> list[Array]:
        """The Gauss-Newton matrix from as few samples as steer a quasi-Newton method: one block, or its diagonal ones.

        With n joints, r coordinates have about r n^2 / 2 coefficients. The whole matrix takes n^6 operations, and n^9
        to factor. Its blocks, one for each coordinate, take n^5 and n^7.
        """
        # as few samples as leave enough residuals for each coefficient
        residuals = self.N * (self._loss.hinge_rows.start or 1)
        stride = RULES.stride
        while 2 * stride <= RULES.most_stride and residuals >= 2 * stride * RULES.rough * theta.size:
            stride *= 2
        return [self._build_matrix(theta, stride)] if theta.size <= RULES.coupled else self._build_blocks(theta, stride)

    def hessian(self, theta: Array) -> Array:
        """d^2L/dtheta^2, exact, (size, size)."""
        # second derivatives with respect to J_xi at each sample, then the gradients of the basis on both sides
        r, n, K = self.r, self.n, self.K
        (curvature,) = build_curvature_columns(self._loss)(self._evaluate_jacobians(theta), *self._data)
        W = split_by_sample(curvature.reshape(-1, n * r, n * r, curvature.shape[2]), self.N).reshape(-1, n, r, n, r)
        G, H = self._dense, np.zeros((r, K, r, K))
        # each pair of coordinates is a block, filled by one thread

        def fill(pair: tuple[int, int]) -> None:
            i, j = pair
            for start in range(0, self.N, RULES.chunk):
                part = slice(start, start + RULES.chunk)
                raised = W[part, :, i, :, j] @ G[part]  # (chunk, n, K)
                H[i, :, j] += G[part].reshape(-1, K).T @ raised.reshape(-1, K) / self.N
            H[j, :, i] = H[i, :, j].T

        run_in_threads(fill, [(i, j) for i in range(r) for j in range(i + 1)])
        # coefficients that may differ from zero
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
        """The same loss of the same family on another box, without building it again.

        Args:
            gradients: gradients of the basis there.
            samples: the samples.
            start: parameters whose orientation the regularity term keeps.
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
                self._expanded[name] = self._gradients.expand_part(self.X, self.N, row, stride, np.float32)
        return [self._expanded[name] for name in names]

    def _table(self, theta: Array) -> Array:
        """T, (g, n r / g, S)."""
        return self._gradients.build_table(expand(theta, self.kept).reshape(self.r, self.K))

    @property
    def _parts(self) -> list[slice]:
        """The blocks of samples in parts."""
        return [slice(start, start + RULES.blocks) for start in range(0, len(self.X), RULES.blocks)]

    def _evaluate_jacobians(self, theta: Array) -> Array:
        """J_xi, (B, n r, c)."""
        T = self._table(theta)
        J = _to_double(np.concatenate(run_in_threads(lambda part: T @ self.X[part], self._parts)))
        return J.reshape(len(J), self.n * self.r, -1)

    def _build_matrix(self, theta: Array, stride: int) -> Array:
        """Gauss-Newton matrix; that of the smooth residuals from every `stride`-th sample."""
        smooth, hinges = self._differentiate(theta, stride)
        free, rows = int(self.kept.sum()), self._loss.smooth_rows
        H = np.zeros((free, free))
        if smooth:
            # blocks of coordinate pairs, from few rows per sample in single precision
            shared = [(i, j, rows[i].index(row), rows[j].index(row)) for i, j, row in self._loss.shared_rows]
            gradients = self._thin(stride)
            H = build_normal_matrix(smooth, gradients, shared) / len(gradients[0])
        # a hinge couples all coordinates, but acts at few samples
        for D, G, share in hinges:
            active = (D @ G)[:, self.kept]
            H += share * (active.T @ active).astype(float)
        return H

    def _build_blocks(self, theta: Array, stride: int) -> list[Array]:
        """The diagonal blocks of the same matrix, one for the coefficients of each coordinate."""
        smooth, hinges = self._differentiate(theta, stride)

        def build(j: int) -> Array:
            H = np.zeros((int(self.kept[j].sum()),) * 2)
            if smooth:
                gradients = self._thin(stride)[j : j + 1]
                H = build_normal_matrix(smooth[j : j + 1], gradients, ()) / len(gradients[0])
            for D, G, share in hinges:
                active = (D[:, j : j + 1] @ G)[:, 0, self.kept[j]]
                H += share * (active.T @ active).astype(float)
            return H

        return [build(j) for j in range(self.r)]

    def _differentiate(self, theta: Array, stride: int) -> tuple[list[Array], list[tuple[Any, Any, float]]]:
        """Derivatives of residuals with respect to J_xi, in single precision.

        Returns:
            Those of the smooth residuals of each coordinate at every `stride`-th sample, (N / stride, rows, n); none
            if there are none. And for each hinge (N', r, n) at some of the samples where it acts, with gradients of the
            basis there (N', n, K), and by what their products count.
        """
        derivatives = build_residual_columns(self._loss)(self._evaluate_jacobians(theta), *self._data)
        smooth, hinges = list[Array](), list[tuple[Any, Any, float]]()
        if any(self._loss.smooth_rows):
            for derivative in derivatives[: self.r]:
                blocks = derivative.reshape(len(derivative), self.n, -1, derivative.shape[2])
                smooth.append(split_by_sample(blocks, self.N, stride).astype(np.float32))
        for residual, derivative in zip(derivatives[self.r :: 2], derivatives[self.r + 1 :: 2], strict=True):
            # only samples at which the hinge acts, without the padding of the last block
            block, column = np.nonzero((residual[:, 0] > 0) & (self._share > 0))
            # where it acts at most samples, some of them estimate the matrix well enough
            every = max(1, len(block) // RULES.hinges)
            block, column = block[::every], column[::every]
            D = derivative[block, :, column].reshape(-1, self.n, self.r).transpose(0, 2, 1).astype(np.float32)
            chosen: Array = self.X[block, :, :, column]  # (active, g, S)
            G = self._gradients.expand(chosen.transpose(1, 2, 0)[None], len(chosen)).astype(np.float32)
            hinges.append((D, G, every / self.N))
        return smooth, hinges


def _to_double(products: Array) -> Array:
    """Numbers of the type that CasADi's functions read."""
    return products.astype(np.float64, copy=False)


def expand(theta: Array, kept: NDArray[np.bool_]) -> Array:
    """All coefficients, (r K,), from those that may differ from zero."""
    C = np.zeros(kept.shape)
    C[kept] = theta
    return C.ravel()


class BoundedMutual:
    """Minimise the task term of (24) subject to a bound on the mutual term, and to a gauge condition.

    min  E[sum of task cosines^2] lambda1 / (2 m r)  (plus the regularity term, if there is one)
    s.t. E[mean of mutual cosines^2] <= bound^2  and  E|grad xi_j|^2 = 1 for every coordinate j.

    The scales of the coordinates change neither term. The gauge condition fixes them, so that the solution is an
    isolated point. Up to terms of third order, sqrt(E cos^2) is the root mean square deviation of mutual angles from
    a right angle [rad].

    Args:
        objective: the weighted loss on its samples. Its lambda2 is not used.
        bound: upper bound on the root mean square mutual cosine, > 0.

    Source:
        ours, docs/explanation/derivations_meaning.md#constrained-form.
    """

    def __init__(self, objective: BasisObjective, bound: float) -> None:
        # the basis is sampled once, and shared by the objectives below
        weights, self._gram = objective.weights, objective.gram
        self._task = objective.reweigh(Weights(weights.task, 0.0, weights.regularity, angles=weights.angles))
        # 2 cancels the factor 1/2 of the loss
        only_mutual = Weights(0.0, 2.0, 0.0, angles=weights.angles)
        self._mutual = objective.reweigh(only_mutual)
        self._r, self._K, self._bound = objective.r, objective.K, bound

    def value(self, theta: Array) -> float:
        """Task term (and regularity term)."""
        return self._task.value(theta)

    def value_and_gradient(self, theta: Array) -> tuple[float, Array]:
        """Task term (and regularity term) and its gradient, (size,)."""
        return self._task.value_and_gradient(theta)

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds of `constraints`, (1 + r,) each."""
        ones = np.ones(self._r)
        return np.concatenate([[-np.inf], ones]), np.concatenate([[1.0], ones])

    def constraints(self, theta: Array) -> tuple[Array, Array]:
        """Mutual term over its bound, then the gauge of every coordinate, (1 + r,), and their Jacobian."""
        value, gradient = self._mutual.value_and_gradient(theta)
        C = theta.reshape(self._r, self._K)
        raised = C @ self._gram
        gauge = np.zeros((self._r, self._r, self._K))
        gauge[np.arange(self._r), np.arange(self._r)] = 2 * raised
        values = np.concatenate([[value / self._bound**2], (raised * C).sum(axis=1)])
        return values, np.vstack([gradient / self._bound**2, gauge.reshape(self._r, -1)])

    def lagrangian_hessian(self, theta: Array, factor: float, multipliers: Array) -> Array:
        """Hessian of factor L + multipliers . constraints, (size, size)."""
        H: Array = factor * self._task.hessian(theta) + multipliers[0] / self._bound**2 * self._mutual.hessian(theta)
        for j, multiplier in enumerate(multipliers[1:]):
            block = slice(j * self._K, (j + 1) * self._K)
            H[block, block] += 2 * multiplier * self._gram
        return H

    def normalise_gradients(self, theta: Array) -> Array:
        """The same coordinates with E|grad xi_j|^2 = 1."""
        C = theta.reshape(self._r, self._K)
        scaled: Array = C / np.sqrt(((C @ self._gram) * C).sum(axis=1))[:, None]
        return scaled.ravel()


def build_normal_matrix(derivatives: Sequence[Array], gradients: Sequence[Array], shared: Shared) -> Array:
    """Sums over samples of X_j^T X_j, and of x_i^T x_j for residuals that two coordinates share, (size, size).

    X_j = D_j G_j are the derivatives of the residuals of coordinate j with respect to its coefficients. Products are
    taken over chunks of samples, and added in double precision in the order of the chunks.

    Args:
        derivatives: D_j of every coordinate, (N, rows, n).
        gradients: G_j of every coordinate, (N, n, K_j).
        shared: coordinates i > j and the places of their shared residual among the rows of X_i and of X_j.
    """
    r, ends = len(derivatives), np.cumsum([G.shape[2] for G in gradients])
    places = [slice(end - G.shape[2], end) for G, end in zip(gradients, ends, strict=True)]
    H = np.zeros((ends[-1], ends[-1]))
    chunks = range(0, len(gradients[0]), RULES.chunk)
    # so many chunks at a time that there is work for all threads
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
    """Add the products of some chunks: every block by one thread, in the order of the chunks."""

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

    # rows of samples times gradients first, then squares and mixed products of them, each a block of the matrix
    r = len(derivatives)
    rows_of: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for i, j, row, other in shared:
        rows_of.setdefault((i, j), []).append((row, other))
    pieces = [(start, j) for start in starts for j in range(r)]
    X = dict(zip(pieces, run_in_threads(rows, pieces), strict=True))
    work: list[Callable[[], None]] = [partial(square, j) for j in range(r)]
    work += [partial(mixed, pair) for pair in rows_of]
    run_in_threads(lambda block: block(), work)
