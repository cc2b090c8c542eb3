"""The length term: gradients of even length, so that a controller gain means the same everywhere (ours)."""

from dataclasses import dataclass

import casadi as ca

from orthocas.fitting.loss.term import Data, Sizes


def log_lengths(coordinate_jacobian: ca.SX) -> ca.SX:
    """Logarithms of the lengths of the coordinate gradients, (r, 1).

    Angles do not fix how fast a coordinate grows along itself: xi^7 is as orthogonal as xi, but flat at 0.

    Source:
        ours, docs/derivations.md#lengths.
    """
    return ca.log(ca.sum2(coordinate_jacobian**2)) / 2


@dataclass(frozen=True)
class LengthTerm:
    """Mean over coordinates of the squared `log_lengths`."""

    name: str = "length"
    data: tuple[str, ...] = ()
    hinge: bool = False

    def residuals(self, coordinate_jacobian: ca.SX, data: Data, sizes: Sizes) -> ca.SX:
        """Logarithms over sqrt(r), (r, 1)."""
        rho: ca.SX = (1 / sizes.r) ** 0.5 * log_lengths(coordinate_jacobian)
        return rho
