"""Trackers that go as near as they can: to the nearest x in reach, and with that to the nearest xi."""

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from orthocas.charts.newton import Bound, PointFunctions
from orthocas.charts.phi import PhiMap
from orthocas.charts.solutions import Tracker, TrackerStatus
from orthocas.errors import DomainError
from orthocas.tasks.domains import Domain, reach
from orthocas.tools.batch import dense_function
from orthocas.tools.checks import Array

_WEIGHT = 1e-3  # of errors of xi, relative to those of x
ZONE = 0.02  # next to the boundary, in half-widths of joints and in relative room of conditions
DESCENTS, _HALVINGS = 12, 20  # steps of Gauss and Newton in a call, and halvings of one
INERTIA = 1e-3  # weight of the way from the last q, in half-widths
_CONVERGED = 1e-10  # relative decrease of the cost at which a call ends
_DECREASE = 1e-4  # of the cost, relative to what the model promises


class ReachingTracker(Tracker):
    """A `Tracker` that goes as near as it can where phi is out of reach.

    It minimises, from where it is,

        |D^-1 e_x|^2 + w^2 |e_xi|^2 + sum over boundaries of max(0, 1 - room / zone)^2

    by damped Gauss-Newton steps, with the sizes D of x, w = 0.001 and a zone of 2 % next to the boundaries. The cost is
    smooth, so q is smooth in phi where the minimum is. A phi that is reached outside the zones is met to rounding, as
    by `Tracker`; otherwise `status` is NEAREST: x has priority, xi gives way. q never leaves the domain, and no joint
    moves more than `largest_step` in a call.
    """

    def __init__(
        self,
        functions: PointFunctions,
        domain: Domain,
        q0: ArrayLike,
        largest_step: ArrayLike | None,
        parts: tuple[ca.Function, ca.Function],
    ) -> None:
        self._parts = parts
        super().__init__(functions, domain, q0, largest_step)
        n, rooms = len(domain.centre), parts[1].size1_out(0)
        self._at, self._to, self._e, self._rooms = np.empty(n), np.empty(n), np.empty(n), np.empty(rooms)
        self._J, self._slopes = np.empty((n, n)), np.empty((n, rooms))
        self._near = Bound(parts[0], [self._at, self._to], [self._e, self._J, self._rooms])
        self._inwards = Bound(parts[1], [self._at], [self._slopes])
        widths = reach(domain)
        self._bounded = np.flatnonzero(np.isfinite(widths))
        self._widths = widths[self._bounded]

    def __getstate__(self) -> dict[str, object]:
        """Without scratch memory."""
        return {**super().__getstate__(), "parts": self._parts}

    def __setstate__(self, state: dict[str, object]) -> None:
        names = ("functions", "domain", "q", "limit", "parts")
        self.__init__(*(state[name] for name in names))  # type: ignore[misc]

    def step(self, phi: ArrayLike) -> Array:
        """As `Tracker.step`; where that stays, the nearest q (n,) that a search from the last one finds."""
        q = super().step(phi)
        if self.status in (TrackerStatus.OK, TrackerStatus.BAD_INPUT):
            return q
        found = self._descended(q)
        self._solver.q[:] = found
        if not self._solver.refresh():
            self._solver.q[:] = q
            self._solver.refresh()
            return q
        self.status = TrackerStatus.NEAREST
        return found

    def _descended(self, q: Array) -> Array:
        """Where Gauss-Newton steps lead from q (n,), within the domain and the largest step."""
        start, now = q, q
        self._to[:] = self._solver.target
        pull = (INERTIA / self._domain.half_width) ** 2
        cost = self._cost(now)
        for _ in range(DESCENTS):
            r, J = self._model()
            gradient, H = J.T @ r + pull * (now - start), J.T @ J + np.diag(pull)
            move = -np.linalg.solve(H, gradient)
            promised = float(-gradient @ move)
            if promised <= _CONVERGED * cost:
                break
            for halvings in range(_HALVINGS + 1):
                change = np.clip(now + move * 0.5**halvings - start, -self._limit, self._limit)
                after = self._cost(start + change) + float(pull @ change**2) / 2
                if after < cost - _DECREASE * 0.5**halvings * promised and self._domain.contains(self._at[None])[0]:
                    break
            else:
                break
            now, cost = start + change, after
        return np.asarray(now)

    def _cost(self, q: Array) -> float:
        """Half the sum of squares at q (n,), without the way from the last q."""
        self._at[:] = q
        self._near.run()
        squares = float(self._e @ self._e + (self._short() ** 2).sum())
        return squares / 2 if np.isfinite(squares) else np.inf

    def _short(self) -> Array:
        """How deep the last q lies in the zones of joints, below and above, and of conditions, (k,); 0 outside them."""
        away = (self._at - self._domain.centre)[self._bounded] / self._widths
        rooms = np.concatenate([1 - away, 1 + away, self._rooms])
        return np.maximum(0.0, 1 - rooms / ZONE)

    def _model(self) -> tuple[Array, Array]:
        """The residuals other than 0 at the last q, and their Jacobian."""
        short = self._short()
        active, k = short > 0, len(self._bounded)
        rows = np.zeros((len(short), len(self._at)))
        joints = np.arange(k)
        rows[joints, self._bounded], rows[k + joints, self._bounded] = 1 / self._widths, -1 / self._widths
        if active[2 * k :].any():
            self._inwards.run()
            rows[2 * k :] = -self._slopes.T
        r = np.concatenate([self._e, short[active]])
        return r, np.vstack([self._J.T, rows[active] / ZONE])


def parts_of(
    phi: ca.Function, rates: ca.Function, m: int, known: PhiMap, domain: Domain
) -> tuple[ca.Function, ca.Function]:
    """The errors of phi and the rooms of the domain's conditions, for `ReachingTracker`.

    Returns:
        q, phi_d (n, 1) -> weighted errors (n, 1), their Jacobian (n, n), rooms (k, 1); and q -> slopes of rooms (k, n).

    Raises:
        DomainError: if the domain is neither a box nor clear of singular positions.
    """
    n = len(known.sizes)
    q, target = ca.MX.sym("q", n), ca.MX.sym("target", n)
    weights = ca.DM(np.where(np.arange(n) < m, 1 / known.sizes, _WEIGHT))
    e = -known.difference(target, phi(q)) * weights
    rooms = ca.MX(0, 1)
    clear = domain.singular_bound
    if clear is not None:
        rooms = _clearance(clear.gram(q), clear.least_singular_value)
        if domain.room_to_fold is not None:
            rooms = ca.vertcat(rooms, domain.room_to_fold(q))
    elif not domain.is_box:
        raise DomainError(f"a domain of kind '{domain.name}' has no nearest x, expected a box or a clear box")
    near = dense_function("near", [q, target], [e, rates(q) * ca.repmat(weights, 1, n), rooms], ["q", "phi"])
    return near, dense_function("inwards", [q], [ca.jacobian(rooms, q)])


def _clearance(gram: ca.MX, bound: float) -> ca.MX:
    """The product of 1 - bound^2 / sigma_i^2 over the singular values, which is 0 where the least one is the bound."""
    m = gram.shape[0]
    symbol = ca.SX.sym("G", m, m)
    share = ca.SX(1)
    for pivot, whole in zip(_pivots(symbol - bound**2 * ca.SX.eye(m)), _pivots(symbol), strict=True):
        share *= pivot / whole
    return ca.Function("clearance", [symbol], [ca.cse(share)])(gram)


def _pivots(A: ca.SX) -> list[ca.SX]:
    found = []
    while True:
        found.append(A[0, 0])
        if A.shape[0] == 1:
            return found
        A = A[1:, 1:] - A[1:, 0] @ A[0, 1:] / A[0, 0]
