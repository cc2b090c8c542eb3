"""What one coordinate reaches from a joint position, as postures along a curve (ours)."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from orthocas.checks import Array
from orthocas.reaching.curves import Branch
from orthocas.reaching.intervals import branch_along
from orthocas.reaching.stops import Stop

if TYPE_CHECKING:
    from orthocas.chart import Chart


@dataclass(frozen=True, eq=False)
class Fan:
    """The curve on which only one coordinate changes, from its lowest to its highest value."""

    label: str
    q: Array  #: (N, n) joint positions along the curve
    xi: Array  #: (N,) values of the coordinate
    arc_length: Array  #: (N,) [rad] or [m], 0 at the joint position that was given
    low_stop: Stop
    high_stop: Stop

    def places(self, count: int) -> Array:
        """Even distances along the curve, (count,), from one end to the other."""
        return np.linspace(self.arc_length[0], self.arc_length[-1], count)

    def spread(self, count: int) -> Array:
        """Joint positions at even distances along the curve, (count, n), by interpolation between its points."""
        return np.column_stack([np.interp(self.places(count), self.arc_length, column) for column in self.q.T])


def fan_along(chart: "Chart", q: Array, k: int) -> Fan:
    """The fan of the k-th coordinate at a joint position (n,) inside the domain."""
    down, up = branch_along(chart, q, k, -1.0), branch_along(chart, q, k, 1.0)
    if down.endless:  # then one direction passes everything
        down = Branch(q[None], np.zeros(1), down.stop)
    points = np.concatenate([down.q[:0:-1], up.q])
    arc_length = np.concatenate([-down.arc_length[:0:-1], up.arc_length])
    xi = chart.xi(points)[:, k]
    turn = getattr(chart.coordinates, "turn", 0.0)
    xi = np.unwrap(xi, period=turn) if turn else xi
    return Fan(chart.labels[chart.m + k], points, xi, arc_length, down.stop, up.stop)
