"""The loss of one sample as least squares in J_xi, and its derivatives on columns of samples."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import casadi as ca

from orthocas.fitting.terms import SAMPLE_DATA, LossTerm, Sizes, term_of
from orthocas.tools.cached import cached_property
from orthocas.tools.columns import ColumnFunction

Pairs = tuple[tuple[int, int], ...]


@dataclass(frozen=True)
class Loss:
    """The loss of one sample: L = |rho|^2 / 2, with the residuals of all terms with a positive weight.

    Rows are in the order of the terms, with those of hinge terms last.
    """

    sizes: Sizes
    weights: tuple[tuple[str, float], ...]  #: names of terms and their positive weights
    exchanged: Pairs = ()  #: rows i, j of J_xi that stand for components, see `coordinates_of`

    @classmethod
    def of(cls, sizes: Sizes, weights: Mapping[str, float], exchanged: Pairs = ()) -> "Loss":
        """The terms with a positive weight.

        Raises:
            UnknownNameError: if there is no term for a weight.
        """
        positive = tuple((name, weight) for name, weight in weights.items() if weight > 0 and term_of(name))
        return cls(sizes, positive, exchanged)

    @cached_property
    def terms(self) -> tuple[tuple[LossTerm, float], ...]:
        """Loss terms with their weights, smooth ones first."""
        known = [(term_of(name), weight) for name, weight in self.weights]
        return tuple(sorted(known, key=lambda pair: pair[0].hinge))

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
        """For every coordinate j, the rows that depend on it, without hinge rows."""
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
        """Rows of the hinge terms, which are the last ones."""
        J, data = self.arguments()
        named = dict(zip(self.data, data, strict=True))
        counts = [term.residuals(J, named, self.sizes).shape[0] for term, _ in self.terms if not term.hinge]
        return range(sum(counts), len(self._touched))

    @cached_property
    def _touched(self) -> list[list[int]]:
        """The coordinates that each row depends on."""
        J, data = self.arguments()
        by_entry = ca.jacobian(self.residuals(J, data), ca.vec(J)).sparsity()
        touched: list[set[int]] = [set() for _ in range(by_entry.size1())]
        for row, entry in zip(*by_entry.get_triplet(), strict=True):
            touched[row].add(entry % self.sizes.r)
        return [sorted(coordinates) for coordinates in touched]

    def arguments(self) -> tuple[ca.SX, list[ca.SX]]:
        """Symbols of J_xi (r, n) and of the data of one sample."""
        return ca.SX.sym("J", self.sizes.r, self.sizes.n), self.symbols()


def coordinates_of(rows: Sequence[Any], exchanged: Pairs) -> list[Any]:
    """Rows with (a + b) / sqrt 2 and (b - a) / sqrt 2 in place of the rows a, b of each pair: a rotation."""
    turned = list(rows)
    for i, j in exchanged:
        turned[i], turned[j] = (rows[i] + rows[j]) * 0.5**0.5, (rows[j] - rows[i]) * 0.5**0.5
    return turned


@cache
def sample_loss(loss: Loss) -> ca.Function:
    """Loss of one sample (1, 1) as a function of J_xi (r, n) and the data in `Loss.symbols`."""
    J, data = loss.arguments()
    return ca.Function("sample_loss", [J, *data], [ca.sumsqr(loss.residuals(J, data)) / 2])


@cache
def loss_columns(loss: Loss) -> ColumnFunction:
    """Loss of one sample (1, 1) and its derivative dL/dJ_xi (r, n), with the inputs of `sample_loss`."""
    J, data = loss.arguments()
    value = ca.sumsqr(loss.residuals(J, data)) / 2
    return ColumnFunction(ca.Function("loss", [J, *data], [value, ca.gradient(value, J)]))


@cache
def value_columns(loss: Loss) -> ColumnFunction:
    """Loss of one sample, with the inputs of `sample_loss`."""
    return ColumnFunction(sample_loss(loss))


@cache
def residual_columns(loss: Loss) -> ColumnFunction:
    """Derivatives of the residuals of one sample with respect to J_xi, for the Gauss-Newton matrix.

    The inputs are those of `sample_loss`. The outputs are, for every coordinate j, the derivative of `smooth_rows[j]`
    with respect to row j of J_xi, (rows, n); then, for every hinge row, the residual (1, 1) and its derivative with
    respect to J_xi, (r, n).
    """
    J, data = loss.arguments()
    r, n = loss.sizes.r, loss.sizes.n
    rho = loss.residuals(J, data)
    by_entry = ca.jacobian(rho, ca.vec(J))  # its columns are the entries of J_xi, column by column
    outputs = [by_entry[list(loss.smooth_rows[j]), j::r] for j in range(r)]
    for row in loss.hinge_rows:
        outputs += [rho[row], ca.reshape(by_entry[row, :], r, n)]
    return ColumnFunction(ca.Function("residuals", [J, *data], outputs))


@cache
def curvature_columns(loss: Loss) -> ColumnFunction:
    """Second derivatives of the loss of one sample with respect to J_xi column by column, (n r, n r).

    The inputs are those of `sample_loss`.
    """
    J, data = loss.arguments()
    column = ca.SX.sym("v", loss.sizes.r * loss.sizes.n)
    value = sample_loss(loss)(ca.reshape(column, loss.sizes.r, loss.sizes.n), *data)
    second = ca.Function("second", [column, *data], [ca.hessian(value, column)[0]])
    return ColumnFunction(ca.Function("curvature", [J, *data], [second(ca.vec(J), *data)]))
