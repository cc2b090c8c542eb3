"""Minimisers behind one protocol (`orthocas.solvers.protocol.Solver`)."""

from orthocas.solvers.casadi_solvers import GradientFlow, Ipopt
from orthocas.solvers.minimisers import LBFGS, Adam, GaussNewton, QuasiNewton
from orthocas.solvers.protocol import Solver
from orthocas.tools.checks import require_known

__all__ = ["LBFGS", "SOLVERS", "Adam", "GaussNewton", "GradientFlow", "Ipopt", "QuasiNewton", "get"]

SOLVERS: dict[str, type[GaussNewton] | type[LBFGS] | type[Ipopt] | type[Adam] | type[GradientFlow]] = {
    "gauss_newton": GaussNewton,
    "quasi_newton": QuasiNewton,
    "lbfgs": LBFGS,
    "ipopt": Ipopt,
    "adam": Adam,
    "gradient_flow": GradientFlow,
}


def get(name: str) -> Solver:
    """The solver with the given name, in its default settings.

    Raises:
        UnknownNameError: if no solver has that name.
    """
    require_known("solver", name, SOLVERS)
    return SOLVERS[name]()
