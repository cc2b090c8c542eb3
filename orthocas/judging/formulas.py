"""Cosines, leaks, conditioning and orientation of coordinates, as formulas of one sample for columns of samples."""

from functools import cache

import casadi as ca
import numpy as np

from orthocas.casadi_tools.blocks import BlockFunction, fill
from orthocas.casadi_tools.columns import ColumnFunction
from orthocas.checks import Array
from orthocas.judging.pairs import pairs
from orthocas.judging.small_matrices import determinant_sign, laguerre, tridiagonal, unfinished, whitened
from orthocas.samples import Samples

MOST_JOINTS = 10  #: of more the formulas take longer to build than they save
_SMALLEST_PIVOT = 1e-14  # keeps singular samples finite
_STEPS = 5  # towards the smallest eigenvalue; few samples need more
_MOST_ROUNDS = 20  # of so many steps; a smallest eigenvalue that occurs twice takes 25 steps


def judge_by_columns(samples: Samples, J: Array) -> dict[str, Array]:
    """Like `judge`, for enough samples to fill columns. Without metric_mutual_cosines if A is the identity."""
    (N, r, n), inverse = J.shape, samples.metric_inverse
    data = [samples.task_jacobian.reshape(N, -1), J.reshape(N, -1), np.zeros((N, 1))]
    if inverse is not None:
        data.append(inverse.reshape(N, -1))
    function, sizes = _function(n - r, n, inverse is None)
    rows = _evaluated(function, sum(sizes.values()), data)
    _finish(function, rows, data)
    found = dict(zip(sizes, np.split(rows, np.cumsum(list(sizes.values()))[:-1], axis=1), strict=True))
    del found["last_step"]
    conditioning = np.sqrt(found.pop("eigenvalue")[:, 0])
    shaped = {"task_cosines": found["task_cosines"].reshape(N, n - r, r), "signs": found["signs"][:, 0]}
    return {**found, **shaped, "conditioning": conditioning}


def _evaluated(function: ColumnFunction, size: int, data: list[Array]) -> Array:
    """Results (N, size) for data (N, ...)."""

    def on_one_block() -> BlockFunction:
        run = function.on_one_block()
        return lambda *columns: run(*columns)[0]

    results = np.empty((len(data[0]), size))
    fill(results, data[0], on_one_block, *data[1:])
    return results


def _finish(function: ColumnFunction, rows: Array, data: list[Array]) -> None:
    """Go on with the search for the smallest eigenvalue at samples that need more steps, and update their rows."""
    left = np.flatnonzero(unfinished(rows[:, -1]))
    for _ in range(_MOST_ROUNDS):
        if not left.size:
            break
        some = [array[left] for array in data]
        some[2] = rows[left, -2:-1]
        rows[left] = _evaluated(function, rows.shape[1], some)
        left = left[unfinished(rows[left, -1])]


@cache
def _function(m: int, n: int, euclidean: bool) -> tuple[ColumnFunction, dict[str, int]]:
    """The function of J_x, J_xi, a bound below the eigenvalues, and A^-1, row by row; names and sizes of results."""
    J, at, inverse = ca.SX.sym("J", n, n), ca.SX.sym("at"), ca.SX.sym("inverse", n, n)
    found = _formulas(J[:, :m].T, J[:, m:].T, None if euclidean else inverse, at)
    inputs = [ca.SX.sym("task", n * m), ca.SX.sym("covectors", n * (n - m)), at]
    stacked = ca.substitute(ca.vertcat(*found.values()), ca.vec(J), ca.vertcat(*inputs[:2]))
    inputs += [] if euclidean else [ca.vec(inverse)]
    function = ca.Function("judgement", inputs, [ca.cse(ca.densify(stacked))])
    return ColumnFunction(function), {name: part.numel() for name, part in found.items()}


def _formulas(task: ca.SX, covectors: ca.SX, inverse: ca.SX | None, at: ca.SX) -> dict[str, ca.SX]:
    """Columns by name for rows of J_x (m, n) and J_xi (r, n)."""
    m, r = task.size1(), covectors.size1()
    raised, gradients = (rows if inverse is None else rows @ inverse for rows in (task, covectors))
    products, shares = gradients @ covectors.T, raised @ covectors.T
    euclidean, own = _lengths(covectors), ca.sqrt(ca.diag(products))
    scale = ca.sqrt(ca.sum2(raised * task))  # normalise rows first, so that units do not matter
    along = whitened(raised @ task.T / (scale @ scale.T), shares / (scale @ own.T), _SMALLEST_PIVOT)
    unit = products / (own @ own.T)
    gram = ca.vertcat(ca.horzcat(ca.SX.eye(m), along), ca.horzcat(along.T, ca.tril2symm(ca.tril(unit))))

    def of_pairs(matrix: ca.SX) -> ca.SX:
        return ca.vertcat(ca.SX(0, 1), *(matrix[i, j] for i, j in pairs(r)))

    eigenvalue, last_step = laguerre(*tridiagonal(gram), at, _STEPS)
    return {
        "task_cosines": ca.vec((shares / (_lengths(raised) @ euclidean.T)).T),
        "mutual_cosines": of_pairs(products / (_lengths(gradients) @ euclidean.T)),
        **({} if inverse is None else {"metric_mutual_cosines": of_pairs(unit)}),
        "leak_sines": ca.sqrt(ca.sum1(along * along)).T,
        "signs": determinant_sign(ca.vertcat(task, covectors)),
        "eigenvalue": eigenvalue,
        "last_step": last_step,
    }


def _lengths(rows: ca.SX) -> ca.SX:
    """Euclidean norms of rows, a column."""
    return ca.sqrt(ca.sum2(rows * rows))
