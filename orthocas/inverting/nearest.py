"""The nearest coordinates inside the domain at given task values, by Ipopt, one row at a time (ours).

Where no q inside the domain has phi(q) = (x, xi), the nearest one that keeps the task solves

    minimise |xi(q) - xi|^2 / 2   subject to   h(q) = x,  q in the domain.

Ipopt finds a local minimum in 10 to 50 ms; `nearest_xi` treats all rows at once, and leaves few to Ipopt.
"""

from dataclasses import dataclass
from threading import Lock
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from orthocas.casadi_tools.batch import evaluate_columns
from orthocas.casadi_tools.cached import cached_property
from orthocas.checks import Array
from orthocas.coordinates.turns import shortest
from orthocas.domains import Conditioned, Domain, borders
from orthocas.inverting.phi_map import PhiMap, largest
from orthocas.postures.clear_box import ClearBox

_OPTIONS: dict[str, Any] = {
    "print_time": False,
    "error_on_fail": False,
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "ipopt.tol": 1e-9,
    "ipopt.constr_viol_tol": 1e-12,
    "ipopt.bound_relax_factor": 0.0,
    "ipopt.max_iter": 200,
}
_CLEAR = 1e-6  # least pivot over its bound: the domain is open there
_one_at_a_time = Lock()  # Ipopt's linear solver is not made for threads


@dataclass(frozen=True, eq=False)
class Nearest:
    """Finds the nearest coordinates in the domain that keep the task."""

    domain: Domain
    m: int  #: number of task components
    phi: ca.Function  #: of a column q (n, 1)
    phi_map: PhiMap

    def search(self, targets: Array, starts: Array) -> Array:
        """Where the search from starts (N, n) ends, (N, n); see `keeps_task`."""
        low, high = borders(self.domain)
        with _one_at_a_time:
            q = evaluate_columns(self._search, 1, np.clip(starts, low, high), targets)[0]
        q = np.clip(q, low, high)  # NaN stays
        known = np.asarray(np.isfinite(q).all(axis=1))
        return np.where(known[:, None], q, np.clip(starts, low, high))

    def keeps_task(self, targets: Array, q: Array, tolerance: float) -> NDArray[np.bool_]:
        """Whether points (N, n) lie in the domain and have the task values of the targets, (N,)."""
        error = largest(self.phi_map.residual(targets, q)[:, : self.m])
        return np.asarray((error <= tolerance) & self.domain.contains(q))

    @cached_property
    def _search(self) -> ca.Function:
        """start (n, 1), target (n, 1) -> q (n, 1)."""
        m, domain, n = self.m, self.domain, len(self.domain.centre)
        q, target = ca.MX.sym("q", n), ca.MX.sym("phi", n)
        difference = shortest(self.phi(q) - target, self.phi_map.turns)
        constraints = [difference[:m] / ca.DM(self.phi_map.sizes[:m])]
        upper = np.zeros(m)
        if isinstance(domain, ClearBox):
            pivots = domain.pivots(q) / domain.least_singular_value**2
            constraints += [_CLEAR - _products(pivots)]  # the pivots themselves have poles
            upper = np.zeros(m + m)
        elif isinstance(domain, Conditioned):
            constraints += [-domain.pivots(q)]
            upper = np.zeros(m + domain.pivots.size1_out(0))
        lower = np.where(np.arange(len(upper)) < m, 0.0, -np.inf)
        equations: dict[str, Any] = {
            "x": q,
            "p": target,
            "f": ca.sumsqr(difference[m:]) / 2,
            "g": ca.vertcat(*constraints),
        }
        solver = ca.nlpsol("nearest", "ipopt", equations, _OPTIONS)
        low, high = (ca.DM(bound) for bound in borders(domain))
        start = ca.MX.sym("start", n)
        found = solver(x0=start, p=target, lbx=low, ubx=high, lbg=ca.DM(lower), ubg=ca.DM(upper))
        return ca.Function("nearest", [start, target], [found["x"]])


def _products(pivots: ca.MX) -> ca.MX:
    """The products of the first 1, 2, ... pivots: leading minors, which are > 0 just where the pivots are."""
    found = [pivots[0]]
    for k in range(1, pivots.shape[0]):
        found.append(found[-1] * pivots[k])
    return ca.vertcat(*found)
