"""The loss of a family of dense products as one CasADi graph, with its gradient by symbolic differentiation."""

from collections.abc import Iterator, Mapping
from copy import copy
from dataclasses import dataclass, field
from math import ceil
from typing import Self

import casadi as ca
import numpy as np

from orthocas.bases.family import Family
from orthocas.fitting.residuals import Loss, loss_with_slopes
from orthocas.fitting.terms import Sizes, Weights
from orthocas.tasks.samples import Draw, Samples, even_parts
from orthocas.tools.blas_graph import NumpyGraph
from orthocas.tools.checks import Array
from orthocas.tools.expressions import replay

_ORIENTING = 200  # samples that determine the orientation of the start
_CHUNK_ENTRIES = 2**20  # entries of the largest matrix in a graph; larger ones leave the cache


class GraphObjective:
    """Mean loss (25) of any family on fixed samples, with samples side by side as columns.

    Args:
        family: the coordinates.
        samples: fixed samples of the family's joints.
        weights: weights of the loss.
        start: parameters, (size,), whose orientation the regularity term keeps.
        draw: draws fresh samples.
    """

    def __init__(self, family: Family, samples: Samples, weights: Weights, start: Array, draw: Draw) -> None:
        m, n = samples.task_jacobian.shape[1:]
        loss = Loss.of(Sizes(n, m, family.outputs, samples.metric_inverse is None), weights.by_name)
        oriented = loss.oriented or weights.folds > 0
        self._graphs, self._draw = _Graphs(family, loss), draw
        self._orientation = _orientation(family, start, samples[:_ORIENTING]) if oriented else None
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
        for part in even_parts(self._draw(size * count, seed), count):
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

    def _put(self, samples: Samples, room: int) -> None:
        """Use these samples. Graphs are built for `room` samples, so that smaller sets share them."""
        entries = _entries(samples.described(self._graphs.loss.data, self._orientation), len(samples))
        graph = self._graphs.of_size(room)
        self._blocks = [
            _Block.filled(graph, samples.points[k : k + graph.columns], entries[k : k + graph.columns], len(samples))
            for k in range(0, len(samples), graph.columns)
        ]


@dataclass(frozen=True, eq=False)
class _Graphs:
    """The graphs of one loss, one for each number of columns."""

    family: Family
    loss: Loss
    known: dict[int, "_LossGraph"] = field(default_factory=dict)

    def of_size(self, samples: int) -> "_LossGraph":
        """The graph for a set of samples: for all at once, or for as many as stay in the cache."""
        most = max(1, _CHUNK_ENTRIES // (self.family.outputs * self.family.width))
        columns = ceil(samples / ceil(samples / most))
        if columns not in self.known:
            self.known[columns] = _LossGraph(self.family, self.loss, columns)
        return self.known[columns]


class _LossGraph:
    """Loss and gradient of samples side by side: functions of theta, q (n, c), data (c, entries) and shares (c, 1)."""

    def __init__(self, family: Family, loss: Loss, columns: int) -> None:
        self.columns = columns
        theta, q = ca.MX.sym("theta", family.size), ca.MX.sym("q", loss.sizes.n, columns)
        data = ca.MX.sym("data", columns, sum(symbol.numel() for symbol in loss.symbols()))
        share = ca.MX.sym("share", columns)
        gradients = family.jacobian(q, theta)
        by_component = [ca.horzsplit(gradient.T) for gradient in gradients]  # r times n columns of samples
        entries = [column for by_joint in zip(*by_component, strict=True) for column in by_joint]
        r = loss.sizes.r
        values, *slopes = replay(loss_with_slopes(loss).tape, [*entries, *(ca.horzsplit(data) if loss.data else [])])
        weighted = [ca.horzcat(*(share * slope for slope in slopes[j::r])) for j in range(r)]
        # chain rule, split at J_xi: the derivatives of the loss are one sample's graph, replayed on columns
        by_theta = ca.jtimes(ca.horzcat(*gradients), theta, ca.horzcat(*(part.T for part in weighted)), True)
        value, inputs = ca.dot(share, values), [theta, q, data, share]
        self.value = NumpyGraph("loss", inputs, [value])
        self.both = NumpyGraph("loss_and_gradient", inputs, [value, ca.densify(by_theta)])


@dataclass(frozen=True, eq=False)
class _Block:
    """Samples in the columns of a graph. Unused columns have weight 0."""

    graph: _LossGraph
    points: Array  #: (c, n)
    data: Array  #: (entries, c)
    share: Array  #: (c,)

    @classmethod
    def filled(cls, graph: _LossGraph, points: Array, data: Array, total: int) -> "_Block":
        """Samples with weight 1 / total each. Unused columns repeat samples with weight 0."""
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
