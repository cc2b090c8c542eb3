"""Two tasks, of which the first has priority: second tasks, their forces, and what both laws share."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, Protocol, get_args

import casadi as ca
import numpy as np

from orthocas.charts.chart import Chart
from orthocas.control.controller import count_turns_from_centre
from orthocas.control.linear_algebra import block_inertia, damped, median_volume
from orthocas.control.posture import joint_path
from orthocas.control.reference import Reference
from orthocas.errors import InvalidValueError, SingularTaskError, UnreachableReferenceError
from orthocas.tasks.domains import sample_uniform
from orthocas.tasks.metric import Metric
from orthocas.tasks.problem import Problem
from orthocas.tasks.relative import Relative
from orthocas.tasks.task import Task
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array, require_known
from orthocas.tools.display import Shown
from orthocas.tools.expressions import fast_form, shortest

SecondName = Literal["joints", "xi"]  #: second tasks by name, for laws that are built on a chart
_SAMPLES, _RANK_LOST = 32, 1e-9


class SecondTask(Protocol):
    """What a projector moves in the null space of the task: k_2 functions x_2(q)."""

    @property
    def name(self) -> str:
        """'joints', 'xi', or the name of a task."""
        ...

    @property
    def chart(self) -> Chart | None:
        """The chart whose domain the law has to respect, if any."""
        ...

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of x, then of x_2."""
        ...

    @property
    def measured(self) -> ca.Function:
        """q (n, 1) -> [x; x_2]."""
        ...

    def jacobian(self, q: ca.MX) -> ca.MX:
        """J_2 = dx_2/dq, (k_2, n)."""
        ...

    def weighted(self, q: ca.MX, A: ca.MX) -> tuple[ca.MX, ca.MX, ca.MX]:
        """J_2^#A (n, k_2), (J_2 A^-1 J_2^T)^-1 (k_2, k_2), and det(J_2 A^-1 J_2^T) over its median on the domain."""
        ...

    def curvature(self, q: ca.MX, dq: ca.MX) -> ca.MX:
        """dJ_2/dt dq, (k_2, 1)."""
        ...

    def shortest(self, difference: ca.MX) -> ca.MX:
        """A difference of two [x; x_2], without whole turns of joints that turn without end."""
        ...

    def runnable(self, graph: ca.Function) -> ca.Function:
        """The fast form of a graph."""
        ...

    def require_reachable(self, reference: Reference, q_start: Array) -> None:
        """Raise UnreachableReferenceError if the law cannot follow the reference."""
        ...


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


def named_second(chart: Chart, name: SecondName) -> Chart | None:
    """The argument `second` by its name: "joints" (None) or "xi" (the chart).

    Raises:
        UnknownNameError: for another name.
    """
    require_known("second task", name, get_args(SecondName))
    return chart if name == "xi" else None


@dataclass(frozen=True, eq=False)
class _Joints:
    """x_2 = q."""

    problem: Problem

    name: ClassVar[str] = "joints"
    chart = None

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

    chart = None

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
        shorter: ca.MX = shortest(difference, self.chart.turns)
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


Inputs = dict[str, ca.MX]


def two_task_forces(problem: Problem, second: SecondTask, inputs: Inputs, feed_forward: bool) -> tuple[ca.MX, ca.MX]:
    """f = -K (y - y_d) - D J dq for y = x, (m, 1), and for y = x_2, (k_2, 1), with an input `second_force` added.

    The feed-forward adds M_y (dd_y_d - dJ/dt dq + J M^-1 C dq) + D d_y_d with M_y = (J M^-1 J^T)^-1. A force J_x^T f_x
    alone then gives Lambda_x (dd_x - dd_x_d) + D_x (d_x - d_x_d) + K_x (x - x_d) = 0, Lambda_x = M_x.
    """
    m, K = problem.m, inputs["stiffness"]
    q, dq = inputs["q"], inputs["dq"]
    J_2 = second.jacobian(q)
    e, J, damped_x, damped_2 = errors_and_damping(problem, second, inputs)
    f_x, f_2 = -K[:m] * e[:m], -K[m:] * e[m:] + inputs.get("second_force", 0)
    if not feed_forward:
        return f_x - damped_x(J @ dq), f_2 - damped_2(J_2 @ dq)
    M, C_dq = problem.robot.mass_matrix(q), problem.robot.coriolis_product(q, dq, dq)
    B, M_x, _ = block_inertia(problem.n, (m,))(J, M)
    sharp, M_2, _ = second.weighted(q, M)
    x_d, rate, acceleration = (inputs[name] for name in ("reference", "reference_velocity", "reference_acceleration"))
    relative = Relative(problem.task)
    bend = relative.bend(q, dq, dq, (x_d[:m], rate[:m], acceleration[:m]))
    f_x += M_x @ (B.T @ C_dq - bend) - damped_x(J @ dq - relative.drift(q, x_d[:m], rate[:m]))
    f_2 += M_2 @ (acceleration[m:] - second.curvature(q, dq)) + sharp.T @ C_dq - damped_2(J_2 @ dq - rate[m:])
    return f_x, f_2


Damped = Callable[[ca.MX], ca.MX]  #: v -> D v


def errors_and_damping(problem: Problem, second: SecondTask, inputs: Inputs) -> tuple[ca.MX, ca.MX, Damped, Damped]:
    """e = [x - x_d; x_2 - x_2d], de_x/dq, and the functions v -> D_x v, with the inertia M_x, and v -> D_2 v, with M_2.

    Source:
        [AS2023] eq. (29).
    """
    q, K, Z, m = inputs["q"], inputs["stiffness"], inputs["damping_ratio"], problem.m
    M = problem.robot.mass_matrix(q)
    e_x, J = Relative(problem.task).error(q, inputs["reference"][:m])
    M_x = block_inertia(problem.n, (m,))(J, M)[1]
    M_2 = second.weighted(q, M)[1]
    rest = second.shortest(second.measured(q) - inputs["reference"])[m:]
    return ca.vertcat(e_x, rest), J, _damping(M_x, K[:m], Z[:m]), _damping(M_2, K[m:], Z[m:])


def _damping(inertia: ca.MX, stiffness: ca.MX, damping_ratio: ca.MX) -> Damped:
    size = inertia.shape[0]
    M, K, Z, v = ca.MX.sym("M", size, size), *(ca.MX.sym(name, size) for name in ("K", "Z", "v"))
    D_v = ca.Function("damping", [M, K, Z, v], [ca.densify(damped("square_root", M, K, Z, v))])
    return lambda velocity: D_v(inertia, stiffness, damping_ratio, velocity)


class TwoTaskLaw(Shown, ABC):
    """A law for the task x of a problem, and a second task x_2 in its null space."""

    problem: Problem
    second: Task | Chart | None  #: default: the joints

    def remarks(self) -> list[str]:
        """No warnings."""
        return []

    @property
    def chart(self) -> Chart | None:
        """The chart of the second task, if it is one."""
        return self._second.chart

    @property
    def labels(self) -> tuple[str, ...]:
        """Task labels, then those of the second task."""
        return self._second.labels

    @property
    def measured(self) -> ca.Function:
        """[h(q); x_2(q)]."""
        return self._second.measured

    @cached_property
    def function(self) -> ca.Function:
        """q, dq (n, 1), reference and its derivatives (m + k_2, 1), gains -> command (n, 1), status (1, 1)."""
        return self._second.runnable(count_turns_from_centre(self.graph, self.problem))

    @cached_property
    @abstractmethod
    def graph(self) -> ca.Function:
        """The same function as a graph with shared subexpressions; C is generated from it."""

    def require_reachable(self, reference: Reference, q_start: Array) -> None:
        """Raise UnreachableReferenceError if the reference leaves the joint limits (joints) or the domain (xi).

        Nothing is checked for a second task of your own.
        """
        self._second.require_reachable(reference, q_start)

    @cached_property
    def _second(self) -> SecondTask:
        return second_task(self.problem, self.second)
