"""CasADi SX expressions as plain data: files store custom expressions, and loading them runs no code.

A tape is a list of steps on numbered work slots. The steps are elementary operations, so replaying a tape can only
rebuild an expression. Its inputs may be scalars or whole rows of an MX matrix. With rows, the expression of one sample
becomes that of all samples side by side.
"""

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import casadi as ca

from orthocas.errors import OrthocasError

Tape = dict[str, Any]
Entry = TypeVar("Entry", ca.SX, ca.MX)

_UNARY: dict[str, Callable[[Any], Any]] = {
    "neg": lambda a: -a,
    "exp": ca.exp,
    "log": ca.log,
    "sqrt": ca.sqrt,
    "sq": lambda a: a * a,
    "twice": lambda a: 2 * a,
    "sin": ca.sin,
    "cos": ca.cos,
    "tan": ca.tan,
    "asin": ca.asin,
    "acos": ca.acos,
    "atan": ca.atan,
    "sinh": ca.sinh,
    "cosh": ca.cosh,
    "tanh": ca.tanh,
    "inv": lambda a: 1 / a,
    "fabs": ca.fabs,
    "sign": ca.sign,
    "not": ca.logic_not,
    "floor": ca.floor,
    "ceil": ca.ceil,
    "erf": ca.erf,
    "log1p": ca.log1p,
    "expm1": ca.expm1,
    "asinh": ca.asinh,
    "acosh": ca.acosh,
    "atanh": ca.atanh,
    "assign": lambda a: a,
}
_BINARY: dict[str, Callable[[Any, Any], Any]] = {
    "add": lambda a, b: a + b,
    "sub": lambda a, b: a - b,
    "mul": lambda a, b: a * b,
    "div": lambda a, b: a / b,
    "pow": lambda a, b: a**b,
    "constpow": lambda a, b: a**b,
    "atan2": ca.atan2,
    "hypot": ca.hypot,
    "fmod": ca.fmod,
    "copysign": ca.copysign,
    "fmin": ca.fmin,
    "fmax": ca.fmax,
    "lt": lambda a, b: a < b,
    "le": lambda a, b: a <= b,
    "eq": lambda a, b: a == b,
    "ne": lambda a, b: a != b,
    "and": ca.logic_and,
    "or": ca.logic_or,
    "if_else_zero": lambda a, b: ca.if_else(a, b, 0),
}
_NAMES: dict[int, str] = {
    getattr(ca, f"OP_{name.upper()}"): name for name in (*_UNARY, *_BINARY, "const", "input", "output")
}


def to_tape(function: ca.Function) -> Tape:
    """Write an SX function of one column and one output as a tape.

    Raises:
        OrthocasError: if the function uses an operation that tapes do not support.
    """
    rows, columns = function.size_out(0)
    steps: list[list[Any]] = []
    for k in range(function.n_instructions()):
        operation = function.instruction_id(k)
        if operation not in _NAMES:
            raise OrthocasError(f"custom expression uses CasADi operation {operation}, which chart files cannot store")
        name, into, of = _NAMES[operation], function.instruction_output(k), function.instruction_input(k)
        if name == "const":
            steps.append([name, into[0], function.instruction_constant(k)])
        elif name == "input":
            steps.append([name, into[0], of[1]])
        elif name == "output":
            steps.append([name, into[1], of[0]])
        else:
            steps.append([name, into[0], *of[: 2 if name in _BINARY else 1]])
    return {"rows": rows, "columns": columns, "steps": steps}


def from_tape(tape: Tape, q: ca.SX) -> ca.SX:
    """Rebuild the expression of a tape at q.

    Raises:
        KeyError, IndexError, TypeError, ValueError: if the tape is malformed. The caller names the file.
    """
    entries = replay(tape, [q[i] for i in range(q.shape[0])])
    return ca.reshape(ca.vertcat(*entries), int(tape["rows"]), int(tape["columns"]))


def replay(tape: Tape, inputs: Sequence[Entry]) -> list[Entry]:
    """Evaluate a tape at the entries of its input. Returns the entries of its output, column by column.

    Raises:
        KeyError, IndexError, TypeError, ValueError: if the tape is malformed.
    """
    work: dict[int, Any] = {}
    result: dict[int, Any] = {}
    zero = 0 * inputs[0]  # gives constants the shape of the entries
    for name, into, *of in tape["steps"]:
        if name == "const":
            work[into] = zero + float(of[0])
        elif name == "input":
            if not 0 <= of[0] < len(inputs):
                raise IndexError(f"input {of[0]} of {len(inputs)}")
            work[into] = inputs[of[0]]
        elif name == "output":
            result[into] = work[of[0]]
        elif name in _UNARY:
            work[into] = _UNARY[name](work[of[0]])
        else:
            work[into] = _BINARY[name](work[of[0]], work[of[1]])
    return [result[k] for k in range(int(tape["rows"]) * int(tape["columns"]))]
