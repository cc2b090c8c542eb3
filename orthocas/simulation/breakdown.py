"""The sources of unwanted task acceleration ([AS2023] Fig. 25b)."""

from dataclasses import dataclass, field

import casadi as ca

from orthocas.casadi_tools.batch import Batched, dense_function
from orthocas.chart import Chart
from orthocas.checks import Array, require_kind
from orthocas.errors import InvalidValueError
from orthocas.simulation.trajectory import Trajectory


@dataclass(frozen=True, eq=False)
class Breakdown:
    """Terms of the task acceleration dd_x along a run, each (N, m). They add up to dd_x."""

    labels: tuple[str, ...]  #: of x
    own: Array = field(repr=False)  #: J_x M^-1 J_x^T f_x, the effect of the task force
    error: Array = field(repr=False)  #: J_x M^-1 J_xi^T f_xi, [AS2023] eq. (38); 0 where (5) holds with A = M
    curvature: Array = field(repr=False)  #: dJ_x/dt dq
    coriolis: Array = field(repr=False)  #: -J_x M^-1 C dq

    @property
    def total(self) -> Array:
        """dd_x, (N, m)."""
        return self.own + self.error + self.curvature + self.coriolis


def task_acceleration_breakdown(chart: Chart, trajectory: Trajectory) -> Breakdown:
    """Split dd_x into the terms of the first rows of [AS2023] eq. (34), with f_phi = J^-T (tau - g).

    The terms use the controller's model of the robot and leave out pushes and friction.

    Args:
        chart: the chart whose coordinates define the terms.
        trajectory: a run of any torque controller.

    Raises:
        InvalidValueError: if the trajectory belongs to a velocity controller.
    """
    require_kind("chart", chart, Chart)
    require_kind("trajectory", trajectory, Trajectory)
    if trajectory.kind != "torque":
        raise InvalidValueError("trajectory", f"a run of '{trajectory.controller}'", "a run of a torque controller")
    parts = Batched(_parts(chart))(trajectory.q, trajectory.dq, trajectory.command)
    return Breakdown(chart.problem.task.labels, *parts)


def _parts(chart: Chart) -> ca.Function:
    n, m, robot = chart.n, chart.m, chart.problem.robot
    q, dq, tau = (ca.MX.sym(name, n) for name in ("q", "dq", "tau"))
    J = chart.function("jacobian")(q)
    f = ca.solve(J.T, tau - robot.gravity(q))
    mobility = ca.solve(robot.mass_matrix(q), J[:m, :].T).T  # J_x M^-1
    own, error = mobility @ J[:m, :].T @ f[:m], mobility @ J[m:, :].T @ f[m:]
    curvature = chart.function("second_derivative")(q, dq, dq)[:m]
    coriolis = -mobility @ robot.coriolis_product(q, dq, dq)
    return dense_function("breakdown", [q, dq, tau], [own, error, curvature, coriolis], ["q", "dq", "tau"])
