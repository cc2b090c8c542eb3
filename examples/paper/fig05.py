"""[AS2023] Fig. 5: the planar arms with two and three joints. Angles are relative to the link before."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from orthocas import problems

from .arm_sketch import draw_angle, draw_arm, draw_base, joints_and_tip, link_lengths
from .drawing import Drawing
from .style import EXTRA, INK, LABEL, TASK, THIRD, TICK, new_figure

_ARMS = {"planar_2r": (0.65, 0.8), "planar_3r_xy": (0.95, -0.75, 0.9)}  # problem -> drawn posture [rad]
_COLOURS = (TASK, EXTRA, THIRD)


def draw(quick: bool) -> Drawing:
    """Draw both arms with their angles; the numbers compare the drawn tips with the models."""
    figure = new_figure(2.75)
    panels = figure.subplots(1, 2, sharey=True)
    numbers: dict[str, float] = {}
    for k, (axes, (name, q)) in enumerate(zip(panels, _ARMS.items(), strict=True)):
        robot = problems.get(name).robot
        lengths = link_lengths(robot)
        _draw_panel(axes, lengths, q, f"({'ab'[k]}) $n = {robot.n}$")
        tip = np.asarray(robot.tip_position(np.array(q))).ravel()[:2]
        numbers[f"joints_{'ab'[k]}"] = float(robot.n)
        numbers[f"tip_error_{'ab'[k]}_m"] = float(np.abs(joints_and_tip(lengths, q)[-1] - tip).max())
        numbers[f"mass_of_all_links_{'ab'[k]}_kg"] = float(robot.tree.masses.sum())
    return Drawing({"": figure}, numbers)


def _draw_panel(axes: Any, lengths: Sequence[float], q: Sequence[float], title: str) -> None:
    draw_base(axes)
    draw_arm(axes, lengths, q)
    points = joints_and_tip(lengths, q)
    for k, (centre, angle) in enumerate(zip(points, q, strict=False)):
        draw_angle(axes, centre, float(np.sum(q[:k])), angle, f"$q_{k + 1}$", _COLOURS[k])
    x, y = points[-1]
    axes.annotate("$h(q)$", (x, y), (9, 7), textcoords="offset points", fontsize=LABEL)
    axes.plot([x, x], [0, y], color=INK, linewidth=0.8, linestyle=":", zorder=1)
    axes.plot([0, x], [y, y], color=INK, linewidth=0.8, linestyle=":", zorder=1)
    axes.set(xlim=(-0.55, 2.6), ylim=(-0.4, 2.25), aspect="equal", title="")
    axes.set_title(title, fontsize=LABEL)
    axes.set_xlabel("$x$ [m]", fontsize=LABEL)
    if axes.get_subplotspec().is_first_col():
        axes.set_ylabel("$y$ [m]", fontsize=LABEL)
    axes.tick_params(labelsize=TICK)
