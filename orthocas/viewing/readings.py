"""What a view tells about a joint position: task, coordinates, and how far everything is from its limits."""

from dataclasses import dataclass

import numpy as np

from orthocas.chart import Chart
from orthocas.checks import Array
from orthocas.domains import borders


@dataclass(frozen=True, eq=False)
class Readings:
    """Numbers at one joint position of a chart."""

    q: Array  #: (n,) [rad] or [m]
    x: Array  #: (m,) task value
    xi: Array  #: (r,)
    drift: float  #: largest |x - held x| of a component, in the units of the task
    leak_deg: Array  #: (r,) leak of each coordinate [deg]
    conditioning: float  #: 1 perfect, 0 singular
    border: float  #: distance to the border of the domain [rad] or [m]
    inside: Array  #: (n,) place of each joint in the domain: -1 and 1 are its borders, 0 its middle
    stop: str = ""  #: what stopped the last motion, or ""


class Readers:
    """Takes readings of a chart."""

    def __init__(self, chart: Chart) -> None:
        self._chart = chart
        domain = chart.problem.domain
        low, high = borders(domain)
        self._free = ~np.isfinite(low) | ~np.isfinite(high)
        self._middle, self._half_width = domain.centre, domain.half_width

    def at(self, q: Array, held: Array, stop: str = "") -> Readings:
        """Readings at a joint position (n,), with the task value (m,) that should not change."""
        chart = self._chart
        phi = chart.phi(q)
        quality = chart.quality(q)
        inside = (q - self._middle) / self._half_width
        return Readings(
            q=q,
            x=phi[: chart.m],
            xi=phi[chart.m :],
            drift=float(np.abs(phi[: chart.m] - held).max()),
            leak_deg=quality.leak_deg,
            conditioning=float(quality.conditioning),
            border=float(quality.border_distance),
            inside=np.where(self._free, (inside + 1) % 2 - 1, inside),
            stop=stop,
        )
