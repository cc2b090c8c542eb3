"""The loss of families that are not linear: of networks with NumPy arrays, of others with CasADi graphs."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from copy import copy
from math import ceil
from typing import NamedTuple, Self

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from orthocas.bases.family import ArrayFamily, ArrayMemory, Family, Memories
from orthocas.fitting.basis_objective import RULES
from orthocas.fitting.sample_loss import Loss, build_loss_columns, build_loss_with_slopes, build_value_columns
from orthocas.fitting.terms import Sizes, Weights
from orthocas.tasks.samples import Draw, Samples, split_samples
from orthocas.tools.batch import count_threads, run_in_threads, run_in_threads_with
from orthocas.tools.blas_graph import NumpyGraph
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array
from orthocas.tools.columns import Run, arrange_blocks, build_weights, split_by_sample
from orthocas.tools.expressions import replay


class _SampledLoss(ABC):
    """Mean loss (25) of a family on fixed samples. Subclasses evaluate it.

    Args:
        family: the coordinates.
        samples: fixed samples of the family's joints.
        weights: weights of the loss.
        start: parameters, (size,). The regularity term keeps the orientation of their coordinates.
        draw: draws fresh samples.
        orientation: sign of the coordinates' volume, which the regularity term keeps. Default: that of the start.
    """

    def __init__(
        self, family: Family, samples: Samples, weights: Weights, start: Array, draw: Draw, orientation: float | None
    ) -> None:
        m, n = samples.task_jacobian.shape[1:]
        self._draw, self._orientation = draw, orientation
        self._loss = Loss.of(Sizes(n, m, family.outputs, samples.metric_inverse is None), weights.by_name)
        # The orientation is that of the start at up to 200 of the samples
        if orientation is None and (self._loss.oriented or weights.folds > 0):
            some = samples[: RULES.orienting]
            q, theta = ca.MX.sym("q", n, len(some)), ca.MX.sym("theta", family.size)
            graph = NumpyGraph("J_xi", [q, theta], [ca.vertcat(*family.jacobian(q, theta))])
            (J,) = graph(np.ascontiguousarray(some.points), np.ascontiguousarray(start))
            self._orientation = some.orientation(J.reshape(len(some), family.outputs, n))
        self._put(samples, len(samples))

    @abstractmethod
    def _hold(self, points: Array, entries: Array, room: int) -> None:
        """Use these samples, with the data of each as a row of `entries`. Graphs are built for `room` samples."""

    def _put(self, samples: Samples, room: int) -> None:
        """Use these samples. The data of a sample are one row, with the entries of matrices column by column."""
        data, N = samples.collect_data(self._loss.data, self._orientation), len(samples)
        flat = [(part.transpose(0, 2, 1) if part.ndim == 3 else part).reshape(N, -1) for part in data]
        self._ends = np.cumsum([part.shape[1] for part in flat], dtype=int)
        self._points, self._entries = samples.points, np.concatenate([np.empty((N, 0)), *flat], axis=1)
        self._hold(self._points, self._entries, room)

    def batches(self, size: int, count: int, seed: tuple[int, ...]) -> Iterator[Self]:
        """The same loss on `count` fresh sample sets of `size` each."""
        for part in split_samples(self._draw(size * count, seed), count):
            other = copy(self)
            other._put(part, size)
            yield other

    def elsewhere(self, samples: Samples, weights: Mapping[str, float]) -> Self:
        """As in `BasisObjective.elsewhere`."""
        other = copy(self)
        other._loss = Loss.of(self._loss.sizes, weights)
        other._put(samples, len(samples))
        return other

    def part(self, places: NDArray[np.int_] | slice) -> Self:
        """The same loss on the samples at these places, in this order."""
        other = copy(self)
        other._points, other._entries = self._points[places], self._entries[places]
        other._hold(other._points, other._entries, len(other._points))
        return other


class _Piece(NamedTuple):
    """A part of the samples, which one thread evaluates at a time."""

    points: Array  #: (c, n)
    data: list[Array]  #: data of the loss, in the blocks of `orthocas.tools.columns`
    shares: Array  #: weights of the samples in the mean, in blocks


class ArrayObjective(_SampledLoss):
    """The loss of a network: NumPy computes the coordinate gradients, and pulls their derivatives back to theta.

    CasADi computes the loss of a sample and its derivative with respect to J_xi, always in double precision; with
    `single`, the products of the network are computed in single precision. Threads share pieces of samples, whose sizes
    and order do not depend on the number of threads.
    """

    def __init__(
        self,
        family: ArrayFamily,
        samples: Samples,
        weights: Weights,
        start: Array,
        draw: Draw,
        single: bool = False,
        orientation: float | None = None,
    ) -> None:
        self._family, self._single, self._memories = family, single, Memories()
        super().__init__(family, samples, weights, start, draw, orientation)

    def value(self, theta: Array) -> float:
        """L(theta)."""
        small = self._round(theta)
        J = run_in_threads(lambda piece: arrange_blocks(self._family.pullback(piece.points, small)[0]), self._pieces)
        columns = build_value_columns(self._loss)
        parts = zip(J, self._pieces, strict=True)
        return sum(float(np.vdot(columns(own, *piece.data)[0][:, 0], piece.shares)) for own, piece in parts)

    def value_and_gradient(self, theta: Array) -> tuple[float, Array]:
        """L(theta) and dL/dtheta."""
        # For each piece of samples: J_xi of the network, the loss and its slopes, and these pulled back to theta
        small, columns, sizes = self._round(theta), build_loss_columns(self._loss), self._loss.sizes

        def part(tools: tuple[Run, ArrayMemory], work: tuple[_Piece, Array]) -> float:
            (run, memory), (piece, result) = tools, work
            # The network gives J_xi and a function `back`, which adds slopes with respect to theta to its result
            J, back = self._family.pullback(piece.points, small, memory)
            entries = arrange_blocks(J)
            losses, slopes = np.empty(piece.shares.shape), np.empty_like(entries)
            for b, block in enumerate(entries):
                run([block, *(array[b] for array in piece.data)], [losses[b], slopes[b]])
            slopes *= piece.shares[:, None]
            by_entry = slopes.reshape(-1, sizes.n, sizes.r, slopes.shape[2])
            back(split_by_sample(by_entry, len(J)), result)
            return float(np.vdot(losses, piece.shares))

        # Threads share the pieces. Gradients are added in the order of the pieces, so the sum is always the same
        threads = min(count_threads(), len(self._pieces))
        with columns.borrow(threads) as runs, self._memories.borrow(threads + 1) as (results, *memories):
            gradients = [results.array(f"piece {k}", small.shape, small.dtype) for k in range(len(self._pieces))]
            tools, work = list(zip(runs, memories, strict=True)), list(zip(self._pieces, gradients, strict=True))
            value = sum(run_in_threads_with(tools, part, work))
            gradient = gradients[0].astype(np.float64)
            for slopes in gradients[1:]:
                gradient += slopes
        return value, gradient

    def _round(self, theta: Array) -> Array:
        """Parameters in the number type of the products."""
        return theta.astype(np.float32 if self._single else np.float64)

    def _hold(self, points: Array, entries: Array, room: int) -> None:
        self._arranged = list[_Piece]()

    @property
    def _pieces(self) -> list[_Piece]:
        """The samples in pieces of nearly equal size, which are arranged on first use."""
        if not self._arranged:
            N, entries = len(self._points), self._family.outputs * self._family.width
            most = max(RULES.least_piece, RULES.piece // entries)
            size = ceil(N / ceil(N / most))
            for k in range(0, N, size):
                *blocks, _ = np.split(arrange_blocks(self._entries[k : k + size]), self._ends, axis=1)
                own = self._points[k : k + size]
                self._arranged.append(_Piece(own, blocks, build_weights(len(own)) * (len(own) / N)))
        return self._arranged


class GraphObjective(_SampledLoss):
    """The loss of any family, by CasADi graphs that take many samples at once as columns."""

    def __init__(
        self,
        family: Family,
        samples: Samples,
        weights: Weights,
        start: Array,
        draw: Draw,
        orientation: float | None = None,
    ) -> None:
        # Cache: graphs by loss and number of columns. Copies of the objective share it
        self._family, self._graphs = family, dict[tuple[Loss, int], _LossGraph]()
        super().__init__(family, samples, weights, start, draw, orientation)

    def value(self, theta: Array) -> float:
        """L(theta)."""
        start = np.ascontiguousarray(theta)
        return sum(float(self._graph.value(start, *block)[0][0, 0]) for block in self._blocks)

    def value_and_gradient(self, theta: Array) -> tuple[float, Array]:
        """L(theta) and dL/dtheta."""
        start = np.ascontiguousarray(theta)
        parts = [self._graph.both(start, *block) for block in self._blocks]
        return sum(float(value[0, 0]) for value, _ in parts), np.sum([slopes[0] for _, slopes in parts], axis=0)

    def _hold(self, points: Array, entries: Array, room: int) -> None:
        # The graph takes all samples at once, or fewer, so that its matrices fit the cache
        columns = ceil(room / ceil(room / max(1, RULES.graph // (self._family.outputs * self._family.width))))
        if (self._loss, columns) not in self._graphs:
            self._graphs[self._loss, columns] = _LossGraph(self._family, self._loss, columns)
        self._graph = self._graphs[self._loss, columns]
        # Blocks have points (c, n), data (entries, c) and shares (c,). The last one repeats samples with the share 0
        self._blocks = []
        for k in range(0, len(points), columns):
            own = k + np.arange(columns) % min(columns, len(points) - k)
            share = np.where(np.arange(columns) < len(points) - k, 1 / len(points), 0.0)
            self._blocks.append((np.ascontiguousarray(points[own]), np.ascontiguousarray(entries[own].T), share))


class _LossGraph:
    """Loss and gradient for c samples at once: functions of theta, q (n, c), data (c, entries) and shares (c, 1)."""

    def __init__(self, family: Family, loss: Loss, columns: int) -> None:
        # Replay the graph of one sample's loss on columns: every operation then acts on all samples
        theta, q = ca.MX.sym("theta", family.size), ca.MX.sym("q", loss.sizes.n, columns)
        data = ca.MX.sym("data", columns, sum(symbol.numel() for symbol in loss.arguments()[1]))
        share = ca.MX.sym("share", columns)
        gradients = family.jacobian(q, theta)
        # The entries of J_xi in the order of the graph's inputs, each a column with all samples
        by_component = [ca.horzsplit(gradient.T) for gradient in gradients]
        entries = [column for by_joint in zip(*by_component, strict=True) for column in by_joint]
        r = loss.sizes.r
        values, *slopes = replay(
            build_loss_with_slopes(loss).tape, [*entries, *(ca.horzsplit(data) if loss.data else [])]
        )
        weighted = [ca.horzcat(*(share * slope for slope in slopes[j::r])) for j in range(r)]
        # Chain rule: dL/dtheta from the slopes dL/dJ_xi and the derivatives of J_xi with respect to theta
        by_theta = ca.jtimes(ca.horzcat(*gradients), theta, ca.horzcat(*(part.T for part in weighted)), True)
        self._inputs, self._value, self._slope = [theta, q, data, share], ca.dot(share, values), ca.densify(by_theta)

    @cached_property
    def value(self) -> NumpyGraph:
        """Function that returns the loss."""
        return NumpyGraph("loss", self._inputs, [self._value])

    @cached_property
    def both(self) -> NumpyGraph:
        """Function that returns the loss and its gradient."""
        return NumpyGraph("loss_and_gradient", self._inputs, [self._value, self._slope])
