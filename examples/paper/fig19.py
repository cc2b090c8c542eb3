"""[AS2023] Fig. 19: a section of joint space, task (x, y), and a fitted coordinate that is nearly orthogonal.

Our coordinate is a polynomial, that of the paper a neural network. Rectangles mark where self-motion curves cross the
isosurfaces. They lie 0.03 rad above the surfaces, on the side of the viewer, so that their tilt is visible.
"""

import matplotlib as mpl
import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize

from orthocas.bases import Polynomial
from orthocas.charts.chart import Chart
from orthocas.charts.quality import evaluate
from orthocas.exact.involutivity import involutivity
from orthocas.tasks.problem import Problem
from orthocas.tasks.samples import sample_uniform
from orthocas.tools.checks import Array

from .chosen_fit import USUAL, ChosenFit
from .drawing import Drawing
from .fig10 import GREEN, RED
from .scene import Scene
from .section import curves_inside, isosurface, section, tilts, unit_gradients
from .style import LABEL, TASK, TICK, add_3d, joint_cube, line_legend, new_figure

_LOW, _HIGH = np.array([-2.0, 1, 1]) * np.pi / 8, np.array([2.0, 5, 5]) * np.pi / 8
_DEGREE = 5
_SHARES = (0.3, 0.7)  # share of the samples below each isosurface
_SPREAD = 0.45  # distance of self-motion curves along the task gradients at the centre [rad]
_HALF, _ARROW = 0.13, 0.2  # half an edge of the rectangles, length of the gradients [rad]
_LIFT = 0.03  # height of the rectangles above isosurfaces [rad]
_SAMPLES = 2000
_LEAF = "#c9cdd3"
_TILTS = Normalize(0, 15)  # [deg]
_SHADES = mpl.colormaps["plasma_r"]
_VIEW = (25, 244)


def draw(quick: bool, chosen: ChosenFit = USUAL) -> Drawing:
    """Draw curves, gradients, planes and isosurfaces; the numbers tell how far planes and isosurfaces are from tangent.

    `quick` draws coarser surfaces.
    """
    problem = section(_LOW, _HIGH)
    chart = chosen.chart(problem, Polynomial(degree=_DEGREE), quick)
    levels = np.quantile(chart.xi(sample_uniform(problem.domain, _SAMPLES, 3))[:, 0], _SHARES)
    curves = curves_inside(problem, _starts(problem), 0.02)
    places = np.concatenate([_crossings(chart, curve, levels) for curve in curves])
    figure = new_figure(4.6, layout=None)
    axes = add_3d(figure, 0.04, 0.1, 0.8, 0.89)
    joint_cube(axes, _LOW, _HIGH, parts=1, margin=np.pi / 8)
    scene = _scene(problem, curves, places, tilts(chart, places))
    for level in levels:
        leaf = isosurface(chart, float(level), 25 if quick else 80)
        scene.add_surface(leaf.vertices, leaf.faces, _LEAF, 0.6)
    scene.draw(axes, _VIEW, _LOW, _HIGH, 1.05)
    line_legend(
        figure, {"self-motion curves": TASK, r"$\nabla h_1$": RED, r"$\nabla h_2$": GREEN, r"$\xi$ = const": _LEAF}
    )
    bar = figure.colorbar(ScalarMappable(_TILTS, _SHADES), cax=figure.add_axes((0.9, 0.3, 0.014, 0.45)), extend="max")
    bar.set_label("tilt of their plane against the leaf [deg]", fontsize=LABEL)
    bar.ax.tick_params(labelsize=TICK)
    return Drawing({"": figure}, _numbers(problem, chart, places))


def _starts(problem: Problem) -> Array:
    """A lattice of points in the plane of the task gradients at the centre, (9, 3)."""
    centre = problem.domain.centre
    basis = np.linalg.qr(unit_gradients(problem, centre[None])[0].T)[0].T
    steps = _SPREAD * np.array([(a, b) for a in (-1, 0, 1) for b in (-1, 0, 1)])
    starts: Array = centre + steps @ basis
    return starts


def _crossings(chart: Chart, curve: Array, levels: Array) -> Array:
    """Points where a curve crosses the levels of the coordinate, (N, 3)."""
    xi = chart.xi(curve)[:, 0]
    order = np.argsort(xi)
    inside = levels[(levels > xi.min()) & (levels < xi.max())]
    return np.stack([np.interp(inside, xi[order], curve[order, k]) for k in range(3)], axis=1)


def _scene(problem: Problem, curves: list[Array], places: Array, angles: Array) -> Scene:
    scene = Scene()
    scene.add_cube(_LOW, _HIGH, 0.01)
    elevation, azimuth = np.radians(_VIEW)
    towards = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    for curve in curves:
        scene.add_tube(curve, 0.012, TASK)
    for q, units, angle in zip(places, unit_gradients(problem, places), angles, strict=True):
        normal = np.cross(*units)
        lifted = q + _LIFT * np.sign(normal @ towards) * normal / np.linalg.norm(normal)
        scene.add_surface(*_rectangle(lifted, units), _SHADES(_TILTS(angle)))
        for unit, colour in zip(units, (RED, GREEN), strict=True):
            scene.add_arrow(lifted, _ARROW * unit, 0.011, colour)
    return scene


def _rectangle(centre: Array, units: Array, cells: int = 10) -> tuple[Array, Array]:
    """A square in the plane of two vectors: vertices and faces."""
    basis = np.linalg.qr(units.T)[0].T
    line = np.linspace(-_HALF, _HALF, cells + 1)
    vertices = centre + np.stack(np.meshgrid(line, line, indexing="ij"), axis=-1).reshape(-1, 2) @ basis
    number = np.arange((cells + 1) ** 2).reshape(cells + 1, cells + 1)
    a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]
    return vertices, np.concatenate([np.stack(f, axis=-1).reshape(-1, 3) for f in ((a, b, d), (a, d, c))])


def _numbers(problem: Problem, chart: Chart, places: Array) -> dict[str, float]:
    drawn = tilts(chart, places)
    everywhere = tilts(chart, sample_uniform(problem.domain, _SAMPLES, 4))
    report, defect = evaluate(chart, samples=20_000), involutivity(problem)
    return {
        "rectangles": float(len(places)),
        "mean_tilt_of_rectangles_deg": float(drawn.mean()),
        "largest_tilt_of_rectangles_deg": float(drawn.max()),
        "mean_tilt_in_section_deg": float(everywhere.mean()),
        "largest_tilt_in_section_deg": float(everywhere.max()),
        "task_angle_mean_deg": report.task_angle.mean,
        "task_angle_std_deg": report.task_angle.std,
        "involutivity_defect_mean": defect.mean,
        "expected_angle_deg": defect.expected_angle_deg,
    }
