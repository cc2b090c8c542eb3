"""The page of a robot without a chart: one slider for each joint."""

from typing import Any

import numpy as np

from orthocas.robots import Robot
from orthocas.viewing.arm import Arm
from orthocas.viewing.loop import Loop
from orthocas.viewing.panel import RobotPanel
from orthocas.viewing.stick_arm import Look
from orthocas.viewing.window import place_camera, place_floor, place_lights

_ENDLESS = np.pi  # [rad] or [m] of a slider without limits
_STEP = 1e-3


class RobotPage:
    """The page of a robot on a viser server."""

    def __init__(self, server: Any, robot: Robot, look: Look) -> None:
        self._server, self._panel = server, RobotPanel(robot)
        self._arm = Arm(server.scene, "/arm", robot, look)
        self._home = robot.tree.middle
        self._robot = robot
        self._loop = Loop(lambda: None, lambda error: None)
        place_floor(server, robot)
        place_lights(server, robot)
        place_camera(server, robot, self._home[None])
        panel = server.gui.add_panel()
        with panel.add_tab("Readings", "gauge"):
            self._readings = server.gui.add_html("")
        panel.dock_left()
        panel.set_width(310)
        with server.gui.add_folder("Joints"):
            self._sliders = [self._slider(i) for i in range(robot.n)]
        home = server.gui.add_button("Home", icon="home")

        home.on_click(self._go_home)
        self._show()
        self._loop.start()

    def close(self) -> None:
        """End the thread of the page."""
        self._loop.stop()

    def _slider(self, i: int) -> Any:
        robot, middle = self._robot, float(self._home[i])
        low, high = np.clip([robot.lower[i], robot.upper[i]], middle - _ENDLESS, middle + _ENDLESS).tolist()
        low, high = round(low + 4.9e-4, 3), round(high - 4.9e-4, 3)
        high = max(low, high)
        slider = self._server.gui.add_slider(
            robot.joint_names[i], low, high, _STEP, min(max(round(middle, 3), low), high)
        )

        slider.on_update(self._moved)
        return slider

    async def _moved(self, event: Any) -> None:
        self._loop.ask("joints", self._show)

    async def _go_home(self, event: Any) -> None:
        for slider, value in zip(self._sliders, self._home.tolist(), strict=True):
            slider.value = min(max(round(value, 3), slider.min), slider.max)

    def _show(self) -> None:
        q = np.array([slider.value for slider in self._sliders])
        with self._server.atomic():
            self._arm.show(q)
            self._readings.content = self._panel.html(q)
