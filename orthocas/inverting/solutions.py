"""What the inverse map found: joint positions, with a status for each row."""

from dataclasses import dataclass, field
from enum import IntEnum
from typing import Self

import numpy as np
from numpy.typing import NDArray

from orthocas.checks import Array, Indices
from orthocas.errors import InverseError
from orthocas.showing import Shown, listed

_FEW = 5  # rows that a message names


class InverseStatus(IntEnum):
    """How the search for a q with phi(q) = phi ended, from best to worst."""

    FOUND = 0  #: a solution inside the domain
    NEAREST = 1  #: no such q lies inside; this one does, has the same x, and its xi is as near as could be found
    OUTSIDE_DOMAIN = 2  #: a solution within the joint limits, but outside the domain
    LIMIT = 3  #: a solution beyond the joint limits
    SINGULAR = 4  #: a solution at which J is singular, so that it is not unique
    NOT_FOUND = 5  #: no solution was found, which does not prove that there is none; q has the smallest error found
    BAD_INPUT = 6  #: a number of phi or of the start is not finite; q is NaN
    OUT_OF_REACH = 7  #: no solution: x is farther from the first joint than the arm is long; q as for NOT_FOUND


_SOLVED = (InverseStatus.FOUND, InverseStatus.NEAREST)
_UNSOLVED = (InverseStatus.NOT_FOUND, InverseStatus.BAD_INPUT, InverseStatus.OUT_OF_REACH)
_BEYOND = (InverseStatus.OUTSIDE_DOMAIN, InverseStatus.LIMIT)


@dataclass(frozen=True, eq=False, repr=False)
class Solutions(Shown):
    """Joint positions with given task values and coordinates; see `Chart.solve`.

    Example:
        >>> import numpy as np
        >>> import orthocas as oc
        >>> from orthocas import problems
        >>> chart = oc.fit(problems.get("planar_3r_xy"), oc.Polynomial(degree=2), samples=300).chart
        >>> phi = chart.phi([[0.7, 0.9, 0.6], [0.6, 0.8, 0.8]])
        >>> solutions = chart.solve(np.vstack([phi, [9.0, 0.0, 0.0]]))
        >>> [status.name for status in solutions.statuses], solutions.found.tolist()
        (['FOUND', 'FOUND', 'OUT_OF_REACH'], [True, True, False])
    """

    q: Array = field(repr=False)  #: the best points found, (N, n) [rad] or [m]
    status: Indices  #: an `InverseStatus` for each row, (N,)
    iterations: Indices  #: steps of Newton's method that led to q, (N,)
    error: Array  #: largest |phi(q) - phi| relative to the sizes of the components, (N,); of x alone for NEAREST
    distance: Array  #: |xi(q) - xi|, (N,)
    tolerance: float  #: the largest error of a solution

    def __post_init__(self) -> None:
        for array in (self.q, self.status, self.iterations, self.error, self.distance):
            array.setflags(write=False)

    def __len__(self) -> int:
        return len(self.q)

    @property
    def found(self) -> NDArray[np.bool_]:
        """Rows with a solution inside the domain, (N,)."""
        return np.asarray(self.status == InverseStatus.FOUND)

    @property
    def statuses(self) -> tuple[InverseStatus, ...]:
        """The status of each row by name."""
        return tuple(InverseStatus(value) for value in self.status)

    def facts(self) -> dict[str, str]:
        """How many rows ended how."""
        counts = {status.name: int((self.status == status).sum()) for status in InverseStatus}
        solved = self.error[np.isin(self.status, (*_SOLVED, *_BEYOND))]
        return {
            "solutions": listed(f"{count} {name}" for name, count in counts.items() if count) or "no rows",
            **({"largest error": f"{solved.max():.3g}"} if solved.size else {}),
            **({"iterations": f"{self.iterations.mean():.3g} on average"} if len(self) else {}),
        }

    def require(self, inside: bool = True) -> Self:
        """These solutions, if all rows have one.

        Args:
            inside: do not accept solutions outside the domain.

        Raises:
            InverseError: if a row is not solved; the message names the rows.
        """
        accepted = _SOLVED if inside else (*_SOLVED, *_BEYOND)
        missing = np.flatnonzero(np.isin(self.status, _UNSOLVED))
        if missing.size:
            raise InverseError(
                f"no q with phi(q) = phi found for {self.named(missing)}: relative error is "
                f"{self.error[missing].max():.3g}, expected <= {self.tolerance:.1g}. "
                "The target may be out of reach, or the path to it singular"
            )
        singular = np.flatnonzero(self.status == InverseStatus.SINGULAR)
        if singular.size:
            raise InverseError(f"the Jacobian is singular at the solution of row {singular[0]}: q is not unique there")
        beyond = np.flatnonzero(~np.isin(self.status, accepted))
        if beyond.size:
            raise InverseError(f"the only q with phi(q) = phi lies outside the domain for {self.named(beyond)}")
        return self

    def named(self, rows: Indices) -> str:
        """Some rows in words, for messages."""
        return f"rows {rows[:_FEW].tolist()}" if len(self) > 1 else "phi"
