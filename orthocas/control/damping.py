"""Damping matrices for a stiffness and an inertia that changes with the posture."""

from typing import Literal

import casadi as ca

from orthocas.control.linear_algebra import square_root

DampingDesign = Literal["square_root", "double_diagonal"]
DAMPING_DESIGNS: tuple[DampingDesign, ...] = ("square_root", "double_diagonal")


def damping_matrix(design: DampingDesign, inertia: ca.SX, stiffness: ca.SX, damping_ratio: ca.SX) -> ca.SX:
    """D(q), (k, k), for an inertia (k, k), and diagonals of K and Z, (k, 1).

    - square_root: D = M^1/2 Z K^1/2 + K^1/2 Z M^1/2. Symmetric, but not always positive semi-definite.
    - double_diagonal: D = 2 K^1/2 S^1/4 Z S^1/4 K^1/2 with S = K^-1/2 M K^-1/2, always positive semi-definite. With one
      damping ratio z for all coordinates it is 2 z times the geometric mean of M and K: in the generalised eigenvectors
      of (K, M), where both are diagonal, every mode then has the damping ratio z.

    Source:
        square_root: [AS2023] eq. (29); double diagonalisation: [AOFH2003]; its form without eigenvectors and for
        several ratios is ours, docs/derivations.md#damping.
    """
    root_K, Z = ca.diag(ca.sqrt(stiffness)), ca.diag(damping_ratio)
    if design == "square_root":
        half = square_root(inertia) @ Z @ root_K
        return half + half.T
    inverse_root = ca.diag(1 / ca.sqrt(stiffness))
    quarter = square_root(square_root(inverse_root @ inertia @ inverse_root))
    half = root_K @ quarter
    return 2 * half @ Z @ half.T
