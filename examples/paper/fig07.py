"""[AS2023] Fig. 7: leaves of the task x of the planar arm with three joints, in the cube 0 <= q_i <= 2 pi.

With absolute angles a = q1, b = q1 + q2, c = q1 + q2 + q3, a leaf is cos a + cos b + cos c = x. The only singular
values are x = +-1 and +-3. For |x| < 1, the leaf closes in the 3-torus to one surface of genus 3 (Euler characteristic
-4), a sheared version of the approximate Schwarz P surface. For 1 < |x| < 3 it is a sphere.
"""

from typing import Any

import matplotlib as mpl
import numpy as np
import trimesh
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize

from orthocas import problems
from orthocas.tasks.task import Task
from orthocas.tools.checks import Array

from .drawing import Drawing
from .leaves import glued, leaf, wall
from .painting import Isolines
from .scene import Scene
from .style import LABEL, TICK, TURN, add_3d, joint_cube, new_figure

_VALUES = (-2.5, -1.7, -0.6, 0.6, 1.7, 2.5)  # x on the leaves of (b) [m]
_HEIGHTS = np.linspace(-2.75, 2.75, 12)  # y on the lines of (a) [m]
_EDGE, _THICKNESS = 100.0, 3.0  # of the printable model [mm]
_SHADES = mpl.colormaps["viridis"].resampled(256)
_NORM = Normalize(-3.0, 3.0)
_VIEW = (24, -58)


def draw(quick: bool) -> Drawing:
    """Draw a leaf with lines of constant y, several leaves and a printable model; the numbers identify the surfaces."""
    task = problems.get("planar_3r_x").task
    cells = 31 if quick else 73
    one, several = leaf(task, 0.0, cells), {value: leaf(task, value, cells) for value in _VALUES}
    figure = new_figure(3.1, layout=None)
    _draw_one(_cube_axes(figure, -0.01, "(a) $h(q) = x = 0$, lines of constant $y$"), one)
    _draw_several(_cube_axes(figure, 0.435, "(b) several leaves"), several)
    bar = figure.colorbar(ScalarMappable(_NORM, _SHADES), cax=figure.add_axes((0.92, 0.2, 0.014, 0.62)))
    bar.ax.set_title("$x$ [m]", fontsize=LABEL)
    bar.set_ticks([*_VALUES, 0.0], labels=[f"{value:g}" for value in (*_VALUES, 0.0)])
    bar.ax.tick_params(labelsize=TICK)
    model = wall(task, 0.0, 73 if quick else 101, _EDGE, _THICKNESS)
    numbers = _numbers(task, one, several) | _model_numbers(model, one)
    return Drawing({"": figure}, numbers, {"leaf": model})


def _cube_axes(figure: Any, left: float, title: str) -> Any:
    axes = add_3d(figure, left, 0.03, 0.45, 0.93)
    joint_cube(axes, 0.0, TURN)
    axes.text2D(0.5, 0.98, title, fontsize=LABEL, ha="center", transform=axes.transAxes)
    return axes


def _draw_one(axes: Any, mesh: trimesh.Trimesh) -> None:
    height = problems.get("planar_3r_xy").task.batched(np.asarray(mesh.vertices))[0][:, 1]
    white = np.ones((len(_HEIGHTS), 4))
    scene = Scene()
    scene.add_cube(0.0, TURN, 0.02)
    scene.add_surface(mesh.vertices, mesh.faces, "#5b97da", lines=Isolines(height, _HEIGHTS, white, 0.07))
    scene.draw(axes, _VIEW, 0.0, TURN, zoom=0.93)


def _draw_several(axes: Any, leaves: dict[float, trimesh.Trimesh]) -> None:
    scene = Scene()
    scene.add_cube(0.0, TURN, 0.02)
    for value, mesh in leaves.items():
        scene.add_surface(mesh.vertices, mesh.faces, _SHADES(_NORM(value)))
    scene.draw(axes, _VIEW, 0.0, TURN, zoom=0.93)


def _numbers(task: Task, one: trimesh.Trimesh, several: dict[float, trimesh.Trimesh]) -> dict[str, float]:
    closed = glued(one)
    residuals = [_residual(task, mesh, value) for value, mesh in ((0.0, one), *several.items())]
    characteristics = {value: glued(mesh).euler_number for value, mesh in several.items()}
    return {
        "task_error_at_vertices": max(residuals),
        "components_in_torus": float(closed.body_count),
        "closed_in_torus": float(closed.is_watertight),
        "euler_characteristic_in_torus": float(closed.euler_number),
        "genus_in_torus": 1 - closed.euler_number / 2,
        **{f"euler_characteristic_at_{value:g}": float(chi) for value, chi in characteristics.items()},
        "euler_characteristic_in_cube": float(one.euler_number),
    }


def _model_numbers(model: trimesh.Trimesh, mesh: trimesh.Trimesh) -> dict[str, float]:
    scaled: float = mesh.area * (_EDGE / TURN) ** 2  # [mm^2]
    return {
        "model_watertight": float(model.is_watertight),
        "model_volume_mm3": float(model.volume),
        "model_mean_wall_mm": float(model.volume / scaled),
        "model_edge_mm": float(np.max(model.extents)),
        "model_pieces": float(model.body_count),
        "model_euler_characteristic": float(model.euler_number),
    }


def _residual(task: Task, mesh: trimesh.Trimesh, value: float) -> float:
    points: Array = np.asarray(mesh.vertices)
    return float(np.abs(task.batched(points)[0] - value).max())
