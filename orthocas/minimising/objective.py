"""The objectives that minimisers see, and the further data that some of them offer."""

from collections.abc import Iterator
from typing import Protocol, runtime_checkable

from orthocas.checks import Array


class Objective(Protocol):
    """A smooth function of theta."""

    def value(self, theta: Array) -> float:
        """L(theta)."""
        ...

    def value_and_gradient(self, theta: Array) -> tuple[float, Array]:
        """L(theta) and dL/dtheta, (size,)."""
        ...


@runtime_checkable
class LeastSquaresObjective(Objective, Protocol):
    """A mean of squared residuals with a Gauss-Newton matrix."""

    def normal_equations(self, theta: Array) -> tuple[float, Array, Array]:
        """L(theta), its gradient (size,) and the Gauss-Newton matrix (size, size)."""
        ...


@runtime_checkable
class EstimatedObjective(Objective, Protocol):
    """A mean of squared residuals with a rough Gauss-Newton matrix, which costs less than the one of all samples."""

    def curvature_estimate(self, theta: Array) -> Array:
        """An estimate of the Gauss-Newton matrix, (size, size)."""
        ...


@runtime_checkable
class SmoothObjective(Objective, Protocol):
    """An objective with its exact Hessian."""

    def hessian(self, theta: Array) -> Array:
        """d^2L/dtheta^2, (size, size)."""
        ...


@runtime_checkable
class SampledObjective(Objective, Protocol):
    """A mean over samples that can draw fresh ones."""

    def batches(self, size: int, count: int, seed: tuple[int, ...]) -> Iterator[Objective]:
        """The same mean over `count` fresh sample sets, of at most `size` samples each."""
        ...


@runtime_checkable
class ConstrainedObjective(Objective, Protocol):
    """An objective with constraints lower <= c(theta) <= upper."""

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds, (constraints,) each."""
        ...

    def constraints(self, theta: Array) -> tuple[Array, Array]:
        """c(theta), (constraints,), and its Jacobian, (constraints, size)."""
        ...

    def lagrangian_hessian(self, theta: Array, factor: float, multipliers: Array) -> Array:
        """Hessian of factor L + multipliers . c, (size, size)."""
        ...
