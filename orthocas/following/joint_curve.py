"""Joint positions q(s) along a path phi(s) = [x(s); xi(s)], with two derivatives (ours)."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from orthocas.checks import Array
from orthocas.errors import PathError
from orthocas.following.newton import Newton, solved

Goal = Callable[..., Array]  #: s, order of the derivative -> phi (n,), or (N, n)
_LONGEST = 0.15  # of a step of q on the way [rad] or [m]
_FIRST = 0.01  # first step of s
_SHORTEST = 1e-6  # of s


@dataclass(frozen=True, eq=False)
class Lost:
    """A curve that ends early."""

    s: Array  #: (N,) parameters that were reached
    q: Array  #: (N, n) their joint positions
    beyond: float  #: the first parameter that was not reached


@dataclass(frozen=True, eq=False)
class JointCurve:
    """q(s) with phi(q(s)) = phi(s), for s in [0, 1]."""

    newton: Newton
    goal: Goal
    near: CubicHermiteSpline  #: s -> q, close enough for Newton's method

    @classmethod
    def along(cls, newton: Newton, goal: Goal, q_start: Array) -> "JointCurve | Lost":
        """Follow phi(s) from s = 0, where q_start (n,) is the guess, by Euler steps and Newton's method."""
        q = newton.solve(q_start[None], goal(np.zeros(1)))[0]
        if not np.isfinite(q).all():
            return Lost(np.empty(0), np.empty((0, len(q_start))), 0.0)
        s, h = [0.0], _FIRST
        points, slopes = [q], [_slope(newton, q, goal(0.0, 1))]
        while s[-1] < 1:
            h = min(h, 1 - s[-1], _LONGEST / max(float(np.abs(slopes[-1]).max()), 1e-12))
            new, q = s[-1] + h if s[-1] + h < 1 - 1e-12 else 1.0, points[-1]
            found = newton.solve((q + h * slopes[-1])[None], goal(np.array([new])))[0]
            slope = _slope(newton, found, goal(new, 1))
            if not np.isfinite(slope).all() or np.abs(found - q).max() > 2 * _LONGEST:
                h /= 2
                if h < _SHORTEST:
                    return Lost(np.array(s), np.array(points), new)
                continue
            s.append(new)
            points.append(found)
            slopes.append(slope)
            h *= 1.5
        return cls(newton, goal, CubicHermiteSpline(np.array(s), np.array(points), np.array(slopes)))

    def q(self, s: Array) -> Array:
        """Joint positions at parameters (N,), (N, n); NaN where Newton's method fails."""
        return self.newton.solve(np.asarray(self.near(s)), np.asarray(self.goal(s)))

    def at(self, s: Array) -> tuple[Array, Array, Array]:
        """q(s), dq/ds and d2q/ds2 at parameters (N,), (N, n) each.

        J q' = phi' and J q'' = phi'' - d2phi(q)[q', q'].

        Raises:
            PathError: if Newton's method fails at one of them.
        """
        q = self.q(s)
        bad = np.flatnonzero(np.isnan(q).any(axis=1))
        if bad.size:
            raise PathError(f"the path cannot be followed at s = {s[bad[0]]:.6g}: the chart is nearly singular there")
        J = self.newton.phi_and_jacobian(q)[1]
        first = solved(J, self.goal(s, 1))
        return q, first, solved(J, self.goal(s, 2) - self.newton.turning(q, first, first))


def _slope(newton: Newton, q: Array, rate: Array) -> Array:
    """dq/ds (n,) for dphi/ds (n,); NaN where q is not finite."""
    if not np.isfinite(q).all():
        return np.full(len(q), np.nan)
    return np.asarray(solved(newton.phi_and_jacobian(q[None])[1], rate[None])[0])
