"""Settings of the supervised law in generated C: boundary, catcher, limits, bad input."""

from dataclasses import dataclass, fields
from typing import Annotated, Any, Self, get_args

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from orthocas.control.controller import Command, Controller, require_controller
from orthocas.errors import InvalidValueError
from orthocas.tasks.relative import Relative
from orthocas.tasks.samples import sample_uniform
from orthocas.tools.batch import Batched, dense_function
from orthocas.tools.cached import building
from orthocas.tools.checks import Array, as_float_array, as_number, require_count, require_shape
from orthocas.tools.display import listed, number_list
from orthocas.tools.interrupts import deferred

UNBOUNDED = (  #: settings that may be infinite
    *("command_rate", "speed_limit", "stuck_speed", "lower", "upper", "error_limit"),
    *("reference_speed", "reference_acceleration", "start_mismatch", "friction", "contact_torque", "energy_limit"),
)
SIGNED = ("lower", "upper")  #: settings that may be negative
TORQUE_ONLY = (  #: not of velocity laws
    *("observer_rate", "encoder_step", "friction", "stop_zone", "stop_damping", "brake_stiffness", "brake_yield"),
    *("contact_torque", "energy_limit", "energy_rate"),
)


@dataclass(frozen=True, slots=True)
class SafetyRules:
    """Numbers behind the default settings of the supervised law."""

    samples: int = 256  #: of the domain, for spans and gravity
    seed: int = 0  #: of the samples
    torque_rate: float = 1000.0  #: of commands, as on many arms: 1 N m in a millisecond [N m/s]
    full_force: float = 0.1  #: time in which a sliding joint gets its whole force [s]
    acceleration: float = 20.0  #: of commands of velocity laws [rad/s^2]
    speed: float = 4 * np.pi  #: of joints without a limit [rad/s] or [m/s]
    fraction: float = 0.7  #: of the speed limit, for references
    starting: float = 0.25  #: time in which a reference may reach the speed limit [s]
    catcher: float = 12.0  #: natural frequency and damping rate of the catcher, stable with delays up to 59 ms [1/s]
    anchor: float = 5.0  #: rate of the way to the anchor, of velocity laws [1/s]
    return_speed: float = 0.3  #: on the way back [rad/s] or [m/s]
    rest_speed: float = 0.5  #: below which joints count as slow [rad/s] or [m/s]
    stops: float = 30.0  #: natural frequency at the joint limits [rad/s]
    zone: float = 0.05  #: of stops, at most this share of the range of a joint [rad] or [m]
    stuck_speed: float = 0.15  #: that commands must have given to an arm that measures the same [rad/s]
    stuck: float = 0.25  #: and at most this share of the speed limit
    stuck_way: float = 0.03  #: likewise of velocity laws [rad]
    friction: float = 2.0  #: that may hold any joint at a start, and later one without a limit of effort [N m] or [N]
    most_friction: float = 12.5  #: and most that may hold it against the law, later [N m] or [N]
    stiction: float = 0.125  #: the same as a share of the effort limit: Coulomb friction of 10 %, a quarter more
    fine_step: float = 2 * np.pi / 2**13  #: of an encoder [rad]
    observer: float = 60.0  #: poles of the observer for that step, at most twice that for finer ones [1/s]
    turn_per_metre: float = 40 * np.pi  #: encoders of sliding joints turn once in 5 cm [rad/m]
    power: float = 10.0  #: that commands may give the arm for good, to rub and to lift [W]
    error: float = 0.02  #: of models and torque sensors, as a share of the effort limit; without one, of gravity


RULES = SafetyRules()


@dataclass(frozen=True, eq=False, repr=False, init=False)
class Safety:
    """Settings of the supervised law; `Safety.of(controller)` gives the default ones.

    Margins are distances to the boundary in half-widths of the domain. On a `ClearBox`, the bound on the relative
    singular value s is a boundary too, at the distance (s - bound) / (s at the home - bound). In a `Corridor`, the
    path is 1 and the boundary 0, and the other boundaries of its joints count in radii as well. Lists hold one number
    per joint (n,), or per controlled quantity (k,) where that is said. The meanings are those of the generated header.
    """

    command_rate: Annotated[Array, "largest change of the command [N m/s], [rad/s^2]; in a tick: times its period"]
    speed_limit: Annotated[
        Array, "joint speed at which the catcher takes over; 30 times that is a bad one unless q moves alike [rad/s]"
    ]
    rest_speed: Annotated[Array, "joint speed below which the arm counts as slow [rad/s]"]
    near_margin: Annotated[float, "distance to the boundary at which NEAR_BOUNDARY and additional damping begin"]
    catch_margin: Annotated[float, "where the catcher takes over, also if the arm gets there while the law fades out"]
    return_margin: Annotated[float, "where the arm must be before the law takes over again"]
    fade_in: Annotated[float, "time in which the law takes over [s]"]
    fade_out: Annotated[float, "time in which the law gives way to the catcher [s]"]
    return_speed: Annotated[
        float, "of the fastest joint on the way back, but at most a third of its speed limit [rad/s]"
    ]
    error_limit: Annotated[Array, "largest error that the law gets to see (k,)"]
    reference_speed: Annotated[Array, "largest joint speed that the reference may imply [rad/s]"]
    reference_acceleration: Annotated[Array, "and its largest growth [rad/s^2]"]
    offset_rate: Annotated[Array, "speed at which the reference goes from the arm to what is asked (k,) [1/s]"]
    integral_rate: Annotated[Array, "integral action: growth of the reference's shift per error (k,) [1/s]; 0: none"]
    integral_limit: Annotated[Array, "largest shift (k,)"]
    hold_ticks: Annotated[
        int, "ticks without a good measurement for which the last command is held; beyond 1 ms each: milliseconds"
    ]
    stale_ticks: Annotated[
        int, "ticks, or milliseconds, in which a moving arm may measure the same, bit by bit; more are bad measurements"
    ]
    stuck_speed: Annotated[Array, "speed that an arm which measures the same may get [rad/s]; velocity laws: way [rad]"]
    longest_period: Annotated[float, "between two ticks; later ones call the catcher [s]"]
    observer_rate: Annotated[
        Array, "poles of an observer of velocities, for coarse encoders [1/s]; 0: as measured; default by encoder_step"
    ]
    encoder_step: Annotated[Array, "what an encoder rounds to; that observer does not take it for motion [rad] or [m]"]
    friction: Annotated[Array, "dry friction that may hold a joint, whose sensors then measure the same [N m]"]
    lower: Annotated[Array, "joint limits [rad] or [m]"]
    upper: Annotated[Array, "joint limits [rad] or [m]"]
    stop_zone: Annotated[Array, "where springs and dampers near the joint limits begin [rad] or [m]"]
    stop_stiffness: Annotated[Array, "of these springs, per inertia [1/s^2]; velocity laws: speed per distance [1/s]"]
    stop_damping: Annotated[Array, "against motion towards the limit, per inertia [1/s]"]
    damping: Annotated[float, "rate of the catcher's damping -d M dq [1/s]; velocity laws: of the way to the anchor"]
    brake_stiffness: Annotated[float, "spring of the catcher, per inertia [1/s^2]"]
    brake_yield: Annotated[Array, "largest torque of that spring, which gives way slowly beyond it [N m]"]
    contact_torque: Annotated[Array, "torque beside the load at which the catcher takes over: guarded moves [N m]"]
    energy_limit: Annotated[float, "energy beyond energy_rate that commands may give the arm; then, the catcher [J]"]
    energy_rate: Annotated[float, "power that commands may give the arm for good [W]"]
    start_mismatch: Annotated[Array, "torque by which what holds the arm may differ from the model at a start [N m]"]

    def __init__(self, **settings: Any) -> None:
        names = [setting.name for setting in fields(self)]
        if sorted(settings) != sorted(names):
            odd = sorted(set(names) ^ set(settings))
            came = f"{len(settings)}, which differ in {listed(odd, 3)}"
            raise InvalidValueError("settings", came, f"all {len(names)}: use Safety.of(law)")
        # The kind of a setting is that of its annotation.
        for setting in fields(self):
            value = settings[setting.name]
            object.__setattr__(self, setting.name, value)
            if get_args(setting.type)[0] is int:
                require_count(setting.name, value, least=0)
            elif get_args(setting.type)[0] is float:
                number, endless = as_number(setting.name, value), setting.name in UNBOUNDED
                if not (0 < number < np.inf or (endless and number == np.inf)):
                    raise InvalidValueError(setting.name, value, "a number > 0" if endless else "a finite number > 0")
            else:
                # Lists are frozen; some may be infinite, some negative.
                array = np.array(as_float_array(setting.name, value))
                infinite = setting.name not in UNBOUNDED and np.isinf(array).any()
                if array.ndim != 1 or np.isnan(array).any() or infinite:
                    raise InvalidValueError(setting.name, array.tolist(), "a list of numbers")
                if setting.name not in SIGNED and array.size and array.min() < 0:
                    raise InvalidValueError(setting.name, array.min(), "numbers >= 0")
                array.setflags(write=False)
                object.__setattr__(self, setting.name, array)
        if not self.catch_margin < self.near_margin < self.return_margin < 1:
            margins = (self.catch_margin, self.near_margin, self.return_margin)
            raise InvalidValueError("margins", margins, "catch_margin < near_margin < return_margin < 1")

    def __repr__(self) -> str:
        values = ((setting.name, getattr(self, setting.name)) for setting in fields(self))
        return f"Safety({'; '.join(f'{name} = {number_list(np.atleast_1d(value))}' for name, value in values)})"

    def in_c(self, command: Command) -> dict[str, Any]:
        """The settings that generated C has for a kind of command, by name."""
        unused = () if command == "torque" else TORQUE_ONLY
        return {setting.name: getattr(self, setting.name) for setting in fields(self) if setting.name not in unused}

    @classmethod
    def meaning(cls, name: str) -> str:
        """What a setting means, in one line."""
        return next(str(get_args(setting.type)[1]) for setting in fields(cls) if setting.name == name)

    @classmethod
    def of(cls, controller: Controller, **changes: ArrayLike) -> Self:
        """The default settings for a controller, from the robot's limits and its mass matrix at the domain's centre.

        Args:
            controller: the law.
            changes: other values by name; one number stands for all.

        Raises:
            InvalidValueError, ShapeError: for unknown names, values of the wrong shape or range, and integral action
                faster than the law bears somewhere in its domain (`integral_bound` of torque laws).
        """
        require_controller(controller)
        robot, n, domain = controller.problem.robot, controller.problem.n, controller.problem.domain
        # The mass matrix at the centre, and gravity and the span of the quantities at samples.
        M = np.asarray(robot.mass_matrix(domain.centre))
        points = sample_uniform(domain, RULES.samples, RULES.seed)
        gravity = np.abs(robot.gravity(points)).max(axis=0)
        measured = Batched(controller.measured)(points)[0]
        span = np.nanmax(measured, axis=0) - np.nanmin(measured, axis=0)
        torque = controller.command == "torque"
        speed_limit = np.where(np.isfinite(robot.velocity_limits), robot.velocity_limits, RULES.speed)
        slow = np.minimum(RULES.return_speed, speed_limit / 3)
        efforts = np.where(np.isfinite(robot.effort_limits), robot.effort_limits, gravity)
        # Joints without a limit of effort may stick too, and on vertical axes no gravity says how much.
        stiction = np.where(np.isfinite(robot.effort_limits), 0.0, RULES.friction)
        # Motors of sliding joints have the force of many newtons, and give it as soon as others their torque.
        sliding = np.where(
            robot.tree.prismatic & np.isfinite(robot.effort_limits), robot.effort_limits / RULES.full_force, 0.0
        )
        settings = {
            "command_rate": np.fmax(RULES.torque_rate, sliding) if torque else np.full(n, RULES.acceleration),
            "speed_limit": speed_limit,
            "rest_speed": np.full(n, RULES.rest_speed),
            "near_margin": 0.06,
            "catch_margin": 0.01,
            "return_margin": 0.1,
            "fade_in": 0.02,
            "fade_out": 0.03,
            "return_speed": RULES.return_speed,
            "error_limit": 0.15 * span,
            "reference_speed": RULES.fraction * speed_limit,
            "reference_acceleration": speed_limit / RULES.starting,
            "offset_rate": 1 / _compute_joint_motion(controller, points, slow),
            "integral_rate": 0 * span,
            "integral_limit": 0.05 * span,
            "hold_ticks": 10,
            "stale_ticks": 5,
            "stuck_speed": np.minimum(RULES.stuck_speed, RULES.stuck * speed_limit)
            if torque
            else np.full(n, RULES.stuck_way),
            "longest_period": 0.02,
            "observer_rate": np.zeros(n),
            "encoder_step": np.zeros(n),
            "friction": np.clip(RULES.stiction * efforts, stiction, RULES.most_friction),
            "lower": robot.lower,
            "upper": robot.upper,
            "stop_zone": np.fmin(RULES.zone, RULES.zone * (robot.upper - robot.lower)),
            "stop_stiffness": np.full(n, RULES.stops**2 if torque else RULES.stops),
            "stop_damping": np.full(n, 2 * RULES.stops),
            "damping": RULES.catcher if torque else RULES.anchor,
            "brake_stiffness": RULES.catcher**2,
            "brake_yield": 0.5 * gravity + 10 * np.diag(M),
            "contact_torque": np.full(n, np.inf),
            "energy_limit": np.inf,
            "energy_rate": RULES.power,
            "start_mismatch": RULES.friction + RULES.error * efforts,
        }
        unknown = sorted(set(changes) - set(settings))
        if unknown:
            raise InvalidValueError("setting", repr(unknown[0]), f"one of {', '.join(settings)}")
        spread = {name: _spread(name, value, settings[name]) for name, value in changes.items()}
        # Coarse encoders need an observer of velocities, and the coarser they are, a slower one.
        if "encoder_step" in spread and "observer_rate" not in spread:
            fine = np.where(robot.tree.prismatic, RULES.fine_step / RULES.turn_per_metre, RULES.fine_step)
            coarseness = np.asarray(spread["encoder_step"]) / fine
            spread["observer_rate"] = np.where(coarseness > 0, RULES.observer * np.maximum(coarseness, 0.25) ** -0.5, 0)
        rate = float(np.asarray(spread.get("integral_rate", 0.0), dtype=float).max(initial=0.0))
        if rate > 0 and rate > (bound := getattr(controller, "integral_bound", np.inf)):
            raise InvalidValueError("integral_rate", rate, f"at most {bound:.3g}/s, which the slowest mode bears")
        return cls(**{**settings, **spread})


def _compute_joint_motion(controller: Controller, points: Array, slow: Array) -> Array:
    """Time that joints take at slow speeds (n,) per unit of each controlled quantity, at 90 % of the points (k,)."""
    n, m, relative = controller.problem.n, controller.problem.m, Relative(controller.problem.task)
    # Threads share the law.
    with deferred(), building:
        q = ca.MX.sym("q", n)
        moving = ca.vertcat(relative.rates(q), ca.jacobian(controller.measured(q)[m:], q))
        function = dense_function("J", [q], [moving])
    # The slowest joint counts, at 90 % of the points.
    J = Batched(function)(points)[0].reshape(len(points), -1, n)
    largest = (np.abs(np.linalg.pinv(J[np.isfinite(J).all(axis=(1, 2))])) / slow[:, None]).max(axis=1)
    return np.asarray(np.quantile(largest, 0.9, axis=0))


def _spread(name: str, value: ArrayLike, default: object) -> object:
    """One number for all entries of an array; other values are checked."""
    if not isinstance(default, np.ndarray):
        return value
    numbers = as_float_array(name, value)
    if numbers.ndim:
        require_shape(name, numbers.shape, default.shape)
    return np.full(default.shape, numbers)
