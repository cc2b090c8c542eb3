"""[AS2023] Fig. 15: coordinates grown from the leaf x = 0 of the planar arm with three joints, 0 <= q1 <= pi, A = I.

As in the paper, the first joint is limited to half a turn, so that the leaf is a disk. In panel (d), the front leaves
are cut away in steps along lines of constant xi2, because they would hide the other leaves.
"""

from collections.abc import Mapping
from time import perf_counter
from typing import Any

import numpy as np
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgb, to_rgba

from orthocas import problems
from orthocas.charts.grow import grow
from orthocas.exact.flow import GrownCoordinates, TaskFlow
from orthocas.exact.leaves import DiskLeaf, build_disk_leaf
from orthocas.exact.mesh import build_level_surface, compute_signed_areas
from orthocas.tasks.domains import Box
from orthocas.tasks.problem import Problem
from orthocas.tasks.samples import sample_uniform
from orthocas.tasks.task import Task
from orthocas.tools.checks import Array

from .charted_surface import add_with_edges, add_with_lines, part_below
from .drawing import Drawing
from .painting import Isolines
from .scene import Scene
from .style import INK, LABEL, TICK, add_3d, joint_cube, line_legend, new_figure

FIRST, SECOND = "#c8102e", "#f2b701"  #: lines and leaves of constant xi1, xi2
_LOW, _HIGH = np.array([0.0, -np.pi, -np.pi]), np.full(3, np.pi)
_COARSE = 15  # cells along an edge in (a) and (b)
_STEP = 0.3  # step of x between leaves [m]
_LEVELS = np.linspace(-0.8, 0.8, 9)  # levels of xi1 and xi2
_COLOURS = {0.0: "#3a64a8", _STEP: "#a9d1f2", -_STEP: "#c3c6cc"}  # colours of the leaves
_CUTS = {0.0: 0.3, _STEP: np.inf, -_STEP: -0.3}  # xi2 at which the leaves of (d) end
_NAMES = {f"$x = {x:g}$ m": colour for x, colour in _COLOURS.items()}
_SAMPLES = 1000
_COVER_CELLS = 40
_ZOOM = 1.0
_TINTS = np.array([to_rgb(c) for c in ("#cfe0f3", "#f6d9bd", "#d3ebd0", "#e4d3ee")])  # of the quadrants of the disk
_VIEW = (24, 32)


def grown_disk(cells: int) -> tuple[GrownCoordinates, DiskLeaf]:
    """Coordinates of [AS2023] Sec. 5.2 (three joints, task x, A = I, 0 <= q1 <= pi), and their base leaf.

    Args:
        cells: number of marching cubes cells along the longest edge of the box.
    """
    robot = problems.get("planar_3r_x").robot
    domain = Box((_LOW + _HIGH) / 2, (_HIGH - _LOW) / 2)
    coordinates = grow(Problem(robot, Task.position(robot, "x"), "euclidean", domain), 0.0, cells=cells).coordinates
    assert isinstance(coordinates, GrownCoordinates)
    assert isinstance(coordinates.leaf, DiskLeaf)
    return coordinates, coordinates.leaf


def draw(quick: bool) -> Drawing:
    """Draw triangles, their image, and isolines on leaves; the numbers show the accuracy of the coordinates."""
    start = perf_counter()
    coordinates, fine = grown_disk(24 if quick else 70)
    seconds = perf_counter() - start
    coarse = build_disk_leaf(fine.problem, fine.level, fine.region, _COARSE)
    figure = new_figure(6.7, layout=None)
    _draw_triangles(_cube_axes(figure, 0.0, 0.545, "(a) triangles of $S_0$"), coarse)
    _draw_disk(figure, coarse)
    _draw_leaves(_cube_axes(figure, 0.0, 0.06, "(c) isolines on $S_0$"), fine, {0.0: np.inf})
    _draw_leaves(_cube_axes(figure, 0.5, 0.06, "(d) other leaves, cut away in steps"), fine, _CUTS)
    line_legend(figure, {r"$\xi_1$ = const": FIRST, r"$\xi_2$ = const": SECOND} | _NAMES)
    numbers = {"triangles": float(len(fine.faces)), "seconds_to_grow": seconds} | _mesh_numbers(fine, coarse)
    return Drawing({"": figure}, numbers | _flow_numbers(coordinates))


def moved_leaf(leaf: DiskLeaf, dx: float) -> Array:
    """Vertices of a base leaf, carried along the task gradients to the leaf whose task value differs by dx, (V, 3)."""
    return TaskFlow(leaf.problem).move(leaf.vertices, np.full((len(leaf.vertices), 1), dx)).points


def _cube_axes(figure: Any, left: float, bottom: float, title: str) -> Any:
    axes = add_3d(figure, left, bottom, 0.5, 0.415)
    joint_cube(axes, _LOW, _HIGH)
    axes.text2D(0.5, 1.0, title, fontsize=LABEL, ha="center", transform=axes.transAxes)
    return axes


def _draw_triangles(axes: Any, leaf: DiskLeaf) -> None:
    scene = Scene()
    scene.add_cube(_LOW, _HIGH, 0.02)
    add_with_edges(scene, leaf.vertices, leaf.faces, _quadrants(leaf), np.array(to_rgb(INK)), 0.03)
    scene.draw(axes, _VIEW, _LOW, _HIGH, _ZOOM)


def _draw_disk(figure: Any, leaf: DiskLeaf) -> None:
    axes = figure.add_axes((0.6, 0.595, 0.36, 0.36 * 6.3 / 6.7))
    triangles = PolyCollection(list(leaf.disk[leaf.faces]), facecolors=_quadrants(leaf), edgecolors=INK, linewidths=0.4)
    axes.add_collection(triangles)
    axes.set(xlim=(-1.04, 1.04), ylim=(-1.04, 1.04), aspect="equal")
    axes.set_title("(b) the same in the unit disk", fontsize=LABEL)
    axes.set_xlabel(r"$\xi_1$", fontsize=LABEL, labelpad=2)
    axes.set_ylabel(r"$\xi_2$", fontsize=LABEL, labelpad=-4)
    axes.set(xticks=(-1, 0, 1), yticks=(-1, 0, 1))
    axes.tick_params(labelsize=TICK)


def _quadrants(leaf: DiskLeaf) -> Array:
    """Colours of triangles by the quadrant of the disk that contains their centres, (F, 3)."""
    right, upper = (leaf.disk[leaf.faces].mean(axis=1) > 0).T
    tints: Array = _TINTS[2 * right + upper]
    return tints


def _draw_leaves(axes: Any, leaf: DiskLeaf, cuts: Mapping[float, float]) -> None:
    """Draw leaves with isolines; `cuts` gives, for each x, the bound of the drawn part xi2 < cut."""
    scene = Scene()
    scene.add_cube(_LOW, _HIGH, 0.02)
    for x, cut in cuts.items():
        vertices, faces, xi = part_below(moved_leaf(leaf, x), leaf.faces, leaf.disk[:, 1], cut, leaf.disk)
        families = [
            Isolines(xi[:, k], _LEVELS, np.tile(to_rgba(colour), (len(_LEVELS), 1)), 0.055)
            for k, colour in enumerate((FIRST, SECOND))
        ]
        add_with_lines(scene, vertices, faces, _COLOURS[x], families)
    scene.draw(axes, _VIEW, _LOW, _HIGH, _ZOOM)


def _mesh_numbers(fine: DiskLeaf, coarse: DiskLeaf) -> dict[str, float]:
    flipped = [np.sum(compute_signed_areas(leaf.disk, leaf.faces) <= 0) for leaf in (fine, coarse)]
    off = fine.problem.task.batched(fine.vertices)[0]
    return {
        "coarse_triangles": float(len(coarse.faces)),
        "boundary_loops": float(fine.mesh.boundary_loops),
        "euler_characteristic": float(fine.mesh.euler_characteristic),
        "flipped_triangles": float(sum(flipped)),
        "task_error_at_vertices": float(np.abs(off).max()),
    }


def _flow_numbers(coordinates: GrownCoordinates) -> dict[str, float]:
    """Orthogonality of the coordinates, their constancy along the flow, and their coverage."""
    problem = coordinates.problem
    points = sample_uniform(problem.domain, _SAMPLES, 3)
    pulled = coordinates.pull(points)
    points, on_leaf = points[pulled.reached], pulled.points[pulled.reached]
    J_xi, J_x = coordinates.jacobian(points), problem.task.evaluate_jacobian(points)
    lengths = np.linalg.norm(J_xi, axis=2) * np.linalg.norm(J_x, axis=2)
    cosines = (J_xi @ J_x.transpose(0, 2, 1))[:, :, 0] / lengths
    moved = [coordinates.flow.move(on_leaf, np.full((len(on_leaf), 1), dx)).points for dx in (_STEP, -_STEP)]
    return {
        "samples_with_coordinates": len(points) / _SAMPLES,
        "largest_cosine": float(np.abs(cosines).max()),
        "largest_change_along_flow": float(np.abs([coordinates.xi(q) - coordinates.xi(on_leaf) for q in moved]).max()),
        "covered_at_0.3": _covered(coordinates, _STEP),
        "covered_at_-0.3": _covered(coordinates, -_STEP),
    }


def _covered(coordinates: GrownCoordinates, x: float) -> float:
    """Share of the area of a leaf in the domain where the coordinates have values."""
    task, low, high = coordinates.problem.task, _LOW, _HIGH
    mesh = build_level_surface(
        lambda q: task.batched(q)[0][:, 0], lambda q: task.batched_jacobian(q)[0][:, 0], x, low, high, _COVER_CELLS
    )
    corners = mesh.vertices[mesh.faces]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    return float(areas[np.isfinite(coordinates.xi(corners.mean(axis=1))[:, 0])].sum() / areas.sum())
