"""Collisions on the page of a chart: solids of the scene, the nearest pair, and pairs that touch in red."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np
import scipy

from orthocas.robots.collisions import Collisions, LeastDistance, Part
from orthocas.robots.shapes import Shape
from orthocas.tools.checks import Array, Indices
from orthocas.viewer.looks import BodyPoses
from orthocas.viewer.panel import choose_colour, format_bar


@dataclass(frozen=True, slots=True)
class ContactRules:
    """Numbers of what a page shows of collisions."""

    far: float = 0.3  #: [m]: a full bar
    near: float = 0.1  #: [m]: amber below
    close: float = 0.02  #: [m]: red below, and the pair with it
    turns: int = 16  #: points around rounded solids
    thickness: float = 0.004  #: of the line between nearest points [m]
    red: tuple[int, int, int] = (214, 69, 69)
    grey: tuple[int, int, int] = (150, 158, 168)


RULES = ContactRules()


class Contacts:
    """Draws solids of the scene, the line between the nearest points, and the pair in red where it is close."""

    def __init__(self, scene: Any, collisions: Collisions) -> None:
        self._scene, self._collisions = scene, collisions
        self._poses = BodyPoses(collisions.tree)
        self._nodes: list[Any] = []
        links = set(collisions.tree.frame_names) | {collisions.tree.tip_name}
        fixed = [part for part in collisions.parts if part.body < 0 and part.name not in links and part.shape.bounded]
        for k, part in enumerate(fixed):
            self._add(f"/solids/{k}", part, np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), RULES.grey, 1.0)

    def show(self, q: Array) -> str:
        """Show them at a posture (n,); returns a part of the panel."""
        found = self._collisions.distance(q)
        for node in self._nodes:
            node.remove()
        self._nodes = []
        if np.isfinite(found.points).all():
            colour = RULES.red if found.distance < RULES.close else RULES.grey
            shade = np.tile(np.array(colour, dtype=np.uint8), (1, 2, 1))
            ends = found.points[None].astype(np.float32)
            line = self._scene.add_line_segments("/nearest", ends, shade, thickness=RULES.thickness)
            self._nodes.append(line)
        if found.distance < RULES.close:
            positions, quaternions = self._poses(q[None])
            for k, part in enumerate(part for part in self._collisions.parts if part.name in found.pair):
                if part.shape.bounded:
                    place = positions[0, part.body + 1], quaternions[0, part.body + 1]
                    self._nodes.append(self._add(f"/close/{k}", part, *place, RULES.red, 0.5))
        return format_nearest(found)

    def _add(
        self, name: str, part: Part, position: Array, quaternion: Array, colour: tuple[int, int, int], opacity: float
    ) -> Any:
        vertices, faces = build_hull(part.shape)
        return self._scene.add_mesh_simple(
            name, vertices.astype(np.float32), faces, color=colour, opacity=opacity, position=tuple(position),
            wxyz=tuple(quaternion), cast_shadow=False, receive_shadow=False,
        )  # fmt: skip


def build_hull(shape: Shape) -> tuple[Array, Indices]:
    """Vertices (V, 3) and triangles (F, 3) of the convex hull of a solid, in the frame of its body."""
    corners, rounding = shape.list_corners()
    if rounding:
        angles = 2 * np.pi * np.arange(RULES.turns) / RULES.turns
        heights = np.linspace(-1, 1, RULES.turns // 2)
        ring = np.column_stack([np.cos(angles), np.sin(angles)])
        ball = np.vstack([np.column_stack([np.sqrt(1 - z * z) * ring, np.full(len(ring), z)]) for z in heights])
        corners = (corners[:, None] + rounding * ball).reshape(-1, 3)
    hull = scipy.spatial.ConvexHull(corners, qhull_options="QJ")
    return hull.points, np.asarray(hull.simplices, dtype=np.int64)


def format_nearest(found: LeastDistance) -> str:
    """A part of the panel: the nearest pair, and how far it is."""
    if not np.isfinite(found.distance):
        return "<h4>collisions</h4>no pair is checked"
    first, second = (escape(name) for name in found.pair)
    text = "touch" if found.distance <= 0 else f"{1e3 * found.distance:.0f} mm"
    colour = choose_colour(found.distance, RULES.near, RULES.close)
    bar = format_bar("nearest pair", found.distance / RULES.far, text, colour, found.distance)
    return f'<h4>collisions</h4>{bar}<div class="about">{first} and {second}</div>'
