"""Tapes of expressions as lines of Python: every operation acts on the values at all joint positions."""

from typing import Any

import casadi as ca

from orthocas.casadi_tools.tape import ARITHMETIC, Tape, to_tape

_FUNCTIONS = {
    name: name
    for name in (
        *("exp", "log", "sqrt", "sin", "cos", "tan", "sinh", "cosh", "tanh", "floor", "ceil", "log1p", "expm1"),
        *("sign", "hypot", "fmod", "copysign", "fmin", "fmax"),
    )
} | {
    "asin": "arcsin",
    "acos": "arccos",
    "atan": "arctan",
    "asinh": "arcsinh",
    "acosh": "arccosh",
    "atanh": "arctanh",
    "atan2": "arctan2",
    "fabs": "abs",
}  # names in NumPy, which PyTorch and JAX share
_OPERATORS = {
    **ARITHMETIC,
    "pow": "{0} ** {1}",
    "constpow": "{0} ** {1}",
}
_CONDITIONS = {
    "not": "{0} == 0",
    "lt": "{0} < {1}",
    "le": "{0} <= {1}",
    "eq": "{0} == {1}",
    "ne": "{0} != {1}",
    "and": "({0} != 0) & ({1} != 0)",
    "or": "({0} != 0) | ({1} != 0)",
}


def function_code(name: str, summary: str, function: ca.Function) -> str:
    """A Python function of columns q (n, N) with the entries of a dense SX function's output, row by row, (k, N)."""
    q = ca.SX.sym("q", function.size_in(0)[0])
    rows = ca.vec(ca.densify(function(q)).T)
    lines = tape_lines(to_tape(ca.Function("rows", [q], [ca.cse(rows)])))
    body = "\n".join(f"    {line}" for line in lines)
    return f'def {name}(q):\n    """{summary}"""\n{body}\n'


def tape_lines(tape: Tape) -> list[str]:
    """The lines that compute a tape's output from columns q (n, N), and return it as (k, N)."""
    lines: list[str] = []
    known: dict[int, str] = {}  # words for the constants in work slots
    results: dict[int, str] = {}
    for name, into, *of in tape["steps"]:
        if name == "const":
            known[into] = _literal(float(of[0]))
        elif name == "output":
            results[into] = f"y{into}"
            lines.append(f"y{into} = {_array(of[0], known)}")
        else:
            text = f"q[{of[0]}]" if name == "input" else _operation(name, of, known)
            known.pop(into, None)
            lines.append(f"w{into} = {text}")
    return [*lines, f"return np.stack([{', '.join(results[k] for k in range(len(results)))}])"]


def _operation(name: str, of: list[Any], known: dict[int, str]) -> str:
    """One operation on work slots."""
    if name in _OPERATORS:
        return _OPERATORS[name].format(*(known.get(slot, f"w{slot}") for slot in of))
    words = [_array(slot, known) for slot in of]
    if name in _CONDITIONS:
        return f"({_CONDITIONS[name].format(*words)}) * np.ones_like(q[0])"
    if name == "if_else_zero":
        return f"np.where({words[0]} != 0, {words[1]}, np.zeros_like(q[0]))"
    return f"_erf({words[0]})" if name == "erf" else f"np.{_FUNCTIONS[name]}({', '.join(words)})"


def _array(slot: int, known: dict[int, str]) -> str:
    """The value in a work slot as an array, for functions that take nothing else."""
    return f"np.full_like(q[0], {known[slot]})" if slot in known else f"w{slot}"


def _literal(value: float) -> str:
    """The number in Python, exactly; in brackets where an operator beside it would take its sign."""
    if value in (float("inf"), float("-inf")):
        return f'float("{value}")'
    return repr(value) if value >= 0 else f"({value!r})"
