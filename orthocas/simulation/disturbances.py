"""Disturbances that the model leaves out: pushes, friction and sensor noise."""

from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from orthocas.checks import Array, as_float_array, frozen_array, require_count, require_shape
from orthocas.control.gains import non_negative_gains
from orthocas.errors import InvalidValueError

_STICTION_SPEED = 0.01  # [rad/s] or [m/s]: above twice this speed, Coulomb friction is nearly at its full value


@dataclass(frozen=True, eq=False)
class Push:
    """An external load that is constant for some time.

    Args:
        start: [s], >= 0.
        duration: [s], > 0.
        force: at the tip, in world axes, (3,) [N]; default no force.
        torque: at the joints, (n,) [N m] or [N]; default no torque.
    """

    start: float
    duration: float
    force: Array
    torque: Array | None

    def __init__(
        self, start: float, duration: float, force: ArrayLike = (0.0, 0.0, 0.0), torque: ArrayLike | None = None
    ) -> None:
        for name, value, want in (("start", start, ">= 0"), ("duration", duration, "> 0")):
            number = as_float_array(f"{name} of a push", value)
            require_shape(f"{name} of a push", number.shape, ())
            if not (np.isfinite(number) and (number > 0 or (number == 0 and name == "start"))):
                raise InvalidValueError(f"{name} of a push", value, f"a finite number {want}")
        object.__setattr__(self, "start", float(start))
        object.__setattr__(self, "duration", float(duration))
        object.__setattr__(self, "force", frozen_array("force", force, (3,)))
        object.__setattr__(self, "torque", None if torque is None else frozen_array("torque", torque, (None,)))

    @property
    def end(self) -> float:
        """Time at which the push ends [s]."""
        return self.start + self.duration

    def load(self, n: int) -> Array:
        """Force and joint torques in one row, (3 + n,)."""
        torque = np.zeros(n) if self.torque is None else self.torque
        require_shape("torque of a push", torque.shape, (n,))
        return np.concatenate([self.force, torque])


def loads_at(pushes: tuple[Push, ...], times: Array, n: int) -> Array:
    """Sum of the loads at times (N,), (N, 3 + n). A push acts from its start until just before its end."""
    loads = np.zeros((len(times), 3 + n))
    for push in pushes:
        loads[(times >= push.start) & (times < push.end)] += push.load(n)
    return loads


def mean_loads(pushes: tuple[Push, ...], starts: Array, length: float, n: int) -> Array:
    """Mean loads over time intervals of equal length, (N, 3 + n), so that a short push keeps its impulse."""
    loads = np.zeros((len(starts), 3 + n))
    for push in pushes:
        overlap = np.minimum(starts + length, push.end) - np.maximum(starts, push.start)
        loads += np.maximum(overlap, 0.0)[:, None] / length * push.load(n)
    return loads


@dataclass(frozen=True, eq=False)
class Friction:
    """Joint friction tau_f = viscous dq + coulomb tanh(dq / 0.01), which opposes the motion.

    Args:
        viscous: >= 0, (n,) or one number [N m s/rad].
        coulomb: >= 0, (n,) or one number [N m].
    """

    viscous: ArrayLike = 0.0
    coulomb: ArrayLike = 0.0

    def torque(self, dq: ca.SX) -> ca.SX:
        """Friction torque, to be subtracted from the joint torque, (n, 1)."""
        viscous = ca.DM(non_negative_gains("viscous", self.viscous, dq.shape[0]))
        coulomb = ca.DM(non_negative_gains("coulomb", self.coulomb, dq.shape[0]))
        friction: ca.SX = viscous * dq + coulomb * ca.tanh(dq / _STICTION_SPEED)
        return friction


@dataclass(frozen=True)
class Noise:
    """White Gaussian noise on the measurements of the controller, drawn anew at every control tick.

    Args:
        position: standard deviation >= 0 [rad] or [m].
        velocity: standard deviation >= 0 [rad/s] or [m/s].
        seed: of the random numbers.
    """

    position: float = 0.0
    velocity: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        require_count("seed", self.seed, least=0)
        for name in ("position", "velocity"):
            value = as_float_array(f"{name} noise", getattr(self, name))
            if value.shape or not (np.isfinite(value) and value >= 0):
                raise InvalidValueError(f"{name} noise", getattr(self, name), "a finite number >= 0")

    def sample(self, ticks: int, n: int) -> Array:
        """Measurement errors of q and dq, (ticks, 2 n)."""
        rng = np.random.default_rng(self.seed)
        return np.asarray(rng.normal(size=(ticks, 2 * n)) * np.repeat([self.position, self.velocity], n))
