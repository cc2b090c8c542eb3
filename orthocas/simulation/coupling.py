"""Coupling indices: how much a commanded coordinate disturbs the others."""

from dataclasses import dataclass

import numpy as np

from orthocas.chart import Chart
from orthocas.checks import Array, require_kind
from orthocas.control.reference import Reference
from orthocas.coordinates.turns import shortest
from orthocas.errors import InvalidValueError
from orthocas.showing import Shown
from orthocas.simulation.trajectory import Trajectory

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
