"""A user's session with a chart: targets for phi, undo, home, and the mirrored arm."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from orthocas.charts.chart import Chart
from orthocas.charts.self_motion import fan_along
from orthocas.charts.trackers import TrackerStatus
from orthocas.charts.walls import Stop, Walls
from orthocas.errors import InvalidValueError
from orthocas.robots.robot import Robot
from orthocas.tasks.branches import Branches
from orthocas.tasks.domains import StopKind
from orthocas.tools.checks import Array, as_number, as_point, require_kind, require_known
from orthocas.viewer.looks import RULES
from orthocas.viewer.panel import Readers, Readings


def describe_stop(stop: Stop, robot: Robot) -> str:
    """Text about what ends a motion; for a joint, its position with unit."""
    if stop.kind is not StopKind.JOINT:
        return str(stop)
    slides = robot.tree.prismatic[robot.joint_names.index(stop.joint)]
    place = f"{stop.value:.3f} m" if slides else f"{np.degrees(stop.value):.1f}°"
    return f"joint '{stop.joint}' at {place}, {'its limit' if stop.is_limit else 'the boundary of the domain'}"


class Session:
    """A joint position of a chart that follows targets for components of phi.

    A target names components of phi, such as {"xi1": 0.2}; the others keep their values. `follow` moves q along the
    straight line in phi with a tracker, so q stays within the domain and never jumps. If the line leaves the domain or
    meets a fold, q stops before it, and the target is dropped. A session belongs to one thread.

    Args:
        chart: a fitted chart.
        q: initial joint position, (n,); default: the centre of the domain.

    Raises:
        NoExpressionError: if the coordinates are grown.
        InvalidValueError: if q lies outside the domain, or J is singular there.
    """

    flips: tuple[int, ...] = ()  #: cuts of `branches` at which the arm is mirrored
    branches: Branches | None = None  #: branches of the robot, after a search

    def __init__(self, chart: Chart, q: Array | None = None) -> None:
        require_kind("chart", chart, Chart)
        self.home: Array = chart.problem.domain.home if q is None else as_point("q", q, chart.n)
        self._past: list[tuple[Array, tuple[int, ...]]] = []
        # Whether a joint limit of the mirrored arm stopped the motion.
        self._limited = False
        self.chart = chart
        self._tracker = chart.tracker(self.home)
        self._readers, self._walls = Readers(chart), Walls(chart.problem)
        self._target: Array = chart.phi(self.home)  # (n,)
        self.stop = ""  #: what stopped the last motion, or ""

    @property
    def place(self) -> str:
        """The branch of a mirrored arm, for the panel; empty if the arm is not mirrored."""
        if not (self.branches and self.flips):
            return ""
        branch = self.branches.of(self.mirror(self.q[None])[0])
        return f"mirrored: branch {branch.name if branch else 'without a name'}"

    @property
    def q(self) -> Array:
        """The joint position, (n,)."""
        return self._tracker.q

    @property
    def readings(self) -> Readings:
        """The readings at q, with the task value of the last target as reference."""
        return self._readers.read(self.q, self._target[: self.chart.m], self.stop)

    def mirror(self, q: Array) -> Array:
        """Joint positions of the arm for positions of the chart (N, n): mirrored at `flips`, same pose of the tip."""
        for cut in self.flips:
            assert self.branches is not None
            q = np.array([self.branches.mirrored(point, cut) for point in q])
        return q

    def find_allowed(self, q: Array) -> NDArray[np.bool_]:
        """Whether the (mirrored) arm is within its joint limits at positions of the chart (N, n), (N,)."""
        robot, shown = self.chart.problem.robot, self.mirror(q)
        return np.asarray(((shown >= robot.lower) & (shown <= robot.upper)).all(axis=1)) | (not self.flips)

    def flip(self, cut: int) -> None:
        """Mirror the arm at one of `branches.mirrors`, or undo this; the tip keeps its pose.

        The coordinates of the mirrored arm are those of its mirror image in the chart, so no other chart is needed. If
        the mirrored arm would exceed a joint limit, xi moves to the nearest value where it does not.

        Raises:
            InvalidValueError: if the mirrored arm exceeds a joint limit at all values of xi.
        """
        self.remember()
        before, self.flips = self.flips, tuple(sorted({*self.flips} ^ {cut}))
        # Find the nearest position on the self-motions where the mirrored arm is within its joint limits.
        curves = [fan_along(self.chart, self.q, k).q for k in range(self.chart.r)]
        places = np.concatenate([self.q[None], *curves])
        good = places[self.find_allowed(places)]
        if not len(good):
            self.flips = before
            raise InvalidValueError(
                "the mirrored arm", "beyond its joint limits", "a pose of the tip at which it is within them"
            )
        self._move_to(good[np.argmin(np.linalg.norm(good - self.q, axis=1))])

    @property
    def can_undo(self) -> bool:
        """Whether there is an earlier joint position to return to."""
        return bool(self._past)

    def wish(self, values: Mapping[str, float]) -> None:
        """Set targets for some components of phi, by their labels.

        Raises:
            UnknownNameError, InvalidValueError: if there is no such component, or a value is not finite.
        """
        require_kind("values", values, Mapping)
        wished = self._target.copy()
        for label, value in values.items():
            require_known("component of phi", str(label), self.chart.labels)
            number = as_number(f"wish for {label}", value)
            if not np.isfinite(number):
                raise InvalidValueError(f"target for {label}", value, "a finite number")
            wished[self.chart.labels.index(label)] = number
        self._target = wished

    def follow(self, most_steps: int = RULES.tracker_steps) -> bool:
        """Move towards the target. Returns whether q moved; then the target is reached, dropped, or still ahead."""
        moved = False
        for _ in range(most_steps):
            here = self.chart.phi(self.q)
            if not self._find_far(here).any():
                break
            if not self._step(here):
                # Drop the unreachable part of the target, and report what stops the motion.
                self._target = np.where(self._find_far(here), here, self._target)
                if self._limited:
                    self.stop = "a joint limit of the mirrored arm"
                elif self._tracker.status is not TrackerStatus.OUTSIDE_DOMAIN:
                    self.stop = "a fold of the chart or a singular position"
                else:
                    self.stop = describe_stop(self._walls.worst(self.q), self.chart.problem.robot)
                break
            moved, self.stop = True, ""
        return moved

    def find_reach(self, k: int) -> tuple[float, float]:
        """The lowest and highest value of component k of phi on a line from here, with the other components fixed."""
        here, size, ends = self.chart.phi(self.q), float(self.chart.parts.phi_sizes[k]), []
        for sense in (-1.0, 1.0):
            tracker, far, step = self.chart.tracker(self.q), 0.0, size / RULES.reach_steps
            while step > RULES.slider_step / 4 and far < RULES.reach_sizes * size:
                target, before = here.copy(), tracker.q
                target[k] += sense * (far + step)
                tracker.step(target)
                missed = np.abs(self.chart.phi(tracker.q) - target) / self.chart.parts.phi_sizes
                if (
                    tracker.status is TrackerStatus.OK
                    and missed.max() < RULES.missed
                    and self.find_allowed(tracker.q[None])[0]
                ):
                    far += step
                else:
                    tracker.reset(before)
                    step /= 2
            ends.append(float(here[k] + sense * far))
        return ends[0], ends[1]

    def remember(self) -> None:
        """Store the joint position for `undo`."""
        if not self._past or not self._is_here(*self._past[-1]):
            self._past = [*self._past[-RULES.most_undone :], (self.q, self.flips)]

    def undo(self) -> None:
        """Return to the last stored joint position that differs from the present one."""
        while self._past:
            before, flips = self._past.pop()
            if not self._is_here(before, flips):
                self.flips = flips
                self._move_to(before)
                return

    def go_home(self) -> None:
        """Return to the initial position of the session."""
        self.remember()
        self.flips = ()
        self._move_to(self.home)

    def _is_here(self, q: Array, flips: tuple[int, ...]) -> bool:
        """Whether the arm is at this position, with these flips."""
        return bool((q == self.q).all()) and flips == self.flips

    def _step(self, here: Array) -> bool:
        """Step as far along the line as the tracker allows. Returns whether a step was possible."""
        fraction, before, self._limited = 1.0, self.q, False
        while fraction >= RULES.shortest_step:
            self._tracker.step(here + fraction * (self._target - here))
            if self._tracker.status is TrackerStatus.OK:
                if self.find_allowed(self.q[None])[0]:
                    return True
                self._tracker.reset(before)
                self._limited = True
            fraction /= 2
        return False

    def _find_far(self, here: Array) -> NDArray[np.bool_]:
        """Which components of phi have not reached their target, (n,)."""
        return np.asarray(np.abs((self._target - here) / self.chart.parts.phi_sizes) > RULES.reached)

    def _move_to(self, q: Array) -> None:
        self._tracker.reset(q)
        self._target = self.chart.phi(q)
        self.stop = ""
