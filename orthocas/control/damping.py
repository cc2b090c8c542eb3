"""Damping matrices for a given stiffness and a posture-dependent inertia."""

from typing import Literal

import casadi as ca

from orthocas.control.linear_algebra import square_root
from orthocas.parametrisations.family import Expression

DampingDesign = Literal["square_root", "double_diagonal"]
DAMPING_DESIGNS: tuple[DampingDesign, ...] = ("square_root", "double_diagonal")


def damping_matrix(
    design: DampingDesign, inertia: Expression, stiffness: Expression, damping_ratio: Expression
) -> Expression:
    """Damping matrix D(q), (k, k), for an inertia (k, k) and the diagonals of K and Z, (k, 1).

    - square_root: D = M^1/2 Z K^1/2 + K^1/2 Z M^1/2. Symmetric, but not always positive semi-definite.
    - double_diagonal: D = 2 K^1/2 S^1/4 Z S^1/4 K^1/2 with S = K^-1/2 M K^-1/2, always positive semi-definite. With one
      damping ratio z for all coordinates it is 2 z times the geometric mean of M and K: in the generalised eigenvectors
      of (K, M), where both are diagonal, every mode then has the damping ratio z.

    Source:
        square_root: [AS2023] eq. (29); double diagonalisation: [AOFH2003]; its form without eigenvectors and for
        several ratios is ours, docs/derivations.md#damping.
    """
    root_K = ca.sqrt(stiffness)
    if design == "square_root":
        half = square_root(inertia) * _row(damping_ratio * root_K)
        return half + half.T
    quarter = square_root(square_root(inertia / (root_K @ root_K.T)))
    half = quarter * _row(root_K).T
    return 2 * (half * _row(damping_ratio)) @ half.T


def _row(diagonal: Expression) -> Expression:
    """The vector (k, 1) repeated in every row of (k, k); an entrywise product with it scales columns."""
    return ca.repmat(diagonal.T, diagonal.shape[0], 1)
