"""Velocity control with a null-space projector: the state of the art, also with coordinates as the second task."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from orthocas.casadi_tools.cached import cached_property
from orthocas.chart import Chart
from orthocas.checks import Array, require_kind
from orthocas.control.controller import Command, fallback_function, guarded_graph, law_facts, named_inputs
from orthocas.control.gains import FEEDBACK, LIMIT, command_limit, non_negative_gains
from orthocas.control.inertia import block_inertia, median_volume
from orthocas.control.second_tasks import named_second, second_task
from orthocas.control.two_task_law import TwoTaskLaw
from orthocas.problem import Problem
from orthocas.tasks import Task


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
    formula: ClassVar[str] = "Velocity control by pseudo-inverse and projector; does not use the input dq."
    command: ClassVar[Command] = "velocity"
    energy: ClassVar[None] = None
    energy_graph: ClassVar[None] = None
    gain_units: ClassVar[Mapping[str, str]] = {"feedback": FEEDBACK, "limit": LIMIT}
    options: ClassVar[tuple[str, ...]] = ("feedback", "second")

    def __init__(
        self,
        problem: Problem,
        feedback: ArrayLike = 0.0,
        posture_feedback: ArrayLike = 0.0,
        limit: ArrayLike | None = None,
        second: Task | Chart | None = None,
    ) -> None:
        require_kind("problem", problem, Problem)
        k_2 = len(second_task(problem, second).labels) - problem.m
        task = non_negative_gains("feedback", feedback, problem.m)
        posture = non_negative_gains("posture_feedback", posture_feedback, k_2)
        object.__setattr__(self, "problem", problem)
        object.__setattr__(self, "feedback", np.concatenate([task, posture]))
        object.__setattr__(self, "limit", command_limit("limit", limit, problem.robot.velocity_limits))
        object.__setattr__(self, "second", second)

    @classmethod
    def on_chart(cls, chart: Chart, limit: ArrayLike | None = None, **settings: Any) -> Self:
        """Build the law on the problem of a chart; `feedback`, one number or (m + k_2,), defaults to 0.

        The setting `second` is "joints" (default) or "xi", the coordinates of the chart.
        """
        name = settings.pop("second", "joints")
        second = named_second(chart, name)
        m, k = chart.m, chart.n + (chart.m if second is None else 0)
        feedback = non_negative_gains(f"feedback (task, then {name})", settings.pop("feedback", 0.0), k)
        return cls(chart.problem, feedback[:m], feedback[m:], limit, second, **settings)

    def facts(self) -> dict[str, str]:
        """Quantities, gains and problem."""
        return law_facts(self)

    @property
    def settings(self) -> Mapping[str, str]:
        """The second task."""
        return {"second": self._second.name}

    @property
    def gains(self) -> dict[str, Array]:
        """Feedback and limit."""
        return {"feedback": self.feedback, "limit": self.limit}

    @cached_property
    def graph(self) -> ca.Function:
        """The same function as a graph with shared subexpressions; C is generated from it."""
        problem, m = self.problem, self.problem.m
        inputs = named_inputs(problem.n, self.gains, len(self.labels))
        q = inputs["q"]
        J, A = problem.task.jacobian_function(q), problem.metric.function(q)
        B, Lambda, volume = block_inertia(problem.n, (m,))(J, A)
        J_2_inverse, _, relative = self._second.weighted(q, A)
        error = self._second.shortest(inputs["reference"] - self.measured(q))
        rate = inputs["reference_velocity"] + inputs["feedback"] * error
        second = J_2_inverse @ rate[m:]
        velocity = second + B @ (Lambda @ (rate[:m] - J @ second))
        scale = median_volume(problem, problem.task.jacobian_function, problem.metric, (m,))
        domain = None if self.chart is None else self.chart.problem.domain
        return guarded_graph(self.name, inputs, velocity, ca.MX(problem.n, 1), volume / scale * relative, domain, True)

    @cached_property
    def fallback(self) -> ca.Function:
        """q, gains -> zero velocity."""
        n = self.problem.n
        return fallback_function(named_inputs(n, self.gains, 0), ca.MX(n, 1))
