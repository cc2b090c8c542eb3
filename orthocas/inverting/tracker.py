"""Trackers follow a stream of phi with q: one warm-started solution a call (ours)."""

from enum import IntEnum
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from orthocas.casadi_tools.batch import dense_function
from orthocas.checks import Array, as_float_array, as_point, require_shape
from orthocas.domains import Conditioned, Domain, contains, reach
from orthocas.errors import InvalidValueError
from orthocas.inverting.newton import GOAL
from orthocas.inverting.point import REFRESHES, Bound, PointFunctions, PointSolver
from orthocas.showing import Shown, number_list

_ROUNDED = 1e-9  # error up to which only rounding may have stopped the decrease
_STEP = 0.1  # of the half-widths: default of the largest change of q in a call


class TrackerStatus(IntEnum):
    """How the last call of a tracker ended. With all but OK, q stays where it was."""

    OK = 0  #: phi(q) = phi, inside the domain
    JUMP = 1  #: q would have moved by more than `largest_step`
    OUTSIDE_DOMAIN = 2  #: q would have left the domain
    SINGULAR = 3  #: J is singular, or nearly so
    LOST = 4  #: no solution near the last q
    BAD_INPUT = 5  #: a number of phi is not finite


class Tracker(Shown):
    """Follows a stream of phi: each call starts where the last one ended, and never leaves the domain.

    A call takes chord steps with the Jacobian of an earlier call, and evaluates a new one only where they do not
    converge. If the new q would be too far from the last one or outside the domain, or if there is none, `step` returns
    the last q again, and `status` tells why. `Chart.tracker` makes trackers; each belongs to one thread.

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
        function = _guard(domain, self._limit)
        self._guard = Bound(function, [self._before, self._solver.reached], [self._guarded])
        self.reset(q0)

    def __getstate__(self) -> dict[str, Any]:
        """Without scratch memory."""
        return {"functions": self._functions, "domain": self._domain, "q": self.q, "limit": self._limit}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(state["functions"], state["domain"], state["q"], state["limit"])  # type: ignore[misc]

    @property
    def q(self) -> Array:
        """The last solution, (n,)."""
        return self._solver.q.copy()

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
        if not contains(self._domain, point):
            raise InvalidValueError("q", point.tolist(), "a point of the domain")
        self._solver.q[:] = point
        if not self._solver.refresh():
            raise InvalidValueError("q", point.tolist(), "a point where J is regular")
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
        """Move to the solution and tell whether that is allowed."""
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
    outside = ca.mmax(ca.fabs(q - ca.DM(domain.centre)) - ca.DM(reach(domain)))
    if isinstance(domain, Conditioned):
        outside = ca.fmax(outside, ca.if_else(ca.mmin(domain.pivots(q)) > 0, -1, 1))
    return dense_function("guard", [before, q], [ca.vertcat(ca.norm_inf((q - before) / ca.DM(limit)), outside)])
