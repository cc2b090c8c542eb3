"""phi in a box: joint positions in half-widths from the centre, task errors in the sizes of their components (ours)."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from orthocas.casadi_tools.cached import cached_property
from orthocas.checks import Array
from orthocas.domains import Domain, borders
from orthocas.inverting.phi_map import ROUNDING, PhiMap
from orthocas.tasks import Task


@dataclass(frozen=True, eq=False)
class Equations:
    """k equations g(u) = target in a box, of many rows."""

    errors: Callable[[Array, Array], Array]  #: targets (N, k), u (N, n) -> (target - g(u)) / scale, (N, k)
    jacobians: Callable[[Array, Array], Array]  #: targets (N, k), u (N, n) -> d(g / scale)/du, (N, k, n)
    low: Array  #: lowest u, (n,)
    high: Array  #: highest u, (n,)


@dataclass(frozen=True, eq=False)
class BoxedPhi:
    """Task values and phi of points u = (q - centre) / half_width, and their errors.

    Values need not be finite: errors are infinite there, and derivatives 0 or NaN; those of equations are 0.
    """

    task: Task
    domain: Domain
    phi_map: PhiMap

    @property
    def m(self) -> int:
        """Number of task components."""
        return self.task.m

    @cached_property
    def low(self) -> Array:
        """Lowest u, (n,): -1, or -inf for joints without borders."""
        return (borders(self.domain)[0] - self.domain.centre) / self.domain.half_width

    @cached_property
    def high(self) -> Array:
        """Highest u, (n,)."""
        return (borders(self.domain)[1] - self.domain.centre) / self.domain.half_width

    def points(self, u: Array) -> Array:
        """q at u (N, n), within the borders, (N, n)."""
        domain = self.domain
        return np.clip(domain.centre + domain.half_width * u, *borders(domain))

    def of_points(self, q: Array) -> Array:
        """u of the points of the box nearest to q (N, n), (N, n)."""
        u = (q - self.domain.centre) / self.domain.half_width
        return np.clip(u, self.low, self.high)

    @cached_property
    def task_equations(self) -> Equations:
        """h(q) = x, with task values x (N, m); scale as in `PhiMap`."""
        return Equations(self._task_errors, self._task_jacobians, self.low, self.high)

    @cached_property
    def phi_equations(self) -> Equations:
        """phi(q) = phi, with targets (N, n)."""
        return Equations(self._phi_errors, self._phi_jacobians, self.low, self.high)

    def xi_errors(self, targets: Array, u: Array) -> Array:
        """xi - xi(q), (N, r), for targets (N, n) of phi."""
        return self.phi_map.difference(targets, self.phi_map.phi(self.points(u)))[:, self.m :]

    def jacobians(self, targets: Array, u: Array) -> tuple[Array, Array]:
        """d(h / scale)/du (N, m, n) and dxi/du (N, r, n)."""
        J = self.phi_map.jacobian(self.points(u)) * self.domain.half_width
        return J[:, : self.m] / self._scale(targets[:, : self.m])[:, :, None], J[:, self.m :]

    def _task_errors(self, x: Array, u: Array) -> Array:
        errors = (x - self.task.batched(self.points(u))[0]) / self._scale(x)
        return np.where(np.isfinite(errors), errors, np.inf)

    def _task_jacobians(self, x: Array, u: Array) -> Array:
        J = self.task.batched_jacobian(self.points(u))[0].reshape(len(u), self.m, -1)
        J = J * self.domain.half_width / self._scale(x)[:, :, None]
        return np.where(np.isfinite(J), J, 0.0)

    def _phi_errors(self, targets: Array, u: Array) -> Array:
        errors = self.phi_map.residual(targets, self.points(u))
        return np.where(np.isfinite(errors), errors, np.inf)

    def _phi_jacobians(self, targets: Array, u: Array) -> Array:
        J = self.phi_map.jacobian(self.points(u)) * self.domain.half_width / self.phi_map.scale(targets)[:, :, None]
        return np.where(np.isfinite(J), J, 0.0)

    def _scale(self, x: Array) -> Array:
        scale: Array = self.phi_map.sizes[: self.m] + ROUNDING * np.abs(x)
        return scale
