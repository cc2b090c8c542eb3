"""The inverse map as a CasADi function with exact derivatives (ours).

With F(q, phi) = phi(q) - phi = 0, the implicit function theorem gives dq/dphi = J^-1, and second derivatives by
differentiating it again. CasADi's rootfinder does so for any order. The start has no influence: its derivative is 0.
"""

from typing import Any

import casadi as ca
import numpy as np

from orthocas.checks import Array
from orthocas.coordinates.turns import shortest
from orthocas.inverting.phi_map import ROUNDING

_TOLERANCE = 1e-9  # the largest relative error of a solution
_OPTIONS: dict[str, Any] = {
    "error_on_fail": False,  # an exception would end an optimisation
    "abstol": 1e-12,
    "max_iter": 50,
    "line_search": True,
    "linear_solver": "symbolicqr",
}


def inverse_function(phi: ca.Function, sizes: Array, turns: Array) -> ca.Function:
    """phi (n, 1), q_start (n, 1) -> q (n, 1) with phi(q) = phi, NaN where Newton's method finds none from q_start."""
    n = len(sizes)
    q, target, start = (ca.MX.sym(name, n) for name in ("q", "phi", "q_start"))

    def residual(at: ca.MX) -> Any:
        return shortest(phi(at) - target, turns) / (ca.DM(sizes) + ROUNDING * ca.fabs(target))

    solve = ca.rootfinder("solve", "newton", {"x": q, "p": target, "g": residual(q)}, _OPTIONS)
    found = solve(start, target)
    failed = ca.if_else(ca.norm_2(residual(found)) <= _TOLERANCE, 0.0, np.nan)  # a constant, so without derivatives
    return ca.Function("inverse", [target, start], [found + failed], ["phi", "q_start"], ["q"])
