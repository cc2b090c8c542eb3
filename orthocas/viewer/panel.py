"""Readings at a joint position as a small HTML page with numbers and bars."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from itertools import takewhile

import numpy as np

from orthocas.charts.chart import Chart
from orthocas.robots.robot import Robot
from orthocas.tools.checks import Array
from orthocas.viewer.looks import RULES
from orthocas.viewer.motion import Motion

GOOD, FAIR, POOR, PLAIN = "#2f9e62", "#e0a100", "#d64545", "#5b83b5"
STYLE = """<style>
.oc{font:13px/1.45 system-ui,sans-serif;color:#22262b;padding:2px 14px 6px 4px}
.oc h4{font-size:11px;letter-spacing:.06em;text-transform:uppercase;color:#7a828c;margin:14px 0 5px;font-weight:600}
.oc .name{font-size:16px;font-weight:650}.oc .about{color:#6a727c;font-size:12px;overflow-wrap:anywhere}
.oc .row{display:grid;grid-template-columns:8em 1fr 4.6em;gap:8px;align-items:center;margin:3px 0}
.oc .row>span:first-child{overflow-wrap:anywhere}
.oc .row>b{font-weight:500;text-align:right;font-variant-numeric:tabular-nums;white-space:nowrap}
.oc .bar{position:relative;height:8px;border-radius:4px;background:#e9ecef}
.oc .bar i{position:absolute;top:0;bottom:0;border-radius:4px}
.oc .bar u{position:absolute;top:-3px;bottom:-3px;width:4px;margin-left:-2px;border-radius:2px}
.oc .held{display:flex;justify-content:space-between;align-items:baseline;background:#f1f5fa;border-radius:8px;
padding:8px 10px;margin-top:10px}
.oc .held b{font-size:17px;font-weight:650;color:#1f5fa8;font-variant-numeric:tabular-nums}
.oc .copy{user-select:all;font:12px/1.4 ui-monospace,monospace;background:#f6f7f9;border-radius:6px;padding:5px 8px}
.oc .stop{margin-top:10px;padding:7px 10px;border-radius:8px;background:#fff3e6;color:#8a4b08;font-size:12px}
</style>"""


@dataclass(frozen=True, eq=False)
class Readings:
    """Numbers of a chart at one joint position."""

    q: Array  #: (n,) [rad] or [m]
    x: Array  #: (m,) task values
    xi: Array  #: (r,)
    drift: Array  #: (m,) |x - desired x|, in the units of the task
    leak_deg: Array  #: (r,) leak of each coordinate [deg]
    conditioning: float  #: 1: perfect, 0: singular
    boundary: float  #: distance to the boundary of the domain [rad] or [m]
    nearest: int  #: the joint nearest to the boundary
    inside: Array  #: (n,) position of each joint in the domain: -1 and 1 at the boundaries, 0 at the centre
    stop: str = ""  #: what stopped the last motion, or ""


class Readers:
    """Computes the readings of a chart."""

    def __init__(self, chart: Chart) -> None:
        self._chart = chart
        domain = chart.problem.domain
        low, high = domain.bounds
        self._free = ~np.isfinite(low) | ~np.isfinite(high)
        self._middle, self._half_width = domain.centre, domain.half_width

    def read(self, q: Array, held: Array, stop: str = "") -> Readings:
        """Readings at a joint position (n,); `held` (m,) is the task value that should stay constant."""
        chart = self._chart
        phi = chart.phi(q)
        quality = chart.quality(q)
        # Positions of the joints in the domain, from -1 to 1, and their distances to the boundaries; endless joints
        # have none.
        inside = (q - self._middle) / self._half_width
        room = np.where(self._free, np.inf, self._half_width - np.abs(q - self._middle))
        return Readings(
            q=q,
            x=phi[: chart.m],
            xi=phi[chart.m :],
            drift=np.abs(phi[: chart.m] - held),
            leak_deg=quality.leak_deg,
            conditioning=float(quality.conditioning),
            boundary=float(quality.boundary_distance),
            nearest=int(np.argmin(room)),
            inside=np.where(self._free, (inside + 1) % 2 - 1, inside),
            stop=stop,
        )


class ChartPanel:
    """Writes the readings of one chart as HTML."""

    def __init__(self, chart: Chart, place: str = "", mirrored: bool = False) -> None:
        self.place = place
        problem = chart.problem
        # Bars of the joints show the domain, unless the arm is mirrored.
        robot, domain = problem.robot, problem.domain
        low, high = (None, None) if mirrored else domain.bounds
        self._joints = JointBars(robot, low, high)
        self._labels, self._units = chart.labels, problem.task.units
        self._half_width = float(domain.half_width.min())
        # The head names the chart and does not change.
        task = ", ".join(map(escape, chart.labels[: chart.m]))
        self._wide = "branch" in chart.notes
        self._levels = (0.15, 0.04) if self._wide else (0.4, 0.15)
        branch = chart.notes.get("branch")
        lines = [escape(place)] if place else [f"branch {escape(branch)}"] if isinstance(branch, str) else []
        if not lines and problem.name:
            lines = [f"problem {escape(problem.name)}"]
        family, _, _ = chart.coordinates.label.partition(":cyclic")
        lines += [f"{escape(family)}, {chart.n} joints"]
        lines += [f"task {task}; {chart.r} coordinate{'s' if chart.r > 1 else ''}"]
        title = escape(name_robot(robot, problem.name))
        self._head = f'<div class="name">{title}</div><div class="about">{"<br>".join(lines)}</div>'

    def format_html(self, readings: Readings, nearest: str = "", ends: str = "") -> str:
        """The HTML page; `nearest` is a part about collisions, and `ends` a part about the range of a coordinate."""
        m = len(readings.x)
        # What stopped the last motion, then the leak of each coordinate.
        stop = f'<div class="stop">stopped by {escape(readings.stop)}</div>' if readings.stop else ""
        # On a whole branch, leaks of tens of degrees are normal.
        whole = 90 if self._wide else 15
        leaks = [
            format_bar(
                label,
                degrees / whole,
                f"{degrees:.2f}°",
                PLAIN if self._wide else choose_colour(-degrees, -2, -6),
                degrees,
            )
            for label, degrees in zip(self._labels[m:], readings.leak_deg.tolist(), strict=True)
        ]
        if len(leaks) == 1:
            most = 1 / float(np.cos(np.radians(readings.leak_deg[0])))
            leaks.append(format_row("speed to hold it", most, "of the least, at most"))
        if self._wide:
            leaks.append('<div class="about">tens of degrees are normal on a whole branch</div>')
        # Distances to the boundary and to folds, then the drift of the task.
        joint, fraction = readings.nearest, readings.boundary / self._half_width
        label = f"boundary {self._joints.shown[joint]}" if np.isfinite(readings.boundary) else "boundary"
        text, colour = self._joints.format_value(joint, readings.boundary), choose_colour(fraction, 0.15, 0.04)
        boundary = format_bar(label, fraction, text, colour, readings.boundary, "boundary")
        level = readings.conditioning
        conditioning = format_bar(
            "conditioning", level, f"{level:.3f}", choose_colour(level, *self._levels), value=level
        )
        drift = format_number("drift", float(readings.drift.max()), format_drift(readings.drift, self._units))
        parts = [
            STYLE, '<div class="oc">', self._head, f'<div class="held"><span>task moved by</span>{drift}</div>',
            stop, ends, "<h4>leak of the coordinates</h4>", *leaks,
            "<h4>chart</h4>", conditioning, boundary, nearest,
            "<h4>joints</h4>", self._joints.format_html(readings.q), self._joints.format_copy(readings.q), "</div>",
        ]  # fmt: skip
        return "".join(parts)


class JointBars:
    """One bar for each joint: its limits, the domain as a darker band, and its position."""

    def __init__(self, robot: Robot, low: Array | None = None, high: Array | None = None) -> None:
        # A track covers the limits, or else the domain, or else a full turn. The domain is a band in it.
        names, lower, upper = robot.joint_names, robot.lower, robot.upper
        low = lower if low is None else np.maximum(low, lower)
        high = upper if high is None else np.minimum(high, upper)
        ends = np.where(np.isfinite(lower), lower, np.where(np.isfinite(low), low, -np.pi))
        tops = np.where(np.isfinite(upper), upper, np.where(np.isfinite(high), high, np.pi))
        spans = np.maximum(tops - ends, 1e-9)
        bands = np.clip(np.column_stack([low - ends, high - ends]) / spans[:, None], 0, 1)
        self.shown = strip_shared_words(names)
        self._slides = robot.tree.prismatic
        places = zip(ends.tolist(), spans.tolist(), bands.tolist(), strict=True)
        self._joints = list(zip(names, self.shown, range(len(self.shown)), places, strict=True))

    def format_html(self, q: Array) -> str:
        """The bars at a joint position (n,)."""
        return "".join(self._format_bar(*joint, value) for joint, value in zip(self._joints, q.tolist(), strict=True))

    def format_copy(self, q: Array) -> str:
        """All joint positions as text that one click selects for copying [rad], [m]."""
        numbers = ", ".join(f"{value:.6g}" for value in q.tolist())
        return f'<div class="about">to copy, rad and m:</div><div class="copy">{numbers}</div>'

    def format_value(self, i: int, value: float) -> str:
        """A position or displacement of joint i, with its unit."""
        return f"{value:.3f} m" if self._slides[i] else f"{round(np.degrees(value), 1) + 0.0:.1f}°"

    def _format_bar(
        self, name: str, shown_name: str, i: int, track: tuple[float, float, list[float]], value: float
    ) -> str:
        end, span, band = track
        # Joints without limits wrap around the track.
        place = (value - end) / span if np.isfinite(value) else 0.0
        shown = place % 1 if not 0 <= place <= 1 else place
        near = min(place - band[0], band[1] - place) / max(band[1] - band[0], 1e-9)
        return (
            f'<div class="row"><span title="{escape(name)}">{escape(shown_name)}</span><div class="bar">'
            f'<i style="left:{100 * band[0]:.1f}%;right:{100 - 100 * band[1]:.1f}%;background:#c9d3df"></i>'
            f'<u style="left:{100 * shown:.2f}%;background:{choose_colour(near, 0.03, 0.005)}"></u></div>'
            f"{format_number(name, value, self.format_value(i, value))}</div>"
        )


def name_robot(robot: Robot, known: str = "") -> str:
    """A robot's display name: a known one, or the words shared by its joints' names, such as panda of panda_joint1."""
    first = robot.joint_names[0]
    shared = first.removesuffix(strip_shared_words(robot.joint_names)[0]).strip("_")
    return shared or known or robot.tree.tip_name


def strip_shared_words(names: Sequence[str]) -> list[str]:
    """Names without the words before a "_" that all of them share, such as panda in panda_joint1, panda_joint2."""
    words = [name.split("_") for name in names]
    shared = len(list(takewhile(lambda same: len(set(same)) == 1, zip(*(each[:-1] for each in words), strict=False))))
    return ["_".join(each[shared if len(names) > 1 else 0 :]) for each in words]


def format_bar(label: str, fraction: float, text: str, colour: str, value: float, name: str = "") -> str:
    """A row with a label, a bar filled to a fraction of its width, and a number with a name (default: the label)."""
    width = 100 * float(np.clip(fraction if np.isfinite(fraction) else 0.0, 0, 1))
    number = format_number(name or label, value, text)
    return (
        f'<div class="row"><span title="{escape(label)}">{escape(label)}</span><div class="bar">'
        f'<i style="left:0;width:{width:.1f}%;background:{colour}"></i></div>{number}</div>'
    )


def format_number(name: str, value: float, text: str) -> str:
    """A number as text, a dash if it is not finite; `data-value` has the exact value for other programs."""
    shown = "∞" if value == np.inf else text if np.isfinite(value) else "-"
    return f'<b data-oc="{escape(name)}" data-value="{value!r}">{escape(shown)}</b>'


def choose_colour(value: float, good: float, fair: float) -> str:
    """Colour of a value for which larger is better."""
    return GOOD if value >= good else FAIR if value >= fair else POOR


def format_drift(drift: Array, units: Sequence[str]) -> str:
    """The drift of the task components (m,) in words: lengths and angles in units of a familiar scale."""
    parts = [
        _format_scaled(unit, [d for d, u in zip(drift.tolist(), units, strict=True) if u == unit]) for unit in units
    ]
    return ", ".join(dict.fromkeys(parts))


def _format_scaled(unit: str, drifts: Sequence[float]) -> str:
    """The largest of several differences, in a unit."""
    drift = max(drifts)
    if unit == "rad":
        degrees = float(np.degrees(drift))
        return f"{degrees:.3g}°" if degrees >= RULES.small_angle else f"< {RULES.small_angle}°"
    if unit != "m":
        return f"{drift:.0e} {unit}".rstrip()
    scales = ((1e-3, "mm"), (1e-6, "µm"), (1e-9, "nm"))
    return next((f"{drift / scale:.3g} {name}" for scale, name in scales if drift >= scale), "< 1 nm")


class RobotPanel:
    """Writes the joints and the tip of a robot as HTML."""

    def __init__(self, robot: Robot) -> None:
        self._robot, self._joints = robot, JointBars(robot)
        self._head = (
            f'<div class="name">{escape(name_robot(robot))}</div>'
            f'<div class="about">{robot.n} joints, {robot.tree.masses.sum():.4g} kg<br>'
            f"tip {escape(robot.tree.tip_name)}</div>"
        )

    def format_html(self, q: Array) -> str:
        """The page at a joint position (n,)."""
        tip = zip("xyz", self._robot.tip_position(q).tolist(), strict=True)
        rows = [format_row(f"{axis} [m]", value) for axis, value in tip]
        return "".join([STYLE, '<div class="oc">', self._head, "<h4>tip</h4>", *rows, "<h4>joints</h4>",
                        self._joints.format_html(q), "</div>"])  # fmt: skip


def format_row(label: str, value: float, note: str = "") -> str:
    """A row with a name, an optional note, and a number."""
    name = f'<span title="{escape(label)}">{escape(label)}</span><span class="about">{escape(note)}</span>'
    return f'<div class="row">{name}{format_number(label, value, f"{value:.4f}")}</div>'


class PlayerPanel:
    """Writes the state of motions: quantities of one motion, or distances of several motions from their start."""

    def __init__(self, robot: Robot, motions: Sequence[Motion], units: Mapping[str, str] | None = None) -> None:
        self._units, self._motions, self._joints = units or {}, motions, JointBars(robot)
        self._prismatic = np.array(robot.tree.prismatic)

    def format_html(self, seconds: float) -> str:
        """The HTML page at a time after the start [s]."""
        several = len(self._motions) > 1
        parts = [
            self._format_distance(motion, seconds) if several else self._format_alone(motion, seconds)
            for motion in self._motions
        ]
        return "".join([STYLE, '<div class="oc">', f'<div class="about">{seconds:.2f} s</div>', *parts, "</div>"])

    def _format_alone(self, motion: Motion, seconds: float) -> str:
        k = motion.index(seconds)
        rows = []
        for i, label in enumerate(motion.labels):
            note = "" if motion.references is None else f"reference {motion.references[k, i]:.4f}"
            name = f"{label} [{self._units[label]}]" if label in self._units else label
            rows.append(format_row(name, float(motion.values[k, i]), note))
        marked = motion.marked is not None and motion.marked[k]
        stop = '<div class="stop">the controller uses its fallback</div>' if marked else ""
        head = f'<div class="name">{escape(motion.name)}</div>'
        return "".join(
            [head, stop, "<h4>quantities</h4>", *rows, "<h4>joints</h4>", self._joints.format_html(motion.at(seconds))]
        )

    def _format_distance(self, motion: Motion, seconds: float) -> str:
        away = motion.at(seconds) - motion.q[0]
        name = f"{motion.name}: joints from their start"
        turned = float(np.degrees(np.abs(np.where(self._prismatic, 0.0, away)).max()))
        shown = format_number(name, turned, f"{turned:.2f}°")
        ends = [
            f'<div class="row"><span>after {k}</span><span class="about">{"cycles" if k > 1 else "cycle"}</span>'
            f"{format_number(f'{motion.name} after {k}', degrees, f'{degrees:.2f}°')}</div>"
            for k, degrees in motion.returns(seconds)
        ]
        return (
            f'<h4></h4><div class="name">{escape(motion.name)}</div>'
            f'<div class="held"><span>joints from their start</span>{shown}</div>'
            f"{''.join(ends)}{self._joints.format_html(motion.at(seconds))}"
        )
