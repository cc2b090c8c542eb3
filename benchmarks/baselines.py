"""Null-space projectors on velocity and torque level, what coordinates are compared with: laws of the textbook.

`oc.simulate`, `oc.generate_c` and the supervised law take them, as any law that keeps the protocol
`orthocas.control.Controller`. They move a task x, and a second task x_2(q) in its null space.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar, Protocol

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from orthocas.charts.chart import Chart
from orthocas.control.controller import (
    Command,
    build_function,
    count_turns_from_centre,
    fallback_function,
    guarded_graph,
    law_facts,
    named_inputs,
)
from orthocas.control.gains import (
    DAMPING_RATIO,
    FEEDBACK,
    LIMIT,
    STIFFNESS,
    command_limit,
    find_holding_doubts,
    non_negative_gains,
    positive_gains,
)
from orthocas.control.linear_algebra import apply_damping, build_block_inertia, compute_median_volume
from orthocas.control.reference import Reference, joint_path
from orthocas.errors import InvalidValueError, SingularTaskError, UnreachableReferenceError
from orthocas.robots.tree import require_driven
from orthocas.tasks.metric import Metric
from orthocas.tasks.problem import Problem
from orthocas.tasks.relative import Relative
from orthocas.tasks.samples import sample_uniform
from orthocas.tasks.task import Task
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array, as_float_array, freeze_array, require_kind
from orthocas.tools.display import Shown
from orthocas.tools.expressions import choose_form, wrap_shortest

_SAMPLES, _RANK_LOST = 32, 1e-9


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
    def _second(self) -> "SecondTask":
        return second_task(self.problem, self.second)


@dataclass(frozen=True, eq=False, repr=False)
class KinematicProjector(TwoTaskLaw):
    """Joint velocity dq = J_x^#A (d_x_d + Lambda_x (x_d - x)) + P J_2^#A (d_x_2d + Lambda_2 (x_2d - x_2)).

    J_x P = 0, so the task moves exactly as commanded, whatever the second task x_2(q) is. With zero feedback and a
    constant x_2d, this is pseudo-inverse control. The reference is [x_d; x_2d].

    Args:
        problem: robot, task and metric A.
        feedback: diagonal of Lambda_x, >= 0, (m,) or one number [1/s].
        posture_feedback: diagonal of Lambda_2, >= 0, (k_2,) or one number [1/s].
        limit: largest speed of each joint, (n,) or one number; default the velocity limits of the robot.
        second: x_2. A `Task` of the same robot, or a `Chart` of the same task for its xi. Default: the joints, x_2 = q,
            with J_2^#A = I. The law has the domain of the chart, and otherwise none.

    Raises:
        ShapeError, InvalidValueError, SingularTaskError, NoExpressionError: for arguments that do not fit.

    Source:
        [AS2023] eq. (1); projected coordinates: Sec. 10.
    """

    problem: Problem
    feedback: Array  #: Lambda_x, then Lambda_2, (m + k_2,)
    limit: Array
    second: Task | Chart | None

    name: ClassVar[str] = "kinematic_projector"
    formula = "Velocity control by pseudo-inverse and projector; does not use the input dq."
    command: ClassVar[Command] = "velocity"
    energy = None
    energy_graph = None
    gain_units = MappingProxyType({"feedback": FEEDBACK, "limit": LIMIT})

    def __init__(
        self,
        problem: Problem,
        feedback: ArrayLike = 0.0,
        posture_feedback: ArrayLike = 0.0,
        limit: ArrayLike | None = None,
        second: Task | Chart | None = None,
    ) -> None:
        require_kind("problem", problem, Problem)
        require_driven(f"the law {self.name}", problem.robot.tree)
        k_2 = len(second_task(problem, second).labels) - problem.m
        task = non_negative_gains("feedback", feedback, problem.m)
        posture = non_negative_gains("posture_feedback", posture_feedback, k_2)
        object.__setattr__(self, "problem", problem)
        object.__setattr__(self, "feedback", np.concatenate([task, posture]))
        object.__setattr__(self, "limit", command_limit("limit", limit, problem.robot.velocity_limits))
        object.__setattr__(self, "second", second)

    def facts(self) -> dict[str, str]:
        """Quantities, gains and problem."""
        return law_facts(self)

    @property
    def settings(self) -> Mapping[str, str]:
        """The second task."""
        return {"second": self._second.name}

    @property
    def gains(self) -> dict[str, Array]:
        """Inputs of the law besides state and targets: the feedback gain [1/s] and the limit of the task speed."""
        return {"feedback": self.feedback, "limit": self.limit}

    @cached_property
    def graph(self) -> ca.Function:
        """The same function as a graph with shared subexpressions; C is generated from it."""
        problem, m = self.problem, self.problem.m
        inputs = named_inputs(problem.n, self.gains, len(self.labels))
        q = inputs["q"]
        x_d, dx_d, gain = (inputs[name] for name in ("reference", "reference_velocity", "feedback"))
        known = Relative(problem.task)
        e, J = known.error(q, x_d[:m])
        A = problem.metric.function(q)
        B, Lambda, volume = build_block_inertia(problem.n, (m,))(J, A)
        J_2_inverse, _, relative = self._second.weighted(q, A)
        rest = self._second.wrap_shortest(x_d - self.measured(q))[m:]
        second = J_2_inverse @ (dx_d[m:] + gain[m:] * rest)
        velocity = second + B @ (Lambda @ (known.compute_drift(q, x_d[:m], dx_d[:m]) - gain[:m] * e - J @ second))
        scale = compute_median_volume(problem, known.rates, problem.metric, (m,))
        domain = None if self.chart is None else self.chart.problem.domain
        return guarded_graph(self.name, inputs, velocity, ca.MX(problem.n, 1), volume / scale * relative, domain, True)

    @cached_property
    def fallback(self) -> ca.Function:
        """q, gains -> zero velocity."""
        n = self.problem.n
        return fallback_function(named_inputs(n, self.gains, 0), ca.MX(n, 1))


@dataclass(frozen=True, eq=False, repr=False)
class Projector(TwoTaskLaw):
    """Impedance control of the task x, with springs of a second task x_2(q) in the null space of the task.

    tau = J_x^T (-K_x (x - x_d) - D_x J_x dq) + P^T J_2^T (-K_2 (x_2 - x_2d) - D_2 J_2 dq + f_2) + g,
    P = I - J_x^#A J_x, where A is the metric of the problem; A = M gives the dynamically consistent projector, whose
    second task causes no acceleration of the first. The reference is [x_d; x_2d]. Eq. (29) gives the damping, with the
    inertias M_x and M_2 = (J_2 M^-1 J_2^T)^-1, which is M for joints.

    Args:
        problem: robot, task and metric.
        stiffness: diagonal of K_x, > 0, (m,) or one number.
        posture_stiffness: diagonal of K_2, > 0, or >= 0 with a `second_force`, (k_2,) or one number; [N m/rad] for
            joints.
        damping_ratio: of all springs, >= 0, (m + k_2,) or one number.
        limit: largest torque of each joint, (n,) or one number; default the effort limits of the robot.
        second: x_2. A `Task` of the same robot, or a `Chart` of the same task for its xi ("projected coordinates").
            Default: the joints, x_2 = q. The law has the domain of the chart, and otherwise none.
        second_force: f_2, (k_2,) or one number. If it is given, the law takes an input of that name, with this
            value as the default, as in [AS2023] eq. (3b); with a `posture_stiffness` of 0 it acts alone.
        feed_forward: whether to follow moving references, as operational space control does: the forces in x and in x_2
            also get the desired acceleration, what Coriolis terms and dJ/dt take away, and D times the desired
            velocity. With A = M, the task then obeys M_x dd_e + D_x d_e + K_x e = 0, e = x - x_d, exactly, whatever the
            second task does.

    Raises:
        ShapeError, InvalidValueError, SingularTaskError, NoExpressionError: for arguments that do not fit.

    Source:
        [AS2023] eqs. (2), (3); projected coordinates: Sec. 10; feed-forward: [Kha1987].
    """

    problem: Problem
    stiffness: Array  #: K_x, then K_2, (m + k_2,)
    damping_ratio: Array
    limit: Array
    second: Task | Chart | None
    second_force: Array | None
    feed_forward: bool

    name: ClassVar[str] = "projector"
    command: ClassVar[Command] = "torque"
    gain_units = MappingProxyType(
        {
            "stiffness": STIFFNESS,
            "damping_ratio": DAMPING_RATIO,
            "second_force": "J per unit of the second quantity",
            "limit": LIMIT,
        }
    )

    def __init__(
        self,
        problem: Problem,
        stiffness: ArrayLike,
        posture_stiffness: ArrayLike,
        damping_ratio: ArrayLike = 0.7,
        limit: ArrayLike | None = None,
        second: Task | Chart | None = None,
        second_force: ArrayLike | None = None,
        feed_forward: bool = False,
    ) -> None:
        require_kind("problem", problem, Problem)
        require_driven(f"the law {self.name}", problem.robot.tree)
        require_kind("feed_forward", feed_forward, bool)
        k = len(second_task(problem, second).labels)
        k_2 = k - problem.m
        task = positive_gains("stiffness", stiffness, problem.m)
        springs = positive_gains if second_force is None else non_negative_gains
        posture = springs("posture_stiffness", posture_stiffness, k_2)
        force = None if second_force is None else as_float_array("second_force", second_force)
        if force is not None:
            force = freeze_array("second_force", force if force.ndim else np.full(k_2, force), (k_2,))
        for name, value in {
            "problem": problem,
            "stiffness": freeze_array("stiffness", np.concatenate([task, posture]), (k,)),
            "damping_ratio": non_negative_gains("damping_ratio", damping_ratio, k),
            "limit": command_limit("limit", limit, problem.robot.effort_limits),
            "second": second,
            "second_force": force,
            "feed_forward": feed_forward,
        }.items():
            object.__setattr__(self, name, value)

    def remarks(self) -> list[str]:
        """A warning if the motors cannot hold the arm."""
        return find_holding_doubts(self.problem.robot, self.problem.domain, self.limit)

    def facts(self) -> dict[str, str]:
        """Quantities, gains and problem."""
        return law_facts(self)

    @property
    def formula(self) -> str:
        """The law in one line, for generated C."""
        springs = "posture springs" if self.second is None else f"springs in {self._second.name}"
        law = "Task impedance with feed-forward" if self.feed_forward else "Task impedance"
        return f"{law} plus {springs} in the null space of the task, plus g(q)."

    @property
    def settings(self) -> Mapping[str, str]:
        """The second task."""
        return {"second": self._second.name, "feed_forward": "yes" if self.feed_forward else "no"}

    @property
    def gains(self) -> dict[str, Array]:
        """Stiffness, damping ratio, the second force if there is one, and limit."""
        force = {} if self.second_force is None else {"second_force": self.second_force}
        return {"stiffness": self.stiffness, "damping_ratio": self.damping_ratio, **force, "limit": self.limit}

    @cached_property
    def graph(self) -> ca.Function:
        """The same function as a graph with shared subexpressions; C is generated from it."""
        problem, m = self.problem, self.problem.m
        inputs = self._inputs()
        q = inputs["q"]
        known = Relative(problem.task)
        J, A, gravity = known.error(q, inputs["reference"][:m])[1], problem.metric.function(q), problem.robot.gravity(q)
        f_x, f_2 = two_task_forces(problem, self._second, inputs, self.feed_forward)
        B, Lambda, volume = build_block_inertia(problem.n, (m,))(J, A)
        second = self._second.jacobian(q).T @ f_2
        torque = J.T @ f_x + second - J.T @ (Lambda @ (B.T @ second)) + gravity
        scale = compute_median_volume(problem, known.rates, problem.metric, (m,))
        relative = volume / scale * self._second.weighted(q, A)[2]
        domain = None if self.chart is None else self.chart.problem.domain
        return guarded_graph(self.name, inputs, torque, gravity, relative, domain)

    @cached_property
    def fallback(self) -> ca.Function:
        """q, gains -> gravity torque."""
        inputs = self._inputs()
        return fallback_function(inputs, self.problem.robot.gravity(inputs["q"]))

    @cached_property
    def energy(self) -> ca.Function:
        """The fast form of `energy_graph`."""
        return self._second.runnable(count_turns_from_centre(self.energy_graph, self.problem))

    @cached_property
    def energy_graph(self) -> ca.Function:
        """V, the kinetic energy plus all springs, also their projected-out part [J], and power of both dampers [W].

        The work of a given second force is not part of either.
        """
        problem, m = self.problem, self.problem.m
        inputs = self._inputs()
        q, dq = inputs["q"], inputs["dq"]
        e, J, damped_x, damped_2 = errors_and_damping(problem, self._second, inputs)
        J_2 = self._second.jacobian(q)
        B, Lambda, _ = build_block_inertia(problem.n, (m,))(J, problem.metric.function(q))
        through = dq - B @ (Lambda @ (J @ dq))  # P dq
        storage = (ca.bilin(problem.robot.mass_matrix(q), dq, dq) + ca.dot(e, inputs["stiffness"] * e)) / 2
        power = ca.dot(J @ dq, damped_x(J @ dq)) + ca.dot(J_2 @ through, damped_2(J_2 @ dq))
        outputs = {"storage": storage, "dissipated_power": power}
        return build_function("energy", inputs, outputs)

    def _inputs(self) -> dict[str, ca.MX]:
        return named_inputs(self.problem.n, self.gains, len(self.labels))


def posture_reference(chart: Chart, reference: Reference, q_start: ArrayLike) -> Reference:
    """The reference [x_d; q_d] with phi(q_d) = phi_d at every instant, for a fair comparison with a `Projector`.

    Args:
        chart: the chart whose coordinates the reference is given in.
        reference: the motion of phi = [x; xi].
        q_start: joint position at the start, (n,).

    Raises:
        UnreachableReferenceError: if the reference leaves the domain.
    """
    require_kind("chart", chart, Chart)
    path = joint_path(chart, reference, q_start)
    times = reference.grid()
    task = reference.sample(times)[0][:, : chart.m]
    labels = (*chart.problem.task.labels, *chart.problem.robot.joint_names)
    return Reference.through(labels, times, np.hstack([task, path]))


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

    def wrap_shortest(self, difference: ca.MX) -> ca.MX:
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

    def wrap_shortest(self, difference: ca.MX) -> ca.MX:
        return difference

    def runnable(self, graph: ca.Function) -> ca.Function:
        return choose_form(graph, self.problem.n)

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

    def wrap_shortest(self, difference: ca.MX) -> ca.MX:
        return difference

    def runnable(self, graph: ca.Function) -> ca.Function:
        return choose_form(graph, self.problem.n)

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

    def wrap_shortest(self, difference: ca.MX) -> ca.MX:
        shorter: ca.MX = wrap_shortest(difference, self.chart.parts.turns)
        return shorter

    def runnable(self, graph: ca.Function) -> ca.Function:
        return self.chart.parts.runnable(graph)

    def require_reachable(self, reference: Reference, q_start: Array) -> None:
        """Raise UnreachableReferenceError if the motion from q_start along the reference leaves the chart's domain."""
        joint_path(self.chart, reference, q_start)


def _stacked(problem: Problem, q: ca.MX, second: ca.MX) -> ca.Function:
    return ca.Function("measured", [q], [ca.densify(ca.vertcat(problem.task.function(q), second))])


def _weighted(problem: Problem, metric: Metric, jacobian: ca.Function, q: ca.MX, A: ca.MX) -> tuple[Any, Any, Any]:
    """`SecondTask.weighted` from the Jacobian J_2 as a function of q, on the domain of a problem."""
    k = jacobian.size1_out(0)
    B, Lambda, volume = build_block_inertia(problem.n, (k,))(jacobian(q), A)
    return B @ Lambda, Lambda, volume / compute_median_volume(problem, jacobian, metric, (k,))


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
    B, M_x, _ = build_block_inertia(problem.n, (m,))(J, M)
    sharp, M_2, _ = second.weighted(q, M)
    x_d, rate, acceleration = (inputs[name] for name in ("reference", "reference_velocity", "reference_acceleration"))
    relative = Relative(problem.task)
    bend = relative.compute_bias(q, dq, dq, (x_d[:m], rate[:m], acceleration[:m]))
    f_x += M_x @ (B.T @ C_dq - bend) - damped_x(J @ dq - relative.compute_drift(q, x_d[:m], rate[:m]))
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
    M_x = build_block_inertia(problem.n, (m,))(J, M)[1]
    M_2 = second.weighted(q, M)[1]
    rest = second.wrap_shortest(second.measured(q) - inputs["reference"])[m:]
    return ca.vertcat(e_x, rest), J, _damping(M_x, K[:m], Z[:m]), _damping(M_2, K[m:], Z[m:])


def _damping(inertia: ca.MX, stiffness: ca.MX, damping_ratio: ca.MX) -> Damped:
    size = inertia.shape[0]
    M, K, Z, v = ca.MX.sym("M", size, size), *(ca.MX.sym(name, size) for name in ("K", "Z", "v"))
    D_v = ca.Function("damping", [M, K, Z, v], [ca.densify(apply_damping("square_root", M, K, Z, v))])
    return lambda velocity: D_v(inertia, stiffness, damping_ratio, velocity)
