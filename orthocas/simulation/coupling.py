"""Evaluation of runs: coupling indices, and the sources of unwanted task acceleration ([AS2023] Fig. 25b)."""

from dataclasses import dataclass, field

import casadi as ca
import numpy as np

from orthocas.charts.chart import Chart
from orthocas.charts.phi import shortest
from orthocas.control.reference import Reference
from orthocas.errors import InvalidValueError
from orthocas.simulation.trajectory import Trajectory
from orthocas.tools.batch import Batched, dense_function
from orthocas.tools.cached import building
from orthocas.tools.checks import Array, require_kind
from orthocas.tools.display import Shown
from orthocas.tools.interrupts import deferred

_NO_STEP = 1e-9  # smaller differences of targets are rounding


@dataclass(frozen=True, eq=False, repr=False)
class Coupling(Shown):
    """Coupling indices. Rows are disturbed coordinates, columns are commanded coordinates."""

    labels: tuple[str, ...]  #: of phi = [x; xi]
    index: Array  #: (n, n) [unit of the row / unit of the column]; NaN where a coordinate was never commanded alone

    def of(self, disturbed: str, commanded: str) -> float:
        """The index of one pair of labels: how much steps of the second coordinate disturb the first."""
        return float(self.index[self.labels.index(disturbed), self.labels.index(commanded)])

    def facts(self) -> dict[str, str]:
        """The coordinate that each commanded coordinate disturbs most."""
        known = [j for j in range(len(self.labels)) if np.isfinite(self.index[:, j]).any()]
        worst = {j: int(np.nanargmax(self.index[:, j])) for j in known}
        found = {f"steps of {self.labels[j]}": f"{self.index[i, j]:.3g} in {self.labels[i]}" for j, i in worst.items()}
        return {"coupling": f"{len(known)} of {len(self.labels)} coordinates commanded alone", **found}


def coupling_index(chart: Chart, reference: Reference, trajectory: Trajectory) -> Coupling:
    """Largest deviation of each coordinate while only one other is commanded, divided by the commanded step.

    Deviations are measured from the reference. Steps that change several targets at once are left out; of several steps
    in one coordinate, the worst counts. Motion left over from an earlier step counts too, so let the arm come to rest
    between steps.

    Args:
        chart: the chart whose coordinates are evaluated, even if the controller does not use them.
        reference: steps in phi = [x; xi], `Reference.steps` with `chart.labels`.
        trajectory: the run.

    Raises:
        InvalidValueError: if the reference has other labels.

    Source:
        ours
    """
    require_kind("chart", chart, Chart)
    require_kind("reference", reference, Reference)
    require_kind("trajectory", trajectory, Trajectory)
    if reference.labels != chart.labels:
        raise InvalidValueError("labels of the reference", reference.labels, f"those of the chart {chart.labels}")
    wanted = reference.sample(np.minimum(trajectory.times, reference.duration))[0]
    away = np.abs(shortest(chart.phi(trajectory.q) - wanted, chart.turns))
    steps = np.diff(np.vstack([reference.start, reference.targets]), axis=0)
    index = np.full((chart.n, chart.n), np.nan)
    for segment, step in enumerate(steps):
        moved = np.flatnonzero(np.abs(step) > _NO_STEP)
        begin, end = reference.times[segment : segment + 2]
        inside = (trajectory.times >= begin) & (trajectory.times <= end)
        if len(moved) == 1 and inside.any():
            worst = away[inside].max(axis=0) / abs(step[moved[0]])
            worst[moved] = np.nan
            index[:, moved[0]] = np.fmax(index[:, moved[0]], worst)
    return Coupling(chart.labels, index)


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
    with deferred(), building:  # threads share the chart
        function = _parts(chart)
    parts = Batched(function)(trajectory.q, trajectory.dq, trajectory.command)
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
