"""Small symmetric systems as CasADi expressions: Cholesky, inertia in phi, and damping design."""

from functools import cache
from typing import Any, Literal

import casadi as ca
import numpy as np

from orthocas.bases.family import Expression
from orthocas.native.kernels import LARGE_INVERSE, ROOT_TIMES, ROUNDS
from orthocas.tasks.metric import Metric
from orthocas.tasks.problem import Problem
from orthocas.tasks.samples import sample_uniform
from orthocas.tools.batch import Batched, dense_function
from orthocas.tools.expressions import WRITTEN_OUT

SOFTEST = 1e-6  #: smallest squared frequency in double_diagonal, relative to the largest: K_i = 0 divides by zero


def invert_spd(matrix: Expression) -> tuple[Any, Any]:
    """Inverse and determinant of a symmetric positive definite matrix (k, k), without pivoting.

    The results are NaN or infinite if the matrix is singular. SX expressions are written out by L D L^T. MX graphs use
    loops, whose code does not grow with k.
    """
    # Use loops for graphs, and written-out code for expressions.
    k = matrix.shape[0]
    if k == 1:
        return 1 / matrix, matrix
    if isinstance(matrix, ca.MX):
        inverse, determinant = _build_sweeps(k)(matrix)
        return inverse, determinant
    D, LT, order = ca.ldl(matrix, False)
    volume = ca.SX(1)
    for i in range(k):
        volume *= D[i]
    return _mirror(ca.ldl_solve(ca.SX.eye(k), D, LT, order)), volume


@cache
def _build_sweeps(k: int) -> ca.Function:
    """Inverse and determinant of A (k, k) by k sweeps; each pivots on the first entry and moves it to the end.

    A sweep turns [[p, w^T], [w, R]] into [[R - w w^T / p, w / p], [w^T / p, -1 / p]]; k of them lead to -A^-1.
    """
    # `fold` carries the matrix and the product of the pivots along.
    state = ca.MX.sym("state", k * k + 1)
    A = ca.reshape(state[:-1], k, k)
    p, w = A[0, 0], A[1:, 0]
    ratio = w / p
    swept = ca.vertcat(ca.horzcat(A[1:, 1:] - w @ ratio.T, ratio), ca.horzcat(ratio.T, -1 / p))
    sweeps = ca.Function("sweep", [state], [ca.vertcat(ca.vec(swept), state[-1] * p)]).fold(k)
    matrix = ca.MX.sym("A", k, k)
    end = sweeps(ca.vertcat(ca.vec(matrix), 1))
    return ca.Function(LARGE_INVERSE, [matrix], [-ca.reshape(end[:-1], k, k), end[-1]])


def multiply_by_root(matrix: Expression, vectors: Expression) -> Expression:
    """S V with the symmetric positive definite S, S S = A, for A (k, k) and V (k, c).

    Newton's iteration in the product form of Denman and Beavers, scaled by determinants, with a fixed number of rounds;
    generated C stops as soon as the residual is below rounding. All matrices of the iteration commute, so it can work
    on S V instead of S. The result is a rational function of the entries and of roots of determinants.

    Source:
        [H2008] Sec. 6.3, product form of the Denman-Beavers iteration with determinantal scaling.
    """
    if matrix.shape[0] == 1:
        return ca.sqrt(matrix) * vectors
    return _build_rounds(*vectors.shape)(matrix, vectors)


@cache
def _build_rounds(k: int, c: int) -> ca.Function:
    # One round on the product X (k, k), a rational function of A and therefore symmetric, and on S V (k, c).
    kind = choose_kind(k)
    product, result, identity = kind.sym("X", k, k), kind.sym("SV", k, c), ca.DM.eye(k)
    inverse, determinant = invert_spd(product)
    mu_squared = determinant ** (-1 / k)
    next_result = ca.sqrt(mu_squared) * (result + inverse @ result / mu_squared) / 2
    next_product = (identity + (mu_squared * product + inverse / mu_squared) / 2) / 2
    newton_round = ca.Function("newton_round", [product, result], [_mirror(next_product), ca.densify(next_result)])
    # All rounds call the same function, and start from X = A and A V.
    A, V = ca.MX.sym("A", k, k), ca.MX.sym("V", k, c)
    X, SV = A, A @ V
    for _ in range(ROUNDS):
        X, SV = newton_round(X, SV)
    return ca.Function(ROOT_TIMES, [A, V], [SV])


def _mirror(matrix: Any) -> Any:
    """Mirror the lower triangle of an SX that is symmetric up to rounding, which halves the operations."""
    return matrix if isinstance(matrix, ca.MX) else ca.SX(ca.tril2symm(ca.tril(matrix)))


def choose_kind(k: int) -> Any:
    """SX for few rows, which are fastest written out; MX for larger ones, which C compiles too slowly as SX."""
    return ca.SX if k <= WRITTEN_OUT else ca.MX


def build_block_inertia(n: int, blocks: tuple[int, ...]) -> ca.Function:
    """J (k, n), A (n, n) -> B = A^-1 J^T (n, k), Lambda (k, k), volume (1, 1).

    The rows of J are divided into blocks, k = sum(blocks). Lambda is block diagonal with (J_b A^-1 J_b^T)^-1, [AS2023]
    eqs. (30), (31); one block gives the full M_phi. The volume is the product of det(J_b A^-1 J_b^T), which is 0 at
    singular positions.
    """
    # Invert one block of rows of J after the other.
    k = sum(blocks)
    kind = choose_kind(n)
    J, A = kind.sym("J", k, n), kind.sym("A", n, n)
    B = invert_spd(A)[0] @ J.T
    parts, volume, start = [], kind(1), 0
    for size in blocks:
        rows = list(range(start, start + size))
        inverse, determinant = invert_spd(J[rows, :] @ B[:, rows])
        parts.append(inverse)
        volume *= determinant
        start += size
    return ca.Function("inertia", [J, A], [ca.densify(B), ca.densify(ca.diagcat(*parts)), volume])


def compute_median_volume(problem: Problem, jacobian: ca.Function, metric: Metric, blocks: tuple[int, ...]) -> float:
    """Median of the volume of `build_block_inertia` over the domain. It sets the scale for "near singular"."""
    q = ca.MX.sym("q", problem.n)
    volume = build_block_inertia(problem.n, blocks)(jacobian(q), metric.function(q))[2]
    points = sample_uniform(problem.domain, 256, 0)
    return float(np.nanmedian(Batched(dense_function("volume", [q], [volume]))(points)[0]))


DampingDesign = Literal["square_root", "double_diagonal"]
DAMPING_DESIGNS: tuple[DampingDesign, ...] = ("square_root", "double_diagonal")


def apply_damping(
    design: DampingDesign,
    inertia: Expression,
    stiffness: Expression,
    damping_ratio: Expression,
    velocities: Expression,
) -> Expression:
    """D V with the damping matrix D(q), (k, k), for an inertia (k, k), the diagonals of K and Z, (k, 1), and V (k, c).

    - square_root: D = M^1/2 Z K^1/2 + K^1/2 Z M^1/2. Symmetric, but not always positive semi-definite.
    - double_diagonal: D = 2 Z^1/2 (M # K) Z^1/2, always positive semi-definite, with the geometric mean
      M # K = K^1/2 (K^-1/2 M K^-1/2)^1/2 K^1/2. With one damping ratio z for all coordinates, D is diagonal in the
      generalised eigenvectors of (K, M), and every mode has the damping ratio z. A spring softer than `SOFTEST` of
      the stiffest one, also K_i = 0, is damped as if it had that stiffness, which is very little.

    Source:
        square_root: [AS2023] eq. (29); double diagonalisation: [AOFH2003]; its form without eigenvectors and for
        several ratios is ours, docs/explanation/derivations_control.md#damping.
    """
    # Multiply both matrices, side by side, by the root at once.
    c = velocities.shape[1]
    if design == "square_root":
        weight = ca.repmat(damping_ratio * ca.sqrt(stiffness), 1, c)
        both = multiply_by_root(inertia, ca.horzcat(weight * velocities, velocities))
        return both[:, :c] + weight * both[:, c:]
    # Raise squared frequencies K_i / M_ii to the least that the rounds of the square root can resolve. K_i < 0 and NaN
    # stay invalid.
    mass = ca.diag(inertia)
    floor = mass * ca.fmax(SOFTEST * ca.mmax(stiffness / mass), SOFTEST**2)
    stiff = ca.if_else(stiffness < 0, stiffness, ca.if_else(stiffness < floor, floor, stiffness))
    root_K = ca.sqrt(stiff)
    scale = ca.repmat(root_K * ca.sqrt(damping_ratio), 1, c)
    return 2 * scale * multiply_by_root(inertia / (root_K @ root_K.T), scale * velocities)


def apply_limited_springs(
    inertia: Expression,
    compliance: Expression,
    stiffness: Expression,
    damping_ratio: Expression,
    errors: Expression,
    velocities: Expression,
) -> tuple[Expression, Expression]:
    """K(q) E and D V, for an inertia M and a compliance C (k, k), the diagonals of K and Z (k, 1), E (k, c), V (k, d).

    K(q) = (K^-1 + C)^-1 is the spring K in series with the compliance C, symmetric positive semi-definite. With the
    factor of I + K^1/2 C K^1/2 = L L^T, K(q) = K^1/2 L^-T L^-1 K^1/2, and the geometric mean of M and K(q) is
    M # K(q) = K^1/2 L^-T (L^T K^-1/2 M K^-1/2 L)^1/2 L^-1 K^1/2. So D = 2 Z^1/2 (M # K(q)) Z^1/2 gives every mode the
    damping ratio z if all have the same, and is always positive semi-definite.

    Source:
        ours, docs/explanation/derivations_springs.md#springs
    """
    k, c, d = inertia.shape[0], errors.shape[1], velocities.shape[1]
    root, ratio = ca.sqrt(stiffness), ca.sqrt(damping_ratio)
    scale = root @ root.T
    LT, inverse = _build_factor(k)(ca.DM.eye(k) + scale * compliance)
    wide_root, damped = ca.repmat(root, 1, c), ca.repmat(root * ratio, 1, d)
    spring = wide_root * (inverse @ (inverse.T @ (wide_root * errors)))
    rooted = multiply_by_root(LT @ (inertia / scale) @ LT.T, inverse.T @ (damped * velocities))
    return spring, 2 * damped * (inverse @ rooted)


@cache
def _build_factor(k: int) -> ca.Function:
    """H (k, k) -> L^T and L^-T, upper triangular, with H = L L^T symmetric positive definite."""
    H = ca.SX.sym("H", k, k)
    LT = ca.chol(ca.tril2symm(ca.tril(H)))
    return ca.Function("factor", [H], [ca.densify(LT), ca.densify(ca.solve(LT, ca.SX.eye(k)))])
