"""References of projector controllers that mean the same motion as a reference in a chart's coordinates."""

import numpy as np
from numpy.typing import ArrayLike

from orthocas.chart import Chart
from orthocas.checks import require_kind
from orthocas.control.reachability import joint_path
from orthocas.control.reference import Reference


def posture_reference(chart: Chart, reference: Reference, q_start: ArrayLike) -> Reference:
    """[x_d; q_d] with phi(q_d) = phi_d at every instant: what to give a `Projector` to compare it with.

    Args:
        chart: the coordinates of the reference.
        reference: in phi = [x; xi].
        q_start: where the motion starts, (n,).

    Raises:
        UnreachableReferenceError: if the reference leaves the domain.
    """
    require_kind("chart", chart, Chart)
    path = joint_path(chart, reference, q_start)
    times = reference.grid()
    task = reference.sample(times)[0][:, : chart.m]
    labels = (*chart.problem.task.labels, *chart.problem.robot.joint_names)
    return Reference.through(labels, times, np.hstack([task, path]))
