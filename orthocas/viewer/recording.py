"""Pages without a server: the scene and a motion in one HTML file, which needs nothing else."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from orthocas.charts.chart import Chart
from orthocas.charts.self_motion import Fan, fan_along
from orthocas.robots.robot import Robot
from orthocas.tools.checks import Array
from orthocas.viewer.arm import GHOSTS, Arm, Ghosts
from orthocas.viewer.looks import Look, chain_length
from orthocas.viewer.motion import Motion
from orthocas.viewer.player import Stage, few
from orthocas.viewer.window import (
    LOCAL,
    TITLES,
    close_window,
    open_window,
    place_camera,
    place_floor,
    place_lights,
    up_of,
)

_RATE = 30  # pictures a second
_SWEEP = 5.0  # [s] of one coordinate
_LONGEST = 120.0  # [s]; longer motions are recorded faster

Scene = Callable[
    [Any], tuple[float, Callable[[float], None]]
]  #: builds a scene -> its length [s], what shows an instant


def recorded(build: Scene) -> str:
    """The HTML of a scene and its motion. It is built on a server whose address is given to nobody."""
    server, _ = open_window(LOCAL, 0, "orthocas")
    try:
        duration, show = build(server)
        show(0.0)
        serializer = server.get_scene_serializer()
        for t in np.linspace(0.0, duration, round(_RATE * duration) + 1)[: None if duration else 0]:
            show(float(t))
            serializer.insert_sleep(1 / _RATE)
        return str(serializer.as_html()).replace(*TITLES, 1)
    finally:
        close_window(server)


def chart_scene(chart: Chart, look: Look) -> Scene:
    """Each coordinate in turn, from its lowest to its highest value and back, with the task held."""

    def build(server: Any) -> tuple[float, Callable[[float], None]]:
        robot, home = chart.problem.robot, chart.problem.domain.centre
        fans = [fan_along(chart, home, k) for k in range(chart.r)]
        arm, ghosts = Arm(server.scene, "/arm", robot, look), Ghosts(server.scene, "/ghosts", robot)
        place_floor(server, robot)
        place_lights(server, robot)
        place_camera(server, robot, np.concatenate([fan.spread(5) for fan in fans]))
        above = robot.joint_points(home).max(axis=0) @ up_of(robot) + 0.12 * chain_length(robot.tree)
        label = server.scene.add_label("/label", "", position=tuple(above * up_of(robot)), anchor="bottom-center")
        shown = -1

        def show(seconds: float) -> None:
            nonlocal shown
            k = min(int(seconds / _SWEEP), chart.r - 1)
            if k != shown:
                ghosts.show(fans[k].spread(GHOSTS), fans[k].spread(4 * GHOSTS))
                shown = k
            q = _on_the_way(chart, fans[k], seconds / _SWEEP - k)
            arm.show(q)
            label.text = f"{fans[k].label} = {chart.xi(q)[k]:+.3f}   {_held(chart)} held"

        return _SWEEP * chart.r, show

    return build


def motion_scene(robot: Robot, look: Look, motions: Sequence[Motion]) -> Scene:
    """Motions side by side."""

    def build(server: Any) -> tuple[float, Callable[[float], None]]:
        stage = Stage(server.scene, robot, look, motions)
        place_floor(server, robot)
        place_lights(server, robot)
        place_camera(server, robot, np.concatenate([few(motion.q) for motion in motions]), stage.shifts)
        speed = max(1.0, stage.duration / _LONGEST)
        return stage.duration / speed, lambda seconds: stage.show(speed * seconds)

    return build


def robot_scene(robot: Robot, look: Look) -> Scene:
    """A robot that stands still."""

    def build(server: Any) -> tuple[float, Callable[[float], None]]:
        arm = Arm(server.scene, "/arm", robot, look)
        place_floor(server, robot)
        place_lights(server, robot)
        place_camera(server, robot, robot.tree.middle[None])
        return 0.0, lambda seconds: arm.show(robot.tree.middle)

    return build


def _on_the_way(chart: Chart, fan: Fan, share: float) -> Array:
    """The joint position (n,) after a share of a sweep, exactly on the curve: from home to both ends and back."""
    here = np.interp(0.0, fan.arc_length, fan.xi)
    middle, half = (fan.xi[-1] + fan.xi[0]) / 2, (fan.xi[-1] - fan.xi[0]) / 2
    phase = np.arcsin(np.clip((here - middle) / max(half, 1e-12), -1, 1))
    wanted = middle + 0.99 * half * np.sin(2 * np.pi * share + phase)
    order = np.argsort(fan.xi)
    near = np.array([np.interp(wanted, fan.xi[order], column[order]) for column in fan.q.T])
    phi = chart.phi(chart.problem.domain.centre)
    phi[list(chart.labels).index(fan.label)] = wanted
    return chart.inverse(phi, near)


def _held(chart: Chart) -> str:
    return ", ".join(chart.labels[: chart.m])
