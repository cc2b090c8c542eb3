"""References for projector controllers that describe the same motion as a reference in a chart's coordinates."""

import numpy as np
from numpy.typing import ArrayLike

from orthocas.chart import Chart
from orthocas.checks import require_kind
from orthocas.control.reachability import joint_path
from orthocas.control.reference import Reference


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
