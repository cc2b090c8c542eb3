"""The inverse map of coordinates with closed expressions: Newton's method with line search (ours)."""

from typing import Any

import casadi as ca
import numpy as np

from orthocas.casadi_tools.batch import evaluate_columns
from orthocas.casadi_tools.interrupts import deferred
from orthocas.checks import Array
from orthocas.errors import InverseError

_ROUNDING = 1e-5  # of phi: 1e-9 of it are 45 units in the last place
_SINGULAR = 1e-8  # ratio of singular values of J below which the inverse map fails


def error_scale(phi: Array, sizes: Array) -> Array:
    """Scale of the errors in phi (N, n): the sizes of its components, and more where rounding of phi exceeds them."""
    scale: Array = sizes + _ROUNDING * np.abs(phi)
    return scale


class NewtonInverse:
    """Solves phi(q) = phi for q.

    Args:
        phi: function of q (n, 1) with values (n, 1).
        sizes: sizes of the components of phi, (n,).
    """

    def __init__(self, phi: ca.Function, sizes: Array) -> None:
        self.n = len(sizes)
        q, target = ca.MX.sym("q", self.n), ca.MX.sym("phi", self.n)
        residual = (phi(q) - target) / (sizes + _ROUNDING * ca.fabs(target))
        options: dict[str, Any] = {"error_on_fail": False, "abstol": 1e-12, "max_iter": 100, "line_search": True}
        equations: dict[str, Any] = {"x": q, "p": target, "g": residual}
        self._rootfinder = ca.rootfinder("inverse", "newton", equations, options)

    def solve(self, phi: Array, q_start: Array) -> Array:
        """Solutions q (N, n) from starts (N, n). A row is NaN where the linear system was singular on the way."""
        return np.array([self._solve(x0, p) for x0, p in zip(q_start, phi, strict=True)])

    def _solve(self, q_start: Array, phi: Array) -> Array:
        """One solution, with its own scratch memory: threads that share the memory of a rootfinder crash."""
        with deferred():  # otherwise CasADi turns Ctrl-C into a RuntimeError, or swallows it
            try:
                solution: Array = evaluate_columns(self._rootfinder, 1, q_start[None], phi[None])[0][0]
                return solution
            except RuntimeError:  # a singular linear system on the way
                return np.full(self.n, np.nan)


def require_solved(errors: Array, J: Array, sizes: Array, tolerance: float) -> None:
    """Raise InverseError where a solution is not close enough, or not unique.

    Args:
        errors: relative errors of phi at the solutions, (N,).
        J: dphi/dq there, (N, n, n).
        sizes: sizes of the components of phi, (n,).
        tolerance: the largest error to accept.
    """
    bad = np.flatnonzero(~(errors <= tolerance))
    if bad.size:
        rows = f"rows {bad[:5].tolist()}" if len(errors) > 1 else "phi"
        raise InverseError(
            f"no q with phi(q) = phi found near q_start for {rows}: relative error is {errors[bad].max():.3g}, "
            f"expected <= {tolerance:.1g}. The target may be out of reach, or the path to it singular"
        )
    values = np.linalg.svd(J / sizes[:, None], compute_uv=False)
    singular = np.flatnonzero(values[:, -1] < _SINGULAR * values[:, 0])
    if singular.size:
        raise InverseError(f"the Jacobian is singular at the solution of row {singular[0]}: q is not unique there")
