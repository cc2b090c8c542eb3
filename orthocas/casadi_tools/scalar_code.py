"""Expand graphs of matrix operations and calls into scalar operations: several times faster for small systems."""

import casadi as ca

from orthocas.casadi_tools.interrupts import deferred


def scalar_code(function: ca.Function) -> ca.Function:
    """Expand a function into scalar operations. One that cannot be expanded (a network) is returned as it is."""
    with deferred():  # `expand` turns Ctrl-C into a RuntimeError
        try:
            flat = function.expand()
        except RuntimeError:
            return function
        inputs = flat.sx_in()
        outputs = ca.cse(list(flat.call(inputs)))
        return ca.Function(function.name(), inputs, outputs, function.name_in(), function.name_out())
