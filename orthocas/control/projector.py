"""The state of the art for comparison: null-space projectors at torque level and at velocity level."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from orthocas.casadi_tools.cached import cached_property
from orthocas.casadi_tools.scalar_code import scalar_code
from orthocas.chart import Chart
from orthocas.checks import Array, frozen_array, require_kind
from orthocas.control.controller import (
    Command,
    fallback_function,
    guarded_graph,
    law_facts,
    named_function,
    named_inputs,
)
from orthocas.control.damping import damping_matrix
from orthocas.control.gains import (
    DAMPING_RATIO,
    FEEDBACK,
    LIMIT,
    STIFFNESS,
    command_limit,
    non_negative_gains,
    positive_gains,
)
from orthocas.control.inertia import block_inertia, median_volume
from orthocas.control.matched_stiffness import matched_posture_stiffness, matched_stiffness
from orthocas.control.reference import Reference
from orthocas.errors import UnreachableReferenceError
from orthocas.problem import Problem
from orthocas.showing import Shown


@dataclass(frozen=True, eq=False, repr=False)
class Projector(Shown):
    """Impedance control of the task, with joint springs to a posture q_d in the null space of the task.

    tau = J_x^T (-K_x (x - x_d) - D_x J_x dq) + P^T (-K_q (q - q_d) - D_q dq) + g, P = I - J_x^#A J_x, where A is the
    metric of the problem; A = M gives the dynamically consistent projector. The reference is [x_d; q_d]. Eq. (29) gives
    the damping, with the inertia M_x in the task and M in the joints. The law has no domain.

    Args:
        problem: robot, task and metric.
        stiffness: diagonal of K_x, > 0, (m,) or one number.
        posture_stiffness: diagonal of K_q, > 0, (n,) or one number [N m/rad].
        damping_ratio: of all springs, >= 0, (m + n,) or one number.
        limit: largest torque of each joint, (n,) or one number; default the effort limits of the robot.

    Source:
        [AS2023] eqs. (2), (3).
    """

    problem: Problem
    stiffness: Array  #: K_x, then K_q, (m + n,)
    damping_ratio: Array
    limit: Array

    name: ClassVar[str] = "projector"
    formula: ClassVar[str] = "Task impedance plus posture springs in the null space of the task, plus g(q)."
    command: ClassVar[Command] = "torque"
    chart: ClassVar[None] = None
    gain_units: ClassVar[Mapping[str, str]] = {"stiffness": STIFFNESS, "damping_ratio": DAMPING_RATIO, "limit": LIMIT}
    settings: ClassVar[Mapping[str, str]] = {}
    options: ClassVar[tuple[str, ...]] = ("stiffness", "damping_ratio", "posture_stiffness")

    def __init__(
        self,
        problem: Problem,
        stiffness: ArrayLike,
        posture_stiffness: ArrayLike,
        damping_ratio: ArrayLike = 0.7,
        limit: ArrayLike | None = None,
    ) -> None:
        require_kind("problem", problem, Problem)
        n, m = problem.n, problem.m
        task = positive_gains("stiffness", stiffness, m)
        posture = positive_gains("posture_stiffness", posture_stiffness, n)
        object.__setattr__(self, "problem", problem)
        object.__setattr__(self, "stiffness", frozen_array("stiffness", np.concatenate([task, posture]), (m + n,)))
        object.__setattr__(self, "damping_ratio", non_negative_gains("damping_ratio", damping_ratio, m + n))
        object.__setattr__(self, "limit", command_limit("limit", limit, problem.robot.effort_limits))

    @classmethod
    def on_chart(cls, chart: Chart, limit: ArrayLike | None = None, **settings: Any) -> Self:
        """Build the law on the problem of a chart; by default with modes around 4 Hz."""
        stiffness, posture = settings.pop("stiffness", None), settings.pop("posture_stiffness", None)
        return cls(
            chart.problem,
            matched_stiffness(chart)[: chart.m] if stiffness is None else stiffness,
            matched_posture_stiffness(chart.problem) if posture is None else posture,
            limit=limit,
            **settings,
        )

    def remarks(self) -> list[str]:
        """No warnings."""
        return []

    def facts(self) -> dict[str, str]:
        """Quantities, gains and problem."""
        return law_facts(self)

    @property
    def labels(self) -> tuple[str, ...]:
        """Task labels, then joint names."""
        return _labels(self.problem)

    @property
    def gains(self) -> dict[str, Array]:
        """Stiffness, damping ratio and limit."""
        return {"stiffness": self.stiffness, "damping_ratio": self.damping_ratio, "limit": self.limit}

    @cached_property
    def measured(self) -> ca.Function:
        """[h(q); q]."""
        return _task_and_posture(self.problem)

    @cached_property
    def function(self) -> ca.Function:
        """q, dq (n, 1), reference and its derivatives (m + n, 1), gains -> command (n, 1), status (1, 1)."""
        return scalar_code(self.graph)

    @cached_property
    def graph(self) -> ca.Function:
        """The same function as a graph with shared subexpressions; C is generated from it."""
        problem, m = self.problem, self.problem.m
        inputs = self._inputs()
        q, K = inputs["q"], inputs["stiffness"]
        J, gravity = problem.task.jacobian_function(q), problem.robot.gravity(q)
        e, D_x, D_q = self._errors_and_damping(inputs)
        f_x = -K[:m] * e[:m] - D_x @ (J @ inputs["dq"])
        posture = -K[m:] * e[m:] - D_q @ inputs["dq"]
        B, Lambda, volume = block_inertia(problem.n, (m,))(J, problem.metric.function(q))
        torque = J.T @ f_x + posture - J.T @ (Lambda @ (B.T @ posture)) + gravity
        scale = median_volume(problem, problem.task.jacobian_function, problem.metric, (m,))
        return guarded_graph(self.name, inputs, torque, gravity, volume / scale, None)

    @cached_property
    def fallback(self) -> ca.Function:
        """q, gains -> gravity torque."""
        inputs = self._inputs()
        return fallback_function(inputs, self.problem.robot.gravity(inputs["q"]))

    @cached_property
    def energy(self) -> ca.Function:
        """V, the kinetic energy plus all springs, also their projected-out part [J], and power of both dampers [W]."""
        problem, m = self.problem, self.problem.m
        inputs = self._inputs()
        q, dq = inputs["q"], inputs["dq"]
        e, D_x, D_q = self._errors_and_damping(inputs)
        J = problem.task.jacobian_function(q)
        B, Lambda, _ = block_inertia(problem.n, (m,))(J, problem.metric.function(q))
        through = dq - B @ (Lambda @ (J @ dq))  # P dq
        storage = (ca.bilin(problem.robot.mass_matrix(q), dq, dq) + ca.dot(e, inputs["stiffness"] * e)) / 2
        power = ca.bilin(D_x, J @ dq, J @ dq) + ca.bilin(D_q, through, dq)
        return scalar_code(named_function("energy", inputs, {"storage": storage, "dissipated_power": power}))

    def require_reachable(self, reference: Reference, q_start: Array) -> None:
        """Raise UnreachableReferenceError if a posture of the reference leaves the joint limits."""
        _require_posture_within_limits(self.problem, reference)

    def _inputs(self) -> dict[str, ca.MX]:
        return named_inputs(self.problem.n, self.gains, len(self.labels))

    def _errors_and_damping(self, inputs: dict[str, ca.MX]) -> tuple[ca.MX, ca.MX, ca.MX]:
        """e = [x - x_d; q - q_d], D_x with the inertia M_x, and D_q with M."""
        problem, m = self.problem, self.problem.m
        q, K, Z = inputs["q"], inputs["stiffness"], inputs["damping_ratio"]
        M = problem.robot.mass_matrix(q)
        M_x = block_inertia(problem.n, (m,))(problem.task.jacobian_function(q), M)[1]
        D_x, D_q = _damping(m)(M_x, K[:m], Z[:m]), _damping(problem.n)(M, K[m:], Z[m:])
        return self.measured(q) - inputs["reference"], D_x, D_q


@dataclass(frozen=True, eq=False, repr=False)
class KinematicProjector(Shown):
    """Joint velocity dq = J_x^#A (d_x_d + Lambda_x (x_d - x)) + P (d_q_d + Lambda_q (q_d - q)).

    With zero feedback and a constant posture, this is pseudo-inverse control. The reference is [x_d; q_d].

    Args:
        problem: robot, task and metric A.
        feedback: diagonal of Lambda_x, >= 0, (m,) or one number [1/s].
        posture_feedback: diagonal of Lambda_q, >= 0, (n,) or one number [1/s].
        limit: largest speed of each joint, (n,) or one number; default the velocity limits of the robot.

    Source:
        [AS2023] eq. (1).
    """

    problem: Problem
    feedback: Array  #: Lambda_x, then Lambda_q, (m + n,)
    limit: Array

    name: ClassVar[str] = "kinematic_projector"
    formula: ClassVar[str] = "Velocity control by pseudo-inverse and projector; does not use the input dq."
    command: ClassVar[Command] = "velocity"
    chart: ClassVar[None] = None
    energy: ClassVar[None] = None
    gain_units: ClassVar[Mapping[str, str]] = {"feedback": FEEDBACK, "limit": LIMIT}
    settings: ClassVar[Mapping[str, str]] = {}
    options: ClassVar[tuple[str, ...]] = ("feedback",)

    def __init__(
        self,
        problem: Problem,
        feedback: ArrayLike = 0.0,
        posture_feedback: ArrayLike = 0.0,
        limit: ArrayLike | None = None,
    ) -> None:
        require_kind("problem", problem, Problem)
        task = non_negative_gains("feedback", feedback, problem.m)
        posture = non_negative_gains("posture_feedback", posture_feedback, problem.n)
        object.__setattr__(self, "problem", problem)
        object.__setattr__(self, "feedback", np.concatenate([task, posture]))
        object.__setattr__(self, "limit", command_limit("limit", limit, problem.robot.velocity_limits))

    @classmethod
    def on_chart(cls, chart: Chart, limit: ArrayLike | None = None, **settings: Any) -> Self:
        """Build the law on the problem of a chart; `feedback`, one number or (m + n,), defaults to 0."""
        m, n = chart.m, chart.n
        feedback = non_negative_gains("feedback (task, then joints)", settings.pop("feedback", 0.0), m + n)
        return cls(chart.problem, feedback[:m], feedback[m:], limit, **settings)

    def remarks(self) -> list[str]:
        """No warnings."""
        return []

    def facts(self) -> dict[str, str]:
        """Quantities, gains and problem."""
        return law_facts(self)

    @property
    def labels(self) -> tuple[str, ...]:
        """Task labels, then joint names."""
        return _labels(self.problem)

    @property
    def gains(self) -> dict[str, Array]:
        """Feedback and limit."""
        return {"feedback": self.feedback, "limit": self.limit}

    @cached_property
    def measured(self) -> ca.Function:
        """[h(q); q]."""
        return _task_and_posture(self.problem)

    @cached_property
    def function(self) -> ca.Function:
        """q, dq (n, 1), reference and its derivatives (m + n, 1), gains -> command (n, 1), status (1, 1)."""
        return scalar_code(self.graph)

    @cached_property
    def graph(self) -> ca.Function:
        """The same function as a graph with shared subexpressions; C is generated from it."""
        problem, m = self.problem, self.problem.m
        inputs = named_inputs(problem.n, self.gains, len(self.labels))
        q = inputs["q"]
        J = problem.task.jacobian_function(q)
        B, Lambda, volume = block_inertia(problem.n, (m,))(J, problem.metric.function(q))
        rate = inputs["reference_velocity"] + inputs["feedback"] * (inputs["reference"] - self.measured(q))
        velocity = rate[m:] + B @ (Lambda @ (rate[:m] - J @ rate[m:]))
        scale = median_volume(problem, problem.task.jacobian_function, problem.metric, (m,))
        return guarded_graph(self.name, inputs, velocity, ca.MX(problem.n, 1), volume / scale, None, True)

    @cached_property
    def fallback(self) -> ca.Function:
        """q, gains -> zero velocity."""
        n = self.problem.n
        return fallback_function(named_inputs(n, self.gains, 0), ca.MX(n, 1))

    def require_reachable(self, reference: Reference, q_start: Array) -> None:
        """Raise UnreachableReferenceError if a posture of the reference leaves the joint limits."""
        _require_posture_within_limits(self.problem, reference)


def _labels(problem: Problem) -> tuple[str, ...]:
    return (*problem.task.labels, *problem.robot.joint_names)


def _task_and_posture(problem: Problem) -> ca.Function:
    q = ca.MX.sym("q", problem.n)
    return ca.Function("measured", [q], [ca.densify(ca.vertcat(problem.task.function(q), q))])


def _damping(size: int) -> ca.Function:
    inertia, K, Z = ca.MX.sym("M", size, size), ca.MX.sym("K", size), ca.MX.sym("Z", size)
    return ca.Function("damping", [inertia, K, Z], [ca.densify(damping_matrix("square_root", inertia, K, Z))])


def _require_posture_within_limits(problem: Problem, reference: Reference) -> None:
    times = reference.grid()
    postures = reference.sample(times)[0][:, problem.m :]
    outside = np.argwhere((postures < problem.robot.lower) | (postures > problem.robot.upper))
    if outside.size:
        k, i = outside[0]
        raise UnreachableReferenceError(
            f"the reference puts joint '{problem.robot.joint_names[i]}' at {postures[k, i]:.4g} "
            f"at t = {times[k]:.3g} s, expected within [{problem.robot.lower[i]:.4g}, {problem.robot.upper[i]:.4g}]"
        )
