"""Expressions from user-defined functions of q, checked on the way in."""

from collections.abc import Callable

import casadi as ca

from orthocas.errors import InvalidValueError


def expression_of(what: str, function: Callable[[ca.SX], ca.SX] | ca.Function, q: ca.SX) -> ca.SX:
    """The SX expression that a user's function returns for q.

    Raises:
        InvalidValueError: if the function fails on q, does not return an SX expression, or uses other symbols.
    """
    if not callable(function):
        raise InvalidValueError(what, repr(function), "a function of an SX column q")
    try:
        value = ca.SX(function(q))
    except (NotImplementedError, RuntimeError, TypeError, ValueError, IndexError, ArithmeticError) as error:
        reason = " ".join(str(error).split())[:120]
        raise InvalidValueError(what, f"failing ({reason})", f"a function of an SX column q {q.shape}") from None
    known = {str(symbol) for symbol in ca.vertsplit(q)}
    free = [str(symbol) for symbol in ca.symvar(value) if str(symbol) not in known]
    if free:
        raise InvalidValueError(what, f"using the free symbols {', '.join(free[:5])}", "an expression in q alone")
    return value
