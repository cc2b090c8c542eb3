"""What a good joint position costs on a path: distances from borders, singular positions and obstacles (ours).

Every cost is a square of a residual that grows without bound towards what must not be reached. Just before that, it
goes on as a straight line, so that a path may begin beyond it:

- for every bounded joint u / sqrt(1 - u^2), with u = (q - centre) / half_width of the domain;
- for the task 0.1 / (s - bound), with the relative singular value s and the bound of a `ClearBox`, or 0;
- for every link and obstacle 0.02 m / (distance - clearance).
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from orthocas.casadi_tools.batch import Batched, dense_function
from orthocas.casadi_tools.cached import cached_property
from orthocas.checks import Array
from orthocas.domains import borders
from orthocas.following.checks import Limits
from orthocas.postures.clear_box import ClearBox

if TYPE_CHECKING:
    pass

_INSIDE = 0.97  # share of the half-width beyond which the residual of a joint is a straight line
_REGULAR, _NEARLY_SINGULAR = 0.1, 0.02  # relative singular values: scale of the residual, and where its line begins
_AWAY, _TOO_NEAR = 0.02, 0.004  # the same for distances from obstacles [m]


@dataclass(frozen=True, eq=False)
class Costs:
    """Residuals of joint positions, and their gradients."""

    limits: Limits

    def __call__(self, q: Array) -> tuple[Array, Array]:
        """Residuals (P, k) and gradients (P, k, n) at joint positions (P, n)."""
        parts = [self._of_borders(q), self._of_task(q)]
        if self.limits.distances.obstacles:
            values, gradients = self.limits.distances.with_gradients(q)
            residuals, slopes = _inverse(values - self.limits.clearance, _AWAY, _TOO_NEAR)
            parts.append((residuals, slopes[..., None] * gradients))
        return np.concatenate([part[0] for part in parts], axis=1), np.concatenate([part[1] for part in parts], axis=1)

    def _of_borders(self, q: Array) -> tuple[Array, Array]:
        domain = self.limits.chart.problem.domain
        bounded = np.flatnonzero(np.isfinite(borders(domain)[0]))
        u = ((q - domain.centre) / domain.half_width)[:, bounded]
        near = np.clip(u, -_INSIDE, _INSIDE)
        slopes = (1 - near**2) ** -1.5
        residuals = near / np.sqrt(1 - near**2) + (u - near) * slopes
        gradients = np.zeros((len(q), len(bounded), q.shape[1]))
        gradients[:, np.arange(len(bounded)), bounded] = slopes / domain.half_width[bounded]
        return residuals, gradients

    def _of_task(self, q: Array) -> tuple[Array, Array]:
        left, values, right = np.linalg.svd(self.limits.scaled_rows(q), full_matrices=False)
        domain = self.limits.chart.problem.domain
        bound = domain.least_singular_value if isinstance(domain, ClearBox) else 0.0
        residuals, slopes = _inverse(values[:, -1:] - bound, _REGULAR, _NEARLY_SINGULAR)
        gradients = self._turning(q, left[:, :, -1] / self.limits.scale, right[:, -1])[0]
        return residuals, slopes[..., None] * gradients[:, None]

    @cached_property
    def _turning(self) -> Batched:
        """q, u, v -> the gradient (n, 1) of u^T J(q) v: with singular vectors, that of the singular value."""
        chart = self.limits.chart
        q, v, u = ca.SX.sym("q", chart.n), ca.SX.sym("v", chart.n), ca.SX.sym("u", chart.m)
        product = ca.dot(u, self.limits.rows(q) @ v)
        return Batched(dense_function("turning", [q, u, v], [ca.cse(ca.gradient(product, q))]))


def _inverse(room: Array, scale: float, least: float) -> tuple[Array, Array]:
    """scale / room and its derivative; a straight line where room is below `least`."""
    far = np.maximum(room, least)
    slopes = -scale / far**2
    return scale / far + (room - far) * slopes, slopes
