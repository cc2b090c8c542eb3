"""`orthocas.view`: charts, robots and motions in a browser, and as pages in one file.

Motions have a time slider, and robots have sliders for their joints. `chart_page` has the page of a chart.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from orthocas.charts.chart import Chart, GrownChart
from orthocas.charts.self_motion import Fan, fan_along
from orthocas.errors import ArchiveError, InvalidValueError, NoExpressionError
from orthocas.paths.joint_motion import JointMotion
from orthocas.robots.collisions import Collisions
from orthocas.robots.robot import Robot
from orthocas.simulation.figure import units_of
from orthocas.simulation.trajectory import Trajectory
from orthocas.tools.checks import Array, as_path, as_point_set, require_kind, suggest_attribute
from orthocas.tools.files import publish, require_replaceable, require_writable
from orthocas.viewer.chart_page import ChartPage
from orthocas.viewer.looks import RULES, Arm, Ghosts, Look, RobotLook, build_shape, compute_chain_length
from orthocas.viewer.motion import Motion, require_joints
from orthocas.viewer.panel import PlayerPanel, RobotPanel, name_robot
from orthocas.viewer.session import Session
from orthocas.viewer.window import (
    LOCAL,
    Loop,
    build_page,
    close_window,
    compute_camera_direction,
    compute_up,
    open_window,
    place_panels,
    place_scene,
    show_error,
)

PORT = 8080
_SPEEDS = ("0.25x", "0.5x", "1x", "2x", "4x")
_OURS = b"<!-- written by orthocas -->"
#: builds a scene on a server; returns its length [s] and a function that shows an instant
Scene = Callable[[Any], tuple[float, Callable[[float], None]]]


@dataclass(eq=False)
class View:
    """A page that a browser can open until `close`; also a context manager.

    A notebook shows it in a frame.
    """

    url: str
    missing: tuple[str, ...]  #: mesh files that were not found; rods replace their links
    _server: Any = field(repr=False)
    _page: Any = field(repr=False)
    _closed: threading.Event = field(default_factory=threading.Event, repr=False)

    def wait(self) -> None:
        """Wait until `close` is called elsewhere, or until Ctrl-C."""
        while not self._closed.wait(0.2):
            pass

    def close(self) -> None:
        """Close the page."""
        if not self._closed.is_set():
            self._closed.set()
            self._page.close()
            close_window(self._server)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _repr_html_(self) -> str:
        return f'<iframe src="{self.url}" width="100%" height="620" style="border:1px solid #ddd"></iframe>'


def view(
    shown: Any,
    *,
    robot: Robot | Chart | None = None,
    robot_file: str | Path | None = None,
    locked: Mapping[str, float] | None = None,
    collisions: Collisions | None = None,
    path: ArrayLike | None = None,
    host: str = LOCAL,
    port: int = PORT,
) -> View:
    """Open a page in the browser: an interactive chart, a robot, or a motion.

    Args:
        shown: a fitted chart, a robot, a `Trajectory` of `simulate`, a `JointMotion` of `follow`, or a sequence of
            `Motion` of one robot, which are shown side by side.
        robot: for motions: the robot that moves, or a chart of it.
        robot_file: URDF file of the robot with its meshes. Default: drums and rods, made from the kinematic tree.
        locked: joints that were locked when the robot was built from that file, with their positions [rad] or [m].
        collisions: for charts, such as `robot.collisions`. The page then shows the nearest pair, in red if it is close,
            and the objects of the scene.
        path: for charts: waypoints of the task (N, m), or of task and coordinates (N, n), joined by straight lines. A
            button plays it from the present position.
        host: address to listen at. By default only this machine can open the page. The page's address contains a random
            token that acts as a password.
        port: port of the page; 0 takes any free one.

    Returns:
        The running page with its `url`. It runs in threads of this process.

    Raises:
        MissingExtraError: if viser is not installed.
        ViewError: if the port is taken, or the host is not an address of this machine.
        NoExpressionError: for grown charts.
        RobotError: if the robot file belongs to another robot.
        InvalidValueError: if collisions belong to another robot, or collisions or a path are given without a chart.
    """
    arm, motions = read_subject(shown, robot)
    if collisions is not None:
        require_kind("collisions", collisions, Collisions)
        collisions.require_for(arm.tree)
        if not isinstance(shown, Chart):
            raise InvalidValueError("collisions", f"given with a {type(shown).__name__}", "a chart to show")
    points = None
    if path is not None:
        if not isinstance(shown, Chart):
            raise InvalidValueError("path", f"given with a {type(shown).__name__}", "a chart to show")
        width = np.shape(path)[1:]
        points, _ = as_point_set("path", path, shown.n if width == (shown.n,) else shown.m)
    shape = build_shape(arm, robot_file, locked)
    server, url = open_window(host, port, name_robot(arm, shown.problem.name if isinstance(shown, Chart) else ""))
    try:
        page: ChartPage | RobotPage | PlayerPage
        if motions:
            page = PlayerPage(
                server, arm, shape.look, motions, units_of(robot.problem) if isinstance(robot, Chart) else {}
            )
        elif isinstance(shown, Chart):
            page = ChartPage(server, Session(shown), shape.look, collisions, points)
        else:
            page = RobotPage(server, arm, shape.look)
    except BaseException:
        close_window(server)
        raise
    return View(url, shape.missing, server, page)


def export_page(
    shown: Any,
    path: str | Path,
    *,
    robot: Robot | Chart | None = None,
    robot_file: str | Path | None = None,
    locked: Mapping[str, float] | None = None,
    force: bool = False,
) -> RobotLook:
    """Write one self-contained HTML file that shows an animation without a server and offline.

    For a chart, each coordinate moves over its range and back. Only `view` has sliders.

    Args:
        shown: as in `view`.
        path: path of the HTML file.
        robot: as in `view`.
        robot_file: as in `view`.
        locked: as in `view`.
        force: replace a file that orthocas did not write.

    Raises:
        ArchiveError: if the file cannot be written.
    """
    target = as_path("path", path)
    require_page(target, force)
    arm, motions = read_subject(shown, robot)
    shape = build_shape(arm, robot_file, locked)
    scene: Scene
    if motions:
        scene = partial(show_motions, arm, shape.look, motions)
    elif isinstance(shown, Chart):
        scene = partial(show_chart, shown, shape.look)
    else:
        scene = partial(show_robot, arm, shape.look)
    page = record_scene(scene)
    with publish(target.parent) as drafts:
        (drafts / target.name).write_bytes(page.encode() + _OURS)
    return shape


def require_page(path: Path, force: bool) -> None:
    """Check, before long work, that a page can be written.

    Raises:
        ArchiveError: if the folder is missing or not writable, or the path is a symbolic link or a file not of
            orthocas.
    """
    require_writable(path, ArchiveError)
    ours = path.is_file() and path.read_bytes().endswith(_OURS)
    require_replaceable(path, ours, force)


def read_subject(shown: Any, robot: Robot | Chart | None) -> tuple[Robot, Sequence[Motion]]:
    """The robot to draw and its motions, which are empty for a chart or a robot."""
    if isinstance(shown, GrownChart):
        raise NoExpressionError("a view needs coordinates with a CasADi expression; received grown coordinates")
    if isinstance(shown, Chart):
        return shown.problem.robot, ()
    if isinstance(shown, Robot):
        return shown, ()
    # One motion, or several.
    if isinstance(shown, Trajectory):
        motions: tuple[Motion, ...] = (Motion.of_run(shown),)
    elif isinstance(shown, JointMotion):
        motions = (Motion.of_path(shown),)
    else:
        motions = tuple(shown) if isinstance(shown, list | tuple) else (shown,)
    if not motions or not all(isinstance(part, Motion) for part in motions):
        expected = f"a chart, a robot, a run or a joint motion{suggest_attribute(shown, Chart)}"
        raise InvalidValueError("shown", f"a {type(shown).__name__}", expected)
    # Motions need a robot.
    if not isinstance(robot, Robot | Chart):
        raise InvalidValueError("robot", repr(robot)[:80], "the robot that moved, or a chart of it")
    arm = robot if isinstance(robot, Robot) else robot.problem.robot
    if isinstance(shown, Trajectory | JointMotion):
        require_joints(shown.joint_names, arm, "the motion")
    return arm, motions


def record_scene(build: Scene) -> str:
    """The HTML of a scene with its motion, recorded on a private server."""
    server, _ = open_window(LOCAL, 0, "orthocas")
    try:
        duration, show = build(server)
        show(0.0)
        serializer = server.get_scene_serializer()
        for t in np.linspace(0.0, duration, round(RULES.rate * duration) + 1)[: None if duration else 0]:
            show(float(t))
            serializer.insert_sleep(1 / RULES.rate)
        return build_page(str(serializer.as_html()).encode(), "motion").decode()
    finally:
        close_window(server)


def show_chart(chart: Chart, look: Look, server: Any) -> tuple[float, Callable[[float], None]]:
    """Move each coordinate in turn over its range and back, with the task fixed; a `Scene`."""
    robot, home = chart.problem.robot, chart.problem.domain.home
    fans = [fan_along(chart, home, k) for k in range(chart.r)]
    arm, ghosts = Arm(server.scene, "/arm", robot, look), Ghosts(server.scene, robot)
    place_scene(server, robot, np.concatenate([fan.spread(5) for fan in fans]))
    # Put the label above the highest joint.
    above = robot.joint_points(home).max(axis=0) @ compute_up(robot) + 0.12 * compute_chain_length(robot.tree)
    label = server.scene.add_label("/label", "", position=tuple(above * compute_up(robot)), anchor="bottom-center")
    task, drawn = ", ".join(chart.labels[: chart.m]), -1

    def show(seconds: float) -> None:
        nonlocal drawn
        # Select the current coordinate; draw its ghosts once.
        k = min(int(seconds / RULES.recorded_sweep), chart.r - 1)
        if k != drawn:
            ghosts.show(fans[k].spread(RULES.ghosts), fans[k].spread(4 * RULES.ghosts))
            drawn = k
        q = _find_position(chart, fans[k], seconds / RULES.recorded_sweep - k)
        arm.show(q)
        label.text = f"{fans[k].label} = {chart.xi(q)[k]:+.3f}   {task} held"

    return RULES.recorded_sweep * chart.r, show


def show_motions(
    robot: Robot, look: Look, motions: Sequence[Motion], server: Any
) -> tuple[float, Callable[[float], None]]:
    """Show motions side by side; a `Scene`."""
    stage = Stage(server.scene, robot, look, motions)
    place_scene(server, robot, np.concatenate([pick_few(motion.q) for motion in motions]), stage.shifts)
    speed = max(1.0, stage.duration / RULES.recorded_length)
    return stage.duration / speed, lambda seconds: stage.show(speed * seconds)


def show_robot(robot: Robot, look: Look, server: Any) -> tuple[float, Callable[[float], None]]:
    """Show a robot at rest; a `Scene`."""
    arm = Arm(server.scene, "/arm", robot, look)
    place_scene(server, robot, robot.tree.centre_posture[None])
    return 0.0, lambda seconds: arm.show(robot.tree.centre_posture)


def _find_position(chart: Chart, fan: Fan, fraction: float) -> Array:
    """The joint position (n,) at a fraction of a sweep from home to both ends and back, exactly on the curve."""
    # Follow a sine through the present value, over nearly the whole range.
    here = np.interp(0.0, fan.arc_length, fan.xi)
    centre, half = (fan.xi[-1] + fan.xi[0]) / 2, (fan.xi[-1] - fan.xi[0]) / 2
    phase = np.arcsin(np.clip((here - centre) / max(half, 1e-12), -1, 1))
    target = centre + 0.99 * half * np.sin(2 * np.pi * fraction + phase)
    # Start from the interpolated position, and correct it onto the curve.
    order = np.argsort(fan.xi)
    near = np.array([np.interp(target, fan.xi[order], column[order]) for column in fan.q.T])
    phi = chart.phi(chart.problem.domain.home)
    phi[list(chart.labels).index(fan.label)] = target
    return chart.inverse(phi, near)


class Stage:
    """Arms in a scene that move together, with their tool paths."""

    def __init__(self, scene: Any, robot: Robot, look: Look, motions: Sequence[Motion]) -> None:
        self.motions = motions
        self.shifts = place_side_by_side(robot, len(motions))
        self._arms = []
        size = compute_chain_length(robot.tree)
        for k, (motion, shift) in enumerate(zip(motions, self.shifts, strict=True)):
            self._arms.append(Arm(scene, f"/arm{k}", robot, look, shift))
            # Draw the path of each tip with a limited number of points.
            rows = np.unique(np.linspace(0, len(motion.q) - 1, RULES.path_points).astype(int))
            ways = [robot.frame_position(motion.q[rows], tip) + shift for tip in robot.tips]
            ends = np.concatenate([np.stack([way[:-1], way[1:]], axis=1) for way in ways])
            scene.add_line_segments(
                f"/path{k}", ends, RULES.path_colours[k % len(RULES.path_colours)], thickness=0.005 * size
            )
            if len(motions) > 1:
                place = shift + 1.25 * size * compute_up(robot) * 0.55
                scene.add_label(f"/name{k}", motion.name, position=tuple(place), anchor="bottom-center")

    @property
    def duration(self) -> float:
        """Length of the longest motion [s]."""
        return max(motion.duration for motion in self.motions)

    def show(self, seconds: float) -> None:
        """Move all arms to their positions at a time after the start [s]."""
        for arm, motion in zip(self._arms, self.motions, strict=True):
            arm.show(motion.at(seconds))


class PlayerPage:
    """The page of motions on a viser server."""

    def __init__(
        self, server: Any, robot: Robot, look: Look, motions: Sequence[Motion], units: Mapping[str, str] | None = None
    ) -> None:
        self._server = server
        self._stage = Stage(server.scene, robot, look, motions)
        self._panel = PlayerPanel(robot, motions, units or {})
        self._loop = Loop(lambda: None, self._show_failure)
        self._now = 0.0
        place_scene(server, robot, np.concatenate([pick_few(motion.q) for motion in motions]), self._stage.shifts)
        self._readings = place_panels(server)
        # Controls: play and pause, time, speed, and repeat.
        gui, longest = server.gui, max(round(self._stage.duration, 2), RULES.time_step)
        self._playing = False
        self._play = gui.add_button("Play", icon="player-play")
        self._time = gui.add_slider("time [s]", 0.0, longest, RULES.time_step, 0.0)
        self._speed = gui.add_dropdown("speed", _SPEEDS, initial_value="1x")
        self._again = gui.add_checkbox("repeat", initial_value=True)
        self._play.on_click(self._loop.build_handler("play", self._toggle))
        self._time.on_update(self._slide)
        if len(motions) == 1 and motions[0].commands is not None:
            self._plot_commands(robot, motions[0])
        self._show(0.0)
        self._loop.start()

    def close(self) -> None:
        """Stop the thread of the page."""
        self._loop.stop()

    def _plot_commands(self, robot: Robot, motion: Motion) -> None:
        """Plot the controller's commands over time, for revolute and for prismatic joints."""
        # Only runs have plots.
        from viser import uplot

        assert motion.commands is not None
        rows = np.unique(np.linspace(0, len(motion.times) - 1, RULES.plot_points).astype(int))
        times = motion.times[rows] - motion.times[0]
        units = {"torque": ("N m", "N"), "velocity": ("rad/s", "m/s")}[motion.kind]
        for prismatic, unit in zip((False, True), units, strict=True):
            chosen = [k for k, kind in enumerate(robot.tree.prismatic) if kind == prismatic]
            if not chosen:
                continue
            lines = [
                uplot.Series(
                    label=robot.joint_names[k], stroke=RULES.plot_colours[i % len(RULES.plot_colours)], width=1
                )
                for i, k in enumerate(chosen)
            ]
            self._server.gui.add_uplot(
                (times, *(np.ascontiguousarray(motion.commands[rows, k]) for k in chosen)),
                (uplot.Series(label="s"), *lines),
                title=f"command [{unit}]",
                scales={"x": uplot.Scale(time=False, auto=True), "y": uplot.Scale(auto=True)},
                legend=uplot.Legend(show=True),
                aspect=1.2,
            )

    async def _slide(self, event: Any) -> None:
        # Events without a client come from the page itself.
        if event.client is not None:
            target = float(event.target.value)
            self._loop.ask("time", lambda: self._jump(target))

    def _toggle(self) -> None:
        """Play from the slider's position, or pause."""
        # A second click pauses. At the end, playing starts from the beginning.
        if self._playing:
            self._pause()
            return
        self._playing, last = True, 0.0
        self._play.label, self._play.icon = "Pause", "player-pause"
        if self._now >= self._stage.duration:
            self._now = 0.0

        def tick(seconds: float) -> bool:
            nonlocal last
            # The speed may change during playback, so integrate the time.
            speed = float(self._speed.value.removesuffix("x"))
            now, last = self._now + speed * (seconds - last), seconds
            if now >= self._stage.duration and not self._again.value:
                self._show(self._stage.duration)
                self._pause()
                return False
            self._show(now % self._stage.duration if self._stage.duration > 0 else 0.0)
            return True

        self._loop.animate(tick)

    def _pause(self) -> None:
        self._playing = False
        self._play.label, self._play.icon = "Play", "player-play"
        self._loop.animate(None)

    def _jump(self, seconds: float) -> None:
        self._pause()
        if not np.isfinite(seconds):
            # Reset the slider.
            self._show(self._now)
            raise InvalidValueError("time", seconds, "a finite number of seconds")
        self._show(min(max(seconds, 0.0), self._stage.duration), slide=False)

    def _show_failure(self, error: Exception) -> None:
        self._pause()
        show_error(self._server, error)

    def _show(self, seconds: float, slide: bool = True) -> None:
        self._now = seconds
        with self._server.atomic():
            self._stage.show(seconds)
            self._readings.content = self._panel.format_html(seconds)
            if slide:
                self._time.value = min(round(seconds, 2), self._time.max)


def place_side_by_side(robot: Robot, count: int) -> Array:
    """Positions of arms, (count, 3) [m], in a row from left to right as seen by the camera."""
    places = (np.arange(count) - (count - 1) / 2) * RULES.apart * compute_chain_length(robot.tree)
    return np.outer(places, np.cross(compute_up(robot), compute_camera_direction(robot)))


def pick_few(q: Array) -> Array:
    """A few of the joint positions (N, n), from first to last."""
    rows: Array = q[np.unique(np.linspace(0, len(q) - 1, 20).astype(int))]
    return rows


class RobotPage:
    """The page of a robot on a viser server."""

    def __init__(self, server: Any, robot: Robot, look: Look) -> None:
        self._server, self._panel = server, RobotPanel(robot)
        self._arm = Arm(server.scene, "/arm", robot, look)
        self._home = robot.tree.centre_posture
        self._robot, self._q = robot, self._home
        self._loop = Loop(lambda: None, partial(show_error, server))
        place_scene(server, robot, self._home[None])
        self._readings = place_panels(server)
        # Sliders around the centre, rounded inwards so that their ends are within the limits.
        self._sliders = []
        with server.gui.add_folder("Joints"):
            for name, centre, *limits in zip(
                robot.joint_names, self._home.tolist(), robot.lower, robot.upper, strict=True
            ):
                low, high = np.clip(limits, centre - RULES.endless, centre + RULES.endless).tolist()
                low, high = round(low + 4.9e-4, 3), round(high - 4.9e-4, 3)
                high = max(low, high)
                start = min(max(round(centre, 3), low), high)
                slider = server.gui.add_slider(name, low, high, RULES.slider_step, start)
                slider.on_update(self._loop.build_handler("joints", self._show))
                self._sliders.append(slider)
        home = server.gui.add_button("Home", icon="home")
        home.on_click(self._go_home)
        self._show()
        self._loop.start()

    def close(self) -> None:
        """Stop the thread of the page."""
        self._loop.stop()

    async def _go_home(self, event: Any) -> None:
        for slider, value in zip(self._sliders, self._home.tolist(), strict=True):
            slider.value = min(max(round(value, 3), slider.min), slider.max)

    def _show(self) -> None:
        # Values that are not finite do not move the arm. The sliders are reset, and the page shows an error.
        q = np.array([slider.value for slider in self._sliders])
        good = np.isfinite(q)
        for slider, value in zip(self._sliders, self._q.tolist(), strict=True):
            if not np.isfinite(slider.value):
                slider.value = value
        self._q = np.where(good, q, self._q)
        with self._server.atomic():
            self._arm.show(self._q)
            self._readings.content = self._panel.format_html(self._q)
        if not good.all():
            name = self._robot.joint_names[int(np.argmin(good))]
            raise InvalidValueError(name, q[np.argmin(good)], "a finite joint position")
