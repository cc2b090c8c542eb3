"""CasADi SX expressions as plain data: files store custom expressions, and loading them runs no code.

A tape is a list of steps on numbered work slots. The steps are elementary operations, so replaying a tape can only
rebuild an expression. Its inputs may be scalars or whole rows of an MX matrix. With rows, the expression of one sample
becomes that of all samples side by side.
"""

from collections.abc import Sequence
from math import inf
from typing import Any, TypeVar

import casadi as ca

from orthocas.checks import require_count
from orthocas.errors import InvalidValueError, OrthocasError

_LARGEST = 1e300  # of finite constants
Tape = dict[str, Any]
Entry = TypeVar("Entry", ca.SX, ca.MX)

ARITHMETIC = {
    "neg": "-{0}",
    "sq": "{0} * {0}",
    "twice": "2.0 * {0}",
    "inv": "1.0 / {0}",
    "assign": "{0}",
    "add": "{0} + {1}",
    "sub": "{0} - {1}",
    "mul": "{0} * {1}",
    "div": "{0} / {1}",
}  #: operations that Python and C write alike

UNARY = (  #: operations on one number, by their names in tapes
    *("neg", "exp", "log", "sqrt", "sq", "twice", "sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh"),
    *("inv", "fabs", "sign", "not", "floor", "ceil", "erf", "log1p", "expm1", "asinh", "acosh", "atanh", "assign"),
)
BINARY = (  #: on two
    *("add", "sub", "mul", "div", "pow", "constpow", "atan2", "hypot", "fmod", "copysign", "fmin", "fmax"),
    *("lt", "le", "eq", "ne", "and", "or", "if_else_zero"),
)
#: CasADi's numbers of the operations
CODES = {name: int(getattr(ca, f"OP_{name.upper()}")) for name in (*UNARY, *BINARY)}
_NAMES: dict[int, str] = {code: name for name, code in CODES.items()} | {
    getattr(ca, f"OP_{name.upper()}"): name for name in ("const", "input", "output")
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
            steps.append([name, into[0], *of[: 2 if name in BINARY else 1]])
    return {"rows": rows, "columns": columns, "steps": steps}


def require_tape(tape: Tape, inputs: int) -> None:
    """Check a tape that comes from a file, before anything is built.

    Raises:
        InvalidValueError: if it is not a tape of an expression of that many inputs; the step to blame is named.
    """
    keys = tape.keys() if isinstance(tape, dict) else ()
    if set(keys) != {"rows", "columns", "steps"} or not isinstance(tape["steps"], list | tuple):
        raise InvalidValueError("tape", f"an object with {sorted(keys)[:5]}", "one with rows, columns and steps")
    rows, columns = require_count("rows of a tape", tape["rows"]), require_count("columns of a tape", tape["columns"])
    written: set[int] = set()
    results: set[int] = set()
    for k, step in enumerate(tape["steps"]):
        if not _makes_sense(step, inputs, written):
            raise InvalidValueError(f"step {k} of a tape", repr(step)[:80], "a known operation on earlier results")
        (results if step[0] == "output" else written).add(step[1])
    if len(results) != rows * columns or results != set(range(len(results))):
        raise InvalidValueError("number of outputs of a tape", len(results), f"{rows} rows times {columns} columns")


def _makes_sense(step: Any, inputs: int, written: set[int]) -> bool:
    """Whether a step is [operation, place of the result, what it needs ...]."""
    if not isinstance(step, list | tuple) or len(step) < 3 or not isinstance(step[0], str) or not _is_index(step[1]):
        return False
    name, _, *of = step
    if name == "const":
        return len(of) == 1 and isinstance(of[0], int | float) and (abs(of[0]) <= _LARGEST or abs(of[0]) == inf)
    if name == "input":
        return len(of) == 1 and _is_index(of[0]) and of[0] < inputs
    needs = 2 if name in BINARY else 1
    return (
        (name in UNARY or name in BINARY or name == "output")
        and len(of) == needs
        and all(_is_index(place) and place in written for place in of)
    )


def _is_index(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 0


def from_tape(tape: Tape, q: ca.SX) -> ca.SX:
    """Rebuild the expression of a tape at q (n, 1).

    Raises:
        InvalidValueError: if it is no tape for n inputs.
    """
    require_tape(tape, q.shape[0])
    entries = replay(tape, [q[i] for i in range(q.shape[0])])
    return ca.reshape(ca.vertcat(*entries), tape["rows"], tape["columns"])


def replay(tape: Tape, inputs: Sequence[Entry]) -> list[Entry]:
    """The entries of a checked tape's output, column by column, for the entries of its input."""
    work: dict[int, Any] = {}
    result: dict[int, Any] = {}
    kind: Any = type(inputs[0])  # its static methods take a tenth of the time of operators on Python's side
    zero = 0 * inputs[0]  # gives constants the shape of the entries
    for name, into, *of in tape["steps"]:
        if name == "const":
            work[into] = zero + float(of[0])
        elif name == "input":
            work[into] = inputs[of[0]]
        elif name == "output":
            result[into] = work[of[0]]
        elif name in UNARY:
            work[into] = kind.unary(CODES[name], work[of[0]])
        else:
            work[into] = kind.binary(CODES[name], work[of[0]], work[of[1]])
    return [result[k] for k in range(tape["rows"] * tape["columns"])]
