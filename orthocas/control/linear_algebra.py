"""Inverse and square root of small symmetric positive definite matrices, as smooth CasADi expressions without branches.

Generated C contains them, so they use no eigenvectors (which jump) and no loops with a data-dependent length.
"""

from functools import cache

import casadi as ca

from orthocas.parametrisations.family import Expression

_ROUNDS = 8  # accurate to rounding up to a condition number of 1e6 (tests/test_control_algebra.py)


def spd_inverse(matrix: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Inverse and determinant of a symmetric positive definite matrix (k, k), by L D L^T without pivoting.

    NaN or infinite where the matrix is singular.
    """
    k = matrix.shape[0]
    D, LT, order = ca.ldl(matrix, False)
    inverse = ca.ldl_solve(ca.SX.eye(k), D, LT, order)
    determinant = ca.SX(1)
    for i in range(k):
        determinant *= D[i]
    return _symmetric(inverse), determinant


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
    root, product, identity = ca.SX.sym("S", k, k), ca.SX.sym("X", k, k), ca.SX.eye(k)
    inverse, determinant = spd_inverse(product)
    mu_squared = determinant ** (-1 / k)
    next_root = ca.sqrt(mu_squared) * (root + root @ inverse / mu_squared) / 2
    next_product = (identity + (mu_squared * product + inverse / mu_squared) / 2) / 2
    return ca.Function("newton_round", [root, product], [_symmetric(next_root), _symmetric(next_product)])


def _symmetric(matrix: ca.SX) -> ca.SX:
    """Mirror the lower triangle of a matrix that is symmetric up to rounding, which halves the operations."""
    return ca.SX(ca.tril2symm(ca.tril(matrix)))
