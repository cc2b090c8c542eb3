"""Expand graphs of matrix operations and calls into scalar operations: several times faster for small systems."""

import casadi as ca

from orthocas.casadi_tools.interrupts import deferred

WRITTEN_OUT = 10  #: rows of the largest matrices whose products and inverses are written out


def fast_form(graph: ca.Function, rows: int) -> ca.Function:
    """Scalar code of a graph with matrices of so many rows, or the graph itself where that would be too long."""
    return scalar_code(graph) if rows <= WRITTEN_OUT else graph


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
