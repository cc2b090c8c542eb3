"""What to follow: phi(s) = [x(s); xi(s)] for s in [0, 1], through waypoints."""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.interpolate import CubicSpline

from orthocas.checks import Array
from orthocas.coordinates.turns import counted_on
from orthocas.errors import InvalidValueError
from orthocas.following.splines import places, same_ends, sampled, spline

if TYPE_CHECKING:
    from orthocas.chart import Chart


@dataclass(frozen=True, eq=False)
class Plan:
    """A path of the tool, and one of the extra coordinates."""

    x: CubicSpline  #: s -> (m,)
    xi: CubicSpline  #: s -> (r,)
    s: Array  #: (N,) parameters of the waypoints
    waypoints: Array  #: (N, m)
    is_function: bool  #: whether the path was given as a function, so that waypoints are samples of it
    closed: bool

    @classmethod
    def held(cls, chart: "Chart", tool_path: Any, xi: Array) -> "Plan":
        """A tool path with constant coordinates (r,)."""
        return cls._through(chart, tool_path, np.tile(xi, (2, 1)), np.array([0.0, 1.0]))

    @classmethod
    def scheduled(cls, chart: "Chart", tool_path: Any, xi: Any) -> "Plan":
        """A tool path with a schedule: coordinates at the waypoints (N, r), or a function of s."""
        values = counted_on(sampled("xi", xi, chart.r, chart.labels[chart.m :]), chart.turns[chart.m :])
        if callable(xi) or callable(tool_path):
            return cls._through(chart, tool_path, values, np.linspace(0.0, 1.0, len(values)))
        return cls._through(chart, tool_path, values, None)

    @classmethod
    def _through(cls, chart: "Chart", tool_path: Any, xi: Array, s_xi: Array | None) -> "Plan":
        """Splines; the coordinates are at parameters of their own, or at those of the waypoints (None)."""
        x = sampled("tool_path", tool_path, chart.m, chart.labels[: chart.m])
        if s_xi is None and len(xi) != len(x):
            raise InvalidValueError("number of rows of xi", len(xi), f"{len(x)}, as of tool_path")
        sizes = chart.phi_sizes[: chart.m]
        closed = same_ends(x, sizes) and bool(np.abs(xi[-1] - xi[0]).max() < 1e-9)
        if callable(tool_path):
            s = np.linspace(0.0, 1.0, len(x))
        elif s_xi is None:
            s = places(np.hstack([x, xi]), chart.phi_sizes)
        else:
            s = places(x, sizes)
        places_of_xi = s if s_xi is None else s_xi
        curve = spline(places_of_xi, xi, closed and len(xi) > 2)
        return cls(spline(s, x, closed), curve, s, x, callable(tool_path), closed)

    def with_xi(self, xi: CubicSpline) -> "Plan":
        """The same tool path with other coordinates."""
        return replace(self, xi=xi)

    def phi(self, s: Array, order: int = 0) -> Array:
        """phi or a derivative of it at parameters (N,), (N, n); at one number (n,)."""
        return np.concatenate([self.x(s, order), self.xi(s, order)], axis=-1)

    def checked(self) -> Array:
        """Parameters (P,) at which the path is checked: the waypoints, and between them."""
        return np.union1d(self.s, np.linspace(0.0, 1.0, 1001))

    def told(self, s: float, labels: tuple[str, ...]) -> str:
        """A place on the path in words."""
        x = ", ".join(f"{label} = {value:.4g}" for label, value in zip(labels, self.x(s), strict=False))
        if self.is_function:
            return f"at s = {s:.4g} ({x})"
        k = int(np.searchsorted(self.s, s - 1e-12))
        last = len(self.s) - 1
        if abs(self.s[min(k, last)] - s) < 1e-9:
            return f"at waypoint {k} of 0 to {last} ({x})"
        return f"between waypoints {k - 1} and {k} of 0 to {last} ({x})"
