"""`orthocas.view`: charts, robots and motions in a browser."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from orthocas.charts.chart import Chart, GrownChart
from orthocas.errors import ArchiveError, InvalidValueError, NoExpressionError
from orthocas.paths.joint_motion import JointMotion
from orthocas.robots.collisions import Collisions
from orthocas.robots.robot import Robot
from orthocas.simulation.figure import units_of
from orthocas.simulation.trajectory import Trajectory
from orthocas.tools.checks import as_path, as_point_set, require_kind, suggest_attribute
from orthocas.tools.files import publish, require_replaceable, require_writable
from orthocas.viewer.chart_page import ChartPage
from orthocas.viewer.looks import RobotLook, build_shape
from orthocas.viewer.motion import Motion, require_joints
from orthocas.viewer.panel import name_robot
from orthocas.viewer.player import PlayerPage, RobotPage, Scene, record_scene, show_chart, show_motions, show_robot
from orthocas.viewer.session import Session
from orthocas.viewer.window import LOCAL, close_window, open_window

PORT = 8080
_OURS = b"<!-- written by orthocas -->"


@dataclass(eq=False)
class View:
    """A page that a browser can open, until `close`; also a context manager.

    In a notebook it shows itself in a frame.
    """

    url: str
    missing: tuple[str, ...]  #: mesh files that were not found; rods stand for their links
    _server: Any = field(repr=False)
    _page: Any = field(repr=False)
    _closed: threading.Event = field(default_factory=threading.Event, repr=False)

    def wait(self) -> None:
        """Wait until `close` is called elsewhere, or Ctrl-C."""
        while not self._closed.wait(0.2):
            pass

    def close(self) -> None:
        """End the page."""
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
    """Open a page for the browser: a chart to play with, a robot, or a motion.

    Args:
        shown: a fitted chart, a robot, a `Trajectory` of `simulate`, a `JointMotion` of `follow`, or a
            sequence of `Motion` of one robot, which move side by side.
        robot: for motions: whose they are, or a chart of that robot.
        robot_file: URDF file of the robot with its meshes. Default: drums and rods, made from the kinematic tree.
        locked: joints that were locked when the robot was built from that file, with their positions [rad] or [m].
        collisions: for charts, such as `robot.collisions`: the page shows the nearest pair, in red where it is close,
            and the objects of its scene.
        path: for charts: waypoints of the task (N, m), or of the task and the coordinates (N, n), joined by straight
            lines. A button plays it from where the arm is.
        host: address to listen at. By default only this machine can open the page. The page's address holds a random
            token, which stands for a password.
        port: of the page; 0 takes any free one.

    Returns:
        The running page, with its `url`. It lives in threads of this process.

    Raises:
        MissingExtraError: if viser is not installed.
        ViewError: if the port is taken, or the host is no address of this machine.
        NoExpressionError: for grown charts.
        RobotError: if the robot file is another robot's.
        InvalidValueError: if collisions are another robot's, or collisions or a path are given without a chart.
    """
    # What is shown decides which page it gets.
    arm, motions = read_subject(shown, robot)
    if collisions is not None:
        require_kind("collisions", collisions, Collisions)
        collisions.require_for(arm.tree)
        if not isinstance(shown, Chart):
            raise InvalidValueError("collisions", f"given with a {type(shown).__name__}", "a chart with it")
    points = None
    if path is not None:
        if not isinstance(shown, Chart):
            raise InvalidValueError("path", f"given with a {type(shown).__name__}", "a chart with it")
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
    """Write one self-contained HTML file that shows the same without a server, and works offline.

    A chart moves each coordinate to its ends and back. Sliders need `view`.

    Args:
        shown: as in `view`.
        path: the file.
        robot: as in `view`.
        robot_file: as in `view`.
        locked: as in `view`.
        force: replace a file that orthocas did not write.

    Raises:
        ArchiveError: if the file cannot be written.
    """
    target = as_path("path", path)
    require_page(target, force)
    # What is shown decides which scene is recorded.
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
        ArchiveError: if the folder is missing or not writable, or there is a file of others, or a symbolic link.
    """
    require_writable(path, ArchiveError)
    ours = path.is_file() and path.read_bytes().endswith(_OURS)
    require_replaceable(path, ours, force)


def read_subject(shown: Any, robot: Robot | Chart | None) -> tuple[Robot, Sequence[Motion]]:
    """The robot to draw, and what moves it; no motions for a chart and a robot."""
    if isinstance(shown, GrownChart):
        raise NoExpressionError("a view needs coordinates with a CasADi expression; received grown coordinates")
    if isinstance(shown, Chart):
        return shown.problem.robot, ()
    if isinstance(shown, Robot):
        return shown, ()
    # A motion, or several.
    if isinstance(shown, Trajectory):
        motions: tuple[Motion, ...] = (Motion.of_run(shown),)
    elif isinstance(shown, JointMotion):
        motions = (Motion.of_path(shown),)
    else:
        motions = tuple(shown) if isinstance(shown, list | tuple) else (shown,)
    if not motions or not all(isinstance(part, Motion) for part in motions):
        expected = f"a chart, a robot, a run or a joint motion{suggest_attribute(shown, Chart)}"
        raise InvalidValueError("shown", f"a {type(shown).__name__}", expected)
    # They belong to a robot.
    if not isinstance(robot, Robot | Chart):
        raise InvalidValueError("robot", repr(robot)[:80], "the robot that moved, or a chart of it")
    arm = robot if isinstance(robot, Robot) else robot.problem.robot
    if isinstance(shown, Trajectory | JointMotion):
        require_joints(shown.joint_names, arm, "the motion")
    return arm, motions
