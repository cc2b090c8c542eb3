"""Settings of the supervised law in generated C: border, catcher, limits, bad input (ours)."""

from dataclasses import dataclass, fields
from typing import Self

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from orthocas.casadi_tools.batch import Batched, dense_function
from orthocas.checks import Array, as_float_array, as_number, require_count, require_shape
from orthocas.control.controller import Controller, require_controller
from orthocas.domains import sample_uniform
from orthocas.errors import InvalidValueError

_SAMPLES, _SEED = 256, 0
_RATE = {"torque": 1000.0, "velocity": 20.0}  # [N m/s] as on many arms, 1 N m in a millisecond; [rad/s^2]
_SPEED = 4 * np.pi  # [rad/s] or [m/s], of joints without a limit
_CATCHER = 12.0  # [1/s] natural frequency and damping rate of the catcher
_RETURN = 0.3  # [rad/s] or [m/s], on the way back
_STOPS = 30.0  # [rad/s] natural frequency at the joint limits
_ZONE = 0.05  # [rad] or [m], at most this share of the range of a joint


@dataclass(frozen=True, eq=False)
class Safety:
    """Settings of the supervised law; `Safety.of(controller)` gives the default ones.

    Margins are distances to the border in half-widths of the domain. On a `ClearBox`, the bound on the relative singular
    value s is a border too, at the distance (s - bound) / (s at the centre - bound). Lists hold one number per joint (n,), or per
    controlled quantity (k,) where that is said.
    """

    command_rate: Array  #: largest change of the command [N m/s], [rad/s^2]
    speed_limit: Array  #: joint speed at which the catcher takes over; 30 times as fast is a bad measurement [rad/s]
    rest_speed: Array  #: joint speed below which the arm counts as slow [rad/s]
    near_margin: float  #: where NEAR_BORDER and additional damping begin
    catch_margin: float  #: where the catcher takes over, also if the arm would get there while the law fades out
    return_margin: float  #: where the arm must be before the law takes over again
    fade_in: float  #: time in which the law takes over [s]
    fade_out: float  #: time in which the law gives way to the catcher [s]
    return_speed: float  #: of the fastest joint on the way back [rad/s]
    error_limit: Array  #: largest error that the law gets to see (k,)
    offset_rate: Array  #: speed at which the reference goes from where the arm is to what is asked (k,) [1/s]
    integral_rate: Array  #: integral action: growth of the shift of the reference per error (k,) [1/s]
    integral_limit: Array  #: largest shift (k,)
    hold_ticks: int  #: ticks without a good measurement for which the last command is held
    longest_period: float  #: between two ticks; later ones call the catcher [s]
    lower: Array  #: joint limits [rad] or [m]
    upper: Array  #: joint limits [rad] or [m]
    stop_zone: Array  #: where springs and dampers near the joint limits begin [rad] or [m]
    stop_stiffness: Array  #: of these springs [N m/rad]; velocity laws: largest speed per distance [1/s]
    stop_damping: Array  #: against motion towards the limit [N m s/rad]
    damping: float  #: rate d of the catcher's damping -d M dq [1/s]; velocity laws: of the way to the anchor
    brake_stiffness: Array  #: spring of the catcher, constant and symmetric, row by row (n * n) [N m/rad]
    brake_yield: Array  #: largest torque of that spring; beyond it, the arm is let go slowly [N m]

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name == "hold_ticks":
                require_count("hold_ticks", value, least=0)
            elif field.type is float:
                _require_number(field.name, value)
            else:
                object.__setattr__(self, field.name, _numbers(field.name, value))
        if not self.catch_margin < self.near_margin < self.return_margin < 1:
            margins = (self.catch_margin, self.near_margin, self.return_margin)
            raise InvalidValueError("margins", margins, "catch_margin < near_margin < return_margin < 1")

    @classmethod
    def of(cls, controller: Controller, **changes: ArrayLike) -> Self:
        """The default settings for a controller, from the robot's limits and its mass matrix at the domain's centre.

        Args:
            controller: the law.
            changes: other values by name; one number stands for all.

        Raises:
            InvalidValueError, ShapeError: for unknown names, and values of the wrong shape or range.
        """
        require_controller(controller)
        robot, n, domain = controller.problem.robot, controller.problem.n, controller.problem.domain
        M = np.asarray(robot.mass_matrix(domain.centre))
        points = sample_uniform(domain, _SAMPLES, _SEED)
        gravity = np.abs(robot.gravity(points)).max(axis=0)
        measured = Batched(controller.measured)(points)[0]
        span = np.nanmax(measured, axis=0) - np.nanmin(measured, axis=0)
        torque, free = controller.command == "torque", 1 / np.diag(np.linalg.inv(M))
        settings = {
            "command_rate": np.full(n, _RATE[controller.command]),
            "speed_limit": np.where(np.isfinite(robot.velocity_limits), robot.velocity_limits, _SPEED),
            "rest_speed": np.full(n, 0.5),
            "near_margin": 0.06,
            "catch_margin": 0.01,
            "return_margin": 0.1,
            "fade_in": 0.2,
            "fade_out": 0.03,
            "return_speed": _RETURN,
            "error_limit": 0.15 * span,
            "offset_rate": _RETURN / _joint_motion(controller, points),
            "integral_rate": 0 * span,
            "integral_limit": 0.05 * span,
            "hold_ticks": 10,
            "longest_period": 0.02,
            "lower": robot.lower,
            "upper": robot.upper,
            "stop_zone": np.fmin(_ZONE, _ZONE * (robot.upper - robot.lower)),
            "stop_stiffness": _STOPS**2 * free if torque else np.full(n, _STOPS),
            "stop_damping": 2 * _STOPS * free if torque else np.zeros(n),
            "damping": _CATCHER if torque else 5.0,
            "brake_stiffness": (_CATCHER**2 * M).ravel() if torque else np.zeros(n * n),
            "brake_yield": 0.5 * gravity + 10 * np.diag(M),
        }
        unknown = sorted(set(changes) - set(settings))
        if unknown:
            raise InvalidValueError("setting", repr(unknown[0]), f"one of {', '.join(settings)}")
        spread = {name: _spread(name, value, settings[name]) for name, value in changes.items()}
        return cls(**{**settings, **spread})


def _joint_motion(controller: Controller, points: Array) -> Array:
    """How far the fastest joint moves per unit of each controlled quantity, at 90 % of the points (k,)."""
    q = ca.MX.sym("q", controller.problem.n)
    rows = Batched(dense_function("J", [q], [ca.jacobian(controller.measured(q), q)]))(points)[0]
    J = rows.reshape(len(points), q.shape[0], -1).transpose(0, 2, 1)
    largest = np.abs(np.linalg.pinv(J[np.isfinite(J).all(axis=(1, 2))])).max(axis=1)
    return np.asarray(np.quantile(largest, 0.9, axis=0))


def _spread(name: str, value: ArrayLike, default: object) -> object:
    """One number for all entries of an array; other values are checked."""
    if not isinstance(default, np.ndarray):
        return value
    given = as_float_array(name, value)
    if given.ndim:
        require_shape(name, given.shape, default.shape)
    return np.full(default.shape, given)


def _require_number(name: str, value: float) -> None:
    if not 0 < as_number(name, value) < np.inf:
        raise InvalidValueError(name, value, "a finite number > 0")


def _numbers(name: str, value: ArrayLike) -> Array:
    array = np.array(as_float_array(name, value))
    may_be_infinite = name in ("command_rate", "speed_limit", "lower", "upper", "error_limit")
    if array.ndim != 1 or np.isnan(array).any() or (not may_be_infinite and np.isinf(array).any()):
        raise InvalidValueError(name, array.tolist(), "a list of numbers")
    if name not in ("lower", "upper", "brake_stiffness") and array.size and array.min() < 0:
        raise InvalidValueError(name, array.min(), "numbers >= 0")
    array.setflags(write=False)
    return array
