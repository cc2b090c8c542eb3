"""Charts of orthocas: tight, wide, along a known path, and with the elbow's angle as coordinate."""

from collections.abc import Sequence
from contextlib import suppress

import numpy as np

import orthocas as oc
from orthocas.charts.trackers import Tracker
from orthocas.errors import DomainError, OrthocasError
from orthocas.paths import corridor_problem
from orthocas.tools.checks import Array
from redundancy.arms import TICK, Arm
from redundancy.protocol import Target, Unsuited
from redundancy.search import secant

MARGIN = 1e-3  # of joint ranges [rad]


def around_home(arm: Arm, half_width: float) -> oc.Box:
    """A box with home in its middle, within the joint limits."""
    room = np.minimum(arm.home - arm.lower, arm.upper - arm.home) - MARGIN
    return oc.Box(arm.home, np.minimum(half_width, room))


def widest_clear(arm: Arm, clearance: float) -> oc.ClearBox:
    """The clear part of the box of the joint limits; where its middle is singular, of a smaller one around home."""
    inner = around_home(arm, np.pi)
    ends = [
        (arm.lower + MARGIN, inner.centre - inner.half_width),
        (arm.upper - MARGIN, inner.centre + inner.half_width),
    ]
    for share in np.linspace(0, 1, 21):
        low, high = ((1 - share) * outer + share * near for outer, near in ends)
        with suppress(DomainError):
            return oc.ClearBox(oc.Box((low + high) / 2, (high - low) / 2), arm.task, clearance)
    raise Unsuited("home is not clear of singular positions")


class OnChart:
    """The tracker of a chart. Where a target is out of its domain, it goes as near as the domain lets it."""

    packages = ("orthocas", "casadi")

    def __init__(self, arm: Arm, chart: oc.Chart | None) -> None:
        self.arm, self.chart = arm, chart

    def tracker(self, q: Array) -> Tracker:
        """From q."""
        assert self.chart is not None
        return self.chart.tracker(q, largest_step=self.arm.fastest * TICK, nearest=True)

    def start(self, q: Array, path: Sequence[Target] | None) -> None:
        """Begin at q."""
        assert self.chart is not None
        try:
            self.follower = self.tracker(q)
        except OrthocasError:
            raise Unsuited("the start lies outside the domain") from None
        self.posture: Array | None = None

    def step(self, target: Target) -> Array:
        """Follow x and xi, or search for the xi of a wished elbow."""
        assert self.chart is not None
        if self.posture is None:
            self.xi = self.chart.xi(self.follower.q)
        if target.posture is not self.posture:
            self.posture, self.wished = target.posture, self.chart.xi(target.posture)
        x = self.chart.problem.task.value(target.placement.translation, target.placement.rotation)
        if target.elbow is None or self.chart.r > 1:
            self.xi = self._ramped()
            return np.array(self.follower.step(np.concatenate([x, self.xi])))
        angle = target.elbow

        def rest(xi: float) -> float:
            return angle - self.arm.elbow(self.follower.step(np.append(x, xi)))

        self.xi = np.array([secant(rest, float(self.xi[0]))])
        return np.array(self.follower.q)

    def _ramped(self) -> Array:
        """The next xi on the way to the wished one: as far as the joints' speed permits."""
        assert self.chart is not None
        way = self.wished - self.xi
        if not way.any():
            return self.wished
        joints = np.linalg.solve(self.chart.jacobian(self.follower.q), np.concatenate([np.zeros(self.chart.m), way]))
        needed = float((np.abs(joints) / (0.8 * TICK * self.arm.fastest)).max())
        return self.xi + way / max(1.0, needed)


class Tight(OnChart):
    """Cubic coordinates on a box around home, within the joint limits, fitted for a small leak."""

    name = "chart, tight"
    grid = ({"half_width": 0.6}, {"half_width": 0.3}, {"half_width": 0.9})

    def __init__(self, arm: Arm, half_width: float) -> None:
        box, family = around_home(arm, half_width), oc.Mobile(oc.Polynomial(2)) if arm.mobile else oc.Polynomial(3)
        clear = box if arm.mobile else oc.ClearBox(box, arm.task, 0.05)
        super().__init__(arm, oc.fit(oc.Problem(arm.robot, arm.task, domain=clear), family).chart)


class Wide(OnChart):
    """Coordinates that are regular on a whole branch of the joint range; xi is like the angle of the elbow."""

    name = "chart, wide"
    grid = ({"clearance": 0.1}, {"clearance": 0.05}, {"clearance": 0.2})

    def __init__(self, arm: Arm, clearance: float) -> None:
        if arm.mobile:
            raise Unsuited("branches are those of a fixed arm")
        found = oc.fit_wide(arm.robot, arm.task, clearance=clearance, home=arm.home, like=arm.elbow_expression)
        super().__init__(arm, found.chart)


class Corridor(OnChart):
    """One chart near the postures of a path that is known before: those of least-norm steps."""

    name = "chart, corridor"
    grid = ({"radius": 0.2}, {"radius": 0.1}, {"radius": 0.4})
    thinned = 20  # ticks between postures

    def __init__(self, arm: Arm, radius: float) -> None:
        if arm.mobile:
            raise Unsuited("domains of a mobile base have no corridor")
        super().__init__(arm, None)
        self.radius = radius

    def start(self, q: Array, path: Sequence[Target] | None) -> None:
        """Fit, then begin."""
        if path is None:
            raise Unsuited("the path is not known before")
        postures, now = [q], q
        for target in path:
            now = now + np.linalg.pinv(self.arm.jacobian(now)) @ self.arm.error(now, target.placement)
            postures.append(now)
        problem = oc.Problem(self.arm.robot, self.arm.task, domain=around_home(self.arm, 1.0))
        self.chart = None
        with suppress(OrthocasError):  # where the path leaves the joint limits, there is no corridor
            near = corridor_problem(problem, np.array(postures[:: self.thinned]), self.radius)
            self.chart = oc.fit(near, oc.Polynomial(3, "auto")).chart
            super().start(q, path)
        self.q = q

    def step(self, target: Target) -> Array:
        """Follow; without a corridor, stay."""
        return self.q if self.chart is None else super().step(target)

    def tracker(self, q: Array) -> Tracker:
        """From q; it holds still outside."""
        assert self.chart is not None
        return self.chart.tracker(q, largest_step=self.arm.fastest * TICK)


class Elbow(OnChart):
    """The angle of the elbow as coordinate, as in the shoulder-elbow-wrist parametrisation, between all limits."""

    name = "SEW angle"
    grid = ({"clearance": 0.05}, {"clearance": 0.02}, {"clearance": 0.1})

    def __init__(self, arm: Arm, clearance: float) -> None:
        if arm.mobile:
            raise Unsuited("one number, for one joint more than the task has")
        problem = oc.Problem(arm.robot, arm.task, domain=widest_clear(arm, clearance))
        given = oc.Given.from_function("elbow", arm.n, arm.elbow_expression)
        super().__init__(arm, oc.fit(problem, given).chart)


METHODS = (Tight, Wide, Corridor, Elbow)
