"""Settings that laws share: gains by stiffness and damping ratio, and the stiffness that two laws have in common."""

from dataclasses import dataclass, field

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from orthocas.charts.chart import Chart
from orthocas.charts.point_quality import least_in_domain
from orthocas.errors import InvalidValueError
from orthocas.robots.robot import Robot
from orthocas.tasks.metric import require_mass
from orthocas.tasks.samples import sample_uniform
from orthocas.tools.checks import (
    Array,
    as_float_array,
    as_number,
    as_point_set,
    freeze_array,
    require_kind,
    require_shape,
)

STIFFNESS, DAMPING_RATIO, FEEDBACK, LIMIT = (  #: units of gains, in words
    "J per squared unit of the quantity, > 0",
    ">= 0, 1 is critical damping",
    "1/s, >= 0",
    "largest command per joint, > 0; INFINITY for no limit",
)
SPRING_FREQUENCY = 12 * np.pi  #: [rad/s], 6 Hz; what it holds: docs/measurements/control.md
FASTEST = 36 * np.pi  #: [rad/s], 18 Hz: stable with a delay of 6.5 ms at a damping ratio of 0.7
MARGIN = np.pi / 6  #: [rad], 30 degrees of phase that are left to the fastest mode at a stated delay
_SAMPLES, _SEED = 512, 0
_ROUNDS, _CLOSE = 12, 1.05  # of descents for a delay; how much of a bound on squared frequencies is left to scaling
_TOO_FAST = 3000.0  # weight of the squared logarithm by which a mode exceeds the fastest frequency


@dataclass(frozen=True)
class Setting:
    """A setting of a law that commands offer as an option.

    Example:
        >>> from orthocas.control import Setting
        >>> Setting("Damping of the joints [N m s/rad]; default: 1.")
        Setting(help='Damping of the joints [N m s/rad]; default: 1.', is_word=False, codegen_only=False)
    """

    help: str  #: what it is, with its unit and default
    is_word: bool = False  #: passed on as text; otherwise it is one number, or several with commas between
    codegen_only: bool = False  #: about inputs that simulations do not give, so `orthocas simulate` does not offer it
    option: str = field(default="", repr=False)  #: its option of commands, if it is not named after the setting


STIFFNESS_SETTING = Setting('"100", or "100,50,..." per quantity; default: modes around 6 Hz.')
DAMPING_RATIO_SETTING = Setting('"0.7", or "0.7,1,..." per quantity; default: 0.7.')
DELAY_SETTING = Setting("Delay from measurement to torque that the default stiffness is to bear [s]; default: 0.")
FEEDBACK_SETTING = Setting("Feedback gain [1/s]; default: 0.")


def positive_gains(name: str, value: ArrayLike, length: int) -> Array:
    """Finite numbers > 0, (length,), from one number or (length,)."""
    gains = _spread(name, value, length)
    _require(name, gains, gains > 0, "positive numbers")
    return gains


def non_negative_gains(name: str, value: ArrayLike, length: int) -> Array:
    """Finite numbers >= 0, (length,), from one number or (length,)."""
    gains = _spread(name, value, length)
    _require(name, gains, gains >= 0, "numbers >= 0")
    return gains


def command_limit(name: str, value: ArrayLike | None, default: Array) -> Array:
    """Numbers > 0, (n,), possibly infinite; the limits of the robot if `value` is None."""
    length = len(default)
    limit = np.array(np.broadcast_to(_one_or(name, default if value is None else value, length), (length,)))
    _require(name, limit, limit > 0, "positive numbers")
    limit.setflags(write=False)
    return limit


def _spread(name: str, value: ArrayLike, length: int) -> Array:
    return freeze_array(name, np.broadcast_to(_one_or(name, value, length), (length,)), (length,))


def _one_or(name: str, value: ArrayLike, length: int) -> Array:
    array = as_float_array(name, value)
    if array.ndim:
        require_shape(name, array.shape, (length,))
    return array


def _require(name: str, gains: Array, good: NDArray[np.bool_], want: str) -> None:
    bad = np.flatnonzero(~good)
    if bad.size:
        raise InvalidValueError(f"{name}[{bad[0]}]", gains[bad[0]], want)


def matched_stiffness(
    chart: Chart,
    frequency: float = SPRING_FREQUENCY,
    fastest: float = FASTEST,
    delay: float = 0.0,
    damping_ratio: ArrayLike = 0.7,
) -> Array:
    """Stiffness of [x; xi], (n,), with which the closed loop has its modes around a frequency, and none too fast.

    At rest the loop is M_phi dde + D de + K e = 0 with M_phi = (J M^-1 J^T)^-1, so the squared frequencies lambda_i of
    its modes are the eigenvalues of K^1/2 J M^-1 J^T K^1/2. K minimises the mean over the domain of
    sum_i log^2(lambda_i / omega^2) + 3000 sum_i max(0, log(lambda_i / fastest^2))^2. As long as no mode comes near
    `fastest`, the geometric mean of all modes is omega. Single modes lie on both sides of it, because M_phi is not
    diagonal and varies; `modes` of a law lists them. Delays make fast modes unstable, so `fastest` takes stiffness
    from the coordinates that move light wrists.

    With a delay T, no mode anywhere in the domain is faster than omega_T = (atan(2 zeta a) - 30 deg) / (a T) with
    a^2 = 2 zeta^2 + sqrt(4 zeta^4 + 1), where 30 deg of phase are left; `fastest` is at most that. The fastest mode is
    found by descents (`least_in_domain`). Its posture joins the samples of the second sum, until no mode is too fast,
    or by so little that all of K can be scaled down.

    Args:
        chart: a chart with a closed expression.
        frequency: omega > 0 of the springs [rad/s].
        fastest: of all modes [rad/s], > 0; infinite: no bound. Without a delay it is kept at samples; in corners of
            the domain modes are faster, see `modes` of a law.
        delay: T >= 0 from the measurement to the torque [s], with half a period for torques that are held.
        damping_ratio: zeta > 0 of the law, (n,) or one number; the least counts. Used with a delay only.

    Raises:
        InvalidValueError: for other values, and a damping ratio that leaves less than 30 deg without any delay.
        MetricError: if a joint moves no mass.

    Source:
        ours, docs/explanation/derivations_control.md#stiffness
    """
    require_kind("chart", chart, Chart)
    chart.function("xi")  # raises for grown charts
    require_mass(chart.problem.robot, "gains by modes")
    if not 0 <= as_number("delay", delay) < np.inf:
        raise InvalidValueError("delay", delay, "a finite number >= 0")
    bearable = _bearable(delay, damping_ratio, chart.n) if delay else np.inf
    bound = min(as_number("fastest", fastest), bearable)
    points = sample_uniform(chart.problem.domain, _SAMPLES, _SEED)
    known = mobility(chart, points, chart.problem.robot)
    return _matched(known, frequency, bound) if not delay else _kept_everywhere(chart, known, frequency, bound)


def _kept_everywhere(chart: Chart, known: Array, frequency: float, bound: float) -> Array:
    """The stiffness with all modes below the bound: postures that descents find to be too fast join the samples."""
    robot, corners = chart.problem.robot, np.empty((0, chart.n, chart.n))
    for _ in range(_ROUNDS):
        stiffness = _matched(known, frequency, bound, corners)
        W = mobility(chart, fastest_posture(chart, stiffness, robot)[None], robot)
        root = np.sqrt(stiffness)
        excess = float(np.linalg.eigvalsh(root[:, None] * W[0] * root)[-1]) / bound**2
        if excess <= _CLOSE:
            break
        corners = np.concatenate([corners, W])
    return np.asarray(stiffness / max(1.0, excess))


def _bearable(delay: float, damping_ratio: ArrayLike, n: int) -> float:
    """The fastest mode [rad/s] that has the phase margin at a delay."""
    ratio = float(positive_gains("damping_ratio", damping_ratio, n).min())
    crossing = np.sqrt(2 * ratio**2 + np.sqrt(4 * ratio**4 + 1))
    phase = np.arctan(2 * ratio * crossing) - MARGIN
    if phase <= 0:
        raise InvalidValueError("damping_ratio", ratio, "a larger one: this leaves less than 30 deg without a delay")
    return float(phase / (crossing * delay))


def fastest_posture(chart: Chart, stiffness: Array, robot: Robot) -> Array:
    """The posture of the domain with the fastest mode that descents find, (n,)."""
    scale = np.sqrt(stiffness)

    def slowness(q: Array) -> Array:
        W = scale[:, None] * mobility(chart, q, robot) * scale
        known = np.asarray(np.isfinite(W).all(axis=(1, 2)))
        return np.where(known, -np.linalg.eigvalsh(np.where(known[:, None, None], W, 0))[:, -1], np.nan)

    return least_in_domain(slowness, chart.problem.domain)


def mobility(chart: Chart, points: ArrayLike, robot: Robot) -> Array:
    """M_phi^-1 = J M^-1 J^T of a robot at points (N, n), (N, n, n)."""
    J, M = chart.batched_rates(as_point_set("points", points, chart.n)[0]), robot.mass_matrix(points)
    return np.asarray(J @ np.linalg.solve(M, J.transpose(0, 2, 1)))


def _matched(mobilities: Array, frequency: float, fastest: float, bounded: Array | None = None) -> Array:
    """The stiffness for M_phi^-1 at several postures, (N, n, n); singular postures are left out.

    `bounded` are further ones, whose modes are only kept from being too fast, each with the weight of all others.
    """
    omega = float(positive_gains("frequency", frequency, 1)[0])
    if not as_number("fastest", fastest) > 0:
        raise InvalidValueError("fastest", fastest, "a number > 0 or infinity")
    W = mobilities[np.isfinite(mobilities).all(axis=(1, 2))]
    W = W[np.linalg.eigvalsh(W)[:, 0] > 0]
    start = -np.log(np.median(np.diagonal(W, axis1=1, axis2=2), axis=0))  # the solution where W is diagonal
    bound, count = 2 * np.log(fastest / omega), len(W)
    W = W if bounded is None else np.concatenate([W, bounded])
    spread, excess = (np.append(np.full(count, 1 / count), np.full(len(W) - count, more)) for more in (0.0, 1.0))
    found = scipy.optimize.minimize(_eigenvalue_spread, start, (W, bound, spread, excess), method="BFGS", jac=True)
    return np.asarray(omega**2 * np.exp(found.x))


def _eigenvalue_spread(
    log_stiffness: Array, W: Array, bound: float, spread: Array, excess: Array
) -> tuple[float, Array]:
    """Sum of spread sum_i log^2(lambda_i) + excess 3000 max(0, log(lambda_i) - bound)^2 for K = exp(log_stiffness).

    Weights are those of postures (N,). With unit eigenvectors v_i, d log(lambda_i) / d log(K_j) = v_ij^2: the gradient.
    """
    root = np.exp(log_stiffness / 2)
    values, vectors = np.linalg.eigh(root[:, None] * W * root)
    logs = np.log(values.clip(np.finfo(float).tiny))
    above = (logs - bound).clip(0)
    slopes = 2 * (spread[:, None] * logs + _TOO_FAST * excess[:, None] * above)
    cost = spread @ (logs**2).sum(axis=1) + _TOO_FAST * excess @ (above**2).sum(axis=1)
    return float(cost), (vectors**2 @ slopes[..., None])[..., 0].sum(axis=0)
