"""J-PARSE, from its paper (arXiv 2505.00306): least-norm steps that slow down where the arm is nearly singular."""

from collections.abc import Sequence

import numpy as np

from orthocas.tools.checks import Array
from redundancy.arms import Arm
from redundancy.protocol import Target


class JParse:
    """dq = J_s^+ (P + S) e, held at the limits of the joints.

    With J = U diag(s) V^T, J_s has no singular value below least = threshold max(s); P projects on the columns u of U
    with larger ones, and S = sum of (s / least) u u^T over the others.
    """

    name = "J-PARSE"
    packages = ("numpy",)
    grid = ({"threshold": 0.1}, {"threshold": 0.05}, {"threshold": 0.02})

    def __init__(self, arm: Arm, threshold: float) -> None:
        self.arm, self.threshold = arm, threshold

    def start(self, q: Array, path: Sequence[Target] | None) -> None:
        """Begin at q."""
        self.q = q.copy()

    def step(self, target: Target) -> Array:
        """One step."""
        U, s, V = np.linalg.svd(self.arm.jacobian(self.q), full_matrices=False)
        least = self.threshold * s[0]
        slowed = np.minimum(1.0, s / least) / np.maximum(s, least)
        ahead = self.q + V.T @ (slowed * (U.T @ self.arm.error(self.q, target.placement)))
        self.q = np.clip(ahead, self.arm.lower, self.arm.upper)
        return self.q


METHODS = (JParse,)
