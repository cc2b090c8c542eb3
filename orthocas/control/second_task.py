"""The interface of the second task x_2(q) of a projector."""

from typing import Protocol

import casadi as ca

from orthocas.chart import Chart
from orthocas.checks import Array
from orthocas.control.reference import Reference


class SecondTask(Protocol):
    """What a projector moves in the null space of the task: k_2 functions x_2(q)."""

    @property
    def name(self) -> str:
        """'joints', 'xi', or the name of a task."""
        ...

    @property
    def chart(self) -> Chart | None:
        """The chart whose domain the law has to respect, if any."""
        ...

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of x, then of x_2."""
        ...

    @property
    def measured(self) -> ca.Function:
        """q (n, 1) -> [x; x_2]."""
        ...

    def jacobian(self, q: ca.MX) -> ca.MX:
        """J_2 = dx_2/dq, (k_2, n)."""
        ...

    def weighted(self, q: ca.MX, A: ca.MX) -> tuple[ca.MX, ca.MX, ca.MX]:
        """J_2^#A (n, k_2), (J_2 A^-1 J_2^T)^-1 (k_2, k_2), and det(J_2 A^-1 J_2^T) over its median on the domain."""
        ...

    def curvature(self, q: ca.MX, dq: ca.MX) -> ca.MX:
        """dJ_2/dt dq, (k_2, 1)."""
        ...

    def shortest(self, difference: ca.MX) -> ca.MX:
        """A difference of two [x; x_2], without whole turns of joints that turn without end."""
        ...

    def runnable(self, graph: ca.Function) -> ca.Function:
        """The fast form of a graph."""
        ...

    def require_reachable(self, reference: Reference, q_start: Array) -> None:
        """Raise UnreachableReferenceError if the law cannot follow the reference."""
        ...
