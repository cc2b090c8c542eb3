"""Coordinates given in closed form. Their chart is evaluated, saved and used like any other, without a fit."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from orthocas.bases.family import ClosedForm, Expression, JointSpace, component_gradients
from orthocas.tools.batch import dense_function
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array, require_count, require_shape, require_text
from orthocas.tools.expressions import Tape, expression_of, replay, require_tape, to_tape

if TYPE_CHECKING:
    from orthocas.tasks.problem import Problem

_MOST_JOINTS = 1000


@dataclass(frozen=True, eq=False)
class Given:
    """Coordinates xi(q) as a CasADi expression without parameters. Use `from_function` to build one.

    Args:
        label: a name for reports.
        n: number of joints.
        tape: the expression as plain data; see `orthocas.tools.expressions`.

    Raises:
        InvalidValueError: if the tape is malformed.
    """

    label: str
    n: int
    tape: Tape = field(repr=False)
    linear = True

    def __post_init__(self) -> None:
        require_text("label of given coordinates", self.label)
        require_tape(self.tape, require_count("n", self.n))

    @classmethod
    def from_function(cls, name: str, n: int, function: Callable[[ca.SX], ca.SX] | ca.Function) -> "Given":
        """Build from a function of an SX column q (n, 1) that returns xi (r, 1).

        Raises:
            ShapeError: if xi is not a column.

        Example:
            >>> import orthocas as oc
            >>> from orthocas import problems
            >>> direction = oc.Given.from_function("hand direction", 3, lambda q: q[0] + q[1] + q[2])
            >>> chart = oc.fit(problems.get("planar_3r_xy"), direction).chart
            >>> chart.labels
            ('x', 'y', 'xi1')
        """
        q = ca.SX.sym("q", require_count("n", n, most=_MOST_JOINTS))
        xi = expression_of(f"coordinates '{name}'", function, q)
        require_shape(f"coordinates '{name}'", xi.shape, (None, 1))
        return cls(name, n, to_tape(dense_function("xi", [q], [xi])))

    def for_problem(self, problem: "Problem") -> "Given":
        """The object itself: it does not depend on the problem."""
        return self

    def closed_form(self, problem: "Problem") -> ClosedForm:
        """There are no parameters."""
        return ClosedForm(np.zeros(0))

    def family(self, space: JointSpace, outputs: int) -> "GivenFamily":
        """The coordinates as a family without parameters.

        Raises:
            ShapeError: if the number of coordinates is not `outputs`, or the number of joints differs.
        """
        require_shape(f"q of coordinates '{self.label}'", (self.n,), (space.n,))
        require_shape(f"coordinates '{self.label}'", (self.tape["rows"], self.tape["columns"]), (outputs, 1))
        return GivenFamily(self, outputs)


@dataclass(frozen=True, eq=False)
class GivenFamily:
    """The one function of a `Given`."""

    given: Given
    outputs: int
    size: int = 0
    as_matrices: bool = False

    @cached_property
    def width(self) -> int:
        """Number of steps of the tape."""
        return len(self.given.tape["steps"])

    def expression(self, q: Expression, theta: Expression) -> Expression:
        """xi(q), (r, N), for q (n, N)."""
        xi: Expression = ca.vertcat(*replay(self.given.tape, [q[i, :] for i in range(q.shape[0])]))
        return xi

    def jacobian(self, q: Expression, theta: Expression) -> list[Expression]:
        """Gradients of the components, r matrices (n, N)."""
        return component_gradients(self.expression(q, theta), q)

    def initial(self, seed: int) -> Array:
        """An empty array: there are no parameters."""
        return np.zeros(0)
