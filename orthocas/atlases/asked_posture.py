"""The posture asked for along a motion of the tool: xi is held in one chart after the other, without jumps (ours)."""

import numpy as np

from orthocas.atlases.atlas import Atlas
from orthocas.chart import Chart
from orthocas.checks import Array
from orthocas.errors import PathError

_ENOUGH = 1e-12  # of phi, relative to its sizes
_ITERATIONS = 12
_SINGULAR = 1e12  # condition number of J
_RATE = 10.0  # [1/s] at which xi comes to rest after a hand-over


class AskedPosture:
    """q_d(t) with h(q_d) = x_d(t), held in the coordinates of a chart: phi_d = (x_d, xi_d).

    At a hand-over from chart a to chart b at q_d, the coordinates asked for become phi_b(q_d), J_b dq_d and
    J_b ddq_d + dJ_b/dt dq_d. So q_d, dq_d and ddq_d are continuous. From there on the velocity of xi_d decays like a
    critically damped system: d3xi/dt3 + 2 w d2xi/dt2 + w^2 dxi/dt = 0 with w = 10 1/s.

    A chart is left where the position lies in the outer half of the overlap of its box, if another chart's cell holds
    it. A cell ends where that overlap begins, so charts do not alternate.

    Args:
        atlas: the atlas.
    """

    chart: Chart  #: the chart of the moment
    number: int  #: of the chart
    q: Array  #: q_d, (n,)
    dq: Array  #: (n,)
    ddq: Array  #: (n,)
    phi: Array  #: phi_d with two derivatives, (3, n)

    def __init__(self, atlas: Atlas) -> None:
        self.atlas = atlas

    def start(self, q: Array, time: float = 0.0) -> None:
        """Begin at rest at a posture (n,).

        Raises:
            PathError: if the atlas has no chart there.
        """
        self.number = int(self.atlas.chart_at(q))
        if self.number < 0:
            raise PathError(f"q = {np.round(q, 3).tolist()} has no chart in the atlas, expected a covered posture")
        xi = self.atlas.xi(q, self.number)
        self._time = self._since = time
        self._xi = np.stack([xi, 0 * xi, 0 * xi])
        self.q, self.dq, self.ddq = q.copy(), 0 * q, 0 * q
        self.chart = self.atlas.chart(self.number, q)
        self.phi = np.stack([self.chart.phi(q), self.dq, self.ddq])

    def move(self, time: float, x: Array) -> None:
        """Go on to a time and the task values with two derivatives of that time, (3, m), in the same chart.

        Raises:
            PathError: if no posture near the last one has these coordinates.
        """
        self._time, self._x = time, x
        self.phi = np.hstack([x, self._held(time - self._since)])
        chart = self.chart
        phi, jacobian, bend = (chart.function(name) for name in ("phi", "jacobian", "second_derivative"))
        q, error = self.q, np.inf
        for _ in range(_ITERATIONS):
            missing, J = self.phi[0] - phi(q).full()[:, 0], jacobian(q).full()
            error = np.abs(missing / chart.phi_sizes).max()
            if error <= _ENOUGH or not (np.isfinite(J).all() and np.linalg.cond(J) < _SINGULAR):
                break
            q = q + np.linalg.solve(J, missing)
        if not error <= _ENOUGH:
            raise PathError(f"the task values at {time:.4g} s cannot be reached with the posture held")
        self.q, self.dq = q, np.linalg.solve(J, self.phi[1])
        self.ddq = np.linalg.solve(J, self.phi[2] - bend(q, self.dq, self.dq).full()[:, 0])

    def wanted_at(self, q: Array) -> int:
        """The chart for a position (n,), perhaps the same."""
        index, joints = self.atlas.index, list(self.atlas.plan.joints)
        u = np.abs(index.on_cube(q[None, joints], np.array([self.number]))).max()
        overlap = self.atlas.settings.overlap
        if u <= (1 + 1 / (1 + overlap)) / 2:
            return self.number
        found = int(self.atlas.chart_at(q))
        return found if found >= 0 else self.number

    def hand_over(self, number: int) -> None:
        """Go on in another chart with the same motion of the joints."""
        phi = np.stack(self.atlas.handed_over(self.q, self.dq, self.ddq, number))
        self.chart = self.atlas.chart(number, self.q)
        self.number, self._since, self._xi = number, self._time, phi[:, self.atlas.problem.m :]
        self.move(self._time, self._x)

    def _held(self, t: float) -> Array:
        """xi_d with two derivatives, (3, r), t after the last hand-over."""
        xi, v, a = self._xi
        rise, decay = a + _RATE * v, np.exp(-_RATE * t)
        gone = v * (1 - decay) / _RATE + rise * (1 - decay * (1 + _RATE * t)) / _RATE**2
        return np.stack([xi + gone, (v + rise * t) * decay, (rise - _RATE * (v + rise * t)) * decay])
