"""Lower bounds of the volume that a chart's unit gradients span, and of its conditioning (ours).

Let W = [orthonormal basis of the task gradients; unit gradients of the coordinates], as in `orthocas.evaluate`, for the
Euclidean metric, and D = |det W|. On a box, let V = [V_1, V_2] be an orthogonal basis, V_2 of the kernel of J_x at the
centre. The kernel of J_x is that of V_2 + V_1 X with J_x V_1 X = -J_x V_2, so X = 0 at the centre, and

    D = |det(G V_2 + G V_1 X)| / sqrt(det(I + X X^T))    for the unit gradients of the coordinates, the rows of G.

The squares of the n singular values of W add up to n, so the product of all but the smallest one, s, is at most
((n - s^2) / (n - 1))^((n - 1) / 2), and s >= D ((n - 1) / (n - s^2))^((n - 1) / 2) bounds the conditioning s. Idle
joints have singular values of 1 and are left out. Lengths of rows and rotations of the task rows do not matter.
"""

from functools import reduce
from operator import mul

import numpy as np

from orthocas.certifying.elimination import between, in_singular_basis, lower_bound, pivots, singular_vectors
from orthocas.certifying.functions import reciprocal, reciprocal_square_root
from orthocas.certifying.rounding import UP
from orthocas.certifying.taylor import TaylorModel, stacked
from orthocas.checks import Array

_ORTHOGONAL = 1 - 1e-6  # what singular vectors that are orthogonal up to 1e-9 change at most, for up to 20 rows


def conditioning_bound(J: TaylorModel, m: int) -> Array:
    """A number below the conditioning on each box, (boxes,); 0 where nothing is known. J has its m task rows first."""
    n = len(J.remainder)
    if m == n:
        return np.ones(J.remainder.shape[-1])
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        least = lower_bound(_volume(J, m)) * _ORTHOGONAL
    return _smallest_singular_value(np.clip(np.nan_to_num(least, nan=0.0), 0.0, 1.0), n)


def _volume(J: TaylorModel, m: int) -> TaylorModel:
    """D, (boxes,)."""
    left, right = singular_vectors(J[:m])
    unit = np.broadcast_to(np.eye(1), (len(right), 1, 1))
    task = between(left, J[:m], right)
    gradients = _normalised(stacked([between(unit, J[j : j + 1], right)[0] for j in range(m, len(J.remainder))]))
    kernel = _kernel(task, m)
    across = gradients[:, m:] + _sums([gradients[:, k, None] * kernel[None, k] for k in range(m)])
    turned, _ = in_singular_basis(across)
    return reduce(mul, [*pivots(turned), *map(reciprocal_square_root, _growth(kernel, m))])


def _kernel(task: TaylorModel, m: int) -> TaylorModel:
    """X with [T_1, T_2] [X; I] = 0 for task rows [T_1, T_2], by elimination, (m, r, boxes)."""
    rows, inverses = [], []
    for _ in range(m):
        inverses.append(reciprocal(task[0, 0]))
        rows.append(task[0, 1:])
        if len(task.remainder) > 1:
            task = task[1:, 1:] - (task[1:, 0] * inverses[-1][None])[:, None] * task[0, 1:][None]
    solution: list[TaylorModel] = []
    for row, inverse in zip(rows[::-1], inverses[::-1], strict=True):
        known = len(solution)
        total = _sums([row[known:], *(row[k, None] * solution[k] for k in range(known))])
        solution.insert(0, -(total * inverse[None]))
    return stacked(solution)


def _growth(kernel: TaylorModel, m: int) -> list[TaylorModel]:
    """The pivots of I + X X^T."""
    products = kernel[:, None] * kernel[None]
    gram = _sums([products[:, :, k] for k in range(products.remainder.shape[2])])
    return pivots(gram + TaylorModel.constant(np.eye(m)[:, :, None]))


def _normalised(rows: TaylorModel) -> TaylorModel:
    """The rows divided by their lengths."""
    squares = rows * rows
    squared_lengths = _sums([squares[:, k] for k in range(squares.remainder.shape[1])])
    return rows * reciprocal_square_root(squared_lengths)[:, None]


def _sums(parts: list[TaylorModel]) -> TaylorModel:
    return reduce(lambda a, b: a + b, parts)


def _smallest_singular_value(volume: Array, n: int) -> Array:
    """A number below the smallest of n singular values with that product, whose squares add up to n."""
    least = np.zeros_like(volume)
    for _ in range(4):  # each bound improves the next one
        least = volume * ((n - 1) / (n - least * least)) ** ((n - 1) / 2) / UP
    return least
