"""Integrates many independent initial value problems at once, each with its own step size.

For systems with a few states, mapped SUNDIALS solvers are several times slower (benchmarks/growing_queries.py). Here,
one step of all trajectories is an operation on columns of samples, with little overhead beyond arithmetic.
"""

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
import scipy
from numpy.typing import NDArray

from orthocas.casadi_tools.batch import Batched, dense_function
from orthocas.casadi_tools.cached import cached_property
from orthocas.casadi_tools.columns import ColumnFunction, blocked, by_sample
from orthocas.checks import Array

_STAGES = 12
_FEW = 64  # up to this many trajectories, a block of columns does not pay off
_FIRST = 0.25  # first step
_SMALLEST = 1e-9  # smaller steps mean that the field is singular, so the trajectory stops
_SHRINK, _GROW, _SAFETY = 0.2, 10.0, 0.9


@dataclass(frozen=True, eq=False)
class BatchedFlow:
    """Integrates dy/ds = f(y, p) from s = 0 to 1 for many y and p, by the 8th-order method of Dormand and Prince.

    Coefficients and error estimate are those of `scipy.integrate.DOP853` ([HNW1993] Sec. II.10); the batching is ours.

    Args:
        field: f, (k, 1) x (l, 1) -> (k, 1).
        scale: factor on the tolerance of each state, (k,).
    """

    field: ca.Function
    scale: Array

    def end_points(self, starts: Array, parameters: Array, tolerance: float) -> tuple[Array, NDArray[np.bool_]]:
        """States at s = 1, (N, k), and which trajectories reached s = 1, (N,).

        The other trajectories stopped where the step size fell below 1e-9 or the field was not finite. Their rows hold
        the last state.

        Args:
            starts: (N, k).
            parameters: (N, l).
            tolerance: tolerance of the local error of a step.
        """
        y, s, step = starts.copy(), np.zeros(len(starts)), np.full(len(starts), _FIRST)
        running = np.arange(len(starts))
        while running.size:
            tried = np.minimum(step[running], 1 - s[running])
            moved, error = self._moved(y[running], tried[:, None], parameters[running])
            ratio = np.nan_to_num(error[:, 0] / tolerance, nan=np.inf)
            good = ratio <= 1
            y[running[good]] = moved[good]
            s[running[good]] += tried[good]
            step[running] = tried * np.clip(_SAFETY * np.maximum(ratio, 1e-16) ** (-1 / 8), _SHRINK, _GROW)
            running = running[(s[running] < 1) & (step[running] > _SMALLEST)]
        return y, s >= 1

    def _moved(self, *arguments: Array) -> list[Array]:
        """One step of some trajectories: y (N, k), step sizes (N, 1), p (N, l) -> y (N, k), errors (N, 1)."""
        N = len(arguments[0])
        if N <= _FEW:
            return self._few(*arguments)
        outputs = self._many(*map(blocked, arguments))
        return [by_sample(out[:, None], N)[:, :, 0] for out in outputs]

    @cached_property
    def _few(self) -> Batched:
        return Batched(self._step)

    @cached_property
    def _many(self) -> ColumnFunction:
        return ColumnFunction(self._step)

    @cached_property
    def _step(self) -> ca.Function:
        """One step: y, step size, p -> new y and its estimated error in units of the tolerance."""
        k = self.field.size1_in(0)
        y, step, p = ca.SX.sym("y", k), ca.SX.sym("step"), ca.SX.sym("p", self.field.size1_in(1))
        method, slopes = scipy.integrate.DOP853, list[Any]()
        for i in range(_STAGES):
            slopes.append(self.field(y + step * _combined(method.A[i, :i], slopes), p) if i else self.field(y, p))
        moved = y + step * _combined(method.B, slopes)
        scale = ca.DM(self.scale)
        fifth = ca.sumsqr(_combined(method.E5[:_STAGES], slopes) / scale)
        third = ca.sumsqr(_combined(method.E3[:_STAGES], slopes) / scale)
        error = step * fifth / ca.sqrt(fifth + 0.01 * third + 1e-300)
        return dense_function("step", [y, step, p], [moved, error])


def _combined(weights: Array, slopes: list[Any]) -> Any:
    """Weighted sum, without the terms whose weight is zero."""
    return sum(float(w) * slope for w, slope in zip(weights, slopes, strict=True) if w != 0)
