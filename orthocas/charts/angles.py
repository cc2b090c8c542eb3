"""Cosines between gradients, leaks, conditioning and volumes: as formulas, and by LAPACK."""

from functools import cache
from itertools import combinations

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from orthocas.tasks.samples import Samples
from orthocas.tools.checks import Array
from orthocas.tools.columns import BlockFunction, ColumnFunction, fill

_ROUNDING = 1e-15  # of eigenvalues of matrices whose entries are at most 1
MOST_JOINTS = 10  #: of more the formulas take longer to build than they save
_SMALLEST_PIVOT = 1e-14  # keeps singular samples finite
_STEPS = 5  # towards the smallest eigenvalue; few samples need more
_MOST_ROUNDS = 20  # of so many steps; a smallest eigenvalue that occurs twice takes 25 steps


def pairs(r: int) -> list[tuple[int, int]]:
    """The pairs (i, j), i > j, of r coordinates in the order of the mutual cosines."""
    return [(i, j) for j, i in combinations(range(r), 2)]


def whitened(gram: ca.SX, columns: ca.SX, least: float) -> ca.SX:
    """L^-1 c for columns c (m, r), where L L^T is the Gram matrix (m, m) with pivots of at least `least`."""
    m = gram.size1()
    L, found = ca.SX.zeros(m, m), ca.SX(columns)
    for j in range(m):
        pivot = ca.sqrt(ca.fmax(gram[j, j] - ca.sumsqr(L[j, :j]), least))
        for i in range(j + 1, m):
            L[i, j] = (gram[i, j] - ca.dot(L[i, :j], L[j, :j])) / pivot
        found[j, :] = (found[j, :] - L[j, :j] @ found[:j, :]) / pivot
    return found


def determinant_sign(matrix: ca.SX) -> ca.SX:
    """Sign of the determinant of a square matrix; 0 if a pivot is exactly 0."""
    sign = ca.SX(1)
    for pivot in triangle(matrix):
        sign *= ca.sign(pivot)
    return sign


def triangle(matrix: ca.SX) -> list[ca.SX]:
    """Numbers whose product is the determinant of a square matrix, by reflections of its rows.

    The first k are, up to their signs, the diagonal of the Cholesky factor of the Gram matrix of the first k rows.
    """
    A, n = ca.SX(matrix), matrix.size1()
    found = []
    for k in range(n - 1):
        v, norm, half = _reflection(A[k, k:].T)
        found.append(ca.if_else(A[k, k] >= 0, norm, -norm))  # the pivot is of the other sign, and so is the reflection
        shares = A[k + 1 :, k:] @ v / _or_one(half)
        A[k + 1 :, k + 1 :] -= shares @ v[1:].T
    return [*found, A[n - 1, n - 1]]


def tridiagonal(matrix: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Diagonal (n, 1) and squares of the entries beside it (n - 1, 1) of a similar tridiagonal matrix."""
    A, n = ca.SX(matrix), matrix.size1()
    squares = []
    for k in range(n - 2):
        v, norm, half = _reflection(A[k + 1 :, k])
        squares.append(norm * norm)
        w = A[k + 1 :, k + 1 :] @ v / _or_one(half)
        w -= v * (ca.dot(w, v) / (2 * _or_one(half)))
        update = v @ w.T
        A[k + 1 :, k + 1 :] = ca.tril2symm(ca.tril(A[k + 1 :, k + 1 :] - update - update.T))
    if n > 1:
        squares.append(A[n - 1, n - 2] ** 2)
    return ca.diag(A), ca.vertcat(*squares)


def _reflection(column: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
    """Direction v that reflects the column to the first axis, the column's norm, and half the squared norm of v."""
    norm = ca.norm_2(column)
    half = norm * (norm + ca.fabs(column[0]))
    return ca.vertcat(column[0] + ca.if_else(column[0] >= 0, norm, -norm), column[1:]), norm, half


def _or_one(x: ca.SX) -> ca.SX:
    """The number x > 0, or 1."""
    return ca.if_else(x > 0, x, 1.0)


def laguerre(diagonal: ca.SX, squares: ca.SX, at: ca.SX, steps: int) -> tuple[ca.SX, ca.SX]:
    """Steps towards the smallest eigenvalue of a tridiagonal matrix, from below: where they end, and the last step.

    Steps from below never pass the eigenvalue, but by rounding. No step follows then.
    """
    step = ca.SX(0)
    for _ in range(steps):
        found, before = _laguerre_step(diagonal, squares, at)
        step = ca.if_else(before, found, 0.0)
        at = at + step
    return at, step


def unfinished(last_steps: Array) -> NDArray[np.bool_]:
    """Where the last step of `laguerre` was more than rounding."""
    return np.asarray(last_steps > _ROUNDING)


def _laguerre_step(diagonal: ca.SX, squares: ca.SX, at: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Laguerre's step towards the smallest eigenvalue, and whether it is ahead.

    The characteristic polynomial is the product of the pivots q_i of T - at I, so the sums of 1 / (lambda_i - at) and
    of its square follow from q_i and two derivatives.
    """
    n = diagonal.size1()
    q, slope, bend = diagonal[0] - at, ca.SX(-1), ca.SX(0)
    inverse, least = 1 / q, q
    first, second = inverse, inverse * inverse
    for i in range(1, n):
        ratio, share = squares[i - 1] * inverse, slope * inverse
        bend = ratio * (bend * inverse - 2 * share * share)
        q, slope = diagonal[i] - at - ratio, ratio * share - 1
        inverse, least = 1 / q, ca.fmin(least, q)
        share = slope * inverse
        first -= share
        second += share * share - bend * inverse
    step = n / (first + ca.sqrt(ca.fmax((n - 1) * (n * second - first * first), 0.0)))
    return step, least > 0


def judge_by_columns(samples: Samples, J: Array) -> dict[str, Array]:
    """Like `judge`, for enough samples to fill columns. Without metric_mutual_cosines if A is the identity."""
    (N, r, n), inverse = J.shape, samples.metric_inverse
    data = [samples.task_jacobian.reshape(N, -1), J.reshape(N, -1), np.zeros((N, 1))]
    if inverse is not None:
        data.append(inverse.reshape(N, -1))
    function, sizes = _function(n - r, n, inverse is None)
    rows = _evaluated(function, sum(sizes.values()), data)
    # samples that need more steps go on with the search for the smallest eigenvalue
    left = np.flatnonzero(unfinished(rows[:, -1]))
    for _ in range(_MOST_ROUNDS):
        if not left.size:
            break
        some = [array[left] for array in data]
        some[2] = rows[left, -2:-1]
        rows[left] = _evaluated(function, rows.shape[1], some)
        left = left[unfinished(rows[left, -1])]
    found = dict(zip(sizes, np.split(rows, np.cumsum(list(sizes.values()))[:-1], axis=1), strict=True))
    del found["last_step"]
    conditioning = np.sqrt(found.pop("eigenvalue")[:, 0])
    shaped = {"task_cosines": found["task_cosines"].reshape(N, n - r, r), "signs": found["signs"][:, 0]}
    return {**found, **shaped, "conditioning": conditioning}


def _evaluated(function: ColumnFunction, size: int, data: list[Array]) -> Array:
    """Results (N, size) for data (N, ...)."""

    def build_block_function() -> BlockFunction:
        run = function.build_block_function()
        return lambda *columns: run(*columns)[0]

    results = np.empty((len(data[0]), size))
    fill(results, data[0], build_block_function, *data[1:])
    return results


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


def judge_by_lapack(samples: Samples, J: Array) -> dict[str, Array]:
    """Like `judge`."""
    gradients, covectors, unit = samples.compute_metric_gradients(J), J.transpose(0, 2, 1), _unit(J)
    own = np.sqrt(np.einsum("sij,sij->si", gradients, J))
    first, second = (np.array([pair[k] for pair in pairs(J.shape[1])], dtype=int) for k in (0, 1))
    in_metric = gradients @ covectors / own[:, :, None] / own[:, None, :]
    along = samples.task_basis @ covectors / own[:, None]
    m = along.shape[1]
    gram = np.block([[np.broadcast_to(np.eye(m), (len(along), m, m)), along], [along.transpose(0, 2, 1), in_metric]])
    return {
        "task_cosines": samples.unit_task_gradients @ unit.transpose(0, 2, 1),
        "mutual_cosines": np.einsum("spi,spi->sp", _unit(gradients)[:, first], unit[:, second]),
        "metric_mutual_cosines": in_metric[:, first, second],
        "leak_sines": np.linalg.norm(along, axis=1),
        "conditioning": np.asarray(np.sqrt(np.maximum(np.linalg.eigvalsh(gram)[:, 0], 0.0))),
        "signs": np.sign(np.linalg.det(np.concatenate([samples.task_jacobian, J], axis=1))),
    }


def _unit(rows: Array) -> Array:
    """Rows (N, k, n) of Euclidean length 1."""
    unit: Array = rows / np.linalg.norm(rows, axis=2, keepdims=True)
    return unit
