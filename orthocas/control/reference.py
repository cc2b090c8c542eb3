"""References over time: steps, splines, low-pass filters, and whether joints can follow them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from math import factorial
from typing import Any, Self

import casadi as ca
import numpy as np
import scipy
from numpy.typing import ArrayLike

from orthocas.charts.chart import Chart
from orthocas.charts.self_motion import too_far
from orthocas.charts.trackers import Tracker, TrackerStatus
from orthocas.control.gains import positive_gains
from orthocas.errors import (
    InvalidValueError,
    InverseError,
    OrthocasError,
    UnreachableReferenceError,
    degrees_hint,
)
from orthocas.tools.batch import Batched, dense_function
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import (
    Array,
    as_number,
    as_point,
    freeze_array,
    import_extra,
    require_at_least,
    require_kind,
    require_known,
    require_positive,
)
from orthocas.tools.display import Shown, listed, number_list

NATURAL_FREQUENCY = 2 * np.pi  #: omega0 [rad/s] of [AS2023] Sec. 8
DAMPING_RATIO = 0.7  #: zeta of [AS2023] Sec. 8
Change = tuple[float, Mapping[str, float]]  #: a time [s] and the new targets by label


@dataclass(frozen=True, slots=True)
class ReferenceRules:
    """Numbers of references."""

    grid: float = 0.05  #: largest distance of grid times [s]
    swing: float = 0.3  #: phase of the low-pass oscillation between them; 0.048 s for the paper's filter [rad]
    degree: int = 5  #: of splines through points


RULES = ReferenceRules()
_VALUES = "; targets of a Reference are values of phi, not changes of it ('move' in a steps file is a change)"


@dataclass(frozen=True, eq=False, repr=False)
class Reference(Shown):
    """phi_d(t) and two derivatives, smooth on each of S segments; `steps`, `through` and `jerk_limited` build one."""

    labels: tuple[str, ...]  #: names of the k quantities
    times: Array  #: (S + 1,) starts of the segments, then the end [s]
    targets: Array  #: (S, k) targets of the segments
    start: Array  #: (k,) value at the start
    parameters: Array  #: (S, p) inputs of the profile
    profile: ca.Function  #: time since the start of the segment, parameters -> value, velocity, acceleration (k, 1)
    spacing: float = RULES.grid  #: [s], fine enough to resolve every oscillation

    @classmethod
    def steps(
        cls,
        labels: Sequence[str],
        start: ArrayLike,
        changes: Sequence[Change],
        duration: float,
        natural_frequency: float = NATURAL_FREQUENCY,
        damping_ratio: float = DAMPING_RATIO,
    ) -> Self:
        """Steps of the target, filtered by dd_phi_d = omega0^2 (target - phi_d) - 2 zeta omega0 d_phi_d.

        Args:
            labels: names of the quantities, as in the controller.
            start: value at t = 0, where the reference is at rest, (k,).
            changes: pairs (time, {label: new target}) in order of time, 0 <= time < duration. Targets are values, not
                changes of values; a steps file has both, 'to' and 'move'.
            duration: [s].
            natural_frequency: omega0 > 0 [rad/s].
            damping_ratio: zeta >= 0.

        Raises:
            InvalidValueError, UnknownNameError, ShapeError: for arguments of the wrong value, label or shape.

        Source:
            [AS2023] Sec. 8.

        Example:
            >>> import orthocas as oc
            >>> reference = oc.control.Reference.steps(["x", "xi1"], [1.0, 0.0], [(0.5, {"x": 1.2})], duration=4.0)
            >>> value, velocity, acceleration = reference.sample([0.0, 4.0])
            >>> value.round(2).tolist()
            [[1.0, 0.0], [1.2, 0.0]]
        """
        names = _check_names(labels)
        value = freeze_array("start", start, (len(labels),))
        omega0 = require_positive("natural_frequency", natural_frequency)
        require_positive("duration", duration)
        zeta = require_at_least("damping_ratio", damping_ratio, 0)
        times, targets = _build_stairs(names, value, changes, duration)
        # Each segment starts where the one before ends.
        profile = build_low_pass(len(names), omega0, zeta)
        run = Batched(profile)
        parameters = [np.concatenate([targets[0], value, np.zeros_like(value)])]
        for target, lasted in zip(targets[1:], np.diff(times)[:-1], strict=True):
            position, velocity, _ = (out[0] for out in run(np.array([[lasted]]), parameters[-1][None]))
            parameters.append(np.concatenate([target, position, velocity]))
        return cls(names, times, targets, value, np.array(parameters), profile, min(RULES.grid, RULES.swing / omega0))

    @classmethod
    def through(cls, labels: Sequence[str], times: ArrayLike, points: ArrayLike) -> Self:
        """A spline of degree 5 through points, at rest at both ends; velocity and acceleration are continuous.

        Args:
            labels: names of the quantities.
            times: (N,) increasing, from 0 [s], N >= 2.
            points: (N, k).

        Raises:
            InvalidValueError, ShapeError: for arguments of the wrong value or shape.
        """
        names = _check_names(labels)
        t = freeze_array("times", times, (None,))
        values = freeze_array("points", points, (len(t), len(names)))
        if len(t) < 2 or t[0] != 0 or np.diff(t).min() <= 0:
            raise InvalidValueError("times", t.tolist(), "at least two increasing times that begin with 0")
        # At rest at both ends; the profile takes the polynomials one by one, highest power first.
        rest = [(order, np.zeros(len(names))) for order in (1, 2)]
        spline = scipy.interpolate.make_interp_spline(t, values, RULES.degree, bc_type=(rest, rest))
        taylor = [spline(t[:-1], order) / factorial(order) for order in reversed(range(RULES.degree + 1))]
        coefficients = np.stack(taylor, axis=2).reshape(len(t) - 1, -1)
        spacing = min(RULES.grid, float(np.diff(t).min()) / 4)
        return cls(names, t, values[1:], values[0], coefficients, _build_polynomial(len(names)), spacing)

    @classmethod
    def jerk_limited(
        cls,
        labels: Sequence[str],
        points: ArrayLike,
        velocity: ArrayLike,
        acceleration: ArrayLike,
        jerk: ArrayLike,
        pause: float = 0.0,
    ) -> Self:
        """The fastest way from point to point within limits of velocity, acceleration and jerk, at rest at each point.

        All quantities of a way end together. Accelerations are continuous, so torques do not jump.

        Args:
            labels: names of the quantities.
            points: (N, k), N >= 2; the first is where the reference starts.
            velocity: limit of each quantity or of all, (k,), > 0 [1/s].
            acceleration: the same [1/s^2].
            jerk: the same [1/s^3].
            pause: rest at each point but the first [s], >= 0.

        Raises:
            InvalidValueError, ShapeError: for arguments of the wrong value or shape.
            MissingExtraError: without the package ruckig.

        Source:
            [BK2021]
        """
        names = _check_names(labels)
        values = freeze_array("points", points, (None, len(names)))
        if len(values) < 2:
            raise InvalidValueError("number of points", len(values), "at least 2")
        limits = {"velocity": velocity, "acceleration": acceleration, "jerk": jerk}
        sizes = {name: positive_gains(name, limit, len(names)) for name, limit in limits.items()}
        require_at_least("pause", pause, 0)
        times, targets, coefficients = [0.0], [], []
        for start, end in pairwise(values):
            # Between its corners, the way is cubic; a pause is a way that stays.
            corners, states = _plan_way(start, end, sizes)
            for (begin, finish), state in zip(pairwise(corners), states, strict=True):
                times.append(times[-1] + finish - begin)
                coefficients.append(state)
                targets.append(end)
            if pause > 0:
                times.append(times[-1] + pause)
                coefficients.append(np.column_stack([np.zeros((len(names), RULES.degree)), end]))
                targets.append(end)
        if len(times) == 1:
            raise InvalidValueError("points", values.tolist(), "points that differ, or a pause")
        parameters = np.array(coefficients).reshape(len(targets), -1)
        spacing = min(RULES.grid, times[-1] / 100)
        return cls(
            names, np.array(times), np.array(targets), values[0], parameters, _build_polynomial(len(names)), spacing
        )

    def facts(self) -> dict[str, str]:
        """Quantities, time, start and targets."""
        return {
            "reference": f"{len(self.labels)} quantities, {self.duration:.4g} s in {len(self.parameters)} segments",
            "quantities": listed(self.labels),
            "times": number_list(self.times),
            "start": listed(f"{value:.4g}" for value in self.start),
            "end": listed(f"{value:.4g}" for value in self.targets[-1]),
        }

    @property
    def duration(self) -> float:
        """Length [s]."""
        return float(self.times[-1])

    def segment(self, times: Array) -> Array:
        """Index of the segment that contains each time; a time on a boundary belongs to the later segment."""
        return np.clip(np.searchsorted(self.times, times, side="right") - 1, 0, len(self.parameters) - 1)

    def sample(self, times: ArrayLike) -> tuple[Array, Array, Array]:
        """Value, velocity and acceleration at times (N,), three arrays (N, k).

        Raises:
            InvalidValueError: for a time before the start or after the end.
        """
        t = freeze_array("times", times, (None,))
        if len(t) and not (t.min() >= 0 and t.max() <= self.duration * (1 + 1e-9)):
            bad = t.min() if t.min() < 0 else t.max()
            raise InvalidValueError("time of a reference", bad, f"from 0 to {self.duration:g} s")
        k = self.segment(t)
        value, velocity, acceleration = self._batched((t - self.times[k])[:, None], self.parameters[k])
        return value, velocity, acceleration

    def grid(self) -> Array:
        """Times from start to end, at most `spacing` apart [s]."""
        return np.linspace(0.0, self.duration, max(2, int(np.ceil(self.duration / self.spacing)) + 1))

    @cached_property
    def _batched(self) -> Batched:
        return Batched(self.profile)


@lru_cache(32)
def build_low_pass(k: int, natural_frequency: float, damping_ratio: float) -> ca.Function:
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
    # cosine and sine of the damped oscillation, each with its limit where it does not swing.
    t, parameters = ca.SX.sym("t"), ca.SX.sym("parameters", 3 * k)
    target, value0, velocity0 = parameters[:k], parameters[k : 2 * k], parameters[2 * k :]
    decay, beat = damping_ratio * natural_frequency, natural_frequency * np.sqrt(abs(1 - damping_ratio**2))
    if np.isclose(damping_ratio, 1.0, rtol=0, atol=1e-9):
        cosine, sine = ca.exp(-decay * t), t * ca.exp(-decay * t)
    elif damping_ratio < 1:
        cosine, sine = ca.exp(-decay * t) * ca.cos(beat * t), ca.exp(-decay * t) * ca.sin(beat * t) / beat
    else:
        # Hyperbolic functions, written so that they do not overflow.
        slow, fast = ca.exp((beat - decay) * t), ca.exp(-(beat + decay) * t)
        cosine, sine = (slow + fast) / 2, (slow - fast) / (2 * beat)
    e0 = value0 - target
    e = e0 * cosine + (velocity0 + decay * e0) * sine
    velocity = velocity0 * cosine - (decay * velocity0 + natural_frequency**2 * e0) * sine
    acceleration = -2 * decay * velocity - natural_frequency**2 * e
    return dense_function("low_pass", [t, parameters], [target + e, velocity, acceleration])


@lru_cache(32)
def _build_polynomial(k: int) -> ca.Function:
    """Time and coefficients of k polynomials, highest power first -> value and two derivatives."""
    t, coefficients = ca.SX.sym("t"), ca.SX.sym("coefficients", k * (RULES.degree + 1))
    table = ca.reshape(coefficients, RULES.degree + 1, k).T
    value = ca.SX(table @ ca.vertcat(*(t ** (RULES.degree - i) for i in range(RULES.degree + 1))))
    velocity = ca.jacobian(value, t)
    return dense_function("spline", [t, coefficients], [value, velocity, ca.jacobian(velocity, t)])


def _plan_way(start: Array, end: Array, limits: Mapping[str, Array]) -> tuple[list[float], list[Array]]:
    """Corners in time of the way from rest to rest, and before each the coefficients (k, 6), highest power first."""
    ruckig: Any = import_extra("ruckig", "a jerk-limited reference", "jerk")
    wish, planned = ruckig.InputParameter(len(start)), ruckig.Trajectory(len(start))
    wish.current_position, wish.target_position = start.tolist(), end.tolist()
    for name, limit in limits.items():
        setattr(wish, f"max_{name}", limit.tolist())
    try:
        result = ruckig.Ruckig(len(start)).calculate(wish, planned)
    except ruckig.RuckigError:
        result = ruckig.Result.Error
    if result not in (ruckig.Result.Working, ruckig.Result.Finished) or not np.isfinite(planned.duration):
        raise InvalidValueError("points", [start.tolist(), end.tolist()], "a way and limits of similar sizes")
    phases = [np.cumsum(profile.t) for profile in planned.profiles[0]]
    corners = np.unique(np.clip(np.concatenate([[0.0, planned.duration], *phases]), 0, planned.duration))
    corners = np.append(corners[:-1][np.diff(corners) > 1e-9], corners[-1]) if planned.duration > 0 else corners[:1]
    states = []
    for begin, finish in pairwise(corners.tolist()):
        position, velocity, acceleration = (np.array(part) for part in planned.at_time(begin)[:3])
        # The jerk is constant; taken in the middle, it does not feel rounding at the corners.
        quarter, three = (np.array(planned.at_time(begin + share * (finish - begin))[2]) for share in (0.25, 0.75))
        jerk = (three - quarter) / (0.5 * (finish - begin))
        acceleration = quarter - 0.25 * (finish - begin) * jerk
        zeros = np.zeros_like(position)
        states.append(np.column_stack([zeros, zeros, jerk / 6, acceleration / 2, velocity, position]))
    return corners.tolist(), states


def _check_names(labels: Sequence[str]) -> tuple[str, ...]:
    require_kind("labels", labels, Sequence)
    if isinstance(labels, str) or not all(isinstance(label, str) for label in labels):
        raise InvalidValueError("labels", repr(labels)[:80], "a sequence of names")
    return tuple(labels)


def _build_stairs(
    labels: tuple[str, ...], start: Array, changes: Sequence[Change], duration: float
) -> tuple[Array, Array]:
    """Segment boundaries (S + 1,) and targets (S, k)."""
    times, targets = [0.0], [start]
    require_kind("changes", changes, Sequence)
    for change in changes:
        if not isinstance(change, Sequence) or len(change) != 2:
            raise InvalidValueError("an entry of changes", repr(change)[:80], "a time and targets, (0.5, {'x': 0.1})")
        time, moves = change
        at = as_number("time of a step", time)
        if not times[-1] <= at < duration:
            raise InvalidValueError("time of a step", at, f"from {times[-1]:g} to below the duration {duration:g} s")
        target = targets[-1].copy()
        require_kind("targets of a step", moves, Mapping)
        for label, value in moves.items():
            require_known("quantity", label, labels)
            target[labels.index(label)] = float(freeze_array(f"target of {label}", value, ()))
        # Changes at one time are one step.
        if at == times[-1]:
            targets[-1] = target
        else:
            times.append(at)
            targets.append(target)
    return np.array([*times, float(duration)]), np.array(targets)


def joint_path(chart: Chart, reference: Reference, q_start: ArrayLike) -> Array:
    """Joint positions with phi(q) equal to the reference, followed from q_start, (N, n) on `reference.grid()`.

    Raises:
        UnreachableReferenceError: names the first time at which no such q exists near the previous one, or q lies
            outside the domain.
    """
    require_kind("chart", chart, Chart)
    require_kind("reference", reference, Reference)
    q_start = as_point("q_start", q_start, chart.n)
    if reference.labels != chart.labels:
        raise InvalidValueError("labels of the reference", reference.labels, f"those of the chart {chart.labels}")
    if not chart.problem.domain.contains(q_start):
        hint = degrees_hint(*q_start[~np.array(chart.problem.robot.tree.prismatic)])
        raise UnreachableReferenceError(f"the start lies outside the domain: {_explain_outside(chart, q_start)}{hint}")
    times = reference.grid()
    targets = reference.targets[reference.segment(times)]
    path, q, tracker = np.empty((len(times), chart.n)), q_start, _start_tracker(chart, q_start)
    for k, value in enumerate(reference.sample(times)[0]):
        words = ", ".join(f"{label} = {number:.3g}" for label, number in zip(reference.labels, value, strict=True))
        place, failure = f"at t = {times[k]:.3g} s, at {words}", ""
        # A tracker solves phi(q) = value; where it gives up or J is singular, the inverse map takes more care.
        solution = q if tracker is None else tracker.step(value)
        if tracker is None or tracker.status != TrackerStatus.OK:
            try:
                solution = chart.inverse(value, q, outside=True)
                tracker = _start_tracker(chart, solution)
            except InverseError as error:
                failure = f"cannot be reached {place}: {error}"
        if not failure and not chart.problem.domain.contains(solution):
            failure = f"leaves the domain {place}: {_explain_outside(chart, solution)}"
        if failure:
            hint = too_far(chart, q, targets[k, chart.m :])
            raise UnreachableReferenceError(f"the reference {failure}{hint}{_VALUES}")
        path[k] = q = solution
    return path


def _start_tracker(chart: Chart, q: Array) -> Tracker | None:
    """None for grown coordinates, a singular J, or a point outside the domain."""
    try:
        return chart.tracker(q)
    except OrthocasError:
        return None


def _explain_outside(chart: Chart, q: Array) -> str:
    domain = chart.problem.domain
    if domain.condition is not None and not np.all(np.asarray(domain.condition.pivots(q)) > 0):
        return domain.explain(q)
    # The joint that is farthest out, in widths of its range.
    low, high = domain.bounds
    i = int(np.argmax(np.abs(q - domain.centre) / (high - low)))
    low, high = low[i], high[i]
    return f"joint '{chart.problem.robot.joint_names[i]}' at {q[i]:.4g}, expected within [{low:.4g}, {high:.4g}]"
