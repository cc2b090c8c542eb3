"""Second tasks of projectors: the joints, a task of your own, or the extra coordinates of a chart."""

from dataclasses import dataclass
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from orthocas.casadi_tools.cached import cached_property
from orthocas.casadi_tools.scalar_code import fast_form
from orthocas.chart import Chart
from orthocas.checks import Array, require_known
from orthocas.control.inertia import block_inertia, median_volume
from orthocas.control.reachability import joint_path
from orthocas.control.reference import Reference
from orthocas.control.second_task import SecondTask
from orthocas.control.turns import without_turns
from orthocas.domains import sample_uniform
from orthocas.errors import InvalidValueError, SingularTaskError, UnreachableReferenceError
from orthocas.metrics import Metric
from orthocas.problem import Problem
from orthocas.tasks import Task

SECOND_TASKS = ("joints", "xi")  #: second tasks by name, for laws that are built on a chart
_SAMPLES, _RANK_LOST = 32, 1e-9


def second_task(problem: Problem, second: Task | Chart | None) -> SecondTask:
    """The second task behind the argument `second` of a projector.

    Raises:
        InvalidValueError: for another type, a task or chart of another robot or task, or labels of the first task.
        NoExpressionError: if the chart is grown.
        SingularTaskError: if the Jacobian of a task does not have full row rank anywhere in the domain.
    """
    if second is None:
        return _Joints(problem)
    if isinstance(second, Chart):
        return _ExtraCoordinates(problem, second)
    if isinstance(second, Task):
        return _OwnTask(problem, second.with_reference_at(problem.domain.centre) if second.lacks_reference else second)
    raise InvalidValueError("second", repr(second)[:80], "a Task, a Chart, or None for the joints")


def named_second(chart: Chart, name: str) -> Chart | None:
    """The argument `second` by its name: "joints" (None) or "xi" (the chart).

    Raises:
        UnknownNameError: for another name.
    """
    require_known("second task", name, SECOND_TASKS)
    return chart if name == "xi" else None


@dataclass(frozen=True, eq=False)
class _Joints:
    """x_2 = q."""

    problem: Problem

    name: ClassVar[str] = "joints"
    chart: ClassVar[None] = None

    @property
    def labels(self) -> tuple[str, ...]:
        return (*self.problem.task.labels, *self.problem.robot.joint_names)

    @cached_property
    def measured(self) -> ca.Function:
        q = ca.MX.sym("q", self.problem.n)
        return _stacked(self.problem, q, q)

    def jacobian(self, q: ca.MX) -> ca.MX:
        return ca.MX.eye(self.problem.n)

    def weighted(self, q: ca.MX, A: ca.MX) -> tuple[ca.MX, ca.MX, ca.MX]:
        return ca.MX.eye(self.problem.n), A, ca.MX(1)

    def curvature(self, q: ca.MX, dq: ca.MX) -> ca.MX:
        return ca.MX.zeros(self.problem.n)

    def shortest(self, difference: ca.MX) -> ca.MX:
        return difference

    def runnable(self, graph: ca.Function) -> ca.Function:
        return fast_form(graph, self.problem.n)

    def require_reachable(self, reference: Reference, q_start: Array) -> None:
        """Raise UnreachableReferenceError if a posture of the reference leaves the joint limits."""
        robot, times = self.problem.robot, reference.grid()
        postures = reference.sample(times)[0][:, self.problem.m :]
        outside = np.argwhere((postures < robot.lower) | (postures > robot.upper))
        if outside.size:
            k, i = outside[0]
            raise UnreachableReferenceError(
                f"the reference puts joint '{robot.joint_names[i]}' at {postures[k, i]:.4g} "
                f"at t = {times[k]:.3g} s, expected within [{robot.lower[i]:.4g}, {robot.upper[i]:.4g}]"
            )


@dataclass(frozen=True, eq=False)
class _OwnTask:
    """x_2 of a task. The two tasks may contradict each other, so no reference is refused."""

    problem: Problem
    task: Task

    chart: ClassVar[None] = None

    def __post_init__(self) -> None:
        problem, task = self.problem, self.task
        if task.robot is not problem.robot:
            raise InvalidValueError("second", f"task '{task.name}' of another robot", "a task of the problem's robot")
        if shared := set(task.labels) & set(problem.task.labels):
            raise InvalidValueError("second", f"a task with the label '{min(shared)}'", "labels that are free")
        J = task.batched_jacobian(sample_uniform(problem.domain, _SAMPLES, 0))[0].reshape(-1, task.m, problem.n)
        values = np.linalg.svd(np.nan_to_num(J), compute_uv=False)
        if task.m > problem.n or (values[:, -1] <= _RANK_LOST * values[:, 0]).all():
            raise SingularTaskError(
                f"the Jacobian of second task '{task.name}' has rank below {task.m} at all {_SAMPLES} samples of the "
                "domain"
            )

    @property
    def name(self) -> str:
        return self.task.name

    @property
    def labels(self) -> tuple[str, ...]:
        return (*self.problem.task.labels, *self.task.labels)

    @cached_property
    def measured(self) -> ca.Function:
        q = ca.MX.sym("q", self.problem.n)
        return _stacked(self.problem, q, self.task.function(q))

    def jacobian(self, q: ca.MX) -> ca.MX:
        return self.task.jacobian_function(q)

    def weighted(self, q: ca.MX, A: ca.MX) -> tuple[ca.MX, ca.MX, ca.MX]:
        return _weighted(self.problem, self.problem.metric, self.task.jacobian_function, q, A)

    def curvature(self, q: ca.MX, dq: ca.MX) -> ca.MX:
        return self.task.second_derivative_function(q, dq, dq)

    def shortest(self, difference: ca.MX) -> ca.MX:
        return difference

    def runnable(self, graph: ca.Function) -> ca.Function:
        return fast_form(graph, self.problem.n)

    def require_reachable(self, reference: Reference, q_start: Array) -> None:
        pass


@dataclass(frozen=True, eq=False)
class _ExtraCoordinates:
    """x_2 = xi(q) of a chart, on the domain of the chart."""

    problem: Problem
    chart: Chart

    name: ClassVar[str] = "xi"

    def __post_init__(self) -> None:
        self.chart.function("xi")  # raises for grown charts
        theirs = self.chart.problem
        if theirs.robot is not self.problem.robot or theirs.task is not self.problem.task:
            raise InvalidValueError("second", "a chart of another robot or task", "a chart of the problem's task")

    @property
    def labels(self) -> tuple[str, ...]:
        return self.chart.labels

    @property
    def measured(self) -> ca.Function:
        return self.chart.function("phi")

    def jacobian(self, q: ca.MX) -> ca.MX:
        return self.chart.coordinates.functions["jacobian"](q)

    def weighted(self, q: ca.MX, A: ca.MX) -> tuple[ca.MX, ca.MX, ca.MX]:
        return _weighted(self.chart.problem, self.problem.metric, self.chart.coordinates.functions["jacobian"], q, A)

    def curvature(self, q: ca.MX, dq: ca.MX) -> ca.MX:
        return self.chart.coordinates.functions["second_derivative"](q, dq, dq)

    def shortest(self, difference: ca.MX) -> ca.MX:
        shorter: ca.MX = without_turns(self.chart, difference)
        return shorter

    def runnable(self, graph: ca.Function) -> ca.Function:
        return self.chart.runnable(graph)

    def require_reachable(self, reference: Reference, q_start: Array) -> None:
        """Raise UnreachableReferenceError if the motion from q_start along the reference leaves the chart's domain."""
        joint_path(self.chart, reference, q_start)


def _stacked(problem: Problem, q: ca.MX, second: ca.MX) -> ca.Function:
    return ca.Function("measured", [q], [ca.densify(ca.vertcat(problem.task.function(q), second))])


def _weighted(problem: Problem, metric: Metric, jacobian: ca.Function, q: ca.MX, A: ca.MX) -> tuple[Any, Any, Any]:
    """`SecondTask.weighted` from the Jacobian J_2 as a function of q, on the domain of a problem."""
    k = jacobian.size1_out(0)
    B, Lambda, volume = block_inertia(problem.n, (k,))(jacobian(q), A)
    return B @ Lambda, Lambda, volume / median_volume(problem, jacobian, metric, (k,))
