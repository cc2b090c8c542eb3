"""The solution of phi(q) = phi to which a straight line of values leads from a start."""

from dataclasses import dataclass

import numpy as np

from orthocas.charts.newton import GOAL, Attempt, inverses
from orthocas.charts.phi import PhiMap, largest
from orthocas.tools.checks import Array, Indices


@dataclass(frozen=True, slots=True)
class ContinuationRules:
    """Numbers of the continuation. Chosen on panda-wide, held on five arms (tests/charts/test_continuation.py)."""

    first: float = 0.1  #: largest change of a joint in the first step [rad] or [m]
    longest: float = 0.3  #: in any step
    shortest: float = 1e-5  #: a line that needs shorter steps ends at a fold
    bent: float = 0.3  #: largest miss of the linear prediction, relative to the part of the way taken
    straight: float = 0.1  #: the miss up to which the next step may be longer
    rounding: float = 1e-9  #: error below which only rounding may stop the decrease
    most: int = 400  #: steps


RULES = ContinuationRules()


class Continuation:
    """Follows phi(q(s)) = phi - (1 - s) e from a start with the error e = phi - phi(q), to s = 1.

    Errors of orientations and of periodic coordinates are the shorter way around. Each step goes along J^-1 e; it is
    halved until phi follows the line and det J keeps its sign, so q stays on the sheet of its start. It finds nothing
    where the line meets a fold first, or where e is not the way that the arm can take.
    """

    def __init__(self, phi_map: PhiMap) -> None:
        self._map = phi_map

    def __call__(self, targets: Array, starts: Array) -> Attempt:
        """Follow the lines to targets (N, n) from starts (N, n)."""
        with np.errstate(all="ignore"):
            return self._followed(targets, starts)

    def _followed(self, targets: Array, starts: Array) -> Attempt:
        q, residual = starts.copy(), self._map.residual(targets, starts)
        error = largest(residual)
        step, sign = self._steps(targets, q, residual)
        h, iterations = np.full(len(q), RULES.first), np.zeros(len(q), dtype=np.int64)
        left = np.flatnonzero(np.isfinite(error) & np.isfinite(step).all(axis=1))
        for _ in range(RULES.most):
            left = left[(error[left] > GOAL) & (h[left] > RULES.shortest)]
            if not left.size:
                break
            share = np.minimum(1.0, h[left] / np.abs(step[left]).max(axis=1))
            new = q[left] + share[:, None] * step[left]
            after = self._map.residual(targets[left], new)
            miss = largest(after - (1 - share[:, None]) * residual[left]) / (share * error[left])
            onward, side = self._steps(targets[left], new, after)
            rounded = (share == 1) & (error[left] < RULES.rounding)
            good = (miss <= RULES.bent) & (side == sign[left]) & np.isfinite(onward).all(axis=1)
            good &= ~rounded | (largest(after) < error[left])
            moved = left[good]
            q[moved], residual[moved], step[moved] = new[good], after[good], onward[good]
            error[moved] = largest(after[good])
            iterations[moved] += 1
            longer = miss[good] <= RULES.straight
            h[moved] = np.where(longer, np.minimum(1.5 * h[moved], RULES.longest), h[moved])
            h[left[~good]] /= 2
            left = left[good | ~rounded]
        return Attempt(q, residual, iterations, np.ones(len(q), dtype=bool))

    def _steps(self, targets: Array, q: Array, residual: Array) -> tuple[Array, Indices]:
        """J^-1 e at points (N, n), and the signs of det J, (N,)."""
        J = self._map.jacobian(q) / self._map.scale(targets)[:, :, None]
        steps = (inverses(J)[0] @ residual[:, :, None])[:, :, 0]
        return steps, np.sign(np.linalg.slogdet(J)[0]).astype(np.int64)
