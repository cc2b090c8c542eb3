"""The interface of a loss term, and the sample data that it may use."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import casadi as ca

from orthocas.checks import require_known


@dataclass(frozen=True)
class Sizes:
    """Sizes of a problem, for the loss of one sample."""

    n: int  #: joints
    m: int  #: task components
    r: int  #: coordinates
    identity_metric: bool  #: whether A = I; then products with A^-1 are omitted


Data = Mapping[str, ca.SX]  #: data of a sample by name; there is no 'metric_inverse' for A = I

SAMPLE_DATA: dict[str, Callable[[Sizes], tuple[int, int]]] = {  #: shapes of the properties of `Samples` a term may need
    "unit_task_gradients": lambda s: (s.m, s.n),
    "task_basis": lambda s: (s.m, s.n),
    "task_jacobian": lambda s: (s.m, s.n),
    "metric_inverse": lambda s: (s.n, s.n),
    "null_basis": lambda s: (s.n, s.r),
    "points": lambda s: (s.n, 1),
}


@runtime_checkable
class LossTerm(Protocol):
    """A sum of squared residuals of the coordinate gradients at a sample. `Weights` holds its weight."""

    @property
    def name(self) -> str:
        """Short name, as used in `Weights`."""
        ...

    @property
    def data(self) -> tuple[str, ...]:
        """Sample data that the term needs: names in `SAMPLE_DATA`."""
        ...

    @property
    def hinge(self) -> bool:
        """Whether the term is zero at most samples of a good fit, and couples all coordinates elsewhere."""
        ...

    def residuals(self, coordinate_jacobian: ca.SX, data: Data, sizes: Sizes) -> ca.SX:
        """J_xi (r, n) -> rho (k, 1), where k may be 0. The term adds weight |rho|^2 / 2 to the loss of a sample."""
        ...


def require_sample_data(name: str) -> None:
    """Raise UnknownNameError unless samples have this data."""
    require_known("data of a sample", name, SAMPLE_DATA)
