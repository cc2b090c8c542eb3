"""Readings of a joint position as a small page of HTML: numbers and bars."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from itertools import takewhile

import numpy as np
from numpy.typing import NDArray

from orthocas.charts.chart import Chart
from orthocas.charts.self_motion import Walls
from orthocas.charts.solutions import TrackerStatus
from orthocas.errors import InvalidValueError
from orthocas.robots.robot import Robot
from orthocas.tasks.domains import bounds_of
from orthocas.tools.checks import Array, as_number, as_point, require_kind, require_known
from orthocas.viewer.motion import Motion

GOOD, FAIR, POOR = "#2f9e62", "#e0a100", "#d64545"
STYLE = """<style>
.oc{font:13px/1.45 system-ui,sans-serif;color:#22262b;padding:2px 14px 6px 4px}
.oc h4{font-size:11px;letter-spacing:.06em;text-transform:uppercase;color:#7a828c;margin:14px 0 5px;font-weight:600}
.oc .name{font-size:16px;font-weight:650}.oc .about{color:#6a727c;font-size:12px}
.oc .row{display:grid;grid-template-columns:6.4em 1fr 4.6em;gap:8px;align-items:center;margin:3px 0}
.oc .row>span:first-child{overflow:hidden;text-overflow:ellipsis;white-space:nowrap}
.oc .row>b{font-weight:500;text-align:right;font-variant-numeric:tabular-nums;white-space:nowrap}
.oc .bar{position:relative;height:8px;border-radius:4px;background:#e9ecef}
.oc .bar i{position:absolute;top:0;bottom:0;border-radius:4px}
.oc .bar u{position:absolute;top:-3px;bottom:-3px;width:4px;margin-left:-2px;border-radius:2px}
.oc .held{display:flex;justify-content:space-between;align-items:baseline;background:#f1f5fa;border-radius:8px;
padding:8px 10px;margin-top:10px}
.oc .held b{font-size:17px;font-weight:650;color:#1f5fa8;font-variant-numeric:tabular-nums}
.oc .stop{margin-top:10px;padding:7px 10px;border-radius:8px;background:#fff3e6;color:#8a4b08;font-size:12px}
</style>"""
MOST_STEPS = 200  # of the tracker towards one wish
_SHORTEST = 1e-4  # share of the way to a wish below which there is no way on
_REACHED = 1e-10  # of the sizes of the components
_MOST_UNDONE = 100


@dataclass(frozen=True, eq=False)
class Readings:
    """Numbers at one joint position of a chart."""

    q: Array  #: (n,) [rad] or [m]
    x: Array  #: (m,) task value
    xi: Array  #: (r,)
    drift: float  #: largest |x - held x| of a component, in the units of the task
    leak_deg: Array  #: (r,) leak of each coordinate [deg]
    conditioning: float  #: 1 perfect, 0 singular
    boundary: float  #: distance to the boundary of the domain [rad] or [m]
    inside: Array  #: (n,) place of each joint in the domain: -1 and 1 are its boundaries, 0 its middle
    stop: str = ""  #: what stopped the last motion, or ""


class Readers:
    """Takes readings of a chart."""

    def __init__(self, chart: Chart) -> None:
        self._chart = chart
        domain = chart.problem.domain
        low, high = bounds_of(domain)
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
            boundary=float(quality.boundary_distance),
            inside=np.where(self._free, (inside + 1) % 2 - 1, inside),
            stop=stop,
        )


class ChartPanel:
    """Writes the readings of one chart."""

    def __init__(self, chart: Chart, place: str = "") -> None:
        self.chart = chart
        problem = chart.problem
        robot, domain = problem.robot, problem.domain
        self._joints = JointBars(robot.joint_names, robot.tree.prismatic, robot.lower, robot.upper, *bounds_of(domain))
        self._labels, self._units = chart.labels, problem.task.units
        self._half_width = float(domain.half_width.min())
        task = ", ".join(map(escape, chart.labels[: chart.m]))
        branch = chart.notes.get("branch")
        lines = [place] if place else []
        lines += [f"branch {escape(branch)}"] if isinstance(branch, str) else []
        lines += [f"{escape(chart.coordinates.label)}, {chart.n} joints"]
        lines += [f"task {task}; {chart.r} coordinate{'s' if chart.r > 1 else ''}"]
        self._head = f'<div class="name">{escape(problem.name)}</div><div class="about">{"<br>".join(lines)}</div>'

    def html(self, readings: Readings) -> str:
        """The page."""
        m, units = len(readings.x), set(self._units)
        unit = units.pop() if len(units) == 1 else ""
        stop = f'<div class="stop">stopped by {escape(readings.stop)}</div>' if readings.stop else ""
        leaks = [
            bar(label, degrees / 15, f"{degrees:.2f}°", grade(-degrees, -2, -6), value=degrees)
            for label, degrees in zip(self._labels[m:], readings.leak_deg.tolist(), strict=True)
        ]
        boundary = bar(
            "boundary", readings.boundary / self._half_width, f"{readings.boundary:.3f}", value=readings.boundary,
            colour=grade(readings.boundary / self._half_width, 0.15, 0.04),
        )  # fmt: skip
        level = readings.conditioning
        conditioning = bar("conditioning", level, f"{level:.3f}", grade(level, 0.4, 0.15), value=level)
        drift = number("drift", readings.drift, held(readings.drift, unit))
        parts = [
            STYLE, '<div class="oc">', self._head, f'<div class="held"><span>task moved by</span>{drift}</div>',
            stop, "<h4>leak of the coordinates</h4>", *leaks,
            "<h4>chart</h4>", conditioning, boundary,
            "<h4>joints</h4>", self._joints.html(readings.q), "</div>",
        ]  # fmt: skip
        return "".join(parts)


class JointBars:
    """One bar for each joint: its limits, the domain as a darker band, and where the joint is."""

    def __init__(
        self, names: Sequence[str], prismatic: Iterable[bool], lower: Array, upper: Array, low: Array, high: Array
    ) -> None:
        low, high = np.maximum(low, lower), np.minimum(high, upper)
        ends = np.where(np.isfinite(lower), lower, np.where(np.isfinite(low), low, -np.pi))
        tops = np.where(np.isfinite(upper), upper, np.where(np.isfinite(high), high, np.pi))
        spans = np.maximum(tops - ends, 1e-9)
        bands = np.clip(np.column_stack([low - ends, high - ends]) / spans[:, None], 0, 1)
        shown = without_shared_words(names)
        places = zip(ends.tolist(), spans.tolist(), bands.tolist(), strict=True)
        self._joints = list(zip(names, shown, prismatic, places, strict=True))

    def html(self, q: Array) -> str:
        """The bars at a joint position (n,)."""
        return "".join(self._bar(*joint, value) for joint, value in zip(self._joints, q.tolist(), strict=True))

    def _bar(
        self, name: str, shown_name: str, slides: bool, track: tuple[float, float, list[float]], value: float
    ) -> str:
        end, span, band = track
        place = (value - end) / span
        shown = place % 1 if not 0 <= place <= 1 else place
        text = f"{value:.3f} m" if slides else f"{round(np.degrees(value), 1) + 0.0:.1f}°"
        near = min(place - band[0], band[1] - place) / max(band[1] - band[0], 1e-9)
        return (
            f'<div class="row"><span title="{escape(name)}">{escape(shown_name)}</span><div class="bar">'
            f'<i style="left:{100 * band[0]:.1f}%;right:{100 - 100 * band[1]:.1f}%;background:#c9d3df"></i>'
            f'<u style="left:{100 * shown:.2f}%;background:{grade(near, 0.03, 0.005)}"></u></div>'
            f"{number(name, value, text)}</div>"
        )


def without_shared_words(names: Sequence[str]) -> list[str]:
    """Names without the words before a "_" that all of them begin with, as in panda_joint1, panda_joint2."""
    words = [name.split("_") for name in names]
    shared = len(list(takewhile(lambda same: len(set(same)) == 1, zip(*(each[:-1] for each in words), strict=False))))
    return ["_".join(each[shared if len(names) > 1 else 0 :]) for each in words]


def bar(label: str, share: float, text: str, colour: str, value: float) -> str:
    """A row with a name, a bar that fills a share of its width, and a number."""
    width = 100 * float(np.clip(share if np.isfinite(share) else 0.0, 0, 1))
    return (
        f'<div class="row"><span>{escape(label)}</span><div class="bar">'
        f'<i style="left:0;width:{width:.1f}%;background:{colour}"></i></div>{number(label, value, text)}</div>'
    )


def number(name: str, value: float, text: str) -> str:
    """A number as text; its exact value is in `data-value`, for programs that read the page."""
    return f'<b data-oc="{escape(name)}" data-value="{value!r}">{escape(text)}</b>'


def grade(value: float, good: float, fair: float) -> str:
    """Colour of a value that is better the larger it is."""
    return GOOD if value >= good else FAIR if value >= fair else POOR


def held(drift: float, unit: str) -> str:
    """How far the task has moved, in words of a scale that people know."""
    if unit != "m":
        return f"{drift:.0e} {unit}".rstrip()
    for scale, name in ((1e-3, "mm"), (1e-6, "µm"), (1e-9, "nm")):
        if drift >= scale:
            return f"{drift / scale:.3g} {name}"
    return "< 1 nm"


class RobotPanel:
    """Writes the joints and the tip of a robot."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        endless = np.full(robot.n, np.inf)
        self._joints = JointBars(
            robot.joint_names, robot.tree.prismatic, robot.lower, robot.upper, -endless, endless
        )  # fmt: skip
        self._head = (
            f'<div class="name">{escape(robot.tree.tip_name)}</div>'
            f'<div class="about">{robot.n} joints, {robot.tree.masses.sum():.4g} kg</div>'
        )

    def html(self, q: Array) -> str:
        """The page at a joint position (n,)."""
        tip = zip("xyz", self._robot.tip_position(q).tolist(), strict=True)
        rows = [plain_row(f"{axis} [m]", value) for axis, value in tip]
        return "".join([STYLE, '<div class="oc">', self._head, "<h4>tip</h4>", *rows, "<h4>joints</h4>",
                        self._joints.html(q), "</div>"])  # fmt: skip


def plain_row(label: str, value: float, note: str = "") -> str:
    """A row with a name and a number, and perhaps a note between them."""
    name = f'<span title="{escape(label)}">{escape(label)}</span><span class="about">{escape(note)}</span>'
    return f'<div class="row">{name}{number(label, value, f"{value:.4f}")}</div>'


class PlayerPanel:
    """Writes where motions are: quantities of one motion, or how far the joints of several are from their start."""

    def __init__(self, robot: Robot, motions: Sequence[Motion]) -> None:
        endless = np.full(robot.n, np.inf)
        self._motions = motions
        self._prismatic = np.array(robot.tree.prismatic)
        self._joints = JointBars(
            robot.joint_names, robot.tree.prismatic, robot.lower, robot.upper, -endless, endless
        )  # fmt: skip

    def html(self, seconds: float) -> str:
        """The page some seconds after the start."""
        several = len(self._motions) > 1
        parts = [self._away(motion, seconds) if several else self._alone(motion, seconds) for motion in self._motions]
        return "".join([STYLE, '<div class="oc">', f'<div class="about">{seconds:.2f} s</div>', *parts, "</div>"])

    def _alone(self, motion: Motion, seconds: float) -> str:
        k = motion.index(seconds)
        rows = []
        for i, label in enumerate(motion.labels):
            note = "" if motion.references is None else f"reference {motion.references[k, i]:.4f}"
            rows.append(plain_row(label, float(motion.values[k, i]), note))
        marked = motion.marked is not None and motion.marked[k]
        stop = '<div class="stop">the controller uses its fallback</div>' if marked else ""
        head = f'<div class="name">{escape(motion.name)}</div>'
        return "".join(
            [head, stop, "<h4>quantities</h4>", *rows, "<h4>joints</h4>", self._joints.html(motion.at(seconds))]
        )

    def _away(self, motion: Motion, seconds: float) -> str:
        away = motion.at(seconds) - motion.q[0]
        name = f"{motion.name}: joints from their start"
        turned = float(np.degrees(np.abs(np.where(self._prismatic, 0.0, away)).max()))
        shown = number(name, turned, f"{turned:.2f}°")
        ends = [
            f'<div class="row"><span>after {k}</span><span class="about">{"cycles" if k > 1 else "cycle"}</span>'
            f"{number(f'{motion.name} after {k}', degrees, f'{degrees:.2f}°')}</div>"
            for k, degrees in motion.returns(seconds)
        ]
        return (
            f'<h4></h4><div class="name">{escape(motion.name)}</div>'
            f'<div class="held"><span>joints from their start</span>{shown}</div>'
            f"{''.join(ends)}{self._joints.html(motion.at(seconds))}"
        )


class Session:
    """A joint position of a chart that follows what is wished for components of phi.

    A wish names components of phi, such as {"xi1": 0.2}; the others keep their values. `follow` moves q along the
    straight line in phi with a tracker, so within the domain and without jumps. Where the line leaves the domain or
    meets a fold, q stays before it, and the wish is given up. A session belongs to one thread.

    Args:
        chart: a fitted chart.
        q: where to begin, (n,); default: the centre of the domain.

    Raises:
        NoExpressionError: if the coordinates are grown.
        InvalidValueError: if q lies outside the domain, or J is singular there.
    """

    beyond = 0.0  #: how far a wish for a coordinate may lie beyond its ends in the chart, as a share of their distance
    _wished: Array  #: phi, (n,)

    def __init__(self, chart: Chart, q: Array | None = None) -> None:
        require_kind("chart", chart, Chart)
        self.home: Array = chart.problem.domain.centre if q is None else as_point("q", q, chart.n)
        self._past: list[Array] = []
        self._use(chart, self.home)

    @property
    def place(self) -> str:
        """Where the chart belongs, if there are several."""
        return ""

    @property
    def q(self) -> Array:
        """The joint position, (n,)."""
        return self._tracker.q

    @property
    def readings(self) -> Readings:
        """What the page shows about q; the task should have the value that was last wished for."""
        return self._readers.at(self.q, self._wished[: self.chart.m], self.stop)

    @property
    def can_undo(self) -> bool:
        """Whether there is an earlier joint position to return to."""
        return bool(self._past)

    def wish(self, values: Mapping[str, float]) -> None:
        """Wish for values of some components of phi, by their labels.

        Raises:
            UnknownNameError, InvalidValueError: if there is no such component, or a value is not finite.
        """
        require_kind("values", values, Mapping)
        wished = self._wished.copy()
        for label, value in values.items():
            require_known("component of phi", str(label), self.chart.labels)
            number = as_number(f"wish for {label}", value)
            if not np.isfinite(number):
                raise InvalidValueError(f"wish for {label}", value, "a finite number")
            wished[self.chart.labels.index(label)] = number
        self._wished = wished

    def follow(self, most_steps: int = MOST_STEPS) -> bool:
        """Move towards the wish. Returns whether q has moved; afterwards the wish is met, given up, or still ahead."""
        moved = False
        for _ in range(most_steps):
            here = self.chart.phi(self.q)
            if not self._far(here).any():
                break
            if not self._step(here):
                self._give_up(here)
                break
            moved, self.stop = True, ""
        return moved

    def remember(self) -> None:
        """Keep the joint position, for `undo`."""
        if not self._past or (self._past[-1] != self.q).any():
            self._past = [*self._past[-_MOST_UNDONE:], self.q]

    def undo(self) -> None:
        """Return to the last joint position that was remembered and is another one."""
        while self._past:
            before = self._past.pop()
            if (before != self.q).any():
                self._place(before)
                return

    def go_home(self) -> None:
        """Return to where the session began."""
        self.remember()
        self._place(self.home)

    def _step(self, here: Array) -> bool:
        """Step as far along the line as the tracker allows. Returns whether it allows any step."""
        share = 1.0
        while share >= _SHORTEST:
            self._tracker.step(here + share * (self._wished - here))
            if self._tracker.status is TrackerStatus.OK:
                return True
            share /= 2
        return False

    def _give_up(self, here: Array) -> None:
        """Wish for what there is in place of what cannot be, and say what is in the way."""
        self.stop = self._reason()
        self._wished = np.where(self._far(here), here, self._wished)

    def _far(self, here: Array) -> NDArray[np.bool_]:
        """Which components of phi are not yet what is wished for, (n,)."""
        return np.asarray(np.abs((self._wished - here) / self.chart.phi_sizes) > _REACHED)

    def _reason(self) -> str:
        if self._tracker.status is TrackerStatus.OUTSIDE_DOMAIN:
            return str(self._walls.worst(self.q))
        return "a fold of the chart or a singular position"

    def _use(self, chart: Chart, q: Array) -> None:
        """Go on in a chart, at rest at a joint position."""
        self.chart = chart
        self._tracker = chart.tracker(q)
        self._readers, self._walls = Readers(chart), Walls(chart.problem)
        self._wished = chart.phi(q)
        self.stop = ""  #: what stopped the last motion, or ""

    def _place(self, q: Array) -> None:
        self._tracker.reset(q)
        self._wished = self.chart.phi(q)
        self.stop = ""
