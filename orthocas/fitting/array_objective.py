"""The loss of a family whose coordinate gradients NumPy computes, in double or single precision."""

from collections.abc import Iterator, Mapping
from copy import copy
from math import ceil
from typing import NamedTuple, Self

import numpy as np

from orthocas.bases.family import ArrayFamily, ArrayMemory, Memories
from orthocas.fitting.residuals import Loss, loss_columns, value_columns
from orthocas.fitting.terms import Sizes, Weights
from orthocas.tasks.samples import Draw, Samples, even_parts
from orthocas.tools.batch import in_threads, in_threads_with, thread_count
from orthocas.tools.checks import Array
from orthocas.tools.columns import Run, blocked, by_sample, shares

_ORIENTING = 200  # samples that determine the orientation of the start
_ENTRIES = 2**18  # of the largest array of a piece of samples; larger ones leave the cache
_LEAST = 100  # samples in a piece; smaller products waste time


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
    """

    def __init__(
        self,
        family: ArrayFamily,
        samples: Samples,
        weights: Weights,
        start: Array,
        draw: Draw,
        single: bool = False,
    ) -> None:
        m, self.n = samples.task_jacobian.shape[1:]
        self.r, self._family, self._draw = family.outputs, family, draw
        self._single = single
        self._memories = Memories()
        self._loss = Loss.of(Sizes(self.n, m, self.r, samples.metric_inverse is None), weights.by_name)
        self._orientation: float | None = None
        if self._loss.oriented or weights.folds > 0:
            some = samples[:_ORIENTING]
            self._orientation = some.orientation(family.pullback(some.points, start)[0])
        self._put(samples)

    def value(self, theta: Array) -> float:
        """L(theta)."""
        small = self._rounded(theta)
        J = in_threads(lambda piece: blocked(self._family.pullback(piece.points, small)[0]), self._pieces)
        columns = value_columns(self._loss)
        parts = zip(J, self._pieces, strict=True)
        return sum(float(np.vdot(columns(own, *piece.data)[0][:, 0], piece.shares)) for own, piece in parts)

    def value_and_gradient(self, theta: Array) -> tuple[float, Array]:
        """L(theta) and dL/dtheta."""
        small, columns = self._rounded(theta), loss_columns(self._loss)

        def part(tools: tuple[Run, ArrayMemory], work: tuple[_Piece, Array]) -> float:
            (run, memory), (piece, result) = tools, work
            J, back = self._family.pullback(piece.points, small, memory)
            entries = blocked(J)
            losses, slopes = np.empty(piece.shares.shape), np.empty_like(entries)
            for b, block in enumerate(entries):
                run([block, *(array[b] for array in piece.data)], [losses[b], slopes[b]])
            slopes *= piece.shares[:, None]
            by_entry = slopes.reshape(-1, self.n, self.r, slopes.shape[2])
            back(by_sample(by_entry, len(J)), result)
            return float(np.vdot(losses, piece.shares))

        threads = min(thread_count(), len(self._pieces))
        with columns.borrowed(threads) as runs, self._memories.borrowed(threads + 1) as (results, *memories):
            gradients = [results.array(f"piece {k}", small.shape, small.dtype) for k in range(len(self._pieces))]
            tools, work = list(zip(runs, memories, strict=True)), list(zip(self._pieces, gradients, strict=True))
            value = sum(in_threads_with(tools, part, work))
            gradient = gradients[0].astype(np.float64)
            for slopes in gradients[1:]:
                gradient += slopes
        return value, gradient

    def batches(self, size: int, count: int, seed: tuple[int, ...]) -> Iterator[Self]:
        """The same loss on `count` fresh sample sets of `size` each."""
        for part in even_parts(self._draw(size * count, seed), count):
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

    def _rounded(self, theta: Array) -> Array:
        """Parameters with numbers of the type of the products."""
        return theta.astype(np.float32 if self._single else np.float64)

    def _put(self, samples: Samples) -> None:
        """Use these samples, in pieces of nearly equal size."""
        N, most = len(samples), max(_LEAST, _ENTRIES // (self.r * self._family.width))
        size = ceil(N / ceil(N / most))
        data = samples.described(self._loss.data, self._orientation)
        self._pieces = []
        for k in range(0, N, size):
            points = samples.points[k : k + size]
            blocks = [blocked(array[k : k + size]) for array in data]
            self._pieces.append(_Piece(points, blocks, shares(len(points)) * (len(points) / N)))
