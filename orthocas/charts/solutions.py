"""Results of the inverse map, and trackers of moving targets."""

from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any, Self

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthocas.charts.newton import GOAL, REFRESHES, Bound, PointFunctions, PointSolver
from orthocas.errors import InvalidValueError, InverseError, degrees_hint
from orthocas.tasks.domains import Domain
from orthocas.tools.batch import dense_function
from orthocas.tools.cached import building
from orthocas.tools.checks import Array, Indices, as_float_array, as_point, require_shape
from orthocas.tools.display import Shown, listed, number_list
from orthocas.tools.expressions import wrap_shortest
from orthocas.tools.interrupts import deferred

_FEW = 5  # rows that a message names
_ROUNDED = 1e-9  # error up to which only rounding may have stopped the decrease
_RETURNED = 1e-8  # of phi, relative to its sizes: the tracker is back
_STEP = 0.1  # of the half-widths: default of the largest change of q in a call


class InverseStatus(IntEnum):
    """How the search for a q with phi(q) = phi ended, from best to worst."""

    FOUND = 0  #: a solution inside the domain
    NEAREST = 1  #: none was found inside; this q lies inside, has the same x, and the nearest xi that was found
    OUTSIDE_DOMAIN = 2  #: none was found inside; this solution lies within the joint limits, but outside the domain; of
    #: `inside=True` and `nearest_xi`, no q with that x was found inside, and this one, with another xi, lies there
    LIMIT = 3  #: none was found within the joint limits; this solution lies beyond them
    SINGULAR = 4  #: a solution at which J is singular, so that it need not be unique
    NOT_FOUND = 5  #: no solution was found, which does not prove that there is none; q has the smallest error found
    BAD_INPUT = 6  #: a number of phi or of the start is not finite; q is NaN
    OUT_OF_REACH = 7  #: no solution: x is farther from the first joint than the arm is long; q as for NOT_FOUND


_SOLVED = (InverseStatus.FOUND, InverseStatus.NEAREST)
_UNSOLVED = (InverseStatus.NOT_FOUND, InverseStatus.BAD_INPUT, InverseStatus.OUT_OF_REACH)
_BEYOND = (InverseStatus.OUTSIDE_DOMAIN, InverseStatus.LIMIT)


@dataclass(frozen=True, eq=False, repr=False)
class Solutions(Shown):
    """Joint positions with given task values and coordinates; see `Chart.solve`.

    Example:
        >>> import numpy as np
        >>> import orthocas as oc
        >>> from orthocas import problems
        >>> chart = oc.fit(problems.get("planar_3r_xy"), oc.Polynomial(degree=2), samples=300).chart
        >>> phi = chart.phi([[0.7, 0.9, 0.6], [0.6, 0.8, 0.8]])
        >>> solutions = chart.solve(np.vstack([phi, [9.0, 0.0, 0.0]]))
        >>> [status.name for status in solutions.statuses], solutions.found.tolist()
        (['FOUND', 'FOUND', 'OUT_OF_REACH'], [True, True, False])
    """

    q: Array = field(repr=False)  #: the best points found, (N, n) [rad] or [m]
    status: Indices  #: an `InverseStatus` for each row, (N,)
    iterations: Indices  #: steps of Newton's method that led to q, (N,)
    error: Array  #: largest |phi(q) - phi| relative to the sizes, (N,); of x alone where only x is kept
    distance: Array  #: |xi(q) - xi|, (N,)
    tolerance: float  #: the largest error of a solution

    def __post_init__(self) -> None:
        for array in (self.q, self.status, self.iterations, self.error, self.distance):
            array.setflags(write=False)

    def __len__(self) -> int:
        return len(self.q)

    @property
    def found(self) -> NDArray[np.bool_]:
        """Rows with a solution inside the domain, (N,)."""
        return np.asarray(self.status == InverseStatus.FOUND)

    @property
    def statuses(self) -> tuple[InverseStatus, ...]:
        """The status of each row by name."""
        return tuple(InverseStatus(value) for value in self.status)

    def facts(self) -> dict[str, str]:
        """How many rows ended how."""
        counts = {status.name: int((self.status == status).sum()) for status in InverseStatus}
        solved = self.error[np.isin(self.status, (*_SOLVED, *_BEYOND))]
        return {
            "solutions": listed(f"{count} {name}" for name, count in counts.items() if count) or "no rows",
            **({"largest error": f"{solved.max():.3g}"} if solved.size else {}),
            **({"iterations": f"{self.iterations.mean():.3g} on average"} if len(self) else {}),
        }

    def require(self, inside: bool = True) -> Self:
        """These solutions, if all rows have one.

        Args:
            inside: do not accept solutions outside the domain.

        Raises:
            InverseError: if a row is not solved; the message names the rows.
        """
        accepted = _SOLVED if inside else (*_SOLVED, *_BEYOND)
        missing = np.flatnonzero(np.isin(self.status, _UNSOLVED))
        if missing.size:
            raise InverseError(
                f"no q with phi(q) = phi found for {self.named(missing)}: relative error is "
                f"{self.error[missing].max():.3g}, expected <= {self.tolerance:.1g}. "
                "The target may be out of reach, or the path to it singular"
            )
        singular = np.flatnonzero(self.status == InverseStatus.SINGULAR)
        if singular.size:
            raise InverseError(
                f"the Jacobian is singular at the solution of row {singular[0]}: q need not be unique there"
            )
        beyond = np.flatnonzero(~np.isin(self.status, accepted))
        if beyond.size:
            raise InverseError(f"q was found only outside the domain for {self.named(beyond)}")
        return self

    def named(self, rows: Indices) -> str:
        """Some rows in words, for messages."""
        return f"rows {rows[:_FEW].tolist()}" if len(self) > 1 else "phi"


class TrackerStatus(IntEnum):
    """How the last call of a tracker ended. With all but OK, NEAREST and NEARER, q stays where it was."""

    OK = 0  #: phi(q) = phi, inside the domain
    JUMP = 1  #: q would have moved by more than `largest_step`
    OUTSIDE_DOMAIN = 2  #: q would have left the domain
    SINGULAR = 3  #: J is singular, or nearly so
    LOST = 4  #: no solution near the last q
    BAD_INPUT = 5  #: a number of phi is not finite
    NEAREST = 6  #: a local minimum of the distance to phi in the domain; of trackers with `nearest=True`
    NEARER = 7  #: at least as near as before, but no minimum: `largest_step` or the work of a call ended the descent


class Tracker(Shown):
    """Follows a stream of phi: each call starts where the last one ended, and never leaves the domain.

    A call takes chord steps with the Jacobian of an earlier call, and evaluates a new one only where they do not
    converge. If the new q would be too far from the last one or outside the domain, or if there is none, `step` returns
    the last q again, and `status` says why. `Chart.tracker` makes trackers; each belongs to one thread.

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
        self, functions: PointFunctions, domain: Domain, q0: ArrayLike, largest_step: ArrayLike | None
    ) -> None:
        n = len(domain.centre)
        self._functions, self._domain = functions, domain
        limit = as_float_array("largest_step", _STEP * domain.half_width if largest_step is None else largest_step)
        if limit.ndim:
            require_shape("largest_step", limit.shape, (n,))
        if not (limit > 0).all():
            raise InvalidValueError("largest_step", limit.tolist(), "positive numbers")
        self._limit = np.broadcast_to(limit, n)
        self._solver = PointSolver(functions)
        self._before, self._guarded = np.empty(n), np.empty(2)
        with deferred(), building:  # CasADi's expressions are not for several threads at a time
            function = _guard(domain, self._limit)
        self._guard = Bound(function, [self._before, self._solver.reached], [self._guarded])
        self.reset(q0)

    def __getstate__(self) -> dict[str, Any]:
        """Without scratch memory."""
        parts = {"functions": self._functions, "domain": self._domain, "q": self.q, "limit": self._limit}
        return {**parts, "start": self._start}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(state["functions"], state["domain"], state["q"], state["limit"])  # type: ignore[misc]
        self._start = state["start"]

    @property
    def q(self) -> Array:
        """The last solution, (n,)."""
        return self._solver.q.copy()

    @property
    def left_over(self) -> Array | None:
        """What the way since the last reset leaves over in the joints, (n,), less full turns of endless joints.

        None while x or xi differ from those of the start. A loop around a full turn of tool or base may leave
        something over, see `Chart.left_over`.
        """
        q, phi = self._start
        if self._functions.distance(phi, self._solver.phi) > _RETURNED:
            return None
        turns = np.zeros(len(q))
        turns[list(self._functions.turning)] = 2 * np.pi
        return np.asarray(wrap_shortest(self._solver.q - q, turns))

    @property
    def largest_step(self) -> Array:
        """Largest change of each joint in a call, (n,) [rad] or [m]."""
        return self._limit

    def facts(self) -> dict[str, str]:
        """Where it is."""
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
            InvalidValueError: if q lies outside the domain, or J is singular there.
        """
        point = as_point("q", q, len(self._limit))
        if not self._domain.contains(point):
            hint = degrees_hint(*point[np.isfinite(self._domain.bounds[0])])
            raise InvalidValueError("q", point.tolist(), f"a point of the domain{hint}")
        self._solver.q[:] = point
        if not self._solver.refresh():
            raise InvalidValueError("q", point.tolist(), "a point where J is regular")
        self._start = self._solver.q.copy(), self._solver.phi.copy()
        self.status = TrackerStatus.OK  #: how the last call ended

    def step(self, phi: ArrayLike) -> Array:
        """The q near the last one with phi(q) = phi, or the last one; see `status`.

        Args:
            phi: target values, (n,).

        Returns:
            q, (n,) [rad] or [m].

        Raises:
            ShapeError: if phi has another number of entries.
        """
        solver = self._solver
        if type(phi) is not np.ndarray or phi.shape != solver.target.shape:
            phi = as_float_array("phi", phi)
            require_shape("phi", phi.shape, solver.target.shape)
        solver.target[:] = phi
        self._before[:] = solver.q
        self.status = self._advance()
        if self.status != TrackerStatus.OK:
            solver.q[:] = self._before
            solver.refresh()
        return solver.q.copy()

    def _advance(self) -> TrackerStatus:
        """Move to the solution; returns whether that is allowed."""
        solver, fresh = self._solver, False
        for _ in range(REFRESHES):
            falls, error = solver.step(), solver.errors[-1]
            if error <= GOAL or (error <= _ROUNDED and not falls):
                self._guard.run()
                solver.accept()
                return self._allowed()
            if falls:
                solver.accept()
            elif fresh:
                break
            fresh = True
            if not solver.refresh():
                return TrackerStatus.SINGULAR
        return TrackerStatus.LOST if np.isfinite(solver.target).all() else TrackerStatus.BAD_INPUT

    def _allowed(self) -> TrackerStatus:
        """Whether the step that the guard looked at is allowed."""
        jump, outside = self._guarded.tolist()
        if outside > 0:
            return TrackerStatus.OUTSIDE_DOMAIN
        return TrackerStatus.JUMP if jump > 1 else TrackerStatus.OK


def _guard(domain: Domain, limit: Array) -> ca.Function:
    """q before, q -> the largest change relative to its limit, and a number > 0 outside the domain."""
    before, q = (ca.MX.sym(name, len(limit)) for name in ("before", "q"))
    outside = ca.mmax(ca.fabs(q - ca.DM(domain.centre)) - ca.DM(domain.reach))
    if domain.condition is not None:
        outside = ca.fmax(outside, ca.if_else(ca.mmin(domain.condition.pivots(q)) > 0, -1, 1))
    return dense_function("guard", [before, q], [ca.vertcat(ca.norm_inf((q - before) / ca.DM(limit)), outside)])
