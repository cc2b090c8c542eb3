"""Suggest a domain: the widest box around a posture on which a chart has the quality that is asked (ours)."""

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from orthocas.checks import Array, as_number, require_count, require_kind
from orthocas.domains import Box
from orthocas.errors import DomainError, InvalidValueError
from orthocas.fitting.fit import Fit, fit
from orthocas.fitting.idle_joints import idle_joints
from orthocas.fitting.settings import default_parametrisation, require_parametrisation
from orthocas.metrics import Metric, MetricSpec
from orthocas.minimising.watch import Monitor, silent
from orthocas.parametrisations import Parametrisation, cyclic_joints
from orthocas.postures.home import home_posture
from orthocas.postures.probe import Bounds, Miss, Prober, Verdict, judged_chart
from orthocas.postures.suggestion import JUDGES, DomainSuggestion, JointWidth, Reason
from orthocas.postures.widest import REMEDIES, WidestBox
from orthocas.problem import Problem, check
from orthocas.robots import Robot
from orthocas.robots.tree import PRISMATIC_ROOM, REVOLUTE_ROOM
from orthocas.samples import sample_problem
from orthocas.tasks import Task

LEAK_DEG, CONDITIONING = 8.0, 0.2  #: what is asked by default
_MARGIN = 1.25  # trial charts keep a higher conditioning, since a fit is judged at more points
_FARTHEST = np.pi  # largest half-width of a revolute joint [rad]: a full turn
_LONGEST = 1.0  # largest half-width of a prismatic joint without limits [m]
_CHECKED = 200  # samples that tell whether the task can be regular at all, and which joints are idle
_SHRINK, _TRIES = 0.92, 8  # after a fit that misses a bound


def suggest_domain(
    robot: Robot,
    task: Task,
    home: ArrayLike | str | None = None,
    metric: Metric | MetricSpec = "euclidean",
    *,
    leak_deg: float = LEAK_DEG,
    conditioning: float = CONDITIONING,
    parametrisation: Parametrisation | None = None,
    seed: int = 0,
    monitor: Monitor = silent,
) -> DomainSuggestion:
    """The widest box around a posture, inside the joint limits, on which a chart has the quality that is asked.

    Quadratic charts on trial boxes tell leak and conditioning in a fraction of a second. A search over the half-widths
    of the joints takes the box with the largest volume that keeps both bounds, and a fit confirms it: if the fit misses
    a bound, the box shrinks by 8 %. Idle and cyclic joints take their whole range. The result is deterministic.

    Args:
        robot: the robot.
        task: a task of that robot. A missing reference orientation is taken at the home.
        home: centre of the box, (n,) [rad] or [m], or the name of a posture of the robot's files. Default: the first
            named posture that is regular and away from the limits, otherwise the most regular bent posture.
        metric: as in `Problem`.
        leak_deg: largest leak: the root mean square angle, in the metric, between the gradients of the fitted
            coordinates and the space orthogonal to the task [deg]. 8 degrees couple accelerations by sin 8 = 14 %.
        conditioning: smallest conditioning, at samples of which two thirds lie near faces and corners; 0 to 1.
        parametrisation: the family of the fit. Default: Polynomial(degree=4), of degree 3 for more than 8 joints.
        seed: seed of the fit.
        monitor: called with progress.

    Raises:
        DomainError: if the home lies at a joint limit, or no box around it keeps the bounds. The message says which
            bound breaks, and what may help.
        SingularTaskError: if the task is singular everywhere.
        UnknownNameError: if there is no posture of that name.
        InvalidValueError, NotRedundantError: if an argument is invalid.
        KeyboardInterrupt: after Ctrl-C; `Interrupted` with the fit on the box found, if it comes during a fit.

    Source:
        ours, docs/domains.md.

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
    bounds = _checked(robot, task, leak_deg, conditioning, seed)
    if parametrisation is not None:
        require_parametrisation(parametrisation)
    posture = home_posture(robot, task, home)
    room = np.minimum(_room(robot, posture.q), _farthest(robot))
    problem = Problem(robot, task, metric, Box(posture.q, np.minimum(_unit(robot), room)))
    check(problem, _CHECKED)
    joints = _Joints.of(problem)
    prober = Prober(problem, joints.active, joints.cyclic)
    stricter = replace(bounds, conditioning=min(1.0, _MARGIN * bounds.conditioning))
    widths, broken = WidestBox(prober, posture.q, room, joints.free, stricter, monitor).found(_unit(robot))
    wanted = default_parametrisation(problem, bounded=True) if parametrisation is None else parametrisation
    found, verdict = _confirmed(problem, wanted, joints, widths, bounds, seed, monitor)
    return DomainSuggestion(
        fit=found,
        home=posture.q,
        home_source=posture.source,
        joints=joints.described(found.chart.problem, broken),
        asked=bounds,
        leak_deg=verdict.leak_deg,
        conditioning=verdict.conditioning,
        worst_point=tuple(verdict.worst_point.tolist()),
        seconds=time.perf_counter() - start,
    )


@dataclass(frozen=True)
class _Joints:
    """The roles of the joints: idle and cyclic ones take their whole range, the others are free."""

    names: tuple[str, ...]
    idle: tuple[int, ...]
    cyclic: tuple[str, ...]

    @classmethod
    def of(cls, problem: Problem) -> "_Joints":
        idle = idle_joints(problem, sample_problem(problem, _CHECKED, 0))[-problem.r :]
        return cls(problem.robot.joint_names, tuple(idle), cyclic_joints(problem))

    @property
    def active(self) -> list[int]:
        """Joints that coordinates are fitted in."""
        return [k for k in range(len(self.names)) if k not in self.idle]

    @property
    def free(self) -> list[int]:
        """Joints whose half-widths are searched."""
        return [k for k in self.active if self.names[k] not in self.cyclic]

    def described(self, problem: Problem, broken: Mapping[int, list[Miss]]) -> tuple[JointWidth, ...]:
        """Half-widths of the problem's domain, with what ends them.

        Args:
            problem: the problem on the suggested domain.
            broken: the bounds that break if a joint moves further; none for joints that have no room.
        """
        robot, domain = problem.robot, problem.domain
        limited = _room(robot, domain.centre) <= _farthest(robot)
        found = []
        for k, name in enumerate(self.names):
            reason: Reason = "joint limit" if limited[k] else "unlimited"
            if broken.get(k):
                reason = broken[k][0]
            if k not in self.free:
                reason = "idle" if k in self.idle else "cyclic"
            found.append(JointWidth(name, float(domain.half_width[k]), reason))
        return tuple(found)


def _checked(robot: Robot, task: Task, leak_deg: float, conditioning: float, seed: int) -> Bounds:
    require_kind("robot", robot, Robot)
    require_kind("task", task, Task)
    require_count("seed", seed, least=0)
    if not 0 < as_number("leak_deg", leak_deg) < 90:
        raise InvalidValueError("leak_deg", leak_deg, "an angle between 0 and 90 degrees")
    if not 0 < as_number("conditioning", conditioning) < 1:
        raise InvalidValueError("conditioning", conditioning, "a number between 0 and 1")
    return Bounds(float(leak_deg), float(conditioning))


def _unit(robot: Robot) -> Array:
    """Half-widths whose proportions a search starts from, (n,)."""
    return np.where(robot.tree.prismatic, PRISMATIC_ROOM, REVOLUTE_ROOM)


def _room(robot: Robot, q: Array) -> Array:
    """Distances of a posture from the nearest joint limits, (n,)."""
    room: Array = np.minimum(q - robot.lower, robot.upper - q)
    return room


def _farthest(robot: Robot) -> Array:
    """Largest half-widths that a search tries, (n,): a full turn, the joint's own range, or 1 m."""
    endless = np.isinf(robot.lower) | np.isinf(robot.upper)
    return np.where(robot.tree.prismatic, np.where(endless, _LONGEST, np.inf), _FARTHEST)


def _confirmed(
    problem: Problem,
    parametrisation: Parametrisation,
    joints: _Joints,
    widths: Array,
    bounds: Bounds,
    seed: int,
    monitor: Monitor,
) -> tuple[Fit, Verdict]:
    """A fit that keeps the bounds, and its quality. The box shrinks until there is one."""
    robot = problem.robot
    unbounded = [k for k in joints.idle if np.isinf(robot.lower[k]) and np.isinf(robot.upper[k])]
    factors = np.where(np.isin(np.arange(robot.n), joints.free), _SHRINK, 1.0)
    for shrinkings in range(_TRIES):
        box = Box(problem.domain.centre, widths * factors**shrinkings, unbounded)
        trial = Problem(robot, problem.task, problem.metric, box, problem.name)
        found = fit(trial, parametrisation, seed=seed, monitor=monitor)
        verdict = judged_chart(found.chart, JUDGES, seed + 1)
        if max(verdict.excess(bounds).values()) <= 1:
            return found, verdict
    raise DomainError(
        f"fits of {parametrisation.label} miss the bounds on {_TRIES} ever smaller boxes around the home: the last one "
        f"has a leak of {verdict.leak_deg:.3g} deg and a conditioning of {verdict.conditioning:.3g}; {REMEDIES}"
    )
