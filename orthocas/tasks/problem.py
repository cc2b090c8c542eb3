"""A problem: a robot, a task, a metric and a domain that fit together, and its file format."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from orthocas.errors import InvalidValueError, MetricError, NotRedundantError, SingularTaskError
from orthocas.robots.robot import Robot
from orthocas.robots.tree import KinematicTree
from orthocas.tasks.clear_box import default_domain, exclude_singular
from orthocas.tasks.domains import Domain, domain_from_data, require_within_limits
from orthocas.tasks.metric import Metric, MetricSpec
from orthocas.tasks.samples import compute_row_scale, sample_uniform
from orthocas.tasks.task import Task
from orthocas.tools.archive import Stored
from orthocas.tools.checks import Array, require_kind, require_shape, require_text
from orthocas.tools.display import Shown, listed, number_list
from orthocas.tools.expressions import read_tape, require_tape, wrap_shortest, write_tape
from orthocas.tools.json import get_part

NEAR_SINGULAR = 0.01  #: smallest relative singular value of the task below which a sample counts as singular
NEAR_HALF_A_TURN = 0.01  #: cos(angle / 2) below which a turn counts as half a turn: above 178.9 deg
_RANK_LOST = 1e-9
#: fields of trees with frames or mimic joints; files of other trees do not have them
_OF_FRAMES = {"tips", "frame_names", "frame_parents", "frame_rotations", "frame_translations"}
_OF_MIMICS = {"mimic_names", "mimic_kinds", "mimic_leaders", "mimic_factors", "mimic_offsets"}
#: errors that damaged headers cause while they are read, besides errors of our own
FOREIGN = (LookupError, TypeError, ValueError, AttributeError, ArithmeticError, RuntimeError, MemoryError)


@dataclass(frozen=True, eq=False, repr=False)
class Problem(Shown):
    """Find r = n - m coordinates xi(q) with J_x A^-1 J_xi^T = 0 on a domain ([AS2023] eq. (5)).

    Args:
        robot: the robot.
        task: a task of that robot, m < n. If it lacks a reference orientation, the one at the domain's centre is used.
        metric: "euclidean", "inertia", a constant SPD matrix (n, n), a map q -> A(q) on SX, or a Metric.
        domain: Box, Torus or another Domain inside the joint limits. Default: a box of 45 degrees about the centre of
            the limits, or about a bent posture where the task is regular; near-singular positions in it are left out.
        name: a name for reports.
        least_singular_value: bound on the relative singular value of the task; positions of the Box below it are left
            out of the domain, see `orthocas.ClearBox`. Default: no bound.

    Raises:
        NotRedundantError: if m >= n; the joints of a floating base do not count in n.
        DomainError: if the domain leaves the joint limits, or its centre is nearer to a singular position than allowed.
        MetricError: if a constant metric is not SPD, a joint moves no mass under "inertia", or a robot with a floating
            base has another metric than "inertia". Metrics that depend on q are checked by `check`, and later at every
            sample.

    Example:
        >>> import orthocas as oc
        >>> robot = oc.Robot.planar(lengths=[1.0, 1.0, 1.0], masses=[3.0, 3.0, 3.0])
        >>> task = oc.Task.position(robot, "xy")
        >>> problem = oc.Problem(robot, task, metric="inertia", domain=oc.Box([0.6, 0.8, 0.8], 0.4))
        >>> problem.n, problem.m, problem.r
        (3, 2, 1)
    """

    robot: Robot
    task: Task
    metric: Metric
    domain: Domain
    name: str

    def __init__(
        self,
        robot: Robot,
        task: Task,
        metric: Metric | MetricSpec = "euclidean",
        domain: Domain | None = None,
        name: str = "custom",
        least_singular_value: float | None = None,
    ) -> None:
        require_kind("robot", robot, Robot)
        require_kind("task", task, Task)
        if not task.robot.tree.equals(robot.tree):
            raise InvalidValueError("task", f"a task of another robot ({task.name})", "a task built on the same robot")
        if task.m >= robot.n - len(robot.tree.floating):
            raise NotRedundantError(task.m, robot.n - len(robot.tree.floating))
        # Check the domain against the limits; its centre gives a missing reference.
        domain = default_domain(robot, task) if domain is None else domain
        if not isinstance(domain, Domain):
            raise InvalidValueError("domain", repr(domain), "a Box, a Torus or another Domain")
        require_within_limits(robot, domain)
        task = task.with_reference_at(domain.home)
        domain = exclude_singular(domain, task, least_singular_value)
        # Check the metric against the robot. On a floating base it must be the inertia.
        metric = metric if isinstance(metric, Metric) else Metric.from_spec(robot, metric)
        require_shape("metric", metric.function.size_out(0), (robot.n, robot.n))
        if robot.tree.floating and not metric.is_inertia:
            raise MetricError(f"metric is '{metric.name}', expected 'inertia', because the base floats")
        for key, value in (
            ("robot", robot),
            ("task", task),
            ("metric", metric),
            ("domain", domain),
            ("name", require_text("name of a problem", str(name))),
        ):
            object.__setattr__(self, key, value)

    @property
    def n(self) -> int:
        """Number of joints."""
        return self.robot.n

    @property
    def m(self) -> int:
        """Number of task components."""
        return self.task.m

    @property
    def r(self) -> int:
        """Degree of redundancy n - m."""
        return self.n - self.m

    @property
    def turning(self) -> tuple[int, ...]:
        """Joints whose full turns lead to the same posture: unbounded revolute joints.

        Their turns do not change task, mass matrix and domain, but may change coordinates: a term b q_k grows by 2 pi
        b. On a torus there are none, because coordinates repeat too.
        """
        prismatic = self.robot.tree.prismatic
        return () if self.domain.full_turns else tuple(k for k in self.domain.unbounded if not prismatic[k])

    def unwrap(self, q: Any, near: Any) -> Any:
        """Remove full turns: q - 2 pi round((q - near) / (2 pi)) for joints in `turning`, and q for the others.

        Sensors may report angles with or without full turns; relative to the last position, they become continuous.

        Args:
            q: joint positions, NumPy rows (..., n), or a CasADi column (n, 1).
            near: positions near the result, of the same kind; (n,) applies to all rows.

        Returns:
            Positions of the shape of q, with |q_k - near_k| <= pi for the joints in `turning`.
        """
        if not self.turning:
            return q
        period = np.zeros(self.n)
        period[list(self.turning)] = 2 * np.pi
        return near + wrap_shortest(q - near, period)

    def facts(self) -> dict[str, str]:
        """Sizes, task, metric, domain and robot."""
        domain = self.domain
        joints = [self.robot.joint_names[k] for k in domain.unbounded]
        unbounded = f", unbounded in {listed(joints)}" if joints else ""
        return {
            "problem": f"{self.name}, n = {self.n} joints, m = {self.m} task, r = {self.r} extra",
            "task": self.task.heading,
            "metric": self.metric.name,
            "domain": f"{domain.name}, half-width {number_list(domain.half_width)}{unbounded}",
            **domain.describe_condition(),
            "centre": number_list(domain.centre),
            "robot": self.robot.heading,
        }


@dataclass(frozen=True)
class ProblemCheck:
    """The result of `check`."""

    samples: int
    singular_samples: int  #: samples with a relative singular value of the task below NEAR_SINGULAR
    smallest_singular_value: float  #: smallest relative singular value of the task, see `orthocas.ClearBox`
    most_singular_point: tuple[float, ...]  #: joint position of the smallest singular value [rad] or [m]
    half_turn_samples: int  #: samples where the tool is about half a turn from the reference, where x ends

    @property
    def half_turn_share(self) -> float:
        """Fraction of samples about half a turn from the reference."""
        return self.half_turn_samples / self.samples

    @property
    def singular_share(self) -> float:
        """Fraction of near-singular samples."""
        return self.singular_samples / self.samples


def check(problem: Problem, samples: int = 2000, seed: int = 0) -> ProblemCheck:
    """Check the metric (SPD) and the rank of the task on uniform samples of the domain.

    The rank is that of the rows of `orthocas.ClearBox`: of the frame Jacobian if the task compares orientations. Rows
    with the same unit are first divided by their root mean square length over the domain.

    Raises:
        MetricError: if A is not symmetric positive definite at a sample.
        SingularTaskError: if J_x loses rank at every sample, or is not finite at one.

    Example:
        >>> import orthocas as oc
        >>> from orthocas import problems
        >>> oc.check(problems.get("planar_3r_xy")).singular_share
        0.0
    """
    require_kind("problem", problem, Problem)
    points = sample_uniform(problem.domain, samples, seed)
    problem.metric.evaluate(points)
    smallest = relative_singular_values(problem, points)
    if smallest.max() < _RANK_LOST:
        raise SingularTaskError(
            f"the Jacobian of task '{problem.task.name}' has rank below m = {problem.m} "
            f"at all {samples} samples of the domain"
        )
    worst = int(np.argmin(smallest))
    return ProblemCheck(
        samples=samples,
        singular_samples=int((smallest < NEAR_SINGULAR).sum()),
        smallest_singular_value=float(smallest[worst]),
        most_singular_point=tuple(points[worst].tolist()),
        half_turn_samples=int((measure_half_turn_distance(problem, points) < NEAR_HALF_A_TURN).sum()),
    )


def relative_singular_values(problem: Problem, points: Array) -> Array:
    """Relative singular values of the task at points (N, n), (N,); see `orthocas.ClearBox`.

    Rows with the same unit are divided by their root mean square length at these points. A ClearBox uses its own rows
    and scale.

    Raises:
        SingularTaskError: if a task component does not depend on any joint, or J_x is not finite at a point.
    """
    task, domain = problem.task, problem.domain
    J = problem.task.evaluate_jacobian(points)
    # Each component must depend on some joint.
    idle = np.flatnonzero((J == 0).all(axis=(0, 2)))
    if idle.size:
        raise SingularTaskError(f"task component '{task.labels[idle[0]]}' does not depend on any joint")
    # A domain that bounds singular values has its own scale. Orientation tasks use the frame Jacobian.
    if domain.singular_bound is not None:
        return np.asarray(domain.singular_bound.singular_values(points))
    if task.turn is not None or task.parts:
        J = task.batched_frame_jacobian(points)[0].reshape(J.shape)
    return np.asarray(np.linalg.svd(J / compute_row_scale(J, task.units)[:, None], compute_uv=False)[:, -1])


def is_regular(problem: Problem, points: Array) -> NDArray[np.bool_]:
    """Whether J_x is far from losing rank at points (N, n), (N,): robot nonsingular, tool far from half a turn."""
    nonsingular = relative_singular_values(problem, points) >= NEAR_SINGULAR
    return nonsingular & (measure_half_turn_distance(problem, points) >= NEAR_HALF_A_TURN)


def measure_half_turn_distance(problem: Problem, points: Array) -> Array:
    """cos(angle / 2) of the tool's turn from the reference at points (N, n), (N,); 1 for tasks without a reference."""
    distances = np.ones(len(points))
    for task in problem.task.parts or (problem.task,):
        if task.turn is not None:
            x = task.batched(points)[0].reshape(-1, task.m)
            distances = np.minimum(distances, task.turn.measure_half_turn_distance(x))
    return distances


def measure_task_sizes(problem: Problem) -> Array:
    """Ranges of the task components over the domain, (m,): mean of sum_j |dh_i/dq_j| half_width_j at 32 samples.

    The result is 1 for a component that does not move, or whose gradient is not finite.
    """
    points = sample_uniform(problem.domain, 32, 0)
    J = problem.task.batched_jacobian(points)[0].reshape(-1, problem.m, problem.n)
    sizes = (np.abs(J) @ problem.domain.half_width).mean(axis=0)
    return np.where(np.isfinite(sizes) & (sizes > 0), sizes, 1.0)


def write_problem(problem: Problem) -> tuple[dict[str, Any], dict[str, Stored]]:
    """Parts 'robot' and 'problem' of a header, and arrays whose names begin with robot_ and domain_."""
    tree = problem.robot.tree
    numbers = {f.name: getattr(tree, f.name) for f in fields(tree)}
    # Without frames or mimic joints, files keep the format of older versions.
    unused = (set() if tree.frame_names else _OF_FRAMES) | (set() if tree.mimic_names else _OF_MIMICS)
    numbers = {name: value for name, value in numbers.items() if name not in unused}
    arrays = {f"robot_{name}": value for name, value in numbers.items() if isinstance(value, np.ndarray)}
    domain = problem.domain
    arrays |= {"domain_centre": domain.centre, "domain_half_width": domain.half_width}
    data, more = domain.to_data()
    arrays |= {f"domain_{name}": value for name, value in more.items()}
    header = {
        "robot": {name: value for name, value in numbers.items() if not isinstance(value, np.ndarray)},
        "problem": {
            "name": problem.name,
            "task": _write_task(problem.task),
            "metric": _add_tape(problem.metric.recipe, problem.metric.function),
            "domain": domain.name,
            **data,
        },
    }
    return header, arrays


def read_problem(header: Mapping[str, Any], arrays: Mapping[str, Stored]) -> Problem:
    """Rebuild a problem from a header and arrays, which may be damaged.

    Raises:
        OrthocasError, and errors of Python and NumPy: if the data are damaged.
    """
    robot, data = Robot(_read_tree(get_part(header, "robot", dict), arrays)), get_part(header, "problem", dict)
    kind = get_part(data, "domain", str)
    task, metric = _read_task(robot, get_part(data, "task", dict)), _read_metric(robot, get_part(data, "metric", dict))
    own = {name.removeprefix("domain_"): array for name, array in arrays.items() if name.startswith("domain_")}
    return Problem(robot, task, metric, domain_from_data(kind, task, data, own), get_part(data, "name", str))


def _write_task(task: Task) -> dict[str, Any]:
    """A task as plain data, with the expressions of custom ones."""
    data = _add_tape(task.recipe, task.function)
    return data | {"parts": [_write_task(part) for part in task.parts]} if task.parts else data


def _add_tape(recipe: Mapping[str, Any], function: ca.Function) -> dict[str, Any]:
    """A task or metric as plain data. A custom one includes its expression."""
    return {**recipe, "tape": write_tape(function)} if recipe["kind"] == "custom" else dict(recipe)


def _read_tree(data: Mapping[str, Any], arrays: Mapping[str, Stored]) -> KinematicTree:
    names = get_part(data, "joint_names", list)
    numbers: dict[str, Any] = {
        name.removeprefix("robot_"): array for name, array in arrays.items() if name.startswith("robot_")
    }
    # Older files do not store these limits.
    for name in ("effort_limits", "velocity_limits"):
        numbers.setdefault(name, np.full(len(names), np.inf))
    texts: dict[str, Any] = {name: tuple(value) if isinstance(value, list) else value for name, value in data.items()}
    expected, received = {field.name for field in fields(KinematicTree)}, {*texts, *numbers}
    for optional in (_OF_FRAMES, _OF_MIMICS):
        expected -= set() if received & optional else optional
    if expected != received:
        odd = f"with {sorted(received - expected)} and without {sorted(expected - received)}"
        raise InvalidValueError("robot", odd, "the fields of a KinematicTree")
    for name in ("joint_kinds", "parents", *sorted((_OF_FRAMES | _OF_MIMICS) & {*data})):
        get_part(data, name, list)
    return KinematicTree(**texts | numbers)


def _read_task(robot: Robot, recipe: Mapping[str, Any]) -> Task:
    if get_part(recipe, "kind", str) == "custom":
        labels = get_part(recipe, "labels", list)
        # Older files do not store units.
        units = get_part(recipe, "units", list) if "units" in recipe else ()
        require_tape(get_part(recipe, "tape", dict), robot.n)
        return Task.custom(robot, get_part(recipe, "name", str), lambda q: read_tape(recipe["tape"], q), labels, units)
    if recipe["kind"] == "stack":
        return Task.stack(*(_read_task(robot, each) for each in get_part(recipe, "parts", list)))
    return Task.from_recipe(robot, recipe)


def _read_metric(robot: Robot, recipe: Mapping[str, Any]) -> Metric:
    if get_part(recipe, "kind", str) == "custom":
        require_tape(get_part(recipe, "tape", dict), robot.n)
        # Older files do not store a name.
        name = recipe.get("name", "custom")
        return Metric.custom(robot, name, lambda q: read_tape(recipe["tape"], q))
    return Metric.from_spec(robot, recipe["matrix"] if recipe["kind"] == "constant" else recipe["kind"])
