"""Which references a law can reach."""

import numpy as np
from numpy.typing import ArrayLike

from orthocas.charts.chart import Chart
from orthocas.charts.self_motion import too_far
from orthocas.charts.solutions import Tracker, TrackerStatus
from orthocas.control.reference import Reference
from orthocas.errors import InvalidValueError, InverseError, OrthocasError, UnreachableReferenceError, degrees_hint
from orthocas.tools.checks import Array, as_point, require_kind

_VALUES = "; targets of a Reference are values of phi, not changes of it ('move' in a steps file is a change)"


def joint_path(chart: Chart, reference: Reference, q_start: ArrayLike) -> Array:
    """Joint positions with phi(q) equal to the reference, followed from q_start, (N, n) on `reference.grid()`.

    Raises:
        UnreachableReferenceError: names the first time at which no such q exists near the previous one, or q lies
            outside the domain.
    """
    require_kind("chart", chart, Chart)
    require_kind("reference", reference, Reference)
    q_start = as_point("q_start", q_start, chart.n)
    if reference.labels != chart.labels:
        raise InvalidValueError("labels of the reference", reference.labels, f"those of the chart {chart.labels}")
    if not chart.problem.domain.contains(q_start):
        hint = degrees_hint(*q_start[~np.array(chart.problem.robot.tree.prismatic)])
        raise UnreachableReferenceError(f"the start lies outside the domain: {_outside(chart, q_start)}{hint}")
    times = reference.grid()
    values = reference.sample(times)[0]
    path, q = np.empty((len(times), chart.n)), q_start
    targets = reference.targets[reference.segment(times)]
    follower = _Follower(chart, q_start)
    for k, value in enumerate(values):
        where = f"at t = {times[k]:.3g} s, at {_list(reference.labels, value)}"
        try:
            new = follower.step(value, q)
        except InverseError as error:
            text = (
                f"the reference cannot be reached {where}: {error}{too_far(chart, q, targets[k, chart.m :])}{_VALUES}"
            )
            raise UnreachableReferenceError(text) from None
        if not chart.problem.domain.contains(new):
            reason = f"{_outside(chart, new)}{too_far(chart, q, targets[k, chart.m :])}"
            raise UnreachableReferenceError(f"the reference leaves the domain {where}: {reason}{_VALUES}")
        path[k] = q = new
    return path


class _Follower:
    """Solves phi(q) = phi step by step: with a tracker, or with more care where that gives up or J is singular."""

    def __init__(self, chart: Chart, q_start: Array) -> None:
        self._chart = chart
        self._tracker = self._tracker_at(q_start)

    def step(self, phi: Array, q: Array) -> Array:
        """The solution near q.

        Raises:
            InverseError: if there is none.
        """
        if self._tracker is not None:
            found = self._tracker.step(phi)
            if self._tracker.status == TrackerStatus.OK:
                return found
        found = self._chart.inverse(phi, q, outside=True)  # the caller says where it leaves the domain
        self._tracker = self._tracker_at(found)
        return found

    def _tracker_at(self, q: Array) -> Tracker | None:
        try:
            return self._chart.tracker(q)
        except OrthocasError:  # grown coordinates, a singular J, or a point outside the domain
            return None


def _outside(chart: Chart, q: Array) -> str:
    domain = chart.problem.domain
    if domain.condition is not None and not np.all(np.asarray(domain.condition.pivots(q)) > 0):
        return domain.explain(q)
    low, high = domain.bounds
    i = int(np.argmax(np.abs(q - domain.centre) / (high - low)))
    low, high = low[i], high[i]
    return f"joint '{chart.problem.robot.joint_names[i]}' at {q[i]:.4g}, expected within [{low:.4g}, {high:.4g}]"


def _list(labels: tuple[str, ...], value: Array) -> str:
    return ", ".join(f"{label} = {number:.3g}" for label, number in zip(labels, value, strict=True))
