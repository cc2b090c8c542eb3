"""[AS2023] Fig. 29, a guess: the angles alpha_ij and beta_ij of the appendix, opposite an edge of a triangle mesh.

The text of the paper never cites its Fig. 29. It stands between Figs. 28 and 30, where the appendix is, and eq. (43)
needs a picture of its two angles; hence the guess. The mesh is the coarse one of Fig. 15. The two triangles at the edge
are drawn unfolded into a plane, which keeps their angles.
"""

from typing import Any

import numpy as np
from matplotlib.patches import Arc, Polygon

from orthocas.exact.leaves import DiskLeaf, build_disk_leaf
from orthocas.tools.checks import Array, Indices

from .charted_surface import add_with_edges
from .drawing import Drawing
from .fig15 import grown_disk
from .scene import Scene
from .style import EXTRA, GREY, INK, LABEL, TASK, THIRD, add_3d, new_figure

_CELLS = 15  # of the coarse mesh
_PLAIN, _RING, _PAIR = np.array([0.93, 0.94, 0.95]), np.array([0.80, 0.87, 0.95]), np.array([0.97, 0.85, 0.74])


def draw(quick: bool) -> Drawing:
    """Draw a vertex with its neighbours, and both angles at one edge; the numbers check eqs. (40) to (43)."""
    fine = grown_disk(24)[1]
    leaf = build_disk_leaf(fine.problem, fine.level, fine.region, _CELLS)
    i = _middle_vertex(leaf)
    j, a, b = _edge_at(leaf, i)
    figure = new_figure(2.9, layout=None)
    axes = add_3d(figure, 0.0, -0.02, 0.46, 1.0)
    _draw_ring(axes, leaf, i, j, (a, b))
    axes.text2D(
        0.5, 0.945, "(a) $v_i$ and its neighbours $N_1(v_i)$", fontsize=LABEL, ha="center", transform=axes.transAxes
    )
    flat = figure.add_axes((0.48, 0.03, 0.5, 0.82))
    angles = _draw_pair(flat, *leaf.vertices[[i, j, a, b]])
    figure.text(0.735, 0.905, "(b) both triangles at the edge $e_{ij}$, unfolded", fontsize=LABEL, ha="center")
    return Drawing({"": figure}, _numbers(leaf, i, j, angles))


def _middle_vertex(leaf: DiskLeaf) -> int:
    """The vertex whose image is nearest to the middle of the disk."""
    return int(np.argmin(np.linalg.norm(leaf.disk, axis=1)))


def _edge_at(leaf: DiskLeaf, i: int) -> tuple[int, int, int]:
    """The longest edge of a vertex: its other end, and the vertices opposite the edge in its two triangles."""
    around = leaf.faces[(leaf.faces == i).any(axis=1)]
    others = np.unique(around[around != i])
    j = int(others[np.argmax(np.linalg.norm(leaf.vertices[others] - leaf.vertices[i], axis=1))])
    pair = around[(around == j).any(axis=1)]
    a, b = (int(face[(face != i) & (face != j)][0]) for face in pair)
    return j, a, b


def _draw_ring(axes: Any, leaf: DiskLeaf, i: int, j: int, opposite: tuple[int, int]) -> None:
    near = np.linalg.norm(leaf.vertices - leaf.vertices[i], axis=1) < 0.95
    faces: Indices = leaf.faces[near[leaf.faces].all(axis=1)]
    colours = np.tile(_PLAIN, (len(faces), 1))
    colours[(faces == i).any(axis=1)] = _RING
    colours[(faces == i).any(axis=1) & (faces == j).any(axis=1)] = _PAIR
    scene = Scene()
    add_with_edges(scene, leaf.vertices, faces, colours, np.array([0.45, 0.48, 0.53]), 0.018)
    normal = np.cross(*(leaf.vertices[k] - leaf.vertices[i] for k in opposite))
    lift = 0.03 * normal / np.linalg.norm(normal)
    ends = leaf.vertices[[i, j]]
    for side in (lift, -lift):
        scene.add_tube(np.linspace(ends[0] + side, ends[1] + side, 12), 0.02, EXTRA)
    scene.add_ball(ends[0], 0.055, INK)
    scene.add_ball(ends[1], 0.055, EXTRA)
    away = normal / np.linalg.norm(normal)
    view = float(np.degrees(np.arcsin(abs(away[2])))), float(np.degrees(np.arctan2(away[1], away[0])))
    view = view if away[2] >= 0 else (view[0], view[1] + 180)
    scene.draw(axes, view, leaf.vertices[i] - 0.75, leaf.vertices[i] + 0.75, 1.2)
    for end, name, colour in zip(ends, ("$v_i$", "$v_j$"), (INK, EXTRA), strict=True):
        axes.text(*end + 0.3 * away + [0, 0, 0.13], name, fontsize=LABEL + 1, color=colour, ha="center", va="center")
    axes.set_axis_off()


def unfolded(vi: Array, vj: Array, va: Array, vb: Array) -> Array:
    """Both triangles at the edge (v_i, v_j) in one plane, with a above and b below the edge, (4, 2)."""
    along = vj - vi
    length = np.linalg.norm(along)
    points = [np.zeros(2), np.array([length, 0.0])]
    for corner, side in ((va, 1.0), (vb, -1.0)):
        foot = (corner - vi) @ along / length
        points.append(np.array([foot, side * np.linalg.norm(corner - vi - foot * along / length)]))
    return np.array(points)


def _draw_pair(axes: Any, *corners: Array) -> tuple[float, float]:
    """Draw the unfolded triangles and their angles; returns alpha and beta [rad]."""
    points = unfolded(*corners)
    names = ("$v_i$", "$v_j$", r"$\alpha_{ij}$", r"$\beta_{ij}$")
    for opposite in (2, 3):
        axes.add_patch(Polygon(points[[0, 1, opposite]], facecolor=_PAIR, edgecolor=GREY, linewidth=1.2))
    axes.plot(*points[:2].T, color=EXTRA, linewidth=2.6, zorder=3)
    angles = []
    size = 0.3 * float(np.linalg.norm(points[1]))
    for opposite, colour in ((2, TASK), (3, THIRD)):
        first, second = (points[k] - points[opposite] for k in (0, 1))
        bearings = [float(np.arctan2(v[1], v[0])) for v in (first, second)]
        low, high = np.degrees(sorted(bearings))
        axes.add_patch(Arc(tuple(points[opposite]), size, size, theta1=low, theta2=high, color=colour, linewidth=2))
        angles.append(abs(bearings[1] - bearings[0]))
        middle = np.mean(bearings)
        place = points[opposite] + 0.85 * size * np.array([np.cos(middle), np.sin(middle)])
        axes.text(*place, names[opposite], fontsize=LABEL + 1, color=colour, ha="center", va="center")
    for k, shift in ((0, -0.09), (1, 0.09)):
        axes.plot(*points[k], "o", color=INK if k == 0 else EXTRA, markersize=6, zorder=4)
        axes.text(points[k, 0] + shift, 0, names[k], fontsize=LABEL + 1, ha="center", va="center")
    axes.text(*points[:2].mean(axis=0) + 0.03, "$e_{ij}$", fontsize=LABEL, color=EXTRA, ha="center")
    formula = rf"$\omega_{{ij}} = \cot\alpha_{{ij}} + \cot\beta_{{ij}} = {sum(1 / np.tan(angles)):.3f}$"
    axes.text(0.5, -0.02, formula, fontsize=LABEL, ha="center", transform=axes.transAxes)
    axes.set_aspect("equal")
    axes.margins(0.12)
    axes.autoscale_view()
    axes.set_axis_off()
    return angles[0], angles[1]


def _numbers(leaf: DiskLeaf, i: int, j: int, angles: tuple[float, float]) -> dict[str, float]:
    """Weights (43) of v_i by angles, and row i of (40) with them and with the map of Fig. 15."""
    weights = weights_at(leaf, i)
    row = sum(weight * (leaf.disk[k] - leaf.disk[i]) for k, weight in weights.items())
    return {
        "alpha_deg": float(np.degrees(angles[0])),
        "beta_deg": float(np.degrees(angles[1])),
        "weight": weights[j],
        "error_of_weight": abs(weights[j] - float(sum(1 / np.tan(angles)))),
        "neighbours": float(len(weights)),
        "least_weight": min(weights.values()),
        "residual_of_row": float(np.abs(row).max()),
    }


def weights_at(leaf: DiskLeaf, i: int) -> dict[int, float]:
    """cot(alpha_ij) + cot(beta_ij) of all neighbours j of an inner vertex, by scalar and cross products."""
    weights: dict[int, float] = {}
    for face in leaf.faces[(leaf.faces == i).any(axis=1)]:
        one, other = (int(k) for k in face if k != i)
        for j, corner in ((one, other), (other, one)):
            first, second = (leaf.vertices[k] - leaf.vertices[corner] for k in (i, j))
            cotangent = first @ second / np.linalg.norm(np.cross(first, second))
            weights[j] = weights.get(j, 0.0) + float(cotangent)
    return weights
