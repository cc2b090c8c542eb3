"""[AS2023] Fig. 1: leaves of the task x of the planar arm with three joints, and orthogonal leaves.

The coordinates (xi1, xi2) of the base leaf x = 0 are those of Fig. 15. All surfaces are grids in (x, xi1, xi2), carried
along the task gradients from the base leaf. They are patches of two task leaves, and leaves of xi1 and xi2 through the
middle of these patches.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.colors import to_rgba
from matplotlib.patheffects import withStroke

from orthocas.exact.flow import GrownCoordinates
from orthocas.tools.checks import Array

from .charted_surface import add_with_lines
from .drawing import Drawing
from .fig15 import FIRST, SECOND, grown_disk
from .painting import Isolines, Numbers
from .scene import Scene
from .style import INK, LABEL, add_3d, joint_cube, line_legend, new_figure

_MIDDLE, _REACH = np.array([-0.45, 0.3]), np.array([0.12, 0.22])  # of the patch in the disk of (xi1, xi2)
_VALUES = (-0.5, 0.5)  # x on the task leaves [m]
_BEYOND = 1.5  # size of the leaves of xi, relative to the patch and to the distance of the task leaves
_AT = np.array([0.5, -0.1, 0.15])  # x [m] and xi, relative to the middle, where gradients are drawn
_ARROW = 0.48  # length of the gradients in the picture [rad]
_LIFT = 0.045  # height of the arrows above the leaf [rad]
_SHEET, _BASE = "#8ab6f2", "#0b2f6b"
_GRADIENTS = {r"$\nabla x$": INK, r"$\nabla\xi_1$": FIRST, r"$\nabla\xi_2$": "#a87e00"}
_LOW, _HIGH = np.array([1, -5, 3]) * np.pi / 8, np.array([6, 2, 8]) * np.pi / 8
_VIEW = (20, 162)


@dataclass(frozen=True, eq=False)
class Grid:
    """A surface as a square grid of points."""

    points: Array  #: (N, N, 3)
    xi: Array  #: relative to the middle, (N, N, 2)

    @property
    def faces(self) -> Numbers:
        """Triangles, (F, 3)."""
        number = np.arange(self.points.shape[0] ** 2).reshape(self.points.shape[:2])
        a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]
        return np.concatenate([np.stack(f, axis=-1).reshape(-1, 3) for f in ((a, b, d), (a, d, c))])

    @property
    def boundary(self) -> Array:
        """The points around the surface, (4 N - 3, 3)."""
        p = self.points
        return np.concatenate([p[0, :-1], p[:-1, -1], p[-1, :0:-1], p[::-1, 0]])

    @property
    def normals(self) -> Array:
        """Unit normals at inner points from central differences, (N - 2, N - 2, 3)."""
        along = self.points[2:, 1:-1] - self.points[:-2, 1:-1], self.points[1:-1, 2:] - self.points[1:-1, :-2]
        across = np.cross(*along)
        normals: Array = across / np.linalg.norm(across, axis=2, keepdims=True)
        return normals


def draw(quick: bool) -> Drawing:
    """Draw two task leaves, a leaf of xi1, a leaf of xi2, and gradients; the numbers are the angles between them."""
    coordinates, _ = grown_disk(30 if quick else 100)
    half = 8 if quick else 20  # half times _BEYOND is a whole number, so that all surfaces share points where they meet
    sheet, wide = (np.linspace(-b, b, 2 * int(b * half) + 1) for b in (1.0, _BEYOND))
    task_leaves = [grid(coordinates, np.array([x]), _REACH[0] * sheet, _REACH[1] * sheet) for x in _VALUES]
    heights, zero = wide * _VALUES[-1], np.zeros(1)
    walls = [grid(coordinates, heights, zero, _REACH[1] * wide), grid(coordinates, heights, _REACH[0] * wide, zero)]
    figure = new_figure(4.1, 5.2, layout=None)
    axes = add_3d(figure, 0.04, 0.11, 0.92, 0.87)
    joint_cube(axes, _LOW, _HIGH, parts=1, margin=np.pi / 8)
    scene = _scene(task_leaves, walls)
    base = grid(coordinates, np.zeros(1), _REACH[0] * sheet, _REACH[1] * sheet)
    scene.add_tube(base.boundary, 0.022, _BASE)
    _add_gradients(axes, scene, coordinates)
    scene.draw(axes, _VIEW, _LOW, _HIGH, 1.24)
    names = ("$x$ = const", r"$\xi_1$ = const", r"$\xi_2$ = const")
    line_legend(figure, {"base leaf, $x = 0$": _BASE} | dict(zip(names, (_SHEET, FIRST, SECOND), strict=True)))
    return Drawing({"": figure}, _numbers(coordinates, task_leaves, walls))


def grid(coordinates: GrownCoordinates, x: Array, first: Array, second: Array) -> Grid:
    """Points with all combinations of x, xi1 and xi2 (relative to the middle); one of the three has a single value."""
    x, first, second = np.meshgrid(x, first, second, indexing="ij")
    xi = np.stack([first.ravel(), second.ravel()], axis=1)
    on_leaf = coordinates.leaf.points(_MIDDLE + xi)
    points = coordinates.flow.move(on_leaf, x.reshape(-1, 1)).points
    size = max(x.shape)
    return Grid(points.reshape(size, size, 3), xi.reshape(size, size, 2))


def _scene(task_leaves: list[Grid], walls: list[Grid]) -> Scene:
    scene = Scene()
    scene.add_cube(_LOW, _HIGH, 0.012)
    shares = np.linspace(-0.8, 0.8, 9)
    for leaf in task_leaves:
        families = [
            Isolines(leaf.xi[..., k].ravel(), _REACH[k] * shares, np.tile(to_rgba(colour), (len(shares), 1)), 0.015)
            for k, colour in enumerate((FIRST, SECOND))
        ]
        add_with_lines(scene, leaf.points.reshape(-1, 3), leaf.faces, _SHEET, families)
    for wall, colour in zip(walls, (FIRST, SECOND), strict=True):
        scene.add_surface(wall.points.reshape(-1, 3), wall.faces, colour)
    return scene


def _add_gradients(axes: Any, scene: Scene, coordinates: GrownCoordinates) -> None:
    """Draw arrows with their names a little above a task leaf."""
    on_leaf = grid(coordinates, _AT[:1], _AT[1:2], _AT[2:]).points[0]
    gradients = np.concatenate(_jacobians(coordinates, on_leaf), axis=1)[0]
    units = gradients / np.linalg.norm(gradients, axis=1, keepdims=True)
    start = on_leaf[0] + _LIFT * units[0]
    for unit, (name, colour) in zip(units, _GRADIENTS.items(), strict=True):
        scene.add_arrow(start, _ARROW * unit, 0.025, colour)
        text = axes.text(
            *(start + (_ARROW + 0.16) * unit), name, color=colour, fontsize=LABEL, ha="center", va="center"
        )
        text.set_path_effects([withStroke(linewidth=2.5, foreground="white")])
    scene.add_ball(start, 0.045, INK)


def _numbers(coordinates: GrownCoordinates, task_leaves: list[Grid], walls: list[Grid]) -> dict[str, float]:
    """Angles between gradients, which are normals of leaves, and between normals of the surfaces in the picture."""
    q = np.concatenate([leaf.points.reshape(-1, 3) for leaf in task_leaves])
    J_x, J_xi = _jacobians(coordinates, q)
    angles = _angles(J_x, J_xi)
    sheet = task_leaves[1].normals
    middle, wall_middle = len(sheet) // 2, len(walls[0].normals) // 2
    meeting = wall_middle + middle + 1, slice(wall_middle - middle, wall_middle + middle + 1)
    drawn = _angles(np.stack([wall.normals[meeting] for wall in walls]), np.stack([sheet[middle], sheet[:, middle]]))
    return {
        "mean_angle_task_xi_deg": float(angles.mean()),
        "largest_deviation_from_90_deg": float(np.abs(angles - 90).max()),
        "largest_deviation_of_drawn_surfaces_deg": float(np.abs(drawn - 90).max()),
        "smallest_angle_xi1_xi2_deg": float(_angles(J_xi[:, 0], J_xi[:, 1]).min()),
    }


def _jacobians(coordinates: GrownCoordinates, points: Array) -> tuple[Array, Array]:
    """J_x (N, 1, 3) and J_xi (N, 2, 3)."""
    return coordinates.problem.task.evaluate_jacobian(points), coordinates.jacobian(points)


def _angles(a: Array, b: Array) -> Array:
    """Angles between vectors along the last axis [deg]."""
    cosines = np.sum(a * b, axis=-1) / (np.linalg.norm(a, axis=-1) * np.linalg.norm(b, axis=-1))
    angles: Array = np.degrees(np.arccos(cosines))
    return angles
