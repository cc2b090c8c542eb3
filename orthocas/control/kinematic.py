"""Velocity control in the coordinates phi = [x; xi] ([AS2023] Sec. 9)."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import ClassVar, Self

import casadi as ca
from numpy.typing import ArrayLike

from orthocas.charts.chart import Chart
from orthocas.control.controller import (
    Command,
    count_turns_from_centre,
    fallback_function,
    guarded_graph,
    law_facts,
    named_inputs,
)
from orthocas.control.errors import drift, errors
from orthocas.control.gains import (
    FEEDBACK,
    FEEDBACK_RATE,
    FEEDBACK_SETTING,
    LIMIT,
    Setting,
    command_limit,
    non_negative_gains,
)
from orthocas.control.linear_algebra import block_inertia, median_volume
from orthocas.control.posture import joint_path
from orthocas.control.reference import Reference
from orthocas.robots.tree import require_driven
from orthocas.tasks.problem import Problem
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array, require_kind
from orthocas.tools.display import Shown


@dataclass(frozen=True, eq=False, repr=False)
class Kinematic(Shown):
    """Joint velocity dq = J^-1 (d_phi_d + Lambda (phi_d - phi)).

    The error e = phi - phi_d obeys de/dt = -Lambda e, so every start ends on the reference.

    Args:
        chart: a chart with a closed expression (not a grown one).
        feedback: diagonal of Lambda, >= 0, (n,) or one number [1/s]; default 10. The paper uses 0, which keeps every
            error: of the start, of the integration, and of jumps of the reference or the sensors.
        limit: largest speed of each joint, (n,) or one number [rad/s] or [m/s]; default those of the robot.

    Raises:
        ShapeError, InvalidValueError: for settings of the wrong shape or value.
        NoExpressionError: if the chart is grown.

    Source:
        [AS2023] Sec. 9; the feedback is ours.
    """

    chart: Chart
    feedback: Array
    limit: Array

    name: ClassVar[str] = "kinematic"
    formula = "Velocity control dq = J^-1 (d phi_d + Lambda (phi_d - phi)); does not use the input dq."
    command: ClassVar[Command] = "velocity"
    energy = None
    energy_graph = None
    gain_units = MappingProxyType({"feedback": FEEDBACK, "limit": LIMIT})
    settings = MappingProxyType[str, str]({})
    options: ClassVar[Mapping[str, Setting]] = {"feedback": FEEDBACK_SETTING}

    def __init__(self, chart: Chart, feedback: ArrayLike = FEEDBACK_RATE, limit: ArrayLike | None = None) -> None:
        require_kind("chart", chart, Chart)
        require_driven(f"the law {self.name}", chart.problem.robot.tree)
        chart.function("xi")  # raises for grown charts
        object.__setattr__(self, "chart", chart)
        object.__setattr__(self, "feedback", non_negative_gains("feedback", feedback, chart.n))
        object.__setattr__(self, "limit", command_limit("limit", limit, chart.problem.robot.velocity_limits))

    @classmethod
    def on_chart(cls, chart: Chart, limit: ArrayLike | None = None, *, feedback: ArrayLike = FEEDBACK_RATE) -> Self:
        """Build the law on a chart."""
        return cls(chart, feedback, limit)

    def remarks(self) -> list[str]:
        """No warnings."""
        return []

    @property
    def problem(self) -> Problem:
        """Robot, task, metric and domain of the chart."""
        return self.chart.problem

    def facts(self) -> dict[str, str]:
        """Quantities, gains and problem."""
        return law_facts(self)

    @property
    def labels(self) -> tuple[str, ...]:
        """Task labels, then xi1, xi2, ..."""
        return self.chart.labels

    @property
    def gains(self) -> dict[str, Array]:
        """Inputs of the law besides state and targets: the feedback gain [1/s] and the limit of the task speed."""
        return {"feedback": self.feedback, "limit": self.limit}

    @property
    def measured(self) -> ca.Function:
        """Phi(q)."""
        return self.chart.function("phi")

    @cached_property
    def function(self) -> ca.Function:
        """q, dq (n, 1), reference and its derivatives (n, 1), gains -> command (n, 1), status (1, 1)."""
        return self.chart.runnable(count_turns_from_centre(self.graph, self.problem))

    @cached_property
    def graph(self) -> ca.Function:
        """The same function as a graph with shared subexpressions; C is generated from it."""
        n, problem = self.chart.n, self.problem
        inputs = named_inputs(n, self.gains, n)
        q = inputs["q"]
        e, J = errors(self.chart, q, inputs["reference"])
        B, Lambda, volume = block_inertia(n, (n,))(J, problem.metric.function(q))
        rate = drift(self.chart, q, inputs["reference"], inputs["reference_velocity"]) - inputs["feedback"] * e
        scale = median_volume(problem, self.chart.rates, problem.metric, (n,))
        velocity = B @ (Lambda @ rate)  # J^-1 = A^-1 J^T (J A^-1 J^T)^-1
        return guarded_graph(self.name, inputs, velocity, ca.MX(n, 1), volume / scale, problem.domain, True)

    @cached_property
    def fallback(self) -> ca.Function:
        """q, gains -> zero velocity."""
        return fallback_function(named_inputs(self.chart.n, self.gains, 0), ca.MX(self.chart.n, 1))

    def require_reachable(self, reference: Reference, q_start: Array) -> None:
        """Raise UnreachableReferenceError if the motion from q_start along the reference leaves the chart's domain."""
        joint_path(self.chart, reference, q_start)
