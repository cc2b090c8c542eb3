"""The interface of coordinates xi(q), fitted or grown."""

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
        """Short name of the representation, for example 'polynomial:4'."""
        ...

    @property
    def size(self) -> int:
        """Number of parameters."""
        ...

    @property
    def functions(self) -> dict[str, ca.Function]:
        """CasADi functions of one joint position (n, 1), as graphs of shared parts.

        They are xi (r, 1), jacobian (r, n), and second_derivative (r, 1) of q, v, w: (d/ds) J_xi(q + s v) w.
        """
        ...

    def xi(self, points: Array) -> Array:
        """Coordinates (N, r) at points (N, n)."""
        ...

    def jacobian(self, points: Array) -> Array:
        """J_xi (N, r, n) at points (N, n)."""
        ...


@runtime_checkable
class InvertibleMap(Protocol):
    """Coordinates with their own inverse map."""

    @property
    def turn(self) -> float:
        """Period of the coordinates: 2 pi on a circle, 0 if they are not periodic."""
        ...

    def inverse(self, phi: Array, q_start: Array) -> Array:
        """Joint positions (N, n) with the given task values and coordinates phi (N, n); NaN where there are none."""
        ...
