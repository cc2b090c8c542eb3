"""The regularity term: it keeps the volume of the coordinate gradients, so that the chart does not fold (ours)."""

from dataclasses import dataclass

import casadi as ca

from orthocas.fitting.loss.term import Data, Sizes

REGULAR_VOLUME = 0.9  #: volume of the gradients below which the regularity term acts
LEAST_CONDITIONING = 0.2  #: that fits aim at on the whole domain
_FOLD_VOLUME = 1.6 * LEAST_CONDITIONING  # enough for it: det D <= sqrt(e) times the conditioning


def gradient_volume(coordinate_jacobian: ca.SX, null_basis: ca.SX, metric_inverse: ca.SX | None) -> ca.SX:
    """Signed volume of the coordinate gradients across the task, det(D) with D_jk = v_xi,j . z_k / |v_xi,j|_A^-1.

    The z_k are an A-orthonormal basis of ker J_x, so D holds the components of the unit gradients that do not change
    the task. |det D| is 1 for perfect coordinates, and the chart phi is regular exactly where det D is not 0.

    Args:
        coordinate_jacobian: J_xi, (r, n).
        null_basis: columns z_1..z_r, (n, r), oriented continuously over the domain.
        metric_inverse: A^-1, (n, n); None for the identity.

    Source:
        ours, docs/derivations.md#regularity.
    """
    J = coordinate_jacobian
    raised = J if metric_inverse is None else J @ metric_inverse
    lengths = ca.sqrt(ca.sum2(raised * J))
    return ca.det((J @ null_basis) / ca.repmat(lengths, 1, J.shape[0]))


@dataclass(frozen=True)
class RegularityTerm:
    """max(bound - det D, 0)^2, where det D is the `gradient_volume`."""

    name: str = "regularity"
    bound: float = REGULAR_VOLUME
    data: tuple[str, ...] = ("metric_inverse", "null_basis")
    hinge: bool = True

    def residuals(self, coordinate_jacobian: ca.SX, data: Data, sizes: Sizes) -> ca.SX:
        """One residual, (1, 1)."""
        volume = gradient_volume(coordinate_jacobian, data["null_basis"], data.get("metric_inverse"))
        hinge: ca.SX = ca.fmax(self.bound - volume, 0)
        return hinge


FOLD_TERM = RegularityTerm("folds", _FOLD_VOLUME)  #: for the worst points of the domain only
