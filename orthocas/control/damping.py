"""Damping matrices for a given stiffness and a posture-dependent inertia."""

from typing import Literal

import casadi as ca

from orthocas.control.linear_algebra import square_root
from orthocas.parametrisations.family import Expression

DampingDesign = Literal["square_root", "double_diagonal"]
_SOFTEST = 1e-6  # smallest squared frequency in double_diagonal, relative to the largest: K_i = 0 divides by zero
DAMPING_DESIGNS: tuple[DampingDesign, ...] = ("square_root", "double_diagonal")


def damping_matrix(
    design: DampingDesign, inertia: Expression, stiffness: Expression, damping_ratio: Expression
) -> Expression:
    """Damping matrix D(q), (k, k), for an inertia (k, k) and the diagonals of K and Z, (k, 1).

    - square_root: D = M^1/2 Z K^1/2 + K^1/2 Z M^1/2. Symmetric, but not always positive semi-definite.
    - double_diagonal: D = 2 Z^1/2 (M # K) Z^1/2, always positive semi-definite, with the geometric mean
      M # K = K^1/2 (K^-1/2 M K^-1/2)^1/2 K^1/2. With one damping ratio z for all coordinates, D is diagonal in the
      generalised eigenvectors of (K, M), and every mode has the damping ratio z. A spring softer than 1e-6 of the
      stiffest one, also K_i = 0, is damped as if it had that stiffness, so hardly.

    Source:
        square_root: [AS2023] eq. (29); double diagonalisation: [AOFH2003]; its form without eigenvectors and for
        several ratios is ours, docs/derivations.md#damping.
    """
    if design == "square_root":
        half = square_root(inertia) * _row(damping_ratio * ca.sqrt(stiffness))
        return half + half.T
    root_K = ca.sqrt(_not_too_soft(stiffness, inertia))
    mean = square_root(inertia / (root_K @ root_K.T))
    scale = root_K * ca.sqrt(damping_ratio)
    return 2 * (scale @ scale.T) * mean


def _not_too_soft(stiffness: Expression, inertia: Expression) -> Expression:
    """The stiffness with springs as soft as the rounds of the square root can resolve; K_i < 0 and NaN stay invalid.

    Squared frequencies K_i / M_ii are at least 1e-6 of the largest one, and 1e-12 1/s^2.
    """
    mass = ca.diag(inertia)
    floor = mass * ca.fmax(_SOFTEST * ca.mmax(stiffness / mass), _SOFTEST**2)
    return ca.if_else(stiffness < 0, stiffness, ca.if_else(stiffness < floor, floor, stiffness))


def _row(diagonal: Expression) -> Expression:
    """The vector (k, 1) repeated in every row of (k, k); an entrywise product with it scales columns."""
    return ca.repmat(diagonal.T, diagonal.shape[0], 1)
