"""The loss of one sample, half the sum of squared residuals of d xi / dq, and its derivatives, for many samples."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import cache, partial

import casadi as ca
import numpy as np

from orthocas.fitting.terms import (
    SAMPLE_DATA,
    ArrayTerm,
    LossTerm,
    Pairs,
    RegularityTerm,
    Sizes,
    UnitGradients,
    coordinates_of,
    find_term,
)
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array
from orthocas.tools.columns import COLUMNS, ColumnFunction, Run

# Number of coordinates from which NumPy arrays are faster than CasADi expressions
_BY_ARRAYS = 8


@dataclass(frozen=True)
class Loss:
    """The loss of one sample: L = |rho|^2 / 2, with the residuals rho of all terms that have a positive weight.

    The rows of rho are in the order of the terms, with those of hinge terms last.
    """

    sizes: Sizes
    weights: tuple[tuple[str, float], ...]  #: names of terms and their positive weights
    exchanged: Pairs = ()  #: rows i, j of J_xi that stand for components, see `coordinates_of`

    @classmethod
    def of(cls, sizes: Sizes, weights: Mapping[str, float], exchanged: Pairs = ()) -> Loss:
        """The loss of the terms with a positive weight.

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
        """Names of the sample data that the terms need, in the order in which functions of this module take them."""
        needed = {name for term, _ in self.terms for name in term.data}
        if self.sizes.identity_metric:
            needed.discard("metric_inverse")
        return tuple(sorted(needed))

    @cached_property
    def oriented(self) -> bool:
        """Whether the loss needs a null basis, oriented like the coordinates."""
        return "null_basis" in self.data

    @cached_property
    def array_terms(self) -> tuple[tuple[float, ArrayTerm], ...]:
        """Weights and terms that NumPy arrays evaluate; none for fewer than 8 coordinates."""
        if self.sizes.r < _BY_ARRAYS:
            return ()
        terms = ((weight, term) for term, weight in self.terms if isinstance(term, ArrayTerm))
        return tuple((weight, term) for weight, term in terms if term.by_arrays(self.sizes))

    @property
    def all_by_arrays(self) -> bool:
        """Whether arrays evaluate all terms, and no coordinates are exchanged."""
        return len(self.array_terms) == len(self.terms) and not self.exchanged

    @cached_property
    def volume_terms(self) -> tuple[tuple[float, RegularityTerm], ...]:
        """Those of `array_terms` whose determinants are too large to be written as expressions."""
        return tuple((weight, term) for weight, term in self.array_terms if isinstance(term, RegularityTerm))

    @cached_property
    def written_out(self) -> Loss:
        """The loss without its volume terms."""
        return self.leave_out(self.volume_terms)

    def leave_out(self, terms: Sequence[tuple[float, LossTerm]]) -> Loss:
        """The loss without some terms."""
        names = {term.name for _, term in terms}
        kept = tuple(pair for pair in self.weights if pair[0] not in names)
        return Loss(self.sizes, kept, self.exchanged) if names else self

    def residuals(self, coordinate_jacobian: ca.SX, data: list[ca.SX]) -> ca.SX:
        """Residuals rho of one sample, (rows, 1)."""
        named = dict(zip(self.data, data, strict=True))
        J = ca.vertcat(*coordinates_of([coordinate_jacobian[j, :] for j in range(self.sizes.r)], self.exchanged))
        rho: ca.SX = ca.vertcat(*(weight**0.5 * term.residuals(J, named, self.sizes) for term, weight in self.terms))
        return rho

    @cached_property
    def smooth_rows(self) -> tuple[tuple[int, ...], ...]:
        """For every coordinate j, the rows of `written_out` that depend on it, except hinge rows."""
        touched = self._touched
        return tuple(
            tuple(row for row, coordinates in enumerate(touched) if j in coordinates and row not in self.hinge_rows)
            for j in range(self.sizes.r)
        )

    @cached_property
    def shared_rows(self) -> tuple[tuple[int, int, int], ...]:
        """(i, j, row) with i > j for every row that depends on both coordinates i and j, except hinge rows."""
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
        return range(self.smooth_count, len(self._touched))

    @cached_property
    def smooth_count(self) -> int:
        """Number of residuals of terms that are no hinges."""
        J, data = self.arguments()
        named = dict(zip(self.data, data, strict=True))
        return sum(term.residuals(J, named, self.sizes).shape[0] for term, _ in self.terms if not term.hinge)

    @cached_property
    def _touched(self) -> list[list[int]]:
        """The coordinates that each row of `written_out` depends on."""
        if self.volume_terms:
            return self.written_out._touched
        # A row depends on the coordinates whose entries of J_xi are in its sparsity pattern
        J, data = self.arguments()
        by_entry = ca.jacobian(self.residuals(J, data), ca.vec(J)).sparsity()
        touched: list[set[int]] = [set() for _ in range(by_entry.size1())]
        for row, entry in zip(*by_entry.get_triplet(), strict=True):
            touched[row].add(entry % self.sizes.r)
        return [sorted(coordinates) for coordinates in touched]

    def arguments(self) -> tuple[ca.SX, list[ca.SX]]:
        """CasADi symbols for J_xi (r, n) and for the data of one sample, in the order of `data`."""
        symbols = [ca.SX.sym(name, *SAMPLE_DATA[name](self.sizes)) for name in self.data]
        return ca.SX.sym("J", self.sizes.r, self.sizes.n), symbols


@cache
def build_sample_loss(loss: Loss) -> ca.Function:
    """Loss of one sample (1, 1) as a function of `Loss.arguments`."""
    J, data = loss.arguments()
    return ca.Function("build_sample_loss", [J, *data], [ca.sumsqr(loss.residuals(J, data)) / 2])


@cache
def build_loss_with_slopes(loss: Loss) -> ColumnFunction:
    """Loss of one sample (1, 1) and its derivative dL/dJ_xi (r, n), with the inputs of `build_sample_loss`."""
    J, data = loss.arguments()
    value = ca.sumsqr(loss.residuals(J, data)) / 2
    return ColumnFunction(ca.Function("loss", [J, *data], [value, ca.gradient(value, J)]))


@cache
def build_loss_columns(loss: Loss) -> ColumnFunction | LossByArrays:
    """Like `build_loss_with_slopes`, but arrays evaluate the `array_terms`."""
    return LossByArrays(loss, build_loss_with_slopes) if loss.array_terms else build_loss_with_slopes(loss)


@cache
def build_value_columns(loss: Loss) -> ColumnFunction | LossByArrays:
    """Loss of one sample without derivatives, with the inputs of `build_sample_loss`."""

    def written(part: Loss) -> ColumnFunction:
        return ColumnFunction(build_sample_loss(part))

    return LossByArrays(loss, written, slopes=False) if loss.array_terms else written(loss)


@cache
def build_residual_columns(loss: Loss) -> Callable[..., list[Array]]:
    """Derivatives of the residuals of one sample with respect to J_xi, for the Gauss-Newton matrix.

    The inputs are those of `build_sample_loss`. The outputs are, for every coordinate j, the derivative of
    `smooth_rows[j]` with respect to row j of J_xi, (rows, n); then, for every hinge row and every volume term, the
    residual (1, 1) and its derivative with respect to J_xi, (r, n).
    """
    if loss.volume_terms:
        return partial(_add_volumes, loss)
    J, data = loss.arguments()
    r, n = loss.sizes.r, loss.sizes.n
    rho = loss.residuals(J, data)
    # The columns of this Jacobian belong to the entries of J_xi, taken column by column
    by_entry = ca.jacobian(rho, ca.vec(J))
    outputs = [by_entry[list(loss.smooth_rows[j]), j::r] for j in range(r)]
    for row in loss.hinge_rows:
        outputs += [rho[row], ca.reshape(by_entry[row, :], r, n)]
    return ColumnFunction(ca.Function("residuals", [J, *data], outputs))


@cache
def build_curvature_columns(loss: Loss) -> ColumnFunction:
    """Second derivatives (n r, n r) of the loss of one sample with respect to J_xi, taken column by column.

    The inputs are those of `build_sample_loss`.
    """
    J, data = loss.arguments()
    column = ca.SX.sym("v", loss.sizes.r * loss.sizes.n)
    value = build_sample_loss(loss)(ca.reshape(column, loss.sizes.r, loss.sizes.n), *data)
    second = ca.Function("second", [column, *data], [ca.hessian(value, column)[0]])
    return ColumnFunction(ca.Function("curvature", [J, *data], [second(ca.vec(J), *data)]))


def _add_volumes(loss: Loss, J: Array, *data: Array) -> list[Array]:
    """Evaluate the outputs of `build_residual_columns` for a loss with volume terms, by LAPACK."""
    rest = loss.written_out
    results = [np.empty((len(J), 0, COLUMNS)) for _ in range(loss.sizes.r)]
    if rest.weights:
        results = build_residual_columns(rest)(J, *(data[loss.data.index(name)] for name in rest.data))
    blocks = [SampleBlock(loss, J[b], [array[b] for array in data]) for b in range(len(J))]
    for weight, term in loss.volume_terms:
        parts = [term.hinges(block.units, block.data) for block in blocks]
        results.append(weight**0.5 * np.stack([rho[None] for rho, _ in parts]))
        slopes = [block.pull_back(slopes) for block, (_, slopes) in zip(blocks, parts, strict=True)]
        results.append(weight**0.5 * np.stack(slopes))
    return results


class SampleBlock:
    """Unit gradients and data of a block of c samples, as arrays with one matrix for each sample.

    Args:
        loss: the loss.
        J: entries (n r, c) of J_xi, column by column.
        data: entries (entries, c) of each of the loss's data, column by column.
    """

    def __init__(self, loss: Loss, J: Array, data: Sequence[Array]) -> None:
        sizes = loss.sizes
        self._pairs = loss.exchanged
        #: the data by name, (c, rows, columns)
        self.data = {name: _split(array, SAMPLE_DATA[name](sizes)) for name, array in zip(loss.data, data, strict=True)}
        rows = _turn(_split(J, (sizes.r, sizes.n)), self._pairs)
        self.units = UnitGradients.of(rows, self.data.get("metric_inverse"))

    def pull_back(self, slopes: Array) -> Array:
        """dL/dJ_xi (n r, c), from the derivatives with respect to the unit gradients of coordinates, (c, r, n)."""
        back = _turn(self.units.pull_back(slopes), tuple((j, i) for i, j in self._pairs))
        return np.ascontiguousarray(back.transpose(2, 1, 0)).reshape(-1, len(back))


def _split(entries: Array, shape: tuple[int, int]) -> Array:
    """Matrices (c, rows, columns) from their entries (rows * columns, c), which are listed column by column."""
    return np.ascontiguousarray(entries.reshape(shape[1], shape[0], -1).transpose(2, 1, 0))


def _turn(rows: Array, pairs: Pairs) -> Array:
    """Gradients (c, r, n) of coordinates from those of their components."""
    return np.stack(coordinates_of(list(rows.transpose(1, 0, 2)), pairs), axis=1) if pairs else rows


class LossByArrays:
    """A loss on columns of samples, used like a `ColumnFunction`. NumPy arrays evaluate its `array_terms`.

    Args:
        loss: with at least one such term.
        written: makes the function of the other terms.
        slopes: whether the outputs are values and slopes, or values only.
    """

    def __init__(self, loss: Loss, written: Callable[[Loss], ColumnFunction], slopes: bool = True) -> None:
        rest = loss.leave_out(loss.array_terms)
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
        """Functions of one block each, for `count` threads; see `ColumnFunction.borrow`."""
        with ExitStack() as stack:
            written: Sequence[Run | None] = [None] * count
            if self._written is not None:
                written = stack.enter_context(self._written.borrow(count))
            yield [self._run(own) for own in written]

    def build_curvatures(self, J: Array, data: Sequence[Array]) -> list[Array]:
        """D_j^T D_j (c, n, n) of every coordinate j in single precision, for a block of samples with J_xi (n r, c).

        D_j holds the derivatives of all residuals with respect to row j of J_xi. The loss must be `all_by_arrays`.
        """
        block = SampleBlock(self._loss, J, data)
        terms = [(weight, term.build_curvatures(block.units, block.data)) for weight, term in self._loss.array_terms]
        return [
            np.asarray(sum(weight * next(parts) for weight, parts in terms), dtype=np.float32)
            for _ in range(self._loss.sizes.r)
        ]

    def _run(self, written: Run | None) -> Run:
        def run(arguments: Sequence[Array], results: Sequence[Array]) -> None:
            if written is None:
                for result in results:
                    result[...] = 0.0
            else:
                written([arguments[0], *(arguments[1 + k] for k in self._places)], results)
            # Add the terms that arrays evaluate
            block = SampleBlock(self._loss, arguments[0], arguments[1:])
            slopes = np.zeros(block.units.rows.shape)
            for weight, term in self._loss.array_terms:
                values, own = term.differentiate(block.units, block.data)
                results[0][...] += (weight * values).reshape(results[0].shape)
                own *= weight
                slopes += own
            if self._slopes:
                results[1][...] += block.pull_back(slopes).reshape(results[1].shape)

        return run
