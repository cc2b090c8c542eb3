"""The whole arm of orthocas: exact x and xi inside a wide chart, x first everywhere else, within all limits."""

from collections.abc import Sequence

import numpy as np

import orthocas as oc
from orthocas.tools.checks import Array
from redundancy.arms import TICK, Arm
from redundancy.protocol import Target
from redundancy.search import secant


class Whole:
    """The tracker of `oc.Arm` on the chart of the home's branch. The elbow's angle of a posture is what it holds.

    On a mobile base there is no chart: the tracker holds the posture of the beginning as far as x leaves it free.
    """

    name = "arm"
    packages = ("orthocas", "casadi")
    grid = ({"clearance": 0.1}, {"clearance": 0.05}, {"clearance": 0.2})

    def __init__(self, arm: Arm, clearance: float) -> None:
        self.arm, self.chart = arm, None
        if arm.mobile:
            self.whole = oc.Arm(arm.task)
            return
        fit = oc.fit_wide(arm.robot, arm.task, clearance=clearance, home=arm.home, like=arm.elbow_expression)
        self.chart, self.whole = fit.chart, oc.Arm(fit.chart.task, (fit.chart,))

    def start(self, q: Array, path: Sequence[Target] | None) -> None:
        """Begin at q."""
        self.q = q
        self.tracker = self.whole.tracker(q, period=TICK, velocity_limits=self.arm.fastest, detours=False)
        self.posture: Array | None = None

    def step(self, target: Target) -> Array:
        """Follow x, and the xi at which the elbow has the wished angle."""
        if self.chart is not None and target.posture is not self.posture:
            self.posture, self.bend = target.posture, self.arm.elbow(target.posture)
        x = self.whole.task.value(target.placement.translation, target.placement.rotation)
        if self.chart is None:
            return np.array(self.tracker.step(x))
        self.q = self.tracker.step(x, self._xi_of(x, self.bend if target.elbow is None else target.elbow))
        return np.array(self.q)

    def _xi_of(self, x: Array, angle: float) -> float | None:
        """xi at which the chart's posture of x has an angle of the elbow; None outside the chart."""
        if not self.chart.domain.contains(self.q):
            return None
        probe = self.chart.tracker(self.q, largest_step=1.0)

        def rest(xi: float) -> float:
            probe.reset(self.q)
            bend = self.arm.elbow(probe.step(np.append(x, xi)))
            return float(np.angle(np.exp(1j * (angle - bend))))

        return float(secant(rest, float(self.chart.xi(self.q)[0])))


METHODS = (Whole,)
