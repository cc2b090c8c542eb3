"""Inverse and square root of small symmetric positive definite matrices, as smooth CasADi expressions without branches.

Generated C contains them, so they use no eigenvectors (which jump) and no loops with a data-dependent length.
"""

from functools import cache
from typing import Any

import casadi as ca

from orthocas.casadi_tools.scalar_code import WRITTEN_OUT
from orthocas.parametrisations.family import Expression

LARGE_INVERSE = "large_inverse"  #: name of the functions for which generated C has code of its own
_ROUNDS = 8  # accurate to rounding up to a condition number of 1e6 (tests/test_control_algebra.py)


def spd_inverse(matrix: Expression) -> tuple[Any, Any]:
    """Inverse and determinant of a symmetric positive definite matrix (k, k), without pivoting.

    NaN or infinite where the matrix is singular. SX are written out, by L D L^T; graphs (MX) have loops instead, whose
    code does not grow with k.
    """
    k = matrix.shape[0]
    if k == 1:
        return 1 / matrix, matrix
    if isinstance(matrix, ca.MX):
        inverse, determinant = _swept(k)(matrix)
        return inverse, determinant
    D, LT, order = ca.ldl(matrix, False)
    volume = ca.SX(1)
    for i in range(k):
        volume *= D[i]
    return _symmetric(ca.ldl_solve(ca.SX.eye(k), D, LT, order)), volume


@cache
def _swept(k: int) -> ca.Function:
    """Inverse and determinant of A (k, k) by k sweeps: each pivots on the first entry, and moves it to the end.

    A sweep turns [[p, w^T], [w, R]] into [[R - w w^T / p, w / p], [w^T / p, -1 / p]]; k of them lead to -A^-1.
    """
    state = ca.MX.sym("state", k * k + 1)  # the matrix and the product of the pivots: what `fold` carries along
    A = ca.reshape(state[:-1], k, k)
    p, w = A[0, 0], A[1:, 0]
    share = w / p
    moved = ca.vertcat(ca.horzcat(A[1:, 1:] - w @ share.T, share), ca.horzcat(share.T, -1 / p))
    sweeps = ca.Function("sweep", [state], [ca.vertcat(ca.vec(moved), state[-1] * p)]).fold(k)
    matrix = ca.MX.sym("A", k, k)
    end = sweeps(ca.vertcat(ca.vec(matrix), 1))
    return ca.Function(LARGE_INVERSE, [matrix], [-ca.reshape(end[:-1], k, k), end[-1]])


def square_root(matrix: Expression) -> Expression:
    """The symmetric positive definite S with S S = A, (k, k).

    Newton's iteration in the product form of Denman and Beavers, scaled by determinants, with a fixed number of rounds.
    The result is a rational function of the entries and of roots of determinants. In graphs (MX), all rounds call one
    function.

    Source:
        [H2008] Sec. 6.3, product form of the Denman-Beavers iteration with determinantal scaling.
    """
    k = matrix.shape[0]
    if k == 1:
        return ca.sqrt(matrix)
    root, product = matrix, matrix
    for _ in range(_ROUNDS):
        root, product = _newton_round(k)(root, product)
    return root


@cache
def _newton_round(k: int) -> ca.Function:
    """One round on S and the product X, both (k, k); all are rational functions of A and therefore symmetric."""
    kind = kind_of(k)
    root, product, identity = kind.sym("S", k, k), kind.sym("X", k, k), ca.DM.eye(k)
    inverse, determinant = spd_inverse(product)
    mu_squared = determinant ** (-1 / k)
    next_root = ca.sqrt(mu_squared) * (root + root @ inverse / mu_squared) / 2
    next_product = (identity + (mu_squared * product + inverse / mu_squared) / 2) / 2
    return ca.Function("newton_round", [root, product], [_symmetric(next_root), _symmetric(next_product)])


def _symmetric(matrix: Any) -> Any:
    """Mirror the lower triangle of an SX that is symmetric up to rounding, which halves the operations."""
    return matrix if isinstance(matrix, ca.MX) else ca.SX(ca.tril2symm(ca.tril(matrix)))


def kind_of(k: int) -> Any:
    """SX for matrices with few rows, which are fastest written out; MX for others, which then take C too long."""
    return ca.SX if k <= WRITTEN_OUT else ca.MX
