"""The loss of a network: with gradients by NumPy, or as one CasADi graph of dense products."""

from collections.abc import Iterator, Mapping
from copy import copy
from dataclasses import dataclass, field
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


class _Piece(NamedTuple):
    """Some of the samples."""

    points: Array  #: (c, n)
    data: list[Array]  #: what the loss needs, in blocks
    shares: Array  #: weights of the samples in the mean, in blocks


class ArrayObjective:
    """Mean loss (25) of a network on fixed samples.

    NumPy computes the coordinate gradients and pulls their derivatives back to theta. CasADi computes the loss of a
    sample and its derivative with respect to J_xi, always in double precision. Threads share pieces of samples, whose
    sizes and order do not depend on the number of threads.

    Args:
        family: the coordinates.
        samples: fixed samples of the family's joints.
        weights: weights of the loss.
        start: parameters, (size,), whose orientation the regularity term keeps.
        draw: draws fresh samples.
        single: whether the products of the network are computed in single precision.
        orientation: sign of the volume of the coordinates that the regularity term keeps. Default: that of the start.
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
        m, self.n = samples.task_jacobian.shape[1:]
        self.r, self._family, self._draw = family.outputs, family, draw
        self._single = single
        self._memories = Memories()
        self._loss = Loss.of(Sizes(self.n, m, self.r, samples.metric_inverse is None), weights.by_name)
        self._orientation = orientation
        # the start orients coordinates, at some of the samples
        if orientation is None and (self._loss.oriented or weights.folds > 0):
            some = samples[: RULES.orienting]
            self._orientation = some.orientation(family.pullback(some.points, start)[0])
        self._put(samples)

    def value(self, theta: Array) -> float:
        """L(theta)."""
        small = self._round(theta)
        J = run_in_threads(lambda piece: arrange_blocks(self._family.pullback(piece.points, small)[0]), self._pieces)
        columns = build_value_columns(self._loss)
        parts = zip(J, self._pieces, strict=True)
        return sum(float(np.vdot(columns(own, *piece.data)[0][:, 0], piece.shares)) for own, piece in parts)

    def value_and_gradient(self, theta: Array) -> tuple[float, Array]:
        """L(theta) and dL/dtheta."""
        # each piece: gradients of the network, loss and slopes by CasADi, slopes back to theta
        small, columns = self._round(theta), build_loss_columns(self._loss)

        def part(tools: tuple[Run, ArrayMemory], work: tuple[_Piece, Array]) -> float:
            (run, memory), (piece, result) = tools, work
            # forward through the network, the loss of each sample on its gradients, and back
            J, back = self._family.pullback(piece.points, small, memory)
            entries = arrange_blocks(J)
            losses, slopes = np.empty(piece.shares.shape), np.empty_like(entries)
            for b, block in enumerate(entries):
                run([block, *(array[b] for array in piece.data)], [losses[b], slopes[b]])
            slopes *= piece.shares[:, None]
            by_entry = slopes.reshape(-1, self.n, self.r, slopes.shape[2])
            back(split_by_sample(by_entry, len(J)), result)
            return float(np.vdot(losses, piece.shares))

        # pieces of samples are shared by threads, and their gradients are added in one order
        threads = min(count_threads(), len(self._pieces))
        with columns.borrow(threads) as runs, self._memories.borrow(threads + 1) as (results, *memories):
            gradients = [results.array(f"piece {k}", small.shape, small.dtype) for k in range(len(self._pieces))]
            tools, work = list(zip(runs, memories, strict=True)), list(zip(self._pieces, gradients, strict=True))
            value = sum(run_in_threads_with(tools, part, work))
            gradient = gradients[0].astype(np.float64)
            for slopes in gradients[1:]:
                gradient += slopes
        return value, gradient

    def batches(self, size: int, count: int, seed: tuple[int, ...]) -> Iterator[Self]:
        """The same loss on `count` fresh sample sets of `size` each."""
        for part in split_samples(self._draw(size * count, seed), count):
            other = copy(self)
            other._put(part)
            yield other

    def elsewhere(self, samples: Samples, weights: Mapping[str, float]) -> Self:
        """Other terms of the same coordinates at other samples, with the same orientation.

        Args:
            samples: the samples.
            weights: weights of the terms by name.
        """
        other = copy(self)
        other._loss = Loss.of(self._loss.sizes, weights)
        other._put(samples)
        return other

    def part(self, places: NDArray[np.int_] | slice) -> Self:
        """The same loss on some of its samples, in this order."""
        other = copy(self)
        other._hold(self._points[places], self._entries[places])
        return other

    def _round(self, theta: Array) -> Array:
        """Parameters with numbers of the type of the products."""
        return theta.astype(np.float32 if self._single else np.float64)

    def _put(self, samples: Samples) -> None:
        data = samples.collect_data(self._loss.data, self._orientation)
        self._ends = np.cumsum([array[0].size for array in data], dtype=int)
        self._hold(samples.points, _entries(data, len(samples)))

    def _hold(self, points: Array, entries: Array) -> None:
        """Use these samples, with all data of each in one row, so that samples drawn at random are gathered at once."""
        self._points, self._entries, self._arranged = points, entries, list[_Piece]()

    @property
    def _pieces(self) -> list[_Piece]:
        """The samples in pieces of nearly equal size, arranged once they are evaluated."""
        if not self._arranged:
            N, most = len(self._points), max(RULES.least_piece, RULES.piece // (self.r * self._family.width))
            size = ceil(N / ceil(N / most))
            for k in range(0, N, size):
                *blocks, _ = np.split(arrange_blocks(self._entries[k : k + size]), self._ends, axis=1)
                own = self._points[k : k + size]
                self._arranged.append(_Piece(own, blocks, build_weights(len(own)) * (len(own) / N)))
        return self._arranged


class GraphObjective:
    """Mean loss (25) of any family on fixed samples, with samples side by side as columns.

    Args:
        family: the coordinates.
        samples: fixed samples of the family's joints.
        weights: weights of the loss.
        start: parameters, (size,), whose orientation the regularity term keeps.
        draw: draws fresh samples.
        orientation: sign of the volume of the coordinates that the regularity term keeps. Default: that of the start.
    """

    def __init__(
        self,
        family: Family,
        samples: Samples,
        weights: Weights,
        start: Array,
        draw: Draw,
        orientation: float | None = None,
    ) -> None:
        m, n = samples.task_jacobian.shape[1:]
        loss = Loss.of(Sizes(n, m, family.outputs, samples.metric_inverse is None), weights.by_name)
        self._graphs, self._draw, self._orientation = _Graphs(family, loss), draw, orientation
        if orientation is None and (loss.oriented or weights.folds > 0):
            self._orientation = _orientation(family, start, samples[: RULES.orienting])
        self._put(samples, len(samples))

    def value(self, theta: Array) -> float:
        """L(theta)."""
        return sum(block.run(theta, gradient=False)[0] for block in self._blocks)

    def value_and_gradient(self, theta: Array) -> tuple[float, Array]:
        """L(theta) and dL/dtheta."""
        parts = [block.run(theta, gradient=True) for block in self._blocks]
        return sum(value for value, _ in parts), np.sum([gradient for _, gradient in parts], axis=0)

    def batches(self, size: int, count: int, seed: tuple[int, ...]) -> Iterator[Self]:
        """The same loss on `count` fresh sample sets of `size` each. They share their graphs."""
        for part in split_samples(self._draw(size * count, seed), count):
            other = copy(self)
            other._put(part, size)
            yield other

    def elsewhere(self, samples: Samples, weights: Mapping[str, float]) -> Self:
        """Other terms of the same coordinates at other samples, with the same orientation.

        Args:
            samples: the samples.
            weights: weights of the terms by name.
        """
        other = copy(self)
        other._graphs = _Graphs(self._graphs.family, Loss.of(self._graphs.loss.sizes, weights))
        other._put(samples, len(samples))
        return other

    def part(self, places: NDArray[np.int_] | slice) -> Self:
        """The same loss on some of its samples, in this order."""
        other = copy(self)
        points = self._points[places]
        other._divide(points, self._entries[places], len(points))
        return other

    def _put(self, samples: Samples, room: int) -> None:
        described = samples.collect_data(self._graphs.loss.data, self._orientation)
        self._divide(samples.points, _entries(described, len(samples)), room)

    def _divide(self, points: Array, entries: Array, room: int) -> None:
        """Use these samples. Graphs are built for `room` samples, so that smaller sets share them."""
        self._points, self._entries = points, entries
        graph = self._graphs.of_size(room)
        self._blocks = [
            _Block.filled(graph, points[k : k + graph.columns], entries[k : k + graph.columns], len(points))
            for k in range(0, len(points), graph.columns)
        ]


@dataclass(frozen=True, eq=False)
class _Graphs:
    """The graphs of one loss, one for each number of columns."""

    family: Family
    loss: Loss
    built: dict[int, "_LossGraph"] = field(default_factory=dict)

    def of_size(self, samples: int) -> "_LossGraph":
        """The graph for a set of samples: for all at once, or for as many as stay in the cache."""
        most = max(1, RULES.graph // (self.family.outputs * self.family.width))
        columns = ceil(samples / ceil(samples / most))
        if columns not in self.built:
            self.built[columns] = _LossGraph(self.family, self.loss, columns)
        return self.built[columns]


class _LossGraph:
    """Loss and gradient of samples side by side: functions of theta, q (n, c), data (c, entries) and shares (c, 1)."""

    def __init__(self, family: Family, loss: Loss, columns: int) -> None:
        self.columns = columns
        # the graph of one sample's loss, replayed on columns of samples
        theta, q = ca.MX.sym("theta", family.size), ca.MX.sym("q", loss.sizes.n, columns)
        data = ca.MX.sym("data", columns, sum(symbol.numel() for symbol in loss.symbols()))
        share = ca.MX.sym("share", columns)
        gradients = family.jacobian(q, theta)
        # r times n columns of samples
        by_component = [ca.horzsplit(gradient.T) for gradient in gradients]
        entries = [column for by_joint in zip(*by_component, strict=True) for column in by_joint]
        r = loss.sizes.r
        values, *slopes = replay(
            build_loss_with_slopes(loss).tape, [*entries, *(ca.horzsplit(data) if loss.data else [])]
        )
        weighted = [ca.horzcat(*(share * slope for slope in slopes[j::r])) for j in range(r)]
        # chain rule, split at J_xi: the derivatives of the loss are one sample's graph, replayed on columns
        by_theta = ca.jtimes(ca.horzcat(*gradients), theta, ca.horzcat(*(part.T for part in weighted)), True)
        self._inputs, self._value, self._slope = [theta, q, data, share], ca.dot(share, values), ca.densify(by_theta)

    @cached_property
    def value(self) -> NumpyGraph:
        """The loss alone."""
        return NumpyGraph("loss", self._inputs, [self._value])

    @cached_property
    def both(self) -> NumpyGraph:
        """The loss and its gradient."""
        return NumpyGraph("loss_and_gradient", self._inputs, [self._value, self._slope])


@dataclass(frozen=True, eq=False)
class _Block:
    """Samples in the columns of a graph. Unused columns have weight 0."""

    graph: _LossGraph
    points: Array  #: (c, n)
    data: Array  #: (entries, c)
    share: Array  #: (c,)

    @classmethod
    def filled(cls, graph: _LossGraph, points: Array, data: Array, total: int) -> "_Block":
        """Samples in blocks, with the weight 1 / total each. Unused columns repeat samples with the weight 0."""
        kept = np.arange(graph.columns) % len(points)
        share = np.where(np.arange(graph.columns) < len(points), 1 / total, 0.0)
        return cls(graph, np.ascontiguousarray(points[kept]), np.ascontiguousarray(data[kept].T), share)

    def run(self, theta: Array, gradient: bool) -> tuple[float, Array]:
        """This block's share of the loss and of its gradient, which is empty unless requested."""
        graph = self.graph.both if gradient else self.graph.value
        value, *slopes = graph(np.ascontiguousarray(theta), self.points, self.data, self.share)
        return float(value[0, 0]), slopes[0][0] if gradient else np.empty(0)


def _entries(data: list[Array], samples: int) -> Array:
    """Data of the samples as rows (N, entries), with matrices column by column."""
    flat = [(part.transpose(0, 2, 1) if part.ndim == 3 else part).reshape(samples, -1) for part in data]
    return np.concatenate([np.empty((samples, 0)), *flat], axis=1)


def _orientation(family: Family, theta: Array, samples: Samples) -> float:
    """Orientation of the coordinates with the given parameters."""
    q, parameters = ca.MX.sym("q", samples.points.shape[1], len(samples)), ca.MX.sym("theta", family.size)
    gradients = NumpyGraph("J_xi", [q, parameters], [ca.vertcat(*family.jacobian(q, parameters))])
    (J,) = gradients(np.ascontiguousarray(samples.points), np.ascontiguousarray(theta))  # (N, r n)
    return samples.orientation(J.reshape(len(samples), family.outputs, -1))
