"""The textbook's rate laws: least-norm steps, damped ones, and a posture in the null space."""

from collections.abc import Sequence

import numpy as np

from orthocas.tools.checks import Array
from redundancy.arms import Arm
from redundancy.protocol import Target


class PseudoInverse:
    """dq = gain J^+ e. It knows no limits."""

    name = "pseudo-inverse"
    packages = ("numpy",)
    grid = ({"gain": 1.0}, {"gain": 0.7}, {"gain": 0.4})

    def __init__(self, arm: Arm, gain: float) -> None:
        self.arm, self.gain = arm, gain

    def start(self, q: Array, path: Sequence[Target] | None) -> None:
        """Begin at q."""
        self.q = q.copy()

    def step(self, target: Target) -> Array:
        """One step."""
        J = self.arm.jacobian(self.q)
        self.q = self.q + self.gain * np.linalg.pinv(J) @ self.arm.error(self.q, target.placement)
        return self.q


class PostureInNullSpace(PseudoInverse):
    """dq = J^+ e + (I - J^+ J) gain (q_posture - q)."""

    name = "pseudo-inverse, posture"
    grid = ({"gain": 0.1}, {"gain": 0.01}, {"gain": 1.0})

    def step(self, target: Target) -> Array:
        """One step."""
        J = self.arm.jacobian(self.q)
        inverse, pull = np.linalg.pinv(J), self.gain * (target.posture - self.q)
        self.q = self.q + inverse @ (self.arm.error(self.q, target.placement) - J @ pull) + pull
        return self.q


class Damped:
    """dq = J^T (J J^T + damping^2 I)^-1 e, held at the limits of the joints."""

    name = "damped least squares"
    packages = ("numpy",)
    grid = ({"damping": 0.05}, {"damping": 0.01}, {"damping": 0.2})

    def __init__(self, arm: Arm, damping: float) -> None:
        self.arm, self.damping = arm, damping

    def start(self, q: Array, path: Sequence[Target] | None) -> None:
        """Begin at q."""
        self.q = q.copy()

    def step(self, target: Target) -> Array:
        """One step."""
        J = self.arm.jacobian(self.q)
        damped = J @ J.T + self.damping**2 * np.eye(6)
        ahead = self.q + J.T @ np.linalg.solve(damped, self.arm.error(self.q, target.placement))
        self.q = np.clip(ahead, self.arm.lower, self.arm.upper)
        return self.q


METHODS = (PseudoInverse, PostureInNullSpace, Damped)
