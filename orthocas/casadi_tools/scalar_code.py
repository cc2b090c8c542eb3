"""Graphs of matrix operations and calls as plain scalar operations: several times faster for small systems."""

import casadi as ca

from orthocas.casadi_tools.interrupts import deferred


def scalar_code(function: ca.Function) -> ca.Function:
    """The function as scalar operations with common parts shared, or itself if it holds what has none (networks)."""
    with deferred():  # expand makes a RuntimeError of Ctrl-C
        try:
            flat = function.expand()
        except RuntimeError:
            return function
        inputs = flat.sx_in()
        outputs = ca.cse(list(flat.call(inputs)))
        return ca.Function(function.name(), inputs, outputs, function.name_in(), function.name_out())
