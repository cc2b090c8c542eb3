"""Gains: their values and settings, the stiffness by modes of the loop, the modes, and what the motors can hold."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from orthocas.charts.chart import Chart
from orthocas.charts.point_quality import least_in_domain
from orthocas.errors import InvalidValueError
from orthocas.robots.robot import Robot
from orthocas.tasks.domains import Domain
from orthocas.tasks.metric import require_mass
from orthocas.tasks.samples import sample_uniform
from orthocas.tools.checks import (
    Array,
    as_float_array,
    as_number,
    as_point_set,
    freeze_array,
    require_at_least,
    require_kind,
    require_shape,
)
from orthocas.tools.display import Shown, number_list, percent

STIFFNESS, FASTEST, COMPLIANCE, DAMPING_RATIO, FEEDBACK, LIMIT = (  #: units of gains, in words
    "J per squared unit of the quantity, > 0",
    "frequency that no mode of the loop exceeds [rad/s], > 0",
    "of each joint, in series with the springs [rad/(N m)], >= 0",
    ">= 0, 1 is critical damping",
    "1/s, >= 0",
    "largest command per joint, > 0; INFINITY for no limit",
)


@dataclass(frozen=True, slots=True)
class GainRules:
    """Numbers of gains. What the default stiffness holds: docs/measurements/control.md."""

    frequency: float = 12 * np.pi  #: of the springs, 6 Hz [rad/s]
    fastest: float = 36 * np.pi  #: mode, 18 Hz: stable with a delay of 6.5 ms at a damping ratio of 0.7 [rad/s]
    stiff: float = 2.0  #: springs of tracking laws, in their fastest frequency: modes of heavy directions come near it
    torque_rate: float = 1000.0  #: of motors, 1 N m in a millisecond, as on many arms [N m/s] or [N/s]
    taken_over: float = 0.5  #: or the speed limit: speed of a joint that a law takes over [rad/s] or [m/s]
    late: float = 4.0  #: rate that the springs of such a joint may ask for, in torque_rate; with 10, an arm is lost
    feedback: float = 10.0  #: of velocity laws: 0.23 s to a tenth; no overshoot with up to 36 ms to the motion [1/s]
    margin: float = np.pi / 6  #: 30 degrees of phase that are left to the fastest mode at a stated delay [rad]
    samples: int = 512  #: of the domain
    seed: int = 0  #: of the samples
    rounds: int = 12  #: of descents for a delay
    close: float = 1.05  #: excess of squared frequencies over a bound that is left to scaling
    too_fast: float = 3000.0  #: weight of the squared logarithm by which a mode exceeds the fastest frequency


RULES = GainRules()


def tracking_gains(chart: Chart, delay: float = 0.0, damping_ratio: ArrayLike = 0.7) -> tuple[Array, float, Array]:
    """Stiffness of [x; xi], (n,), fastest mode omega [rad/s], and joint compliances (n,), with which all modes settle.

    No constant K does this on a wide chart: wrists turn from light to heavy directions, so if no mode may be fast, some
    are slow. Each spring K is therefore in series with one of omega^2 M_phi (`limit_stiffness`), and its squared
    frequency s becomes s omega^2 / (omega^2 + s) <= omega^2. omega is 18 Hz, and K that of `matched_stiffness` at
    2 omega without a bound. Light directions come near omega, and where coordinates fold (M_phi grows) the stiffness
    stays below K.

    Heavy joints are softer, because motors could not follow: a joint that moves at v = 0.5 rad/s (or its speed limit,
    if that is less) changes the torque of a spring k by k v. It is at most 4 N m in a millisecond, so joints have the
    compliance v / (4000 N m/s) in series. With a delay T, omega <= omega_T leaves 30 deg of phase, see
    `matched_stiffness`.
    """
    omega = min(RULES.fastest, find_fastest_frequency(delay, damping_ratio, chart))
    speeds = np.minimum(RULES.taken_over, chart.problem.robot.velocity_limits)
    return matched_stiffness(chart, RULES.stiff * omega, np.inf), omega, speeds / (RULES.late * RULES.torque_rate)


def limit_stiffness(
    mobility: Array, J: Array, stiffness: Array, fastest: float, compliance: Array, blocks: Sequence[int]
) -> Array:
    """K(q) = (K^-1 + M_phi^-1 / omega^2 + J diag(c) J^T)^-1 of each block of coordinates, (N, n, n).

    For M_phi^-1 and J (N, n, n), and K, c (n,).
    """
    result, added = np.zeros_like(mobility), mobility / fastest**2 + (J * compliance) @ J.transpose(0, 2, 1)
    for part in np.split(np.arange(len(stiffness)), np.cumsum(blocks)[:-1]):
        place = np.ix_(np.arange(len(mobility)), part, part)
        result[place] = np.linalg.inv(np.diag(1 / stiffness[part]) + added[place])
    return result


def find_fastest_frequency(delay: float, damping_ratio: ArrayLike, chart: Chart) -> float:
    """omega_T [rad/s]: the fastest mode that keeps 30 deg of phase with a delay T >= 0 [s]; infinite without one.

    Raises:
        InvalidValueError: for other delays, and a damping ratio that leaves less than 30 deg without any delay.
    """
    if not require_at_least("delay", delay, 0):
        return float(np.inf)
    # At the crossing a omega, the phase of (2 zeta omega s + omega^2) exp(-s T) / s^2 is atan(2 zeta a) - a omega T.
    ratio = float(positive_gains("damping_ratio", damping_ratio, chart.n).min())
    crossing = np.sqrt(2 * ratio**2 + np.sqrt(4 * ratio**4 + 1))
    phase = np.arctan(2 * ratio * crossing) - RULES.margin
    if phase <= 0:
        need = "a larger one: this leaves less than 30 deg without a delay"
        raise InvalidValueError("damping_ratio", ratio, need)
    return float(phase / (crossing * delay))


def matched_stiffness(
    chart: Chart,
    frequency: float = RULES.frequency,
    fastest: float = RULES.fastest,
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
    # Grown charts raise here.
    chart.function("xi")
    require_mass(chart.problem.robot, "gains by modes")
    bound = min(as_number("fastest", fastest), find_fastest_frequency(delay, damping_ratio, chart))
    points = sample_uniform(chart.problem.domain, RULES.samples, RULES.seed)
    mobilities = compute_mobility(chart, points, chart.problem.robot)
    return _match(mobilities, frequency, bound) if not delay else _match_everywhere(chart, mobilities, frequency, bound)


def _match_everywhere(chart: Chart, mobilities: Array, frequency: float, bound: float) -> Array:
    """The stiffness with all modes below the bound: postures that descents find to be too fast join the samples."""
    robot, corners = chart.problem.robot, np.empty((0, chart.n, chart.n))
    for _ in range(RULES.rounds):
        stiffness = _match(mobilities, frequency, bound, corners)
        # The fastest mode that descents find with this stiffness.
        W = compute_mobility(chart, find_fastest_posture(chart, stiffness, robot)[None], robot)
        root = np.sqrt(stiffness)
        excess = float(np.linalg.eigvalsh(root[:, None] * W[0] * root)[-1]) / bound**2
        if excess <= RULES.close:
            break
        corners = np.concatenate([corners, W])
    return np.asarray(stiffness / max(1.0, excess))


def _match(mobilities: Array, frequency: float, fastest: float, bounded: Array | None = None) -> Array:
    """The stiffness for M_phi^-1 at several postures, (N, n, n); singular postures are left out.

    `bounded` are further ones, whose modes are only kept from being too fast, each with the weight of all others.
    """
    omega = float(positive_gains("frequency", frequency, 1)[0])
    if not as_number("fastest", fastest) > 0:
        raise InvalidValueError("fastest", fastest, "a number > 0 or infinity")
    W = mobilities[np.isfinite(mobilities).all(axis=(1, 2))]
    W = W[np.linalg.eigvalsh(W)[:, 0] > 0]
    # The start is the solution where W is diagonal.
    start = -np.log(np.median(np.diagonal(W, axis1=1, axis2=2), axis=0))
    bound, count = 2 * np.log(fastest / omega), len(W)
    W = W if bounded is None else np.concatenate([W, bounded])
    spread, excess = (np.append(np.full(count, 1 / count), np.full(len(W) - count, more)) for more in (0.0, 1.0))
    solution = scipy.optimize.minimize(_compute_spread, start, (W, bound, spread, excess), method="BFGS", jac=True)
    return np.asarray(omega**2 * np.exp(solution.x))


def _compute_spread(log_stiffness: Array, W: Array, bound: float, spread: Array, excess: Array) -> tuple[float, Array]:
    """Sum of spread sum_i log^2(lambda_i) + excess 3000 max(0, log(lambda_i) - bound)^2 for K = exp(log_stiffness).

    Weights are those of postures (N,). With unit eigenvectors v_i, d log(lambda_i) / d log(K_j) = v_ij^2: the gradient.
    """
    root = np.exp(log_stiffness / 2)
    values, vectors = np.linalg.eigh(root[:, None] * W * root)
    logs = np.log(values.clip(np.finfo(float).tiny))
    above = (logs - bound).clip(0)
    slopes = 2 * (spread[:, None] * logs + RULES.too_fast * excess[:, None] * above)
    cost = spread @ (logs**2).sum(axis=1) + RULES.too_fast * excess @ (above**2).sum(axis=1)
    return float(cost), (vectors**2 @ slopes[..., None])[..., 0].sum(axis=0)


def find_fastest_posture(chart: Chart, stiffness: Array, robot: Robot) -> Array:
    """The posture of the domain with the fastest mode that descents find, (n,)."""
    scale = np.sqrt(stiffness)

    def slowness(q: Array) -> Array:
        W = scale[:, None] * compute_mobility(chart, q, robot) * scale
        finite = np.asarray(np.isfinite(W).all(axis=(1, 2)))
        return np.where(finite, -np.linalg.eigvalsh(np.where(finite[:, None, None], W, 0))[:, -1], np.nan)

    return least_in_domain(slowness, chart.problem.domain)


def compute_mobility(chart: Chart, points: ArrayLike, robot: Robot) -> Array:
    """M_phi^-1 = J M^-1 J^T of a robot at points (N, n), (N, n, n)."""
    J, M = chart.parts.batched_rates(as_point_set("points", points, chart.n)[0]), robot.mass_matrix(points)
    return np.asarray(J @ np.linalg.solve(M, J.transpose(0, 2, 1)))


@dataclass(frozen=True, eq=False, repr=False)
class Modes(Shown):
    """Modes of M_phi dde + D de + K e = 0 at one posture (n,) or at several (N, n).

    Mode i has the shape v_i with K v_i = omega_i^2 M_phi v_i and v_i^T M_phi v_i = 1. Its damping ratio is
    v_i^T D v_i / (2 omega_i). This is exact if D is diagonal in the modes, as for coupled laws with `double_diagonal`
    and one damping ratio for all.
    """

    frequencies: Array  #: [Hz], in ascending order
    damping_ratios: Array  #: infinite for a mode without a spring
    delays: Array  #: longest delay of the loop with which the mode alone stays stable [s]

    def facts(self) -> dict[str, str]:
        """Frequencies, damping ratios and delay."""
        return {
            "modes": f"{number_list(np.median(np.atleast_2d(self.frequencies), axis=0))} Hz",
            "fastest": f"{self.frequencies.max():.4g} Hz",
            "damping ratios": f"{self.damping_ratios.min():.3g} to {self.damping_ratios.max():.3g}",
            "delay": f"stable up to {1e3 * self.delays.min():.3g} ms",
        }


def compute_modes(mobility: Array, stiffness: Array, damping: Array) -> Modes:
    """Modes for M_phi^-1 (N, n, n), K (N, n, n), and D (N, n, n).

    With S = M_phi^-1/2 and the unit eigenvectors u_i of S K S, v_i = S u_i.
    """
    # The root S of M_phi^-1.
    values, vectors = np.linalg.eigh(mobility)
    half = (vectors * np.sqrt(values.clip(0))[:, None, :]) @ vectors.transpose(0, 2, 1)
    squares, shapes = np.linalg.eigh(half @ stiffness @ half)
    omega = np.sqrt(squares.clip(0))
    # 2 zeta omega of each mode [1/s].
    rates = np.einsum("kij,kij->kj", shapes, half @ damping @ half @ shapes)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = rates / (2 * omega)
    # With the delay T, s^2 + (rate s + omega^2) exp(-s T) = 0 gets a root i Omega. The modulus gives
    # Omega^2 = rate^2/2 + sqrt(rate^4/4 + omega^4), the phase T = atan(rate Omega / omega^2) / Omega.
    crossing = np.sqrt(rates**2 / 2 + np.sqrt(rates**4 / 4 + omega**4))
    with np.errstate(divide="ignore", invalid="ignore"):
        delays = np.asarray(np.arctan2(rates * crossing, omega**2) / crossing)
    return Modes(omega / (2 * np.pi), ratios, delays)


def find_holding_doubts(robot: Robot, domain: Domain, limit: Array) -> list[str]:
    """What to know of an arm whose motors cannot hold it: one sentence, or none if they can at all samples.

    A joint is held at q if |g_i(q)| <= limit_i. The sentence names the joint that lacks most at the centre of the
    domain, or else at the worst sample, and the share of uniform samples at which some joint is not held, rounded up.

    Args:
        robot: the arm, with its payload.
        domain: where it is to be held.
        limit: largest torque or force of each joint, (n,) [N m] or [N], infinite where there is none.
    """
    points = np.vstack([domain.home, sample_uniform(domain, RULES.samples, RULES.seed)])
    needed = np.abs(robot.gravity(points))
    excess = needed / limit
    heavy = (excess > 1).any(axis=1)
    if not heavy.any():
        return []
    # The home comes first among the points.
    worst = 0 if heavy[0] else int(np.argmax(excess.max(axis=1)))
    joint = int(np.argmax(excess[worst]))
    unit = "N" if robot.tree.prismatic[joint] else "N m"
    where, most = ("at the centre of", "") if heavy[0] else ("everywhere in", "up to ")
    fraction = percent(heavy[1:].mean(), fault=True)
    return [
        f"the motors cannot hold the arm {where} the domain: gravity needs {most}{needed[worst, joint]:.4g} {unit} at "
        f"joint '{robot.joint_names[joint]}', the limit is {limit[joint]:.4g} {unit}, and at {fraction} of "
        f"{RULES.samples} samples of the domain gravity alone exceeds a limit"
    ]


def positive_gains(name: str, value: ArrayLike, length: int) -> Array:
    """Finite numbers > 0, (length,), from one number or (length,)."""
    gains = spread_gains(name, value, length)
    _require(name, gains, gains > 0, "positive numbers")
    return gains


def non_negative_gains(name: str, value: ArrayLike, length: int) -> Array:
    """Finite numbers >= 0, (length,), from one number or (length,)."""
    gains = spread_gains(name, value, length)
    _require(name, gains, gains >= 0, "numbers >= 0")
    return gains


def command_limit(name: str, value: ArrayLike | None, default: Array) -> Array:
    """Numbers > 0, (n,), possibly infinite; the limits of the robot if `value` is None."""
    length = len(default)
    limit = np.array(np.broadcast_to(_check_length(name, default if value is None else value, length), (length,)))
    _require(name, limit, limit > 0, "positive numbers")
    limit.setflags(write=False)
    return limit


def spread_gains(name: str, value: ArrayLike, length: int) -> Array:
    """Finite numbers (length,), from one number or (length,)."""
    return freeze_array(name, np.broadcast_to(_check_length(name, value, length), (length,)), (length,))


def _check_length(name: str, value: ArrayLike, length: int) -> Array:
    array = as_float_array(name, value)
    if array.ndim:
        require_shape(name, array.shape, (length,))
    return array


def _require(name: str, gains: Array, good: NDArray[np.bool_], want: str) -> None:
    bad = np.flatnonzero(~good)
    if bad.size:
        raise InvalidValueError(f"{name}[{bad[0]}]", gains[bad[0]], want)
