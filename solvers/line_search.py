"""A step length along a descent direction that fulfils the strong Wolfe conditions."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

_DECREASE, _CURVATURE = 1e-3, 0.9  # constants of the two conditions, as in L-BFGS-B
_GROWTH = 4.0  # of the step while the function still falls steeply
_MARGIN = 0.1  # share of a bracket, at both ends, where no step is tried
_MOST = 20  # trials


class Trial(NamedTuple):
    """A function of one variable at one place."""

    step: float
    value: float
    slope: float


def wolfe_step(along: Callable[[float], tuple[float, float]], start: Trial, first: float) -> bool:
    """Try steps until one lowers the function and its slope enough; whether there was one, the last that was tried.

    f(a) <= f(0) + 1e-3 a f'(0) and |f'(a)| <= 0.9 |f'(0)|. Steps grow until they bracket such a point, and then come
    from the cubic through both ends of the bracket.

    Args:
        along: f and f' at a step a > 0; values that are not finite count as too high.
        start: f and f' < 0 at a = 0.
        first: the first step to try, > 0.

    Source:
        [NW2006] Sec. 3.5.
    """
    low, high, step = start, None, first
    for _ in range(_MOST):
        trial = Trial(step, *along(step))
        if not trial.value <= start.value + _DECREASE * step * start.slope:
            high = trial
        elif abs(trial.slope) <= _CURVATURE * abs(start.slope):
            return True
        elif trial.slope < 0:
            low = trial
        else:
            high = trial
        step = _GROWTH * step if high is None else _between(low, high)
    return False


def _between(low: Trial, high: Trial) -> float:
    """Minimiser of the cubic with the values and slopes of both ends, or the middle; not too close to the ends."""
    width = high.step - low.step
    middle = low.step + width / 2
    if not np.isfinite([high.value, high.slope]).all():
        return middle
    a = low.slope + high.slope - 3 * (high.value - low.value) / width
    root = a * a - low.slope * high.slope
    if root < 0:
        return middle
    b = float(np.sqrt(root))
    below = high.slope - low.slope + 2 * b
    share = 1 - (high.slope + b - a) / below if below else 0.5
    return low.step + width * float(np.clip(share, _MARGIN, 1 - _MARGIN))
