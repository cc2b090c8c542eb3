"""What coordinates xi(q) of a chart offer, however they were found."""

from typing import Protocol, runtime_checkable

import casadi as ca

from orthocas.checks import Array


class CoordinateMap(Protocol):
    """Coordinates xi(q), fitted or grown."""

    @property
    def r(self) -> int:
        """Number of coordinates."""
        ...

    @property
    def label(self) -> str:
        """Short name of how they are described, for example 'polynomial:4'."""
        ...

    @property
    def size(self) -> int:
        """Number of numbers that describe them."""
        ...

    @property
    def functions(self) -> dict[str, ca.Function]:
        """CasADi functions of one joint position (n, 1), as graphs of shared parts.

        Coordinates xi (r, 1), their jacobian (r, n), and second_derivative of q, v, w (r, 1): (d/ds) J_xi(q + s v) w.
        """
        ...

    def xi(self, points: Array) -> Array:
        """Coordinates at points (N, n), (N, r)."""
        ...

    def jacobian(self, points: Array) -> Array:
        """J_xi at points (N, n), (N, r, n)."""
        ...


@runtime_checkable
class InvertibleMap(Protocol):
    """Coordinates that know their way back."""

    @property
    def turn(self) -> float:
        """What may be added to a coordinate without changing the point: 2 pi on a circle, otherwise 0."""
        ...

    def inverse(self, phi: Array, q_start: Array) -> Array:
        """Joint positions with given task values and coordinates (N, n), (N, n); NaN where there are none."""
        ...
