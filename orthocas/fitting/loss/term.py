"""What a term of the loss is, and what it may ask of a sample."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

import casadi as ca

from orthocas.checks import require_known


@dataclass(frozen=True)
class Sizes:
    """Sizes of a problem, as the loss of one sample sees it."""

    n: int  #: joints
    m: int  #: task components
    r: int  #: coordinates
    identity_metric: bool  #: whether A = I: then there is no A^-1 to multiply with


Data = Mapping[str, ca.SX]  #: what a sample tells, by name; there is no 'metric_inverse' for A = I

SAMPLE_DATA: dict[str, Callable[[Sizes], tuple[int, int]]] = {  #: shapes of the properties of `Samples` a term may need
    "unit_task_gradients": lambda s: (s.m, s.n),
    "task_basis": lambda s: (s.m, s.n),
    "task_jacobian": lambda s: (s.m, s.n),
    "metric_inverse": lambda s: (s.n, s.n),
    "null_basis": lambda s: (s.n, s.r),
    "points": lambda s: (s.n, 1),
}


class LossTerm(Protocol):
    """A sum of squared residuals of the coordinate gradients at a sample; its weight is in `Weights`."""

    @property
    def name(self) -> str:
        """Short name, as `Weights` has it."""
        ...

    @property
    def data(self) -> tuple[str, ...]:
        """What it needs to know of a sample: names in `SAMPLE_DATA`."""
        ...

    @property
    def hinge(self) -> bool:
        """Whether it is zero at most samples of a good fit, and couples all coordinates where it is not."""
        ...

    def residuals(self, coordinate_jacobian: ca.SX, data: Data, sizes: Sizes) -> ca.SX:
        """rho (k, 1) of J_xi (r, n): the term adds weight |rho|^2 / 2 to the loss of a sample. k may be 0."""
        ...


def require_sample_data(name: str) -> None:
    """Raise UnknownNameError unless samples can tell this."""
    require_known("data of a sample", name, SAMPLE_DATA)
