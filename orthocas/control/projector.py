"""Null-space projectors on velocity and torque level: what the coordinates are compared with."""

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import ClassVar, Self

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from orthocas.charts.chart import Chart
from orthocas.control.controller import (
    Command,
    count_turns_from_centre,
    fallback_function,
    guarded_graph,
    law_facts,
    named_function,
    named_inputs,
)
from orthocas.control.gains import (
    DAMPING_RATIO,
    DAMPING_RATIO_SETTING,
    FEEDBACK,
    FEEDBACK_SETTING,
    LIMIT,
    SECOND_FORCE,
    STIFFNESS,
    STIFFNESS_SETTING,
    Setting,
    command_limit,
    finite_gains,
    matched_posture_stiffness,
    matched_stiffness,
    non_negative_gains,
    positive_gains,
)
from orthocas.control.holding import holding_doubts
from orthocas.control.linear_algebra import block_inertia, median_volume
from orthocas.control.two_tasks import (
    SecondName,
    TwoTaskLaw,
    errors_and_damping,
    named_second,
    second_task,
    two_task_forces,
)
from orthocas.errors import LawWarning
from orthocas.robots.tree import require_driven
from orthocas.tasks.problem import Problem
from orthocas.tasks.relative import Relative
from orthocas.tasks.task import Task
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array, frozen_array, require_kind

_SECOND = Setting("joints (default) or xi, what the projector moves.", is_word=True)


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
    options: ClassVar[Mapping[str, Setting]] = {"feedback": FEEDBACK_SETTING, "second": _SECOND}

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

    @classmethod
    def on_chart(
        cls,
        chart: Chart,
        limit: ArrayLike | None = None,
        *,
        feedback: ArrayLike = 0.0,
        second: SecondName = "joints",
    ) -> Self:
        """Build the law on the problem of a chart.

        Args:
            chart: the chart.
            limit: largest velocity of each joint.
            feedback: one number or (m + k_2,).
            second: "joints" or "xi", the coordinates of the chart.
        """
        task = named_second(chart, second)
        m, k = chart.m, chart.n + (chart.m if task is None else 0)
        gains = non_negative_gains(f"feedback (task, then {second})", feedback, k)
        return cls(chart.problem, gains[:m], gains[m:], limit, task)

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
        B, Lambda, volume = block_inertia(problem.n, (m,))(J, A)
        J_2_inverse, _, relative = self._second.weighted(q, A)
        rest = self._second.shortest(x_d - self.measured(q))[m:]
        second = J_2_inverse @ (dx_d[m:] + gain[m:] * rest)
        velocity = second + B @ (Lambda @ (known.drift(q, x_d[:m], dx_d[:m]) - gain[:m] * e - J @ second))
        scale = median_volume(problem, known.rates, problem.metric, (m,))
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

    Example:
        >>> import orthocas as oc
        >>> from orthocas import problems
        >>> chart = oc.fit(problems.get("planar_3r_xy"), oc.Linear()).chart
        >>> oc.control.Projector(chart.problem, 100.0, 20.0, second=chart).labels
        ('x', 'y', 'xi1')
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
            "second_force": SECOND_FORCE,
            "limit": LIMIT,
        }
    )
    options: ClassVar[Mapping[str, Setting]] = {
        "stiffness": STIFFNESS_SETTING,
        "damping_ratio": DAMPING_RATIO_SETTING,
        "posture_stiffness": Setting("Stiffness of the springs in the second task; default: modes around 6 Hz."),
        "second": _SECOND,
    }

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
        for name, value in {
            "problem": problem,
            "stiffness": frozen_array("stiffness", np.concatenate([task, posture]), (k,)),
            "damping_ratio": non_negative_gains("damping_ratio", damping_ratio, k),
            "limit": command_limit("limit", limit, problem.robot.effort_limits),
            "second": second,
            "second_force": None if second_force is None else finite_gains("second_force", second_force, k_2),
            "feed_forward": feed_forward,
        }.items():
            object.__setattr__(self, name, value)
        for doubt in self.remarks():
            warnings.warn(doubt, LawWarning, stacklevel=2)

    def remarks(self) -> list[str]:
        """A warning if the motors cannot hold the arm."""
        return holding_doubts(self.problem.robot, self.problem.domain, self.limit)

    @classmethod
    def on_chart(
        cls,
        chart: Chart,
        limit: ArrayLike | None = None,
        *,
        stiffness: ArrayLike | None = None,
        damping_ratio: ArrayLike = 0.7,
        posture_stiffness: ArrayLike | None = None,
        second: SecondName = "joints",
    ) -> Self:
        """Build the law on the problem of a chart.

        Args:
            chart: the chart.
            limit: largest torque of each joint.
            stiffness: of the task; default: modes around 6 Hz.
            damping_ratio: one number or (m + k_2,).
            posture_stiffness: of the second task; default: modes around 6 Hz.
            second: "joints" or "xi", the coordinates of the chart.
        """
        task = named_second(chart, second)
        if posture_stiffness is None and task is None:
            posture_stiffness = matched_posture_stiffness(chart.problem)
        elif posture_stiffness is None:
            posture_stiffness = matched_stiffness(chart)[chart.m :]
        stiffness = matched_stiffness(chart)[: chart.m] if stiffness is None else stiffness
        return cls(chart.problem, stiffness, posture_stiffness, damping_ratio, limit, task)

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
        B, Lambda, volume = block_inertia(problem.n, (m,))(J, A)
        second = self._second.jacobian(q).T @ f_2
        torque = J.T @ f_x + second - J.T @ (Lambda @ (B.T @ second)) + gravity
        scale = median_volume(problem, known.rates, problem.metric, (m,))
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
        B, Lambda, _ = block_inertia(problem.n, (m,))(J, problem.metric.function(q))
        through = dq - B @ (Lambda @ (J @ dq))  # P dq
        storage = (ca.bilin(problem.robot.mass_matrix(q), dq, dq) + ca.dot(e, inputs["stiffness"] * e)) / 2
        power = ca.dot(J @ dq, damped_x(J @ dq)) + ca.dot(J_2 @ through, damped_2(J_2 @ dq))
        outputs = {"storage": storage, "dissipated_power": power}
        return named_function("energy", inputs, outputs)

    def _inputs(self) -> dict[str, ca.MX]:
        return named_inputs(self.problem.n, self.gains, len(self.labels))
