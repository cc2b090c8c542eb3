"""The page of a chart: sliders and a handle solved live, bars, ghosts, home, undo, sweeps, paths and recordings.

With collisions, it also shows solids of the scene, the nearest pair, and touching pairs in red.
"""

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from scipy.spatial.transform import Rotation

from orthocas.charts.chart import Chart
from orthocas.charts.self_motion import Fan, fan_along
from orthocas.errors import ViewError
from orthocas.paths.tool_path import read_path
from orthocas.robots.collisions import Collisions, LeastDistance, Part
from orthocas.robots.shapes import Shape
from orthocas.tasks.branches import branches
from orthocas.tools.checks import Array, Indices
from orthocas.viewer.looks import RULES, Arm, BodyPoses, Colour, Ghosts, Look, build_shape, compute_chain_length
from orthocas.viewer.motion import join_waypoints, write_joints
from orthocas.viewer.panel import ChartPanel, choose_colour, format_bar
from orthocas.viewer.session import Session, describe_stop
from orthocas.viewer.window import Loop, place_panels, place_scene, show_error

_NONE = "none"


class ChartPage:
    """The page of a chart on a viser server; `path` holds waypoints of phi (N, n), or of the task alone (N, m)."""

    def __init__(
        self, server: Any, session: Session, look: Look, collisions: Collisions | None = None, path: Array | None = None
    ) -> None:
        # State of the page, and its worker thread.
        self.session = session
        self._server = server
        self._panel = ChartPanel(session.chart, session.place)
        self._loop = Loop(self._settle, self._show_failure)
        self._gesture = self._dragging = self._sweeping = False
        # Waypoints to play.
        self._path: Array | None = None
        # Line through the waypoints.
        self._line: Any = None
        # Times [s] and joints (n,) while the page records.
        self._recorded: list[tuple[float, Array]] | None = None
        # Build the scene with space for the range of the coordinates, then the controls, then the first picture.
        robot = session.chart.problem.robot
        self._fans = [fan_along(session.chart, session.home, k) for k in range(session.chart.r)]
        self._arm, self._ghosts = Arm(server.scene, "/arm", robot, look), Ghosts(server.scene, robot)
        place_scene(server, robot, np.concatenate([session.home[None], *(fan.spread(5) for fan in self._fans)]))
        self._contacts = None if collisions is None else Contacts(server.scene, collisions)
        self._handle, self._rings = self._add_handle(), self._add_rings()
        self._readings = place_panels(server)
        self._sliders = self._add_sliders()
        self._add_buttons()
        self._add_files()
        self._set_path(path)
        self._show()
        self._settle()
        self._loop.start()

    @property
    def _chart(self) -> Chart:
        return self.session.chart

    def close(self) -> None:
        """Stop the thread of the page."""
        self._loop.stop()

    def _add_sliders(self) -> dict[str, Any]:
        """One slider for each component of phi, coordinates first."""
        gui, chart, m = self._server.gui, self._chart, self._chart.m
        phi, sizes = chart.phi(self.session.home), chart.parts.phi_sizes
        sliders = {}
        # Sliders of coordinates start with half a unit on each side; `_settle` sets their true range.
        with gui.add_folder("Coordinates: the task stays"):
            names = chart.parts.named_coordinates
            for label, name, value in zip(chart.labels[m:], names, phi[m:].tolist(), strict=True):
                hint = f"Moves the joints along {label}, and keeps the task and the other coordinates."
                sliders[label] = self._add_slider(name, value, 0.5, hint, label)
        with gui.add_folder("Task: the coordinates stay"):
            units = chart.problem.task.units
            for label, unit, value, size in zip(chart.labels[:m], units, phi[:m].tolist(), sizes[:m], strict=True):
                name = f"{label} [{unit}]" if unit else label
                sliders[label] = self._add_slider(
                    name, value, float(size), "Moves the task, and keeps all coordinates.", label
                )
        return sliders

    def _add_slider(self, name: str, value: float, reach: float, hint: str, label: str = "") -> Any:
        low, high, shown = round(value - reach, 3), round(value + reach, 3), round(value, 3)
        slider = self._server.gui.add_slider(name, low, high, RULES.slider_step, min(max(shown, low), high), hint=hint)
        what = label or name

        async def moved(event: Any) -> None:
            # Events without a client come from the page itself.
            if event.client is not None:
                value = float(event.target.value)
                self._loop.ask(what, lambda: self._move_towards({what: value}))

        slider.on_update(moved)
        return slider

    def _add_buttons(self) -> None:
        gui = self._server.gui
        self._add_button("Home", "home", partial(self._change, self.session.go_home))
        self._undo = self._add_button("Undo", "arrow-back-up", partial(self._change, self.session.undo))
        self._record = gui.add_button("Record", icon="player-record", hint="Joints over time, as a CSV file.")

        async def record(event: Any) -> None:
            self._loop.ask("Record", lambda: self._toggle_record(event.client))

        self._record.on_click(record)
        with gui.add_folder("What a coordinate reaches"):
            # Select the coordinate that moves the joints farthest.
            sweeps = [self._chart.problem.robot.joint_points(fan.spread(5)) for fan in self._fans]
            widest = self._fans[int(np.argmax([np.ptp(points, axis=0).max() for points in sweeps]))].label
            labels = self._chart.labels[self._chart.m :]
            self._chosen = gui.add_dropdown("coordinate", (*labels, _NONE), initial_value=widest)
            self._sweep = self._add_button("Sweep", "repeat", self._toggle_sweep)
        if self._chart.problem.domain.room_to_fold is not None:
            self._branches = gui.add_folder("Other branches: the tip stays")
            with self._branches:
                self._search = self._add_button("Search", "arrows-split", self._find_branches)
        self._chosen.on_update(self._loop.build_handler("fan", self._show_chosen))

    def _add_button(self, label: str, icon: str, job: Callable[[], None]) -> Any:
        button = self._server.gui.add_button(label, icon=icon)
        button.on_click(self._loop.build_handler(label, job))
        return button

    def _find_branches(self) -> None:
        """Search the branches of the robot, which takes seconds, and offer the reachable mirror images."""
        self._search.label, self._search.disabled = "Searching ...", True
        problem = self._chart.problem
        branching = self.session.branches = branches(problem.robot, problem.task)
        self._search.remove()
        # Replace the search button by one button per mirror.
        with self._branches:
            for cut in branching.mirrors:
                flip = partial(self._change, partial(self.session.flip, cut))
                self._add_button(f"Flip the {branching.cuts[cut].part}", "arrows-left-right", flip)
            if not branching.mirrors:
                self._server.gui.add_markdown("No mirror image of this arm has the same pose of its tip.")

    def _add_files(self) -> None:
        """Lists of path files and robot files in the working folder, and a button that plays a path.

        The page accepts only names from these lists, so a browser can never choose another path.
        """
        gui = self._server.gui
        with gui.add_folder("Files"):
            for suffix, what, load in ((".csv", "path", self._load_path), (".urdf", "links", self._load_look)):
                names = sorted(place.name for place in Path.cwd().glob(f"*{suffix}"))[: RULES.most_files]
                if names:
                    chosen = gui.add_dropdown(what, (_NONE, *names), initial_value=_NONE)
                    chosen.on_update(self._loop.build_handler(what, partial(load, chosen)))
            self._play = self._add_button("Play", "player-play", self._toggle_path)

    def _load_path(self, chosen: Any) -> None:
        """Load the waypoints of the chosen file."""
        self._rest()
        x, xi = (None, None) if chosen.value == _NONE else read_path(Path.cwd() / chosen.value, self._chart)
        self._set_path(x if x is None or xi is None else np.hstack([x, xi]))

    def _load_look(self, chosen: Any) -> None:
        """Draw the links with the meshes of the chosen robot file, or as drums and rods."""
        robot = self._chart.robot
        shape = build_shape(robot, None if chosen.value == _NONE else Path.cwd() / chosen.value, None)
        with self._server.atomic():
            self._arm.remove()
            self._arm = Arm(self._server.scene, "/arm", robot, shape.look)
        self._show_arm(self.session.q)
        if shape.missing:
            files = f"{len(shape.missing)} mesh files cannot be found or read, such as {shape.missing[0]}"
            raise ViewError(f"{files}; rods stand for these links")

    def _set_path(self, path: Array | None) -> None:
        """Set the waypoints to play, and draw them if the task has a whole position."""
        self._path, self._play.disabled = path, path is None
        if self._line is not None:
            self._line.remove()
            self._line = None
        labels = self._chart.labels[:3]
        if path is not None and labels == ("x", "y", "z") and self._chart.problem.task.of_tip:
            thickness = RULES.trace * compute_chain_length(self._chart.problem.robot.tree)
            ends = np.stack([path[:-1, :3], path[1:, :3]], axis=1)
            self._line = self._server.scene.add_line_segments("/path", ends, RULES.path_colours[0], thickness=thickness)

    def _toggle_path(self) -> None:
        """Start or stop playing: move to the first waypoint and along the others, until another input or an obstacle.

        The coordinates stay constant, or follow the path if it contains them.
        """
        path = self._path
        if self._play.label == "Stop" or path is None:
            self._rest()
            return
        self._rest()
        self._begin()
        self._play.label = "Stop"
        labels, sizes = self._chart.labels[: path.shape[1]], self._chart.parts.phi_sizes[: path.shape[1]]
        # Start at the current position, so that the arm does not jump.
        start = self._chart.phi(self.session.q)[None, : path.shape[1]]
        along = join_waypoints(np.concatenate([start, path]), sizes)

        def tick(seconds: float) -> bool:
            fraction = min(seconds / RULES.cycle, 1.0)
            self.session.wish(dict(zip(labels, along(np.array([fraction]))[0].tolist(), strict=True)))
            self.session.follow()
            goes_on = fraction < 1 and not self.session.stop
            if not goes_on:
                self._play.label = "Play"
            self._show()
            return goes_on

        self._loop.animate(tick)

    def _toggle_record(self, client: Any) -> None:
        """Start recording the joints, or stop and send the file to the browser."""
        recorded = self._recorded
        if recorded is None:
            self._recorded, self._record.label = [], "Stop and save"
            self._show_arm(self.session.q)
            return
        self._recorded, self._record.label = None, "Record"
        times, q = map(np.array, zip(*recorded, strict=True))
        text = write_joints(self._chart.problem.robot.joint_names, times, q)
        client.send_file_download("joints.csv", text.encode(), save_immediately=True)

    def _change(self, change: Callable[[], None]) -> None:
        """Change the session's position, and stop a sweep."""
        self._rest()
        change()
        self._show()

    def _add_handle(self) -> Any:
        """Add a handle at the tool if the task has components of its position."""
        chart = self._chart
        kind = str(chart.problem.task.recipe["kind"])
        axes = tuple(kind.startswith(("position", "pose")) and axis in chart.labels[: chart.m] for axis in "xyz")
        if not any(axes) or not chart.problem.task.of_tip:
            return None
        size = RULES.handle * compute_chain_length(chart.problem.robot.tree)
        handle = self._server.scene.add_transform_controls(
            "/tool", scale=size, active_axes=axes, disable_rotations=True, depth_test=False, opacity=0.8
        )
        # Axes that the task does not control stay at the tool.
        moved = [axis for axis, active in zip("xyz", axes, strict=True) if active]

        async def dragged(event: Any) -> None:
            place = dict(zip("xyz", map(float, event.target.position), strict=True))
            self._dragging = event.phase != "end"
            self._loop.ask("tool", lambda: self._move_towards({axis: place[axis] for axis in moved}))

        handle.on_update(dragged)
        return handle

    def _add_rings(self) -> Any:
        """Add rings that turn the tool about its own axes if the task has a whole orientation."""
        chart = self._chart
        task, robot = chart.problem.task, chart.problem.robot
        if not task.of_tip or task.turn is None or not task.turn.whole:
            return None
        size = RULES.rings * compute_chain_length(robot.tree)
        rings = self._server.scene.add_transform_controls(
            "/turn", scale=size, disable_axes=True, disable_sliders=True, depth_test=False, opacity=0.8
        )
        first = 3 if task.turn.with_position else 0

        async def dragged(event: Any) -> None:
            turned = task.value(np.zeros(3) if first else None, event.target.wxyz)[first:].tolist()
            self._dragging = event.phase != "end"
            labels = chart.labels[first : chart.m]
            self._loop.ask("turn", lambda: self._move_towards(dict(zip(labels, turned, strict=True))))

        rings.on_update(dragged)
        return rings

    def _move_towards(self, values: dict[str, float]) -> None:
        """Move towards the values set by the user, as the first or a later event of a gesture."""
        self._rest()
        self._begin()
        # Show the ghosts of the coordinate that moves.
        for label in values:
            if label in self._chart.labels[self._chart.m :] and self._chosen.value not in (_NONE, label):
                self._chosen.value = label
        self.session.wish(values)
        self.session.follow()
        self._show(moved=values)

    def _begin(self) -> None:
        """Remember the position at the start of a gesture."""
        if not self._gesture:
            self.session.remember()
            self._gesture = True

    def _toggle_sweep(self) -> None:
        """Start or stop a sweep of the chosen coordinate over its range; any other input stops it too."""
        fan = self._find_fan()
        if self._sweeping or fan is None:
            self._rest()
            return
        self._begin()
        self._sweeping, self._sweep.label = True, "Stop"
        centre, half = (fan.xi[-1] + fan.xi[0]) / 2, RULES.sweep_range * (fan.xi[-1] - fan.xi[0]) / 2
        # Follow a sine through the present value, over nearly the whole range.
        here = float(self.session.readings.xi[self._chart.labels.index(fan.label) - self._chart.m])
        phase = np.arcsin(np.clip((here - centre) / max(half, 1e-9), -1, 1))

        last_reading = -RULES.reading_pause

        def tick(seconds: float) -> bool:
            nonlocal last_reading
            self.session.wish({fan.label: float(centre + half * np.sin(2 * np.pi * seconds / RULES.sweep + phase))})
            self.session.follow()
            if seconds - last_reading < RULES.reading_pause:
                self._show_arm(self.session.q)
            else:
                last_reading = seconds
                self._show()
            return True

        self._loop.animate(tick)

    def _rest(self) -> None:
        """Stop a sweep or a path."""
        self._loop.animate(None)
        self._sweeping, self._sweep.label = False, "Sweep"
        self._play.label = "Play"

    def _show(self, moved: Any = ()) -> None:
        """Draw the arm and the readings, and update the sliders that the user does not hold."""
        readings = self.session.readings
        place = self.session.place
        if self._panel.place != place:
            self._rest()
            self._panel = ChartPanel(self._chart, place, mirrored=bool(self.session.flips))
        with self._server.atomic():
            self._show_arm(readings.q)
            shown = replace(readings, q=self.session.mirror(readings.q[None])[0])
            nearest = "" if self._contacts is None else self._contacts.show(shown.q)
            self._readings.content = self._panel.format_html(shown, nearest, self._format_ends())
            values = np.concatenate([readings.x, readings.xi]).tolist()
            for label, value in zip(self._chart.labels, values, strict=True):
                slider = self._sliders[label]
                if label not in moved and np.isfinite(value):
                    slider.value = min(max(round(value, 3), slider.min), slider.max)
            self._undo.disabled = not self.session.can_undo

    def _show_arm(self, q: Array) -> None:
        """Draw the arm and its handle at a position of the chart (n,)."""
        with self._server.atomic():
            shown = self.session.mirror(q[None])[0]
            self._arm.show(shown)
            if self._recorded is not None and len(self._recorded) < RULES.most_recorded:
                self._recorded.append((time.monotonic(), shown))
            if self._dragging:
                return
            robot = self._chart.problem.robot
            for handle in filter(None, (self._handle, self._rings)):
                handle.position = tuple(robot.tip_position(q))
            if self._rings is not None:
                self._rings.wxyz = tuple(Rotation.from_matrix(robot.tip_rotation(q)).as_quat(scalar_first=True))

    def _settle(self) -> None:
        """After a gesture: update slider ranges and the fan, and reset sliders of values that were not reached."""
        self._gesture = self._dragging = False
        self._fans = [fan_along(self._chart, self.session.q, k) for k in range(self._chart.r)]
        ranges = {fan.label: (float(fan.xi[0]), float(fan.xi[-1])) for fan in self._fans}
        ranges |= {label: self.session.find_reach(k) for k, label in enumerate(self._chart.labels[: self._chart.m])}
        # Use whole slider steps inside the range.
        for label, ends in ranges.items():
            slider = self._sliders[label]
            low = np.ceil(min(ends) / RULES.slider_step) * RULES.slider_step
            high = np.floor(max(ends) / RULES.slider_step) * RULES.slider_step
            if np.isfinite([low, high]).all():
                slider.min, slider.max = round(float(min(low, high)), 3), round(float(max(low, high)), 3)
        self._show_chosen()

    def _find_fan(self) -> Fan | None:
        """The fan of the chosen coordinate; None if none is chosen."""
        return next((fan for fan in self._fans if fan.label == self._chosen.value), None)

    def _show_chosen(self) -> None:
        """Draw the fan and the ends of the newly chosen coordinate."""
        self._show()
        fan = self._find_fan()
        with self._server.atomic():
            if fan is None:
                self._ghosts.hide()
                return
            # Keep the postures of the fan that the joint limits of the arm allow.
            fans = (fan.spread(RULES.ghosts), fan.spread(4 * RULES.ghosts))
            few, many = (self.session.mirror(q[self.session.find_allowed(q)]) for q in fans)
            self._ghosts.show(few, many, [f"{fan.label} = {value:.3f}" for value in (fan.xi[0], fan.xi[-1])])

    def _format_ends(self) -> str:
        """HTML about what limits the chosen coordinate; a mirrored arm has other limits."""
        fan = self._find_fan()
        if fan is None or self.session.flips:
            return ""
        ends = ((fan.xi[0], fan.low_stop), (fan.xi[-1], fan.high_stop))
        robot = self._chart.problem.robot
        lines = [f"{value:.3f}: {escape(describe_stop(stop, robot))}" for value, stop in ends]
        return f'<h4>ends of {escape(fan.label)}</h4><div class="about">{"<br>".join(lines)}</div>'

    def _show_failure(self, error: Exception) -> None:
        self._rest()
        show_error(self._server, error)


class Contacts:
    """Draws solids of the scene, the line between the nearest points, and close pairs in red."""

    def __init__(self, scene: Any, collisions: Collisions) -> None:
        self._scene, self._collisions = scene, collisions
        self._poses = BodyPoses(collisions.tree)
        self._nodes: list[Any] = []
        links = set(collisions.tree.frame_names) | {collisions.tree.tip_name}
        fixed = [part for part in collisions.parts if part.body < 0 and part.name not in links and part.shape.bounded]
        for k, part in enumerate(fixed):
            self._add(f"/solids/{k}", part, np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), RULES.solid, 1.0)

    def show(self, q: Array) -> str:
        """Show contacts at a posture (n,); returns HTML for the panel."""
        found = self._collisions.distance(q)
        for node in self._nodes:
            node.remove()
        self._nodes = []
        if np.isfinite(found.points).all():
            colour = RULES.touching if found.distance < RULES.close_links else RULES.solid
            shade = np.tile(np.array(colour, dtype=np.uint8), (1, 2, 1))
            ends = found.points[None].astype(np.float32)
            line = self._scene.add_line_segments("/nearest", ends, shade, thickness=RULES.link_line)
            self._nodes.append(line)
        if found.distance < RULES.close_links:
            positions, quaternions = self._poses(q[None])
            for k, part in enumerate(part for part in self._collisions.parts if part.name in found.pair):
                if part.shape.bounded:
                    place = positions[0, part.body + 1], quaternions[0, part.body + 1]
                    self._nodes.append(self._add(f"/close/{k}", part, *place, RULES.touching, 0.5))
        return format_nearest(found)

    def _add(self, name: str, part: Part, position: Array, quaternion: Array, colour: Colour, opacity: float) -> Any:
        vertices, faces = build_hull(part.shape)
        return self._scene.add_mesh_simple(
            name, vertices.astype(np.float32), faces, color=colour, opacity=opacity, position=tuple(position),
            wxyz=tuple(quaternion), cast_shadow=False, receive_shadow=False,
        )  # fmt: skip


def build_hull(shape: Shape) -> tuple[Array, Indices]:
    """Vertices (V, 3) and triangles (F, 3) of the convex hull of a solid, in the frame of its body."""
    corners, rounding = shape.list_corners()
    if rounding:
        angles = 2 * np.pi * np.arange(RULES.facets) / RULES.facets
        heights = np.linspace(-1, 1, RULES.facets // 2)
        ring = np.column_stack([np.cos(angles), np.sin(angles)])
        ball = np.vstack([np.column_stack([np.sqrt(1 - z * z) * ring, np.full(len(ring), z)]) for z in heights])
        corners = (corners[:, None] + rounding * ball).reshape(-1, 3)
    hull = scipy.spatial.ConvexHull(corners, qhull_options="QJ")
    return hull.points, np.asarray(hull.simplices, dtype=np.int64)


def format_nearest(found: LeastDistance) -> str:
    """HTML for the panel: the nearest pair and its distance."""
    if not np.isfinite(found.distance):
        return "<h4>collisions</h4>no pair is checked"
    first, second = (escape(name) for name in found.pair)
    text = "touch" if found.distance <= 0 else f"{1e3 * found.distance:.0f} mm"
    colour = choose_colour(found.distance, RULES.near_links, RULES.close_links)
    bar = format_bar("nearest pair", found.distance / RULES.far_links, text, colour, found.distance)
    return f'<h4>collisions</h4>{bar}<div class="about">{first} and {second}</div>'
