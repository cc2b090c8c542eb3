"""Joint velocities from phi = [x; xi]: a law ([AS2023] Sec. 9), and a task for quadratic programs of pink and mink."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar, Self

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from orthocas.charts.chart import Chart
from orthocas.control.controller import (
    Command,
    LawOfChart,
    Setting,
    compute_drift,
    compute_errors,
    fallback_function,
    guarded_graph,
    named_inputs,
    require_chart,
)
from orthocas.control.gains import FEEDBACK, LIMIT, RULES, command_limit, non_negative_gains
from orthocas.control.linear_algebra import build_block_inertia, compute_median_volume
from orthocas.errors import InvalidValueError
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array, as_float_array, require_at_least, require_shape
from orthocas.tools.display import Shown, listed, number_list
from orthocas.tools.expressions import wrap_shortest


@dataclass(frozen=True, eq=False, repr=False)
class Kinematic(LawOfChart):
    """Joint velocity dq = J^-1 (d_phi_d + Lambda (phi_d - phi)).

    The error e = phi - phi_d obeys de/dt = -Lambda e, so the error decays from every start.

    Args:
        chart: a chart with a closed expression (not a grown one).
        feedback: diagonal of Lambda, >= 0, (n,) or one number [1/s]; default 10. The paper uses 0, which keeps errors
            of the start and of the integration, and those from jumps of the reference or the sensors.
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
    options: ClassVar[Mapping[str, Setting]] = {"feedback": Setting("Feedback gain [1/s]; default: 10.")}

    def __init__(self, chart: Chart, feedback: ArrayLike = RULES.feedback, limit: ArrayLike | None = None) -> None:
        require_chart(chart, f"the law {self.name}")
        object.__setattr__(self, "chart", chart)
        object.__setattr__(self, "feedback", non_negative_gains("feedback", feedback, chart.n))
        object.__setattr__(self, "limit", command_limit("limit", limit, chart.problem.robot.velocity_limits))

    @classmethod
    def on_chart(cls, chart: Chart, limit: ArrayLike | None = None, *, feedback: ArrayLike = RULES.feedback) -> Self:
        """Build the law on a chart."""
        return cls(chart, feedback, limit)

    def remarks(self) -> list[str]:
        """No warnings."""
        return []

    @property
    def gains(self) -> dict[str, Array]:
        """Inputs of the law besides state and targets: the feedback gain [1/s] and the limit of the task speed."""
        return {"feedback": self.feedback, "limit": self.limit}

    @cached_property
    def graph(self) -> ca.Function:
        """The same function as a graph with shared subexpressions; C is generated from it."""
        n, problem = self.chart.n, self.problem
        inputs = named_inputs(n, self.gains, n)
        q = inputs["q"]

        # Compute the desired rate of phi, d_phi_d - Lambda_feedback e.
        e, J = compute_errors(self.chart, q, inputs["reference"])
        rate = compute_drift(self.chart, q, inputs["reference"], inputs["reference_velocity"]) - inputs["feedback"] * e

        # dq = J^-1 rate, with J^-1 = A^-1 J^T (J A^-1 J^T)^-1.
        B, Lambda, volume = build_block_inertia(n, (n,))(J, problem.metric.function(q))
        velocity = B @ (Lambda @ rate)
        scale = compute_median_volume(problem, self.chart.parts.rates, problem.metric, (n,))
        return guarded_graph(self.name, inputs, velocity, ca.MX(n, 1), volume / scale, problem.domain, True)

    @cached_property
    def fallback(self) -> ca.Function:
        """q, gains -> zero velocity."""
        return fallback_function(named_inputs(self.chart.n, self.gains, 0), ca.MX(self.chart.n, 1))


class XiTask(Shown):
    """e = xi(q) - xi_d for differential inverse kinematics with pink or mink: J_xi dq = -gain e, at a cost.

    Use this task in a list of tasks or constraints, in place of a posture task. The tool's task does not disturb xi, so
    both are met together, whereas a posture task pulls the tool away. The class needs neither package. It has the
    methods that both call, and finds joints by name in the `model` of a configuration, of Pinocchio or MuJoCo.

    Args:
        chart: a chart with a closed expression, of the arm in the model.
        cost: cost of errors of xi, one number or (r,), >= 0, as in tasks of pink and mink.
        gain: share of the error that a step removes, 0 to 1.
        lm_damping: Levenberg-Marquardt damping as in pink and mink, >= 0.
        joints: names of the chart's joints in the model; default: their names in the chart's robot.

    Raises:
        NoExpressionError: for grown charts.
        InvalidValueError: if a number is out of range.

    Example:
        >>> import orthocas as oc
        >>> from orthocas import problems
        >>> chart = oc.fit(problems.get("planar_3r_xy"), oc.Polynomial(degree=2), samples=300).chart
        >>> task = oc.control.XiTask(chart, cost=1.0)
        >>> task.set_target(chart.xi([0.6, 0.8, 0.8]))
    """

    def __init__(
        self,
        chart: Chart,
        cost: ArrayLike,
        gain: float = 1.0,
        lm_damping: float = 0.0,
        joints: tuple[str, ...] | None = None,
    ) -> None:
        require_chart(chart, "a task of a quadratic program")
        self.gain = require_at_least("gain", gain, 0)
        self.lm_damping = require_at_least("lm_damping", lm_damping, 0)
        if gain > 1:
            raise InvalidValueError("gain", gain, "a number from 0 to 1")
        self.chart = chart
        self.cost = non_negative_gains("cost", cost, chart.r)
        self.joints = chart.problem.robot.joint_names if joints is None else tuple(joints)
        require_shape("joints", (len(self.joints),), (chart.n,))
        self.target_xi: Array | None = None
        # Last position, from which turns of joints without limits are counted.
        self._last: Array | None = None
        # The last model and its joint indices are kept, because a look-up takes longer than xi.
        self._of_model: tuple[Any, list[tuple[Any, int]]] = (None, [])

    def facts(self) -> dict[str, str]:
        """Cost, gain and target."""
        target = "none yet" if self.target_xi is None else number_list(self.target_xi)
        labels = listed(self.chart.parts.named_coordinates)
        return {"task": f"{labels}, cost {number_list(self.cost)}, gain {self.gain:g}", "target": target}

    def set_target(self, xi: ArrayLike) -> None:
        """Set the desired coordinates xi_d, (r,)."""
        target = as_float_array("xi", xi)
        require_shape("xi", target.shape, (self.chart.r,))
        self.target_xi = target.copy()

    def set_target_from_configuration(self, configuration: Any) -> None:
        """Set the target to the coordinates of a configuration."""
        self.target_xi = self.chart.xi(self._read_position(configuration))

    def compute_error(self, configuration: Any) -> Array:
        """e (r,), the shorter way around for circle-valued coordinates.

        Raises:
            InvalidValueError: before a target is set, or if the model lacks one of the joints.
        """
        if self.target_xi is None:
            raise InvalidValueError("target of the task", "none", "one from `set_target`")
        error = self.chart.xi(self._read_position(configuration)) - self.target_xi
        return np.asarray(wrap_shortest(error, self.chart.parts.turns[self.chart.m :]))

    def compute_jacobian(self, configuration: Any) -> Array:
        """de/dq, (r, nv), with zeros for joints that the chart does not have."""
        places = [place for _, place in self._find_places(configuration.model)]
        J = np.zeros((self.chart.r, configuration.model.nv))
        J[:, places] = self.chart.coordinates.jacobian(self._read_position(configuration)[None])[0]
        return J

    def compute_qp_residual(self, configuration: Any) -> tuple[Array, Array, float]:
        """Weighted J, weighted residual r = -gain e, and the damping mu = lm_damping |r|^2; mink calls it."""
        error = -self.gain * self.cost * self.compute_error(configuration)
        J = self.cost[:, None] * self.compute_jacobian(configuration)
        return J, error, self.lm_damping * float(error @ error)

    def compute_qp_objective(self, configuration: Any) -> tuple[Array, Array]:
        """H and c of the cost 1/2 dq^T H dq + c^T dq; pink calls it."""
        J, error, damping = self.compute_qp_residual(configuration)
        return J.T @ J + damping * np.eye(J.shape[1]), -error @ J

    def _read_position(self, configuration: Any) -> Array:
        """The chart's joint positions, (n,)."""
        q = configuration.q
        values = (q[place] for place, _ in self._find_places(configuration.model))
        # Pinocchio stores revolute joints without limits as cosine and sine.
        q = np.array([value if np.ndim(value) == 0 else np.arctan2(value[1], value[0]) for value in values])
        self._last = q if self._last is None else np.asarray(self.chart.problem.unwrap(q, self._last))
        return self._last

    def _find_places(self, model: Any) -> list[tuple[Any, int]]:
        """Indices of each joint in q and in dq; in q, a slice for joints that Pinocchio stores as cosine and sine."""
        if model is self._of_model[0]:
            return self._of_model[1]
        # MuJoCo's models have other attributes than Pinocchio's.
        of_mujoco = not hasattr(model, "getJointId")
        names = [model.joint(k).name for k in range(model.njnt)] if of_mujoco else [*model.names]
        missing = [name for name in self.joints if name not in names]
        if missing:
            raise InvalidValueError("model", f"without a joint '{missing[0]}'", f"one of {', '.join(names)}")
        places: list[tuple[Any, int]] = []
        for name in self.joints:
            if of_mujoco:
                joint = model.joint(name)
                places.append((int(joint.qposadr[0]), int(joint.dofadr[0])))
                continue
            joint = model.joints[model.getJointId(name)]
            places.append((joint.idx_q if joint.nq == 1 else slice(joint.idx_q, joint.idx_q + joint.nq), joint.idx_v))
        self._of_model = model, places
        return places
