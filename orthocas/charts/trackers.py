"""Trackers of moving targets phi. If phi is out of reach, a tracker stays, or goes as near to phi as it can."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from orthocas.charts.descent import rooms_of
from orthocas.charts.newton import NEWTON, Bound, PhiMap, PointFunctions, PointSolver
from orthocas.charts.walls import RULES as CLEARANCE
from orthocas.charts.walls import Clearance
from orthocas.errors import InvalidValueError, degrees_hint
from orthocas.tasks.domains import Domain
from orthocas.tools.batch import dense_function
from orthocas.tools.cached import building
from orthocas.tools.checks import Array, as_float_array, as_point, require_shape
from orthocas.tools.display import Shown, number_list
from orthocas.tools.expressions import wrap_shortest
from orthocas.tools.interrupts import deferred


@dataclass(frozen=True, slots=True)
class TrackerRules:
    """Numbers of the tracker. Errors of phi are relative to its component sizes."""

    rounded: float = 1e-9  #: error of phi below which a stalled iteration counts as converged
    returned: float = 1e-8  #: error of phi up to which two values count as equal
    refreshes: int = 8  #: largest number of new Jacobians in a call
    step: float = 0.1  #: [half-widths] default of the largest change of q in a call
    halvings: int = 4  #: largest number of halvings of a change of xi that has no solution


TRACKER = TrackerRules()


class TrackerStatus(IntEnum):
    """How the last call of a tracker ended. With the values 1 to 5, q stays where it was."""

    OK = 0  #: phi(q) = phi, inside the domain
    JUMP = 1  #: q would have moved by more than `largest_step`
    OUTSIDE_DOMAIN = 2  #: q would have left the domain
    SINGULAR = 3  #: J is singular or nearly singular
    LOST = 4  #: no solution was found near the last q
    BAD_INPUT = 5  #: an entry of phi is not finite
    NEAREST = 6  #: q is a local minimum of the distance to phi in the domain; only with `nearest=True`
    NEARER = 7  #: q is no farther from phi than before; `largest_step` or the work limit ended the descent of this call
    YIELDING = 8  #: x is met, and xi deviates from its target to avoid contacts; only with `avoid`
    BRAKED = 9  #: q went only a part of the way, or stayed, to keep the `margin` to a contact


class Tracker(Shown):
    """Follows a stream of targets phi: each call starts at the last q, and q never leaves the domain.

    A call takes Newton steps with the Jacobian of an earlier call (chord steps), and evaluates a new Jacobian only if
    they do not converge. If there is no new q, or if it is too far from the last one or outside the domain, `step`
    returns the last q again, and `status` says why. `Chart.tracker` makes trackers. A tracker belongs to one thread.

    With a collision model, no call comes nearer to a contact than the margin. The tracker then goes only a part of the
    way, with the status BRAKED. With `avoid`, xi yields before that: the tracker meets x and chooses an xi near its
    target that keeps all pairs at least `avoid` apart, with the status YIELDING. With r > 1 or several pairs, this xi
    is not always the nearest.

    Example:
        >>> import numpy as np
        >>> import orthocas as oc
        >>> from orthocas import problems
        >>> chart = oc.fit(problems.get("planar_3r_xy"), oc.Polynomial(degree=2), samples=300).chart
        >>> tracker = chart.tracker([0.6, 0.8, 0.8])
        >>> phi = chart.phi([0.6, 0.8, 0.8])
        >>> q = tracker.step(phi + [0.01, 0.0, 0.0])  # along x, with xi held
        >>> np.allclose(chart.phi(q) - phi, [0.01, 0.0, 0.0]), tracker.status.name
        (True, 'OK')
    """

    def __init__(
        self,
        functions: PointFunctions,
        domain: Domain,
        q0: ArrayLike,
        largest_step: ArrayLike | None,
        m: int,
        clearance: Clearance | None = None,
    ) -> None:
        n = len(domain.centre)
        self._functions, self._domain, self._m, self._clearance = functions, domain, m, clearance
        limit = as_float_array(
            "largest_step", TRACKER.step * domain.half_width if largest_step is None else largest_step
        )
        if limit.ndim:
            require_shape("largest_step", limit.shape, (n,))
        if not (limit > 0).all():
            raise InvalidValueError("largest_step", limit.tolist(), "positive numbers")
        self._limit = np.broadcast_to(limit, n)
        self._parts: tuple[Any, ...] = functions, domain, self._limit, m, clearance  # arguments that a copy needs
        self._solver = PointSolver(functions)
        self._before, self._guarded = np.empty(n), np.empty(2)
        with deferred(), building:  # CasADi's expressions are not for several threads at a time
            function = _guard(domain, self._limit)
        self._guard = Bound(function, [self._before, self._solver.reached], [self._guarded])
        self.reset(q0)

    def __getstate__(self) -> dict[str, Any]:
        """The state without CasADi buffers, which cannot be pickled."""
        return {"parts": self._parts, "q": self.q, "start": self._start, "target": self._solver.target}

    def __setstate__(self, state: dict[str, Any]) -> None:
        functions, domain, *others = state["parts"]
        self.__init__(functions, domain, state["q"], *others)  # type: ignore[misc]
        self._start, self._solver.target[:] = state["start"], state["target"]

    @property
    def q(self) -> Array:
        """The last solution, (n,)."""
        return self._solver.q.copy()

    @property
    def left_over(self) -> Array | None:
        """Change of the joints since the last reset, once phi is back at its value there, (n,) [rad] or [m].

        Full turns of joints without boundaries are removed. None while x or xi differ from those at the start. The
        change need not be 0 after a full turn of the tool or the base; see `ChartParts.left_over`.
        """
        q, phi = self._start
        apart = self._functions.distance(phi, self._solver.phi)
        return leave_over(apart, TRACKER.returned, self._solver.q - q, self._functions.turning)

    @property
    def largest_step(self) -> Array:
        """Largest change of each joint in a call, (n,) [rad] or [m]."""
        return self._limit

    def facts(self) -> dict[str, str]:
        """Status, joint position, and largest step."""
        return {
            "tracker": f"status {self.status.name}",
            "q": number_list(self._solver.q),
            "largest step": number_list(self._limit),
        }

    def reset(self, q: ArrayLike) -> None:
        """Continue from another joint position.

        Args:
            q: a point of the domain, (n,).

        Raises:
            InvalidValueError: if q lies outside the domain, J is singular there, or a pair touches.
        """
        point = as_point("q", q, len(self._limit))
        if not self._domain.contains(point):
            hint = degrees_hint(*point[np.isfinite(self._domain.bounds[0])])
            raise InvalidValueError("q", point.tolist(), f"a point of the domain{hint}")
        self._solver.q[:] = point
        if not self._solver.refresh():
            raise InvalidValueError("q", point.tolist(), "a point where J is regular")
        if self._clearance is not None:
            self._clearance.start(point)
        self._start = self._solver.q.copy(), self._solver.phi.copy()
        self._solver.target[:] = self._solver.phi
        self.status = TrackerStatus.OK  #: how the last call ended

    def step(self, phi: ArrayLike | None = None, *, x: ArrayLike | None = None, xi: ArrayLike | None = None) -> Array:
        """Move to the q near the last one with phi(q) = phi; if that fails, stay. `status` says which.

        Args:
            phi: target values, (n,).
            x: in place of phi, target of the task, (m,). Default: the target of the last call.
            xi: in place of phi, target of the coordinates, (r,) or a number. Default: the target of the last call.

        Returns:
            q, (n,) [rad] or [m].

        Raises:
            InvalidValueError: if phi is given together with x or xi.
            ShapeError: if a target has another number of entries.
        """
        solver = self._solver
        if x is not None or xi is not None:
            if phi is not None:
                raise InvalidValueError("phi", "given with x or xi", "phi alone, or x and xi")
            phi = np.where(np.isfinite(solver.target), solver.target, solver.phi)
            for name, values, part in (("x", x, phi[: self._m]), ("xi", xi, phi[self._m :])):
                if values is not None:
                    own = np.atleast_1d(as_float_array(name, values))
                    require_shape(name, own.shape, part.shape)
                    part[:] = own
        if type(phi) is not np.ndarray or phi.shape != solver.target.shape:
            phi = as_float_array("phi", phi)
            require_shape("phi", phi.shape, solver.target.shape)
        solver.target[:] = phi
        self._before[:] = solver.q
        self.status = self._advance()
        if self._clearance is not None and self.status != TrackerStatus.BAD_INPUT:
            self._keep_clear(self._clearance)
        if self.status not in _MOVED:
            self._return()
        return solver.q.copy()

    def _return(self) -> None:
        """Go back to the q at which the call began."""
        self._solver.q[:] = self._before
        self._solver.refresh()

    def _keep_clear(self, clearance: Clearance) -> None:
        """Let xi yield if the step came nearer to a contact than `avoid`; shorten the step if it came too near."""
        solver = self._solver
        if clearance.avoid is not None:
            met = self.status == TrackerStatus.OK
            if not met or clearance.measure(solver.q) < clearance.avoid:
                self._give_way(clearance)
        if self.status not in _MOVED:
            return
        q, fraction = clearance.limit(self._before, solver.q)
        if fraction < 1:
            inside = bool(self._domain.contains(q))
            solver.q[:] = q if inside else self._before
            if not inside or not solver.refresh():
                self._return()
            clearance.hold(solver.q)
            self.status = TrackerStatus.BRAKED

    def _give_way(self, clearance: Clearance) -> None:
        """Meet x with an xi that is near its target and keeps all pairs at least `avoid` apart.

        The search starts at the last q, with the target of x and the xi there, and changes xi in a few rounds.
        """
        solver, m = self._solver, self._m
        target = solver.target.copy()
        failed = self.status
        self._return()
        solver.target[m:] = solver.phi[m:]
        self.status = self._advance()
        rounds = CLEARANCE.rounds if self.status == TrackerStatus.OK else 0
        for _ in range(rounds):
            if not solver.refresh():
                break
            # the remaining change of xi, corrected for contacts, and scaled so that no joint exceeds its largest step
            wish = wrap_shortest(target[m:] - solver.phi[m:], np.array(self._functions.turns[m:]))
            slopes = solver.inverse[:, m:]
            change = clearance.yield_to(solver.q, slopes, wish)
            step = np.abs(slopes @ change) / self._limit
            change = change / max(1.0, float(step.max()))
            if float(np.abs(change).max()) <= CLEARANCE.settled * max(1.0, float(np.abs(wish).max())):
                break
            q, reached = solver.q.copy(), solver.phi[m:].copy()
            for _ in range(TRACKER.halvings):
                solver.target[m:] = reached + change
                if self._advance() == TrackerStatus.OK:
                    break
                solver.q[:] = q
                solver.refresh()
                change = change / 2
            else:
                break
        solver.target[:] = target
        if self.status == TrackerStatus.OK:
            left = self._functions.distance(solver.phi, target)
            self.status = TrackerStatus.OK if left <= TRACKER.returned else TrackerStatus.YIELDING
        elif failed != TrackerStatus.OK:
            self.status = failed

    def _advance(self) -> TrackerStatus:
        """Solve for the target from the last q, and return the status. Statuses 1 to 5 may leave q changed."""
        solver, fresh = self._solver, False
        for _ in range(TRACKER.refreshes):
            falls, error = solver.step(), solver.errors[-1]
            if error <= NEWTON.goal or (error <= TRACKER.rounded and not falls):
                self._guard.run()
                solver.accept()
                jump, outside = self._guarded.tolist()
                if outside > 0:
                    return TrackerStatus.OUTSIDE_DOMAIN
                return TrackerStatus.JUMP if jump > 1 else TrackerStatus.OK
            # If full steps fail even with a fresh J, shorter ones may reach the region of convergence.
            if falls or (fresh and solver.shorten()):
                solver.accept()
            elif fresh:
                break
            fresh = True
            if not solver.refresh():
                return TrackerStatus.SINGULAR
        return TrackerStatus.LOST if np.isfinite(solver.target).all() else TrackerStatus.BAD_INPUT


#: statuses with which q has moved
_MOVED = tuple(TrackerStatus[name] for name in ("OK", "NEAREST", "NEARER", "YIELDING", "BRAKED"))


def _guard(domain: Domain, limit: Array) -> ca.Function:
    """Function of the last and the new q (n, 1): the largest change relative to `limit`, and a number > 0 outside."""
    before, q = (ca.MX.sym(name, len(limit)) for name in ("before", "q"))
    outside = ca.mmax(ca.fabs(q - ca.DM(domain.centre)) - ca.DM(domain.reach))
    if domain.condition is not None:
        outside = ca.fmax(outside, ca.if_else(ca.mmin(domain.condition.pivots(q)) > 0, -1, 1))
    return dense_function("guard", [before, q], [ca.vertcat(ca.norm_inf((q - before) / ca.DM(limit)), outside)])


def leave_over(apart: float, tolerance: float, change: Array, turning: tuple[int, ...]) -> Array | None:
    """Change of the joints (n,) after a loop in phi, without full turns of the joints `turning`.

    None if the loop is open: phi at its ends differs by `apart`, relative to the component sizes, more than
    `tolerance`.
    """
    turns = np.zeros(len(change))
    turns[list(turning)] = 2 * np.pi
    return None if apart > tolerance else np.asarray(wrap_shortest(change, turns))


@dataclass(frozen=True, slots=True)
class ReachingRules:
    """Numbers of the descent of `ReachingTracker`, in Python and C.

    Joints are in half-widths of the domain, errors of x in component sizes. Chosen on panda, iiwa7 and xarm7, held on
    eight arms (benchmarks/beyond_reach.py).
    """

    xi_weight: float = 3e-4  #: weight of errors of xi, relative to those of x
    damping: float = 0.3  #: damping of the first step, relative to |D^-1 e_x|, for the curvature that J^T J misses
    least_damping: float = 1e-11  #: smallest damping, so that every step has a solution
    grows: float = 4.0  #: factor of the damping after a step that does not lower the cost
    shrinks: float = 3.0  #: divisor of the damping after a step that the model predicted well
    decrease: float = 1e-4  #: least decrease of the cost for acceptance, relative to the predicted decrease
    converged: float = 1e-8  #: predicted decrease, relative to the cost, below which a point is a minimum
    evaluations: int = 40  #: largest number of evaluations of the errors in a call; a moving target takes six
    corrections: int = 3  #: largest number of corrections of a step that ends beyond a curved boundary
    room: float = 1e-6  #: margin to the conditions of the domain, in their own scale
    joint_room: float = 1e-9  #: [half-widths] margin to joint boundaries, in Python
    still: float = 1e-13  #: change of a constraint along a step below which it is rounding


RULES = ReachingRules()


class ReachingTracker(Tracker):
    """A `Tracker` that goes as near to phi as it can if phi is out of reach.

    From the last q it minimises

        |D^-1 e_x|^2 + w^2 |e_xi|^2

    within the domain, with the errors e_x and e_xi, the component sizes D of x, and w = 3e-4: x has priority over xi.
    Each step solves a quadratic program. Its Hessian is J^T J with damping. Its constraints are the joint boundaries,
    `largest_step`, and the linearised conditions of the domain. So q slides along flat and curved boundaries, and comes
    to rest when the target does.

    A phi within reach is met to rounding, as by `Tracker`. Otherwise `status` is NEAREST at a local minimum, where the
    model predicts a decrease below 1e-8 of the cost. It is NEARER if `largest_step` or the work limit of a call ended
    the descent; the next call continues it. With a collision model, distances of near pairs are constraints of each
    step, too, so a target behind a contact counts as out of reach.

    Source:
        Levenberg and Marquardt's method with an active set; ours: docs/how-to/inverse.md.
    """

    def __init__(
        self,
        functions: PointFunctions,
        domain: Domain,
        q0: ArrayLike,
        largest_step: ArrayLike | None,
        m: int,
        clearance: Clearance | None,
        near: ca.Function,
    ) -> None:
        super().__init__(functions, domain, q0, largest_step, m, clearance)
        self._parts = (*self._parts, near)
        n, rooms = len(domain.centre), near.size1_out(2)
        self._at, self._to, self._e, self._rooms = np.empty(n), np.empty(n), np.empty(n), np.empty(rooms)
        self._J, self._slopes = np.empty((n, n)), np.empty((n, rooms))
        self._near = Bound(near, [self._at, self._to], [self._e, self._J, self._rooms, self._slopes])
        self._width, ends = domain.half_width, domain.reach - RULES.joint_room * domain.half_width
        self._low, self._high = domain.centre - ends, domain.centre + ends

    def step(self, phi: ArrayLike | None = None, *, x: ArrayLike | None = None, xi: ArrayLike | None = None) -> Array:
        """As `Tracker.step`; if that fails, descend from the last q to the nearest q, (n,)."""
        q = super().step(phi, x=x, xi=xi)
        if self.status in (TrackerStatus.OK, TrackerStatus.YIELDING, TrackerStatus.BAD_INPUT):
            return q
        start = self._before.copy()
        if self._clearance is not None:
            self._clearance.hold(start)
            self._near_parts = self._clearance.list_rows(start, self._limit)
        found, is_minimum = self._descended(start)
        if self._clearance is not None:
            found, fraction = self._clearance.limit(start, found)
            if fraction < 1 and not self._domain.contains(found):
                found = start
                self._clearance.hold(start)
            is_minimum = is_minimum and fraction == 1
        self._solver.q[:] = found
        if not self._solver.refresh():
            self._return()
            return start
        self.status = TrackerStatus.NEAREST if is_minimum else TrackerStatus.NEARER
        return found

    def _descended(self, start: Array) -> tuple[Array, bool]:
        """Take damped Gauss-Newton steps from q (n,); return their end (n,), and whether it is a local minimum."""
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
            better = gain > RULES.decrease
            if better:
                self._solver.reached[:] = new.q
                self._guard.run()
                better = bool(self._guarded[1] <= 0)
            if better:
                now = new
                damping *= 1 / RULES.shrinks if gain > 0.75 else 2.0 if gain < 0.25 else 1.0
            else:
                damping *= RULES.grows
        return now.q, False

    def _inside(self, now: _Look, q: Array, low: Array, high: Array) -> _Look:
        """Evaluate the end q (n,) of a step, after corrections back into the conditions of the domain.

        The cost is infinite if the corrections fail.
        """
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

    def _look(self, q: Array) -> _Look:
        """Evaluate errors and constraints at q (n,)."""
        self._left -= 1
        self._at[:] = q
        self._near.run()
        cost = float(self._e @ self._e) / 2
        known = np.asarray(np.isfinite(self._slopes).all(axis=0))
        slopes, rooms = np.where(known[:, None], self._slopes.T, 0.0), self._rooms.copy()
        cost = cost if np.isfinite(cost) and np.isfinite(self._J).all() else np.inf
        # distances of near pairs are constraints like the conditions of the domain
        if self._clearance is not None:
            index, floor = self._near_parts
            values, gradients, _ = self._clearance.collisions.measure_parts(np.asarray(q), index)
            slopes, rooms = np.vstack([slopes, gradients]), np.concatenate([rooms, values - floor])
        return _Look(np.array(q), cost, self._e.copy(), self._J.T.copy(), rooms, slopes)


class _Look(NamedTuple):
    """Errors and constraints at one joint position."""

    q: Array  #: (n,)
    cost: float  #: |e|^2 / 2; infinite where phi is undefined
    e: Array  #: weighted errors of phi, (n,)
    J: Array  #: de/dq, (n, n)
    rooms: Array  #: margins to the domain's conditions and to contacts of near pairs, (k,), positive inside
    slopes: Array  #: d rooms/dq, (k, n); 0 where undefined


def least(H: Array, g: Array, rows: Array, low: Array, high: Array) -> tuple[Array, Array]:
    """Minimise g d + d H d / 2 subject to low <= rows d <= high, by a primal active-set method from d = 0.

    Args:
        H: (n, n), positive definite.
        g: (n,).
        rows: (k, n).
        low: (k,) <= 0, or minus infinity.
        high: (k,) >= 0, or infinity.

    Returns:
        d (n,), and which constraints are active, (k,): -1 at low, 1 at high, 0 inactive. If the rounds run out, d is
        feasible and no worse than d = 0, but not the minimum.
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
    """The CasADi function of errors and constraints that `ReachingTracker` evaluates.

    Returns:
        q, phi_d (n, 1) -> weighted errors e (n, 1), de/dq (n, n), margins to the domain's conditions (k, 1), positive
        inside, and their derivatives (k, n).

    Raises:
        DomainError: if the domain has a condition, but no expression of it.
    """
    n, relative = len(known.sizes), known.difference.task
    q, target = ca.MX.sym("q", n), ca.MX.sym("target", n)
    weights = ca.DM(np.where(np.arange(n) < m, 1 / known.sizes, RULES.xi_weight))
    e, J = -known.difference(target, phi(q)), rates(q)
    if relative is not None:  # `rates` is de/dq at e = 0 only; use the derivative at the actual error
        J = ca.vertcat(relative.error(q, target[:m])[1], J[m:, :])
    rooms = rooms_of(domain, q)
    outputs = [e * weights, J * ca.repmat(weights, 1, n), rooms, ca.jacobian(rooms, q)]
    return dense_function("near", [q, target], outputs, ["q", "phi"])
