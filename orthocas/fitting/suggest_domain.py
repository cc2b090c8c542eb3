"""`suggest_domain`: the largest box around a posture on which a chart has the required quality."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from orthocas.bases.cyclic import cyclic_joints
from orthocas.bases.family import Parametrisation, require_parametrisation
from orthocas.charts.point_quality import worst_points
from orthocas.errors import DomainError, InvalidValueError, MetricError
from orthocas.fitting.fit import Fit, fit_from
from orthocas.fitting.probe import RULES, Bounds, Miss, Prober, Quality, describe_conditioning, evaluate_chart
from orthocas.fitting.stages import choose_parametrisation
from orthocas.fitting.terms import DEFAULT_WEIGHTS, WeightNumbers, Weights
from orthocas.robots.robot import Robot
from orthocas.robots.tree import PRISMATIC_ROOM, REVOLUTE_ROOM, require_driven
from orthocas.tasks.domains import Box, Domain
from orthocas.tasks.metric import Metric, MetricSpec
from orthocas.tasks.problem import Problem, check
from orthocas.tasks.regular_box import find_home
from orthocas.tasks.samples import find_idle_joints, sample_problem
from orthocas.tasks.task import Task
from orthocas.tools.checks import Array, as_number, require_count, require_kind
from orthocas.tools.display import Shown, listed, number_list
from orthocas.tools.json import collect_attributes
from orthocas.tools.progress import Monitor, Progress, silent

_STAGE = "suggest a domain"
#: what may help if no box keeps the bounds
REMEDIES = (
    "another home (home=..., --centre or --home), another metric (metric=..., --metric), a larger leak_deg "
    "(--leak-deg) or a smaller conditioning (--conditioning) may help"
)
LEAK_DEG, CONDITIONING = RULES.leak_deg, RULES.conditioning  #: default bounds

Reason = Literal["joint limit", "unlimited", "idle", "cyclic", "leak", "conditioning", "singularity", "half a turn"]
_WORDS: dict[Reason, str] = {
    "joint limit": "to the joint limit",
    "unlimited": "as far as tried",
    "idle": "idle, whole range",
    "cyclic": "cyclic, whole range",
    "leak": "ended by the leak",
    "conditioning": "ended by conditioning",
    "singularity": "ended by singularity",
    "half a turn": "ended by half a turn",
}


def suggest_domain(
    robot: Robot,
    task: Task,
    home: ArrayLike | str | None = None,
    metric: Metric | MetricSpec = "euclidean",
    *,
    leak_deg: float = LEAK_DEG,
    conditioning: float = CONDITIONING,
    parametrisation: Parametrisation | None = None,
    weights: Weights | WeightNumbers = DEFAULT_WEIGHTS,
    seed: int = 0,
    monitor: Monitor = silent,
) -> DomainSuggestion:
    """The largest box around a posture, inside the joint limits, on which a chart has the required quality.

    Quadratic charts on trial boxes give leak and conditioning in a fraction of a second. A search over the half-widths
    of the joints finds the box with the largest volume that keeps both bounds. Then a fit confirms it: if the fit
    misses a bound, or if descents find a point with less than half of the required conditioning, the box shrinks by
    8 %. Idle and cyclic joints take their whole range. The result is deterministic.

    Args:
        robot: the robot.
        task: a task of that robot. If it lacks a reference orientation, the one at the home is taken.
        home: centre of the box, (n,) [rad] or [m], or the name of a posture of the robot's files. Default: the first
            named posture that is regular and away from the limits, otherwise the most regular bent posture.
        metric: as in `Problem`.
        leak_deg: largest leak: the root mean square angle, in the metric, between the gradients of the fitted
            coordinates and the space orthogonal to the task [deg]. 8 degrees couple accelerations by sin 8 = 14 %.
        conditioning: smallest conditioning, at samples of which two thirds lie near faces and corners; 0 to 1.
        parametrisation: the family of the fit. Default: Polynomial(degree=4); of degree 3 for more
            than 8 joints, and of degree 2 from 12.
        weights: weights of the fits, as in `fit`.
        seed: seed of the fit.
        monitor: called with progress.

    Raises:
        DomainError: if the home lies at a joint limit, or no box around it keeps the bounds. The message says which
            bound breaks, and what may help.
        SingularTaskError: if the task is singular everywhere.
        UnknownNameError: if there is no posture of that name.
        InvalidValueError, NotRedundantError: if an argument is invalid.
        KeyboardInterrupt: after Ctrl-C during the search.
        Interrupted: after Ctrl-C during the fit on the box found; its `result` is that fit.

    Source:
        ours, docs/explanation/domains.md.

    Example:
        >>> import orthocas as oc
        >>> robot = oc.Robot.planar(lengths=[1.0, 1.0, 1.0], masses=[3.0, 3.0, 3.0])
        >>> found = oc.suggest_domain(robot, oc.Task.position(robot, "xy"), [0.6, 0.8, 0.8])
        >>> [joint.reason for joint in found.joints][0]
        'cyclic'
        >>> found.leak_deg < 8.0, found.conditioning > 0.2
        (True, True)
    """
    start = time.perf_counter()
    require_kind("robot", robot, Robot)
    require_driven("suggesting a domain", robot.tree)
    require_kind("task", task, Task)
    require_count("seed", seed, least=0)
    if not 0 < as_number("leak_deg", leak_deg) < 90:
        raise InvalidValueError("leak_deg", leak_deg, "an angle between 0 and 90 degrees")
    if not 0 < as_number("conditioning", conditioning) < 1:
        raise InvalidValueError("conditioning", conditioning, "a number between 0 and 1")
    bounds, loss = Bounds(float(leak_deg), float(conditioning)), Weights.of(weights)
    if parametrisation is not None:
        require_parametrisation(parametrisation)
    # Build the problem around the home, and find the joints whose half-widths are searched
    posture = find_home(robot, task, home)
    room = np.minimum(_measure_room(robot, posture.q), _bound_widths(robot))
    problem = Problem(robot, task, metric, Box(posture.q, np.minimum(_propose_widths(robot), room)))
    check(problem, RULES.checked)
    joints = _Joints.of(problem)
    prober = Prober(problem, joints.active, joints.cyclic, loss)
    stricter = replace(bounds, conditioning=min(1.0, RULES.margin * bounds.conditioning))
    # Find the largest box for trial charts, and confirm it by a fit
    widths, broken = WidestBox(prober, posture.q, room, joints.free, stricter, monitor).search(_propose_widths(robot))
    family = choose_parametrisation(problem, bounded=True) if parametrisation is None else parametrisation
    fit, quality = _confirm(prober, family, joints, widths, bounds, seed, monitor)
    return DomainSuggestion(
        fit=fit,
        home=posture.q,
        home_source=posture.source,
        joints=joints.describe(fit.chart.problem, broken),
        asked=bounds,
        leak_deg=quality.leak_deg,
        conditioning=quality.conditioning,
        worst_point=tuple(quality.worst_point.tolist()),
        seconds=time.perf_counter() - start,
    )


@dataclass(frozen=True)
class _Joints:
    """The roles of the joints: idle and cyclic ones take their whole range, the others are free."""

    names: tuple[str, ...]
    idle: tuple[int, ...]
    cyclic: tuple[str, ...]

    @classmethod
    def of(cls, problem: Problem) -> _Joints:
        idle = find_idle_joints(problem, sample_problem(problem, RULES.checked, 0))[-problem.r :]
        return cls(problem.robot.joint_names, tuple(idle), cyclic_joints(problem))

    @property
    def active(self) -> list[int]:
        """Joints that fitted coordinates depend on."""
        return [k for k in range(len(self.names)) if k not in self.idle]

    @property
    def free(self) -> list[int]:
        """Joints whose half-widths are searched."""
        return [k for k in self.active if self.names[k] not in self.cyclic]

    def describe(self, problem: Problem, broken: Mapping[int, list[Miss]]) -> tuple[JointWidth, ...]:
        """Half-widths of the problem's domain, and the reason that limits each of them.

        Args:
            problem: the problem on the suggested domain.
            broken: the bounds that break if a joint moves further; empty lists for joints without room.
        """
        robot, domain = problem.robot, problem.domain
        limited = _measure_room(robot, domain.centre) <= _bound_widths(robot)
        widths = []
        # Whole ranges come before bounds, and bounds before limits
        for k, name in enumerate(self.names):
            reason: Reason = "joint limit" if limited[k] else "unlimited"
            if broken.get(k):
                reason = broken[k][0]
            if k not in self.free:
                reason = "idle" if k in self.idle else "cyclic"
            widths.append(JointWidth(name, float(domain.half_width[k]), reason))
        return tuple(widths)


def _propose_widths(robot: Robot) -> Array:
    """Half-widths (n,), whose proportions the search starts from."""
    return np.where(robot.tree.prismatic, PRISMATIC_ROOM, REVOLUTE_ROOM)


def _measure_room(robot: Robot, q: Array) -> Array:
    """Distances (n,) of a posture from the nearest joint limits [rad] or [m]."""
    room: Array = np.minimum(q - robot.lower, robot.upper - q)
    return room


def _bound_widths(robot: Robot) -> Array:
    """Largest half-widths (n,) that a search tries.

    Pi for revolute joints [rad]; no bound for slides with limits; 1 m for slides without.
    """
    endless = np.isinf(robot.lower) | np.isinf(robot.upper)
    return np.where(robot.tree.prismatic, np.where(endless, RULES.longest, np.inf), RULES.farthest)


@dataclass(eq=False)
class WidestBox:
    """Search for the half-widths with the largest product that keep the bounds.

    First, a common scale of all half-widths is found. Then, in rounds of exchange, joints whose widening costs little
    become wider, the others narrower, and the scale is adapted until the bounds hold. At the optimum, widening costs
    the same for all free joints.

    Args:
        prober: fits on trial boxes and evaluates them.
        home: centre of the boxes, (n,).
        room: largest half-widths, (n,).
        free: joints to widen. The others have their full room.
        bounds: bounds to keep.
        monitor: called with progress.
    """

    prober: Prober
    home: Array
    room: Array
    free: list[int]
    bounds: Bounds
    monitor: Monitor
    probes: int = 0
    _fraction: float = 0.0  #: finished part of the search, about, for the monitor
    _next: tuple[float, int] = (0.0, 1)  #: that fraction at the end of the present step, and trials until then, about

    def search(self, unit: Array) -> tuple[Array, dict[int, list[Miss]]]:
        """Half-widths (n,), and for every free joint the bounds that break if it alone becomes a fifth wider.

        The list of a joint is empty if it has no room to become wider.

        Args:
            unit: half-widths to start from, (n,); only their proportions count.

        Raises:
            DomainError: if no box around the home keeps the bounds.
        """
        if not self.free:
            return self.room.copy(), {}
        # Estimate for the monitor which fraction of the time each step takes
        count, rounds = len(self.free), max(1, RULES.exchanged // len(self.free))
        times = [RULES.first_time, *[count + RULES.next_time] * rounds]
        ends = np.cumsum(times) / (sum(times) + RULES.growth_time * count)
        self._next = ends[0], RULES.trials
        widths, exchange, step = self._scale_to_boundary(unit, RULES.start), None, 1.0
        # Rounds of exchange: joints that cost little become wider, those that cost much narrower
        for end in ends[1:]:
            self._next = end, count + RULES.trials
            exchange = self._compute_exchange(widths) if exchange is None else exchange
            trial = self._scale_to_boundary(widths * np.exp(-step * exchange), 1.0)
            if np.log(trial[self.free]).sum() > np.log(widths[self.free]).sum():
                widths, exchange = trial, None
                continue
            # If the volume fell, try half of the exchange
            step /= 2
            if step < RULES.least_step:
                break
        return self._grow(widths)

    def evaluate(self, widths: Array, enough: Bounds | None = None, leap: bool = False) -> Quality:
        """Fit and evaluate on the box of the given half-widths, see `Prober.evaluate`."""
        self.probes += 1
        detail = f"trial {self.probes}: mean half-width {widths[self.free].mean():.3g}"
        until, trials = self._next
        self._fraction += (until - self._fraction) / max(2, trials)
        self._next = until, trials - 1
        self.monitor(Progress(_STAGE, self._fraction, detail))
        try:
            return self.prober.evaluate(Box(self.home, widths), enough, leap)
        except MetricError:
            # A(q) is singular where the axes of links without mass are parallel: the box must not reach such postures
            if widths[self.free].max() < RULES.smallest:
                raise
            return Quality(0.0, 1.0, self.home, task_value=0.0, turn_value=1.0)

    def _clip(self, widths: Array) -> Array:
        clipped = self.room.copy()
        clipped[self.free] = np.minimum(widths, self.room)[self.free]
        return clipped

    def _measure_excess(self, widths: Array) -> float:
        return max(self.evaluate(widths, leap=True).excess(self.bounds).values())

    def _scale_to_boundary(self, unit: Array, scale: float) -> Array:
        """The largest multiple of half-widths `unit` (n,) that keeps the bounds, by bisection from a first scale."""
        low, high = 0.0, np.inf
        while high > RULES.close * low:
            widths = self._clip(scale * unit)
            if self.evaluate(widths, self.bounds).keeps(self.bounds):
                low = scale
                if np.array_equal(widths, self.room):
                    break
            else:
                high = scale
            if high < RULES.smallest:
                # Report which bound breaks even on this small box
                quality = self.evaluate(widths)
                miss = next(iter(quality.excess(self.bounds)))
                raise DomainError(
                    f"no box around the home {np.round(self.home, 4).tolist()} keeps the bounds: with half-widths of "
                    f"{widths[self.free].max():.1g} {quality.explained(miss, self.bounds)}; {REMEDIES}"
                )
            scale = (
                low * RULES.step if np.isinf(high) else high / RULES.step if low == 0 else float(np.sqrt(low * high))
            )
        self.prober.go_back()
        return self._clip(low * unit)

    def _compute_exchange(self, widths: Array) -> Array:
        """Logarithms (n,) of the factors by which joints become narrower: each one's cost minus the mean cost."""
        costs, here = np.zeros(len(widths)), self._measure_excess(widths)
        open_joints = [k for k in self.free if widths[k] < self.room[k]]
        for k in open_joints:
            costs[k] = np.log(self._measure_excess(self._widen(widths, k)) / here) / np.log(RULES.wider)
        if open_joints:
            costs[open_joints] -= costs[open_joints].mean()
        return np.clip(costs, -RULES.largest_exchange, RULES.largest_exchange)

    def _grow(self, widths: Array) -> tuple[Array, dict[int, list[Miss]]]:
        """Widen each joint alone as long as the bounds are kept; returns half-widths and the bounds that break then."""
        broken: dict[int, list[Miss]] = {k: [] for k in self.free}
        # Steps of a joint grow while the bounds are kept, and begin small again after a step that breaks one
        begin = self._fraction
        for done, k in enumerate(self.free, 1):
            self._next = begin + (1 - begin) * done / len(self.free), 2
            before, factor = widths[k], RULES.wider
            while widths[k] < self.room[k]:
                # Only the first step of a joint may need a fit. The smallest step that breaks bounds ends the joint
                wider = self._widen(widths, k, factor)
                ratios = self.evaluate(wider, self.bounds, leap=widths[k] > before).excess(self.bounds)
                misses = [name for name, ratio in ratios.items() if ratio > 1]
                if misses and factor == RULES.wider:
                    broken[k] = misses
                    break
                widths = widths if misses else wider
                factor = RULES.wider if misses else factor**2
        self.prober.go_back()
        return widths, broken

    def _widen(self, widths: Array, k: int, factor: float = RULES.wider) -> Array:
        wider = widths.copy()
        wider[k] = min(factor * widths[k], self.room[k])
        return wider


def _confirm(
    prober: Prober,
    parametrisation: Parametrisation,
    joints: _Joints,
    widths: Array,
    bounds: Bounds,
    seed: int,
    monitor: Monitor,
) -> tuple[Fit, Quality]:
    """Fit on the box, and shrink it until the fit keeps the bounds; returns the fit and its quality.

    Raises:
        DomainError: if no fit keeps the bounds, after 12 boxes.
    """
    problem, robot = prober.problem, prober.problem.robot
    unbounded = [k for k in joints.idle if np.isinf(robot.lower[k]) and np.isinf(robot.upper[k])]
    factors = np.where(np.isin(np.arange(robot.n), joints.free), RULES.shrink, 1.0)
    last, enough = "has too small a conditioning", RULES.descent * bounds.conditioning
    for shrinkings in range(RULES.tries):
        box = Box(problem.domain.centre, widths * factors**shrinkings, unbounded)
        trial = Problem(robot, problem.task, problem.metric, box, problem.name)
        # Skip the fit if descents find too small a conditioning: with many coordinates, that is ten times as fast
        if not prober.least(trial, seed + 1) >= enough:
            continue
        fit = fit_from(prober.start_on, trial, parametrisation, prober.weights, seed, monitor)
        quality = evaluate_chart(fit.chart, RULES.confirmed, seed + 1)
        least = worst_points(fit.chart.problem, fit.chart.coordinates, seed + 1).least
        if least >= enough and quality.keeps(bounds):
            return fit, quality
        worst = describe_conditioning(min(least, quality.conditioning))
        last = f"has a leak of {quality.leak_deg:.3g} deg and {worst}"
    raise DomainError(
        f"{parametrisation.label} misses the bounds on {RULES.tries} ever smaller boxes around the home: the last one "
        f"{last}; {REMEDIES}"
    )


@dataclass(frozen=True)
class JointWidth:
    """How wide a suggested box is in one joint, and what limits it.

    The reasons "leak", "conditioning", "singularity" and "half a turn" (of the tool, from the reference) name the bound
    that breaks first if this joint alone moves a fifth further. A joint is "unlimited" if it reaches a full turn, or
    1 m, without breaking a bound.
    """

    joint: str
    half_width: float  #: [rad] or [m]
    reason: Reason

    @property
    def explanation(self) -> str:
        """The reason in words."""
        return _WORDS[self.reason]


@dataclass(frozen=True, eq=False, repr=False)
class DomainSuggestion(Shown):
    """A domain with the required quality, and the fit that confirms it; see `suggest_domain`."""

    fit: Fit  #: the fit on the suggested domain
    home: Array  #: the posture, (n,) [rad] or [m]
    home_source: str  #: where it comes from, in words
    joints: tuple[JointWidth, ...]  #: one per joint
    asked: Bounds
    leak_deg: float  #: of the fit, root mean square over the domain [deg]
    conditioning: float  #: of the fit: the smallest at samples, of which two thirds lie near faces and corners
    worst_point: tuple[float, ...]  #: where the conditioning is smallest [rad] or [m]
    seconds: float

    @property
    def problem(self) -> Problem:
        """Robot, task, metric and suggested domain."""
        return self.fit.chart.problem

    @property
    def domain(self) -> Domain:
        """The suggested domain."""
        return self.problem.domain

    def facts(self) -> dict[str, str]:
        """The box, what limits it, and the quality of the fit."""
        reasons = dict.fromkeys(joint.reason for joint in self.joints)
        ends = {_WORDS[why]: listed(joint.joint for joint in self.joints if joint.reason == why) for why in reasons}
        label = self.fit.chart.coordinates.label
        worst = f"{self.conditioning:.3g} at {RULES.confirmed} samples, most near faces and corners"
        return {
            "suggestion": f"half-width {number_list(self.domain.half_width)}, {self.seconds:.3g} s",
            "home": f"{number_list(self.home)} ({self.home_source})",
            **ends,
            "leak": f"{self.leak_deg:.3g} deg with {label}, asked <= {self.asked.leak_deg:g}",
            "conditioning": f"at least {worst}, asked >= {self.asked.conditioning:g}",
        }

    def as_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        quality = ("leak_deg", "conditioning", "worst_point", "asked", "seconds")
        return collect_attributes(self, "home", "home_source", "joints", *quality)
