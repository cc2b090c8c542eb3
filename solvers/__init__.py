"""Minimisers behind one protocol (`orthocas.objective.Solver`)."""

from orthocas.solvers.gauss_newton import GaussNewton
from orthocas.solvers.lbfgs import LBFGS

from orthocas.checks import require_known
from orthocas.objective import Solver

__all__ = ["LBFGS", "SOLVERS", "GaussNewton", "get"]

SOLVERS: dict[str, type[GaussNewton] | type[LBFGS]] = {"gauss_newton": GaussNewton, "lbfgs": LBFGS}


def get(name: str) -> Solver:
    """A solver with its default settings, by name.

    Raises:
        UnknownNameError: if there is no such solver.
    """
    require_known("solver", name, SOLVERS)
    return SOLVERS[name]()
