"""The loss of one sample: weighted residuals of the gradients d xi / dq, and derivatives, on columns of samples."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import cache
from typing import Any

import casadi as ca
import numpy as np

from orthocas.fitting.terms import (
    SAMPLE_DATA,
    LossTerm,
    Pairs,
    RegularityTerm,
    Sizes,
    coordinates_of,
    find_term,
)
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array
from orthocas.tools.columns import COLUMNS, ColumnFunction, Run

# coordinates from which determinants of numbers are faster than written-out ones
_BY_LAPACK = 8


@dataclass(frozen=True)
class Loss:
    """The loss of one sample: L = |rho|^2 / 2, with the residuals of all terms with a positive weight.

    Rows are in the order of the terms, with those of hinge terms last.
    """

    sizes: Sizes
    weights: tuple[tuple[str, float], ...]  #: names of terms and their positive weights
    exchanged: Pairs = ()  #: rows i, j of J_xi that stand for components, see `coordinates_of`

    @classmethod
    def of(cls, sizes: Sizes, weights: Mapping[str, float], exchanged: Pairs = ()) -> Loss:
        """The terms with a positive weight.

        Raises:
            UnknownNameError: if there is no term for a weight.
        """
        positive = tuple((name, weight) for name, weight in weights.items() if weight > 0 and find_term(name))
        return cls(sizes, positive, exchanged)

    @cached_property
    def terms(self) -> tuple[tuple[LossTerm, float], ...]:
        """Loss terms with their weights, smooth ones first."""
        terms = [(find_term(name), weight) for name, weight in self.weights]
        return tuple(sorted(terms, key=lambda pair: pair[0].hinge))

    @cached_property
    def data(self) -> tuple[str, ...]:
        """The sample data that the terms need, in the order of the inputs of this module's functions."""
        needed = {name for term, _ in self.terms for name in term.data}
        if self.sizes.identity_metric:
            needed.discard("metric_inverse")
        return tuple(sorted(needed))

    @cached_property
    def oriented(self) -> bool:
        """Whether the loss needs a null basis with the orientation of the coordinates."""
        return "null_basis" in self.data

    @cached_property
    def volume_terms(self) -> tuple[tuple[float, RegularityTerm], ...]:
        """Weights and terms whose determinants are too large to be written out."""
        if self.sizes.r < _BY_LAPACK:
            return ()
        return tuple((weight, term) for term, weight in self.terms if isinstance(term, RegularityTerm))

    @cached_property
    def written_out(self) -> Loss:
        """The loss without its volume terms."""
        names = {term.name for _, term in self.volume_terms}
        kept = tuple(pair for pair in self.weights if pair[0] not in names)
        return Loss(self.sizes, kept, self.exchanged) if names else self

    def symbols(self) -> list[ca.SX]:
        """Symbols of the data of one sample, in the order of `data`."""
        return [ca.SX.sym(name, *SAMPLE_DATA[name](self.sizes)) for name in self.data]

    def residuals(self, coordinate_jacobian: ca.SX, data: list[ca.SX]) -> ca.SX:
        """Residuals rho of one sample, (rows, 1)."""
        named = dict(zip(self.data, data, strict=True))
        J = ca.vertcat(*coordinates_of([coordinate_jacobian[j, :] for j in range(self.sizes.r)], self.exchanged))
        rho: ca.SX = ca.vertcat(*(weight**0.5 * term.residuals(J, named, self.sizes) for term, weight in self.terms))
        return rho

    @cached_property
    def smooth_rows(self) -> tuple[tuple[int, ...], ...]:
        """For every coordinate j, the rows of `written_out` that depend on it, without hinge rows."""
        touched = self._touched
        return tuple(
            tuple(row for row, coordinates in enumerate(touched) if j in coordinates and row not in self.hinge_rows)
            for j in range(self.sizes.r)
        )

    @cached_property
    def shared_rows(self) -> tuple[tuple[int, int, int], ...]:
        """(i, j, row) with i > j for every row that depends on both coordinates, without hinge rows."""
        return tuple(
            (i, j, row)
            for row, coordinates in enumerate(self._touched)
            for i in coordinates
            for j in coordinates
            if i > j and row not in self.hinge_rows
        )

    @cached_property
    def hinge_rows(self) -> range:
        """Rows of the hinge terms of `written_out`, which are the last ones."""
        if self.volume_terms:
            return self.written_out.hinge_rows
        J, data = self.arguments()
        named = dict(zip(self.data, data, strict=True))
        counts = [term.residuals(J, named, self.sizes).shape[0] for term, _ in self.terms if not term.hinge]
        return range(sum(counts), len(self._touched))

    @cached_property
    def _touched(self) -> list[list[int]]:
        """The coordinates that each row of `written_out` depends on."""
        if self.volume_terms:
            return self.written_out._touched
        # a row depends on the coordinates whose entries of J_xi are in its sparsity pattern
        J, data = self.arguments()
        by_entry = ca.jacobian(self.residuals(J, data), ca.vec(J)).sparsity()
        touched: list[set[int]] = [set() for _ in range(by_entry.size1())]
        for row, entry in zip(*by_entry.get_triplet(), strict=True):
            touched[row].add(entry % self.sizes.r)
        return [sorted(coordinates) for coordinates in touched]

    def arguments(self) -> tuple[ca.SX, list[ca.SX]]:
        """Symbols of J_xi (r, n) and of the data of one sample."""
        return ca.SX.sym("J", self.sizes.r, self.sizes.n), self.symbols()


@cache
def build_sample_loss(loss: Loss) -> ca.Function:
    """Loss of one sample (1, 1) as a function of J_xi (r, n) and the data in `Loss.symbols`."""
    J, data = loss.arguments()
    return ca.Function("build_sample_loss", [J, *data], [ca.sumsqr(loss.residuals(J, data)) / 2])


@cache
def build_loss_with_slopes(loss: Loss) -> ColumnFunction:
    """Loss of one sample (1, 1) and its derivative dL/dJ_xi (r, n), with the inputs of `build_sample_loss`."""
    J, data = loss.arguments()
    value = ca.sumsqr(loss.residuals(J, data)) / 2
    return ColumnFunction(ca.Function("loss", [J, *data], [value, ca.gradient(value, J)]))


@cache
def build_loss_columns(loss: Loss) -> ColumnFunction | LossWithVolumes:
    """Like `build_loss_with_slopes`, with volumes of many gradients by LAPACK."""
    return LossWithVolumes(loss, build_loss_with_slopes) if loss.volume_terms else build_loss_with_slopes(loss)


@cache
def build_value_columns(loss: Loss) -> ColumnFunction | LossWithVolumes:
    """Loss of one sample, with the inputs of `build_sample_loss`."""

    def written(part: Loss) -> ColumnFunction:
        return ColumnFunction(build_sample_loss(part))

    return LossWithVolumes(loss, written, slopes=False) if loss.volume_terms else written(loss)


@cache
def build_residual_columns(loss: Loss) -> Callable[..., list[Array]]:
    """Derivatives of the residuals of one sample with respect to J_xi, for the Gauss-Newton matrix.

    The inputs are those of `build_sample_loss`. The outputs are, for every coordinate j, the derivative of
    `smooth_rows[j]` with respect to row j of J_xi, (rows, n); then, for every hinge row and every volume term, the
    residual (1, 1) and its derivative with respect to J_xi, (r, n).
    """
    if loss.volume_terms:
        return LossWithVolumes(loss, build_residual_columns).residuals
    J, data = loss.arguments()
    r, n = loss.sizes.r, loss.sizes.n
    rho = loss.residuals(J, data)
    # its columns are the entries of J_xi, column by column
    by_entry = ca.jacobian(rho, ca.vec(J))
    outputs = [by_entry[list(loss.smooth_rows[j]), j::r] for j in range(r)]
    for row in loss.hinge_rows:
        outputs += [rho[row], ca.reshape(by_entry[row, :], r, n)]
    return ColumnFunction(ca.Function("residuals", [J, *data], outputs))


@cache
def build_curvature_columns(loss: Loss) -> ColumnFunction:
    """Second derivatives of the loss of one sample with respect to J_xi column by column, (n r, n r).

    The inputs are those of `build_sample_loss`.
    """
    J, data = loss.arguments()
    column = ca.SX.sym("v", loss.sizes.r * loss.sizes.n)
    value = build_sample_loss(loss)(ca.reshape(column, loss.sizes.r, loss.sizes.n), *data)
    second = ca.Function("second", [column, *data], [ca.hessian(value, column)[0]])
    return ColumnFunction(ca.Function("curvature", [J, *data], [second(ca.vec(J), *data)]))


class LossWithVolumes:
    """A loss on columns of samples, like a `ColumnFunction`, whose volume terms are computed by LAPACK.

    Args:
        loss: with at least one volume term.
        written: makes the function of the other terms.
        slopes: whether outputs are values and slopes, or only values.
    """

    def __init__(self, loss: Loss, written: Callable[[Loss], Any], slopes: bool = True) -> None:
        rest = loss.written_out
        self._loss, self._slopes = loss, slopes
        self._written = written(rest) if rest.weights else None
        self._places = [loss.data.index(name) for name in rest.data]

    def __call__(self, J: Array, *data: Array) -> list[Array]:
        """Outputs (B, entries, c) for contiguous inputs (B, entries, c)."""
        shapes = [(len(J), 1, COLUMNS), *([J.shape] if self._slopes else [])]
        results = [np.empty(shape) for shape in shapes]
        with self.borrow(1) as (run,):
            for b in range(len(J)):
                run([J[b], *(array[b] for array in data)], [result[b] for result in results])
        return results

    @contextmanager
    def borrow(self, count: int) -> Iterator[list[Run]]:
        """Functions of blocks for so many threads; see `ColumnFunction.borrow`."""
        with ExitStack() as stack:
            written: Sequence[Run | None] = [None] * count
            if self._written is not None:
                written = stack.enter_context(self._written.borrow(count))
            yield [self._run(own) for own in written]

    def residuals(self, J: Array, *data: Array) -> list[Array]:
        """The outputs of `build_residual_columns`."""
        if self._written is None:
            results = [np.empty((len(J), 0, COLUMNS)) for _ in range(self._loss.sizes.r)]
        else:
            results = self._written(J, *(data[k] for k in self._places))
        for weight, term in self._loss.volume_terms:
            parts = [self._of_block(term, J[b], [array[b] for array in data]) for b in range(len(J))]
            results.append(weight**0.5 * np.stack([rho[None] for rho, _ in parts]))
            results.append(weight**0.5 * np.stack([slopes for _, slopes in parts]))
        return results

    def _run(self, written: Run | None) -> Run:
        def run(arguments: Sequence[Array], results: Sequence[Array]) -> None:
            if written is None:
                for result in results:
                    result[...] = 0.0
            else:
                written([arguments[0], *(arguments[1 + k] for k in self._places)], results)
            # then the volume terms, whose determinants LAPACK computes
            for weight, term in self._loss.volume_terms:
                rho, slope = self._of_block(term, arguments[0], arguments[1:])
                results[0][...] += (weight / 2 * rho**2).reshape(results[0].shape)
                if self._slopes:
                    results[1][...] += (weight * rho * slope.reshape(-1, len(rho))).reshape(results[1].shape)

        return run

    def _of_block(self, term: RegularityTerm, J: Array, data: Sequence[Array]) -> tuple[Array, Array]:
        """Residuals (c,) of one block (n r, c), and their derivatives (n r, c)."""
        sizes, pairs = self._loss.sizes, self._loss.exchanged
        named = dict(zip(self._loss.data, data, strict=True))
        # r times (c, n)
        rows = list(J.reshape(sizes.n, sizes.r, -1).transpose(1, 2, 0))
        Z = named["null_basis"].reshape(sizes.r, sizes.n, -1).transpose(2, 1, 0)
        A = named.get("metric_inverse")
        metric_inverse = None if A is None else A.reshape(sizes.n, sizes.n, -1).transpose(2, 1, 0)
        turned = np.stack(coordinates_of(rows, pairs), axis=1)
        rho, slopes = term.hinges(turned, Z, metric_inverse)
        back = coordinates_of(list(slopes.transpose(1, 0, 2)), tuple((j, i) for i, j in pairs))
        return rho, np.ascontiguousarray(np.stack(back).transpose(2, 0, 1)).reshape(J.shape)
