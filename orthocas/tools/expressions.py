"""SX expressions as data: tapes for files, their structure, scalar code, and user functions of q."""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations
from math import inf
from typing import Any, TypeVar

import casadi as ca
import numpy as np

from orthocas.errors import InvalidValueError, OrthocasError
from orthocas.tools.checks import Array, require_count
from orthocas.tools.interrupts import deferred

_LARGEST = 1e300  #: largest absolute value of constants
#: operations with the same form in Python and C
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
}
#: operations on one operand, by their names on tapes
UNARY = (
    *("neg", "exp", "log", "sqrt", "sq", "twice", "sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh"),
    *("inv", "fabs", "sign", "not", "floor", "ceil", "erf", "log1p", "expm1", "asinh", "acosh", "atanh", "assign"),
)
#: operations on two operands
BINARY = (
    *("add", "sub", "mul", "div", "pow", "constpow", "atan2", "hypot", "fmod", "copysign", "fmin", "fmax"),
    *("lt", "le", "eq", "ne", "and", "or", "if_else_zero"),
)
MOST_ROWS = 12  #: largest number of rows of a determinant
_BY_CASADI = 5  #: rows up to which CasADi's own determinant is efficient
_LINEAR = ("assign", "neg", "twice", "add", "sub")
WRITTEN_OUT = 10  #: rows of the largest matrices whose products and inverses become scalar code
Tape = dict[str, Any]
Entry = TypeVar("Entry", ca.SX, ca.MX)
Value = TypeVar("Value")


class HoldsFunctions:
    """Base of objects with CasADi functions among their fields; pickles record CasADi's version."""

    def __getstate__(self) -> dict[str, Any]:
        """The fields, with functions as text."""
        version = ca.CasadiMeta.version()
        return {
            name: _Written(value.serialize(), version) if isinstance(value, ca.Function) else value
            for name, value in vars(self).items()
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore the object.

        Raises:
            InvalidValueError: if this version of CasADi cannot read functions of another version.
        """
        for name, value in state.items():
            object.__setattr__(self, name, value.read() if isinstance(value, _Written) else value)


@dataclass(frozen=True)
class _Written:
    """A function as text in a pickle."""

    text: str
    version: str  #: version of CasADi

    def read(self) -> ca.Function:
        try:
            return ca.Function.deserialize(self.text)
        except RuntimeError:
            expected = f"one of CasADi {ca.CasadiMeta.version()}; files of charts outlive versions"
            raise InvalidValueError("pickle", f"from CasADi {self.version}", expected) from None


#: CasADi's codes of the operations
CODES = {name: int(getattr(ca, f"OP_{name.upper()}")) for name in (*UNARY, *BINARY)}
_NAMES: dict[int, str] = {code: name for name, code in CODES.items()} | {
    getattr(ca, f"OP_{name.upper()}"): name for name in ("const", "input", "output")
}


def write_tape(function: ca.Function) -> Tape:
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
        # A step holds its operation, the slot of its result, and a number or the slots of its operands.
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
    """Check a tape from a file before anything is built.

    Raises:
        InvalidValueError: if it is not a tape of an expression with this number of inputs. The message names the bad
            step.
    """
    # Check the outer form, then each step: its operands must be results of earlier steps.
    keys = tape.keys() if isinstance(tape, dict) else ()
    if set(keys) != {"rows", "columns", "steps"} or not isinstance(tape["steps"], list | tuple):
        raise InvalidValueError("tape", f"an object with {sorted(keys)[:5]}", "one with rows, columns and steps")
    rows, columns = require_count("rows of a tape", tape["rows"]), require_count("columns of a tape", tape["columns"])
    written: set[int] = set()
    results: set[int] = set()
    for k, step in enumerate(tape["steps"]):
        if not _is_step(step, inputs, written):
            raise InvalidValueError(f"step {k} of a tape", repr(step)[:80], "a known operation on earlier results")
        (results if step[0] == "output" else written).add(step[1])
    if len(results) != rows * columns or results != set(range(len(results))):
        raise InvalidValueError("number of outputs of a tape", len(results), f"{rows} rows times {columns} columns")


def _is_step(step: Any, inputs: int, written: set[int]) -> bool:
    """Whether a step is [operation, slot of the result, operands ...]."""
    if not isinstance(step, list | tuple) or len(step) < 3 or not isinstance(step[0], str) or not _is_index(step[1]):
        return False
    name, _, *of = step
    if name == "const":
        return len(of) == 1 and isinstance(of[0], int | float) and (abs(of[0]) <= _LARGEST or abs(of[0]) == inf)
    if name == "input":
        return len(of) == 1 and _is_index(of[0]) and of[0] < inputs
    # Operands are results of earlier steps.
    needs = 2 if name in BINARY else 1
    return (
        (name in UNARY or name in BINARY or name == "output")
        and len(of) == needs
        and all(_is_index(place) and place in written for place in of)
    )


def _is_index(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 0


def read_tape(tape: Tape, q: ca.SX) -> ca.SX:
    """Rebuild the expression of a tape at q (n, 1).

    Raises:
        InvalidValueError: if it is not a tape for n inputs.
    """
    require_tape(tape, q.shape[0])
    entries = replay(tape, [q[i] for i in range(q.shape[0])])
    return ca.reshape(ca.vertcat(*entries), tape["rows"], tape["columns"])


def evaluate_tape(
    tape: Tape, leaf: Callable[[str, Any], Value], step: Callable[[str, Sequence[Value]], Value]
) -> list[Value]:
    """Evaluate a tape in any arithmetic; returns its outputs, column by column.

    Args:
        tape: a checked tape.
        leaf: called with "const" and a number, or with "input" and an index.
        step: called with the name of an operation and its operands.
    """
    work: dict[int, Value] = {}
    results: dict[int, Value] = {}
    for name, into, *of in tape["steps"]:
        if name == "output":
            results[into] = work[of[0]]
        elif name in ("const", "input"):
            work[into] = leaf(name, of[0])
        else:
            work[into] = step(name, [work[place] for place in of])
    return [results[k] for k in range(len(results))]


def replay(tape: Tape, inputs: Sequence[Entry]) -> list[Entry]:
    """Evaluate a checked tape on the entries of its input; returns the entries of its output, column by column."""
    # Static methods of the type take a tenth of the time of Python's operators.
    kind: Any = type(inputs[0])
    # Constants get the shape of the entries.
    zero = 0 * inputs[0]

    def step(name: str, of: Sequence[Any]) -> Any:
        return (kind.unary if len(of) == 1 else kind.binary)(CODES[name], *of)

    return evaluate_tape(tape, lambda name, of: zero + float(of) if name == "const" else inputs[of], step)


Joints = frozenset[int]
Gradient = dict[int, Joints]  #: joints that each derivative depends on; missing derivatives are 0
_NOTHING: Joints = frozenset()


def find_gradient_dependences(tape: Tape) -> list[Gradient]:
    """For each output, the joints that its derivatives depend on."""

    def leaf(name: str, of: Any) -> tuple[Joints, Gradient]:
        joints = frozenset([of]) if name == "input" else _NOTHING
        return joints, dict.fromkeys(joints, _NOTHING)

    return [gradient for _, gradient in evaluate_tape(tape, leaf, _combine_dependences)]


def _combine_dependences(name: str, of: Sequence[tuple[Joints, Gradient]]) -> tuple[Joints, Gradient]:
    """The joints on which the result of a step and its derivatives depend."""
    values = [joints for joints, _ in of]
    everything = frozenset().union(*values)
    partials = [everything] * len(values)
    if name in _LINEAR:
        partials = [_NOTHING] * len(values)
    elif name == "mul":
        partials = values[::-1]
    elif name == "div":
        partials[0] = values[1]
    # Chain rule: union over partial derivatives and derivatives of operands.
    total: Gradient = {}
    for partial, (_, part) in zip(partials, of, strict=True):
        for j, own in part.items():
            total[j] = total.get(j, _NOTHING) | partial | own
    return everything, total


def choose_form(graph: ca.Function, rows: int) -> ca.Function:
    """Scalar code of a graph for matrices with so many rows, or the graph itself if the code would be too long."""
    return expand_scalars(graph) if rows <= WRITTEN_OUT else graph


def expand_scalars(function: ca.Function) -> ca.Function:
    """Expand a function into scalar operations. A function that cannot be expanded (a network) stays as it is."""
    # `expand` turns Ctrl-C into a RuntimeError.
    with deferred():
        try:
            flat = function.expand()
        except RuntimeError:
            return function
        inputs = flat.sx_in()
        outputs = ca.cse(list(flat.call(inputs)))
        return ca.Function(function.name(), inputs, outputs, function.name_in(), function.name_out())


def build_expression(what: str, function: Callable[[ca.SX], ca.SX] | ca.Function, q: ca.SX) -> ca.SX:
    """The SX expression that a user's function returns for q.

    Raises:
        InvalidValueError: if the function fails on q, does not return an SX expression, or uses other symbols.
    """
    if not callable(function):
        raise InvalidValueError(what, repr(function), "a function of an SX column q")
    value: ca.SX = call_user(what, f"a function of an SX column q {q.shape}", lambda: ca.SX(function(q)))
    symbols = {str(symbol) for symbol in ca.vertsplit(q)}
    free = [str(symbol) for symbol in ca.symvar(value) if str(symbol) not in symbols]
    if free:
        raise InvalidValueError(what, f"using the free symbols {', '.join(free[:5])}", "an expression in q alone")
    return value


def call_user(what: str, expected: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a user's function, and return its result.

    Raises:
        InvalidValueError: if the function fails.
    """
    try:
        return function(*arguments)
    except (RuntimeError, TypeError, ValueError, LookupError, ArithmeticError, AttributeError) as error:
        # Remove locations in CasADi's sources, and lists of prototypes.
        reason, *_ = " ".join(str(error).split()).partition(" Possible prototypes")
        reason = re.sub(r"\S*\.[ch]pp:\d+: ?|\S*\w::\w\S* ?", "", reason)[:120]
        raise InvalidValueError(what, f"failing ({reason})", expected) from None


def compute_determinant(matrix: ca.SX) -> ca.SX:
    """det A of a symbolic matrix (r, r), by cofactors, with r 2^(r-1) products.

    Minors of the first k rows are computed once for each choice of k columns. CasADi's own determinant repeats them,
    with r! products: at r = 10 it takes a minute, which Ctrl-C cannot interrupt.

    Args:
        matrix: a matrix with at most `MOST_ROWS` rows.
    """
    rows = require_count("rows of a determinant", matrix.shape[0], least=1, most=MOST_ROWS)
    if rows <= _BY_CASADI:
        return ca.det(matrix)
    # Go from row to row, and expand each minor along its last row.
    minors: dict[tuple[int, ...], ca.SX] = {(): ca.SX(1)}
    for k in range(rows):
        minors = {
            columns: sum(
                (-1) ** (k + i) * matrix[k, column] * minors[columns[:i] + columns[i + 1 :]]
                for i, column in enumerate(columns)
            )
            for columns in combinations(range(rows), k + 1)
        }
    return minors[tuple(range(rows))]


def wrap_shortest(difference: Any, turns: Array) -> Any:
    """Remove whole periods from differences of periodic components, so that each is the shorter way around.

    Args:
        difference: NumPy rows (N, k) or (k,), or a CasADi column (k, 1).
        turns: periods of the components, (k,); 0 for components without a period.
    """
    if not turns.any():
        return difference
    periods = np.where(turns > 0, turns, 1.0)
    if isinstance(difference, ca.SX | ca.MX | ca.DM):
        whole: Any = ca.floor(difference / ca.DM(periods) + 0.5)
        return difference - ca.DM(turns) * whole
    return difference - turns * np.round(difference / periods)
