"""Sketches of planar arms in matplotlib axes: links, joints and angles."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.patches import Arc

from orthocas.robots import Robot
from orthocas.tools.checks import Array

from .style import GREY, INK, LABEL

_HALO = {"facecolor": "white", "edgecolor": "none", "pad": 0.6}


def link_lengths(robot: Robot) -> list[float]:
    """Lengths of the links of a planar arm, from its model [m]."""
    ends = np.vstack([robot.tree.translations[1:], robot.tree.tip_translation])
    lengths: list[float] = np.linalg.norm(ends, axis=1).tolist()
    return lengths


def joints_and_tip(lengths: Sequence[float], q: Sequence[float] | Array) -> Array:
    """Points of a planar arm from the base to the tip, (n + 1, 2) [m], by adding up its links."""
    directions = np.cumsum(q)
    steps = np.asarray(lengths)[:, None] * np.stack([np.cos(directions), np.sin(directions)], axis=1)
    return np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])


def draw_arm(
    axes: Any, lengths: Sequence[float], q: Sequence[float] | Array, colour: str = INK, size: float = 1
) -> None:
    """Draw links as thick lines with round joints, and the tip as a cross; `size` scales them."""
    points = joints_and_tip(lengths, q)
    axes.plot(*points.T, color=colour, linewidth=5 * size, solid_capstyle="round", solid_joinstyle="round", zorder=3)
    style = {"markerfacecolor": "white", "markeredgecolor": colour, "markeredgewidth": 1.4 * size, "zorder": 4}
    axes.plot(*points[:-1].T, "o", markersize=8 * size, **style)
    axes.plot(*points[-1], "P", markersize=8 * size, **style)


def draw_base(axes: Any, width: float = 0.3) -> None:
    """Draw the ground below joint 1: a bar with hatching."""
    y = -0.16
    axes.plot([0, 0], [y, 0], color=GREY, linewidth=6, zorder=1, solid_capstyle="butt")
    axes.plot([-width, width], [y, y], color=INK, linewidth=1.4, zorder=1)
    for x in np.linspace(-width, width, 7)[1:]:
        axes.plot([x, x - 0.09], [y, y - 0.09], color=INK, linewidth=0.9, zorder=1)


def draw_angle(
    axes: Any, centre: Array, start: float, turn: float, text: str, colour: str, radius: float = 0.42
) -> None:
    """Draw an angle as an arc from the direction `start`, turned by `turn` [rad], with a thin line along its start."""
    line = np.stack([centre, centre + 1.45 * radius * np.array([np.cos(start), np.sin(start)])])
    axes.plot(*line.T, color=GREY, linewidth=0.9, linestyle=(0, (4, 3)), zorder=2)
    low, high = np.degrees(sorted((start, start + turn)))
    axes.add_patch(Arc(tuple(centre), 2 * radius, 2 * radius, theta1=low, theta2=high, color=colour, lw=1.5, zorder=2))
    middle = start + turn / 2
    place = centre + 1.32 * radius * np.array([np.cos(middle), np.sin(middle)])
    axes.text(*place, text, color=colour, fontsize=LABEL, ha="center", va="center", zorder=5, bbox=_HALO)
