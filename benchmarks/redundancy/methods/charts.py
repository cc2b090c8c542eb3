"""Charts of orthocas: tight, wide, along a known path, with the elbow's angle as coordinate, and many in an atlas."""

from collections.abc import Sequence

import numpy as np
from redundancy.arms import TICK, Arm
from redundancy.protocol import Target, Unsuited

import orthocas as oc
from orthocas.charts.solutions import Tracker
from orthocas.errors import OrthocasError
from orthocas.tools.checks import Array

MARGIN = 1e-3  # of joint ranges [rad]


class OnChart:
    """The tracker of a chart. Where a target is out of its domain, it goes as near as the domain lets it."""

    packages = ("orthocas", "casadi")
    named = False  #: whether xi is the angle of the elbow

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
        """Follow x and xi."""
        assert self.chart is not None
        if target.posture is not self.posture:  # xi of a posture changes seldom
            self.posture, self.wanted = target.posture, self.chart.xi(target.posture)
        xi = [target.elbow] if self.named and target.elbow is not None else self.wanted
        x = self.chart.problem.task.value(target.placement.translation, target.placement.rotation)
        return np.array(self.follower.step(np.concatenate([x, xi])))


class Tight(OnChart):
    """Cubic coordinates on a box around home, within the joint limits, fitted for a small leak."""

    name = "chart, tight"
    grid = ({"half_width": 0.6}, {"half_width": 0.3}, {"half_width": 0.9})

    def __init__(self, arm: Arm, half_width: float) -> None:
        if arm.mobile:
            box, family = oc.Box(arm.home, half_width), oc.Mobile(oc.Polynomial(2))
        else:
            room = np.minimum(arm.home - arm.lower, arm.upper - arm.home) - MARGIN
            box, family = oc.Box(arm.home, np.minimum(half_width, room)), oc.Polynomial(3)
        clear = oc.ClearBox(box, arm.task, 0.05) if not arm.mobile else box
        super().__init__(arm, oc.fit(oc.Problem(arm.robot, arm.task, domain=clear), family).chart)


class Wide(OnChart):
    """Coordinates that are regular on a whole branch of the joint range; xi is like the angle of the elbow."""

    name = "chart, wide"
    grid = ({"clearance": 0.1}, {"clearance": 0.05}, {"clearance": 0.2})
    named = True

    def __init__(self, arm: Arm, clearance: float) -> None:
        if arm.mobile:
            raise Unsuited("branches are those of a fixed arm")
        found = oc.fit_wide(arm.robot, arm.task, clearance=clearance, home=arm.home, like=arm.elbow_expression)
        super().__init__(arm, found.chart)


class Corridor(OnChart):
    """One chart near the postures of a path that is known before: those of least-norm steps with xi free."""

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
        problem = oc.Problem(self.arm.robot, self.arm.task, domain=oc.Box(self.arm.home, 1.0))
        try:
            near = oc.corridor_problem(problem, np.array(postures[:: self.thinned]), self.radius)
            self.chart = oc.fit(near, oc.Polynomial(3, "auto")).chart
        except OrthocasError as error:
            raise Unsuited(f"no corridor: {type(error).__name__}") from None
        super().start(q, path)

    def tracker(self, q: Array) -> Tracker:
        """From q; it holds still outside."""
        assert self.chart is not None
        return self.chart.tracker(q, largest_step=self.arm.fastest * TICK)


class Elbow(OnChart):
    """The angle of the elbow as coordinate, as in the shoulder-elbow-wrist parametrisation, between all limits."""

    name = "SEW angle"
    grid = ({"clearance": 0.05}, {"clearance": 0.02}, {"clearance": 0.1})
    named = True

    def __init__(self, arm: Arm, clearance: float) -> None:
        if arm.mobile:
            raise Unsuited("one number, for one joint more than the task has")
        box = oc.Box((arm.lower + arm.upper) / 2, (arm.upper - arm.lower) / 2 - MARGIN)
        problem = oc.Problem(arm.robot, arm.task, domain=oc.ClearBox(box, arm.task, clearance))
        given = oc.Given.from_function("elbow", arm.n, arm.elbow_expression)
        super().__init__(arm, oc.fit(problem, given).chart)


class Atlas:
    """Not here: it is built for hours, and hand-overs bring back drift; docs/atlas.md measures one."""

    name = "chart, atlas"
    packages = ("orthocas",)
    grid = ({},)

    def __init__(self, arm: Arm) -> None:
        raise Unsuited("takes hours to build for each arm; a corridor is its tool for known paths")


METHODS = (Tight, Wide, Corridor, Elbow, Atlas)
