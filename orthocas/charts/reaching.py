"""Trackers that go as near as they can where phi is out of reach."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from orthocas.charts.newton import Bound, PointFunctions
from orthocas.charts.phi import PhiMap
from orthocas.charts.solutions import Tracker, TrackerStatus
from orthocas.tasks.domains import Domain
from orthocas.tools.batch import dense_function
from orthocas.tools.checks import Array


@dataclass(frozen=True, slots=True)
class ReachingRules:
    """Numbers of the descent, in Python and C. Joints count in half-widths of the domain, errors of x in its sizes.

    Chosen on panda, iiwa7 and xarm7, held on eight arms (benchmarks/beyond_reach.py).
    """

    xi_weight: float = 3e-4  #: of errors of xi, relative to those of x
    damping: float = 0.3  #: of the first step, relative to |D^-1 e_x|: curvature that J^T J does not know
    least_damping: float = 1e-11  #: so that every step has a solution
    grows: float = 4.0  #: damping after a step that does not lower the cost
    shrinks: float = 3.0  #: damping, divided by this, after a step that the model foresaw well
    decrease: float = 1e-4  #: of the cost, relative to what the model promises
    converged: float = 1e-8  #: relative decrease of the cost that a minimum may still promise
    evaluations: int = 40  #: of the errors in a call; a moving target takes six
    corrections: int = 3  #: of a step that ends beyond a curved boundary
    room: float = 1e-6  #: to curved boundaries, relative
    joint_room: float = 1e-9  #: in half-widths, in Python
    still: float = 1e-13  #: smaller changes of a constraint along a step are rounding


RULES = ReachingRules()


class ReachingTracker(Tracker):
    """A `Tracker` that goes as near as it can where phi is out of reach.

    From the last q it descends on

        |D^-1 e_x|^2 + w^2 |e_xi|^2

    within the domain, with the sizes D of x and w = 3e-4: x has priority, xi gives way. Each step solves a quadratic
    program: damped J^T J is its Hessian; the joints' bounds, `largest_step` and the linearised conditions of the domain
    are its constraints. So q slides along flat and curved boundaries alike, and rests where the target rests.

    A phi that is reached is met to rounding, as by `Tracker`. Otherwise `status` is NEAREST at a local minimum, where
    the model promises less than 1e-8 of the cost. It is NEARER if `largest_step` or the bounded work of a call ended
    the descent, which goes on in the next call.

    Source:
        Levenberg and Marquardt's method with an active set; ours: docs/how-to/inverse.md.
    """

    def __init__(
        self,
        functions: PointFunctions,
        domain: Domain,
        q0: ArrayLike,
        largest_step: ArrayLike | None,
        near: ca.Function,
        m: int,
    ) -> None:
        self._parts, self._m = near, m
        super().__init__(functions, domain, q0, largest_step)
        n, rooms = len(domain.centre), near.size1_out(2)
        self._at, self._to, self._e, self._rooms = np.empty(n), np.empty(n), np.empty(n), np.empty(rooms)
        self._J, self._slopes = np.empty((n, n)), np.empty((n, rooms))
        self._near = Bound(near, [self._at, self._to], [self._e, self._J, self._rooms, self._slopes])
        self._width, ends = domain.half_width, domain.reach - RULES.joint_room * domain.half_width
        self._low, self._high = domain.centre - ends, domain.centre + ends

    def __getstate__(self) -> dict[str, Any]:
        """Without scratch memory."""
        return {**super().__getstate__(), "near": self._parts, "m": self._m}

    def __setstate__(self, state: dict[str, Any]) -> None:
        names = ("functions", "domain", "q", "limit", "near", "m")
        self.__init__(*(state[name] for name in names))  # type: ignore[misc]
        self._start = state["start"]

    def step(self, phi: ArrayLike) -> Array:
        """As `Tracker.step`; where that stays, the nearest q (n,) that a descent from the last one finds."""
        q = super().step(phi)
        if self.status in (TrackerStatus.OK, TrackerStatus.BAD_INPUT):
            return q
        found, is_minimum = self._descended(q)
        self._solver.q[:] = found
        if not self._solver.refresh():
            self._solver.q[:] = q
            self._solver.refresh()
            return q
        self.status = TrackerStatus.NEAREST if is_minimum else TrackerStatus.NEARER
        return found

    def _descended(self, start: Array) -> tuple[Array, bool]:
        """Where damped Gauss-Newton steps lead from q (n,), and whether that is a minimum."""
        n, free = len(start), np.eye(len(start))
        first, last = start - self._limit, start + self._limit
        low = np.minimum(np.maximum(self._low, first), start)
        high = np.maximum(np.minimum(self._high, last), start)
        self._to[:] = self._solver.target
        self._left = RULES.evaluations
        now = self._look(start)
        damping = RULES.damping * float(np.linalg.norm(now.e[: self._m]))
        while now.cost < np.inf:
            damping = max(damping, RULES.least_damping)
            J, rows = now.J * self._width, np.vstack([free, now.slopes * self._width])
            g, H = J.T @ now.e, J.T @ J + damping * free
            below = np.concatenate([(low - now.q) / self._width, np.minimum(0.0, RULES.room - now.rooms)])
            above = np.concatenate([(high - now.q) / self._width, np.full(len(now.rooms), np.inf)])
            move, held = least(H, g, rows, below, above)
            promised = -float(g @ move + move @ H @ move / 2)
            if promised <= RULES.converged * now.cost:
                by_step = ((held[:n] < 0) & (first > self._low)) | ((held[:n] > 0) & (last < self._high))
                return now.q, not by_step.any()
            if self._left <= 0:
                break
            new = self._inside(now, now.q + self._width * move, low, high)
            gain = (now.cost - new.cost) / promised
            if gain > RULES.decrease and self._contains(new.q):
                now = new
                damping *= 1 / RULES.shrinks if gain > 0.75 else 2.0 if gain < 0.25 else 1.0
            else:
                damping *= RULES.grows
        return now.q, False

    def _inside(self, now: "_Look", q: Array, low: Array, high: Array) -> "_Look":
        """The end q (n,) of a step, brought back inside the conditions of the domain; of infinite cost if it fails."""
        enough = np.minimum(RULES.room / 2, now.rooms)
        new = self._look(np.clip(q, low, high))
        for _ in range(RULES.corrections):
            short = np.flatnonzero(~(new.rooms >= enough))
            if not short.size:
                return new
            q = new.q
            for k in short:
                inwards = now.slopes[k] * self._width**2
                q = q + inwards * (2 * enough[k] - new.rooms[k]) / (now.slopes[k] @ inwards)
            new = self._look(np.clip(q, low, high))
        return new if (new.rooms >= enough).all() else new._replace(cost=np.inf)

    def _contains(self, q: Array) -> bool:
        """Whether q (n,) lies in the domain."""
        self._solver.reached[:] = q
        self._guard.run()
        return bool(self._guarded[1] <= 0)

    def _look(self, q: Array) -> "_Look":
        """Errors and rooms at q (n,)."""
        self._left -= 1
        self._at[:] = q
        self._near.run()
        cost = float(self._e @ self._e) / 2
        known = np.asarray(np.isfinite(self._slopes).all(axis=0))
        slopes = np.where(known[:, None], self._slopes.T, 0.0)
        cost = cost if np.isfinite(cost) and np.isfinite(self._J).all() else np.inf
        return _Look(np.array(q), cost, self._e.copy(), self._J.T.copy(), self._rooms.copy(), slopes)


class _Look(NamedTuple):
    """What is known of a position."""

    q: Array  #: (n,)
    cost: float  #: half the sum of squares of e; infinite where phi is undefined
    e: Array  #: weighted errors of phi, (n,)
    J: Array  #: de/dq, (n, n)
    rooms: Array  #: of the domain's conditions, (k,), positive inside
    slopes: Array  #: d rooms/dq, (k, n); 0 where undefined


def least(H: Array, g: Array, rows: Array, low: Array, high: Array) -> tuple[Array, Array]:
    """The d (n,) with the least g d + d H d / 2 of those with low <= rows d <= high, by a primal active set from d = 0.

    Args:
        H: (n, n), positive definite.
        g: (n,).
        rows: (k, n).
        low: (k,) <= 0, or minus infinity.
        high: (k,) >= 0, or infinity.

    Returns:
        d, and which rows are held, (k,): -1 at low, 1 at high, 0 for none. If rounds run out, d is feasible, and lower
        than 0, but not the least.
    """
    n, k = len(g), len(rows)
    d, held = np.zeros(n), np.zeros(k)
    K = np.zeros((n + k, n + k))
    K[:n, :n] = H
    for _ in range(2 * k):
        on = held != 0
        K[:n, n:], K[n:, :n], K[n:, n:] = -rows.T * on, rows * on[:, None], np.diag(~on)
        try:
            solution = np.linalg.solve(K, np.concatenate([-(g + H @ d), np.zeros(k)]))
        except np.linalg.LinAlgError:
            break
        way, multipliers = solution[:n], solution[n:]
        along = rows @ way
        moving = ~on & (np.abs(along) > RULES.still)
        shares = np.full(k, np.inf)
        shares[moving] = (np.where(along < 0, low, high) - rows @ d)[moving] / along[moving]
        first = int(np.argmin(shares))
        d = d + min(1.0, max(0.0, float(shares[first]))) * way
        if shares[first] < 1:
            held[first] = np.sign(along[first])
            continue
        wrong = multipliers * held
        worst = int(np.argmax(wrong))
        if wrong[worst] <= 0:
            break
        held[worst] = 0.0
    return d, held


def near_function(phi: ca.Function, rates: ca.Function, m: int, known: PhiMap, domain: Domain) -> ca.Function:
    """What `ReachingTracker` has to know of a position.

    Returns:
        q, phi_d (n, 1) -> weighted errors e (n, 1), de/dq (n, n), rooms of the domain's conditions (k, 1), their slopes
        (k, n).

    Raises:
        DomainError: if the domain has a condition, but no expression of it.
    """
    n, relative = len(known.sizes), known.difference.task
    q, target = ca.MX.sym("q", n), ca.MX.sym("target", n)
    weights = ca.DM(np.where(np.arange(n) < m, 1 / known.sizes, RULES.xi_weight))
    e, J = -known.difference(target, phi(q)), rates(q)
    if relative is not None:  # rates are those of an orientation that is reached
        J = ca.vertcat(relative.error(q, target[:m])[1], J[m:, :])
    rooms = _rooms(domain, q)
    outputs = [e * weights, J * ca.repmat(weights, 1, n), rooms, ca.jacobian(rooms, q)]
    return dense_function("near", [q, target], outputs, ["q", "phi"])


def _rooms(domain: Domain, q: ca.MX) -> ca.MX:
    """Smooth numbers (k, 1) that are positive just inside the conditions of a domain, and grow from 0 at their ends."""
    clear = domain.singular_bound
    if clear is None:
        return ca.MX(0, 1) if domain.condition is None else domain.condition.pivots(q)
    rooms = _clearance(clear.gram(q), clear.least_singular_value)
    return rooms if domain.room_to_fold is None else ca.vertcat(rooms, domain.room_to_fold(q))


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
