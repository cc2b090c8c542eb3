"""The whole arm of orthocas: exact x and xi inside a wide chart, x first everywhere else, within all limits."""

from collections.abc import Sequence

import numpy as np

import orthocas as oc
from orthocas.tools.checks import Array
from redundancy.arms import TICK, Arm
from redundancy.protocol import Target
from redundancy.search import secant


class Whole:
    """The tracker of `oc.Arm` on the chart of the home's branch: near the posture, or with a wished elbow, at its xi.

    On a mobile base there is no chart.
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

    def step(self, target: Target) -> Array:
        """Follow x, and the posture, or the xi at which the elbow has the wished angle."""
        x = self.whole.task.value(target.placement.translation, target.placement.rotation)
        if target.elbow is None or self.chart is None:
            self.q = self.tracker.step(x, posture=target.posture)
        else:
            self.q = self.tracker.step(x, self._xi_of(x, target.elbow))
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
