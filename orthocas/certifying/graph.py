"""CasADi SX functions evaluated in Taylor arithmetic, step by step."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from orthocas.casadi_tools.tape import to_tape
from orthocas.certifying.functions import BINARY, POWERS, UNARY, power
from orthocas.certifying.taylor import TaylorModel
from orthocas.errors import CertifyError

_LARGEST_POWER = 64


@dataclass(frozen=True, eq=False)
class TaylorGraph:
    """An SX function q (n, 1) -> values, dense, as a list of steps in Taylor arithmetic.

    Raises:
        CertifyError: if a step has no bounds.
    """

    steps: tuple[tuple[Any, ...], ...]
    outputs: int  #: number of values, column by column
    what: str  #: for errors

    @classmethod
    def of(cls, function: ca.Function, what: str) -> "TaylorGraph":
        """The steps of a function, checked."""
        tape = to_tape(function)
        graph = cls(tuple(map(tuple, tape["steps"])), tape["rows"] * tape["columns"], what)
        graph.require_bounds()
        return graph

    def require_bounds(self) -> None:
        """Refuse operations without bounds."""
        constants: dict[int, float] = {}
        for name, into, *of in self.steps:
            if name in POWERS and not is_whole(constants.get(of[1])):
                raise CertifyError(f"{self.what} has a power that is no whole number, so it cannot be certified")
            if name not in (*UNARY, *BINARY, *POWERS, "const", "input", "output"):
                raise CertifyError(f"{self.what} uses the operation {name}, which cannot be certified")
            constants.pop(into, None)
            if name == "const":
                constants[into] = of[0]

    def __call__(self, inputs: Sequence[TaylorModel]) -> list[TaylorModel]:
        """The values for models of q_1, ..., q_n."""
        work: dict[int, Any] = {}
        results: dict[int, TaylorModel] = {}
        for name, into, *of in self.steps:
            if name == "const":
                work[into] = TaylorModel.constant(np.array([float(of[0])]))
            elif name == "input":
                work[into] = inputs[of[0]]
            elif name == "output":
                results[into] = work[of[0]]
            elif name in UNARY:
                work[into] = UNARY[name](work[of[0]])
            elif name in POWERS:
                work[into] = power(work[of[0]], int(work[of[1]].centre.flat[0]))
            else:
                work[into] = BINARY[name](work[of[0]], work[of[1]])
        return [results[k] for k in range(self.outputs)]


def is_whole(value: float | None) -> bool:
    """Whether a constant, if there is one, is a whole number that powers may have as exponent."""
    return value is not None and abs(value) <= _LARGEST_POWER and value == round(value)
