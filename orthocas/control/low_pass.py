"""The second-order low-pass filter, in closed form. It turns steps into references with two derivatives."""

from functools import lru_cache

import casadi as ca
import numpy as np

from orthocas.casadi_tools.batch import dense_function


@lru_cache(32)
def low_pass_response(k: int, natural_frequency: float, damping_ratio: float) -> ca.Function:
    """Response of k equal low-pass filters to a constant target, from any start.

    The error e = value - target obeys dd_e + 2 zeta omega0 d_e + omega0^2 e = 0, solved in closed form for
    underdamped, critically damped and overdamped filters.

    Args:
        k: number of quantities.
        natural_frequency: omega0 > 0 [rad/s].
        damping_ratio: zeta >= 0.

    Returns:
        A function of time t >= 0 and [target; value at t = 0; velocity at t = 0] (3 k, 1) -> value, velocity and
        acceleration, each (k, 1).
    """
    t, parameters = ca.SX.sym("t"), ca.SX.sym("parameters", 3 * k)
    target, value0, velocity0 = parameters[:k], parameters[k : 2 * k], parameters[2 * k :]
    decay, beat = damping_ratio * natural_frequency, natural_frequency * np.sqrt(abs(1 - damping_ratio**2))
    if np.isclose(damping_ratio, 1.0, rtol=0, atol=1e-9):
        cosine, sine = ca.exp(-decay * t), t * ca.exp(-decay * t)
    elif damping_ratio < 1:
        cosine, sine = ca.exp(-decay * t) * ca.cos(beat * t), ca.exp(-decay * t) * ca.sin(beat * t) / beat
    else:  # hyperbolic functions, written so that they do not overflow
        slow, fast = ca.exp((beat - decay) * t), ca.exp(-(beat + decay) * t)
        cosine, sine = (slow + fast) / 2, (slow - fast) / (2 * beat)
    e0 = value0 - target
    e = e0 * cosine + (velocity0 + decay * e0) * sine
    velocity = velocity0 * cosine - (decay * velocity0 + natural_frequency**2 * e0) * sine
    acceleration = -2 * decay * velocity - natural_frequency**2 * e
    return dense_function("low_pass", [t, parameters], [target + e, velocity, acceleration])
