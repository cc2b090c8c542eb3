"""Common style of the figures: colours, sizes, and axes in joint angles with ticks at multiples of pi."""

from collections.abc import Mapping
from fractions import Fraction
from typing import Any, Literal

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import ArrayLike

TASK = "#1f5fa8"  #: task coordinates and self-motion manifolds
EXTRA = "#d95f02"  #: extra coordinates, and highlights
THIRD = "#1b9e77"  #: a third kind of line
GREY = "#8a8f98"  #: frames and background
INK = "#222222"  #: text and black lines

DPI = 300  #: resolution of saved pictures
WIDTH = 6.3  #: of a figure across the full text width [inch], 16 cm
LABEL, TICK = 9.0, 8.0  #: font sizes [pt]
TURN = 2 * np.pi  #: [rad]


def new_figure(height: float, width: float = WIDTH, layout: Literal["constrained"] | None = "constrained") -> Figure:
    """An empty figure, with sizes in inches. Use no layout for figures with 3-D axes, see `add_3d`."""
    return Figure(figsize=(width, height), layout=layout)


def add_3d(figure: Figure, left: float, bottom: float, width: float, height: float) -> Any:
    """Add 3-D axes at a place in shares of the figure; drawings may extend beyond the axes."""
    axes: Any = figure.add_axes((left, bottom, width, height), projection="3d")
    axes.patch.set_visible(False)
    return axes


def pi_text(angle: float) -> str:
    """An angle as a fraction of pi in mathematical text, exact for denominators up to 12."""
    part = Fraction(angle / np.pi).limit_denominator(12)
    if part == 0:
        return "$0$"
    top = {1: r"\pi", -1: r"-\pi"}.get(part.numerator, rf"{part.numerator}\pi")
    return f"${top}$" if part.denominator == 1 else f"${top}/{part.denominator}$"


def find_axis(
    axes: Any,
    letter: str,
    joint: int,
    low: float = -np.pi,
    high: float = np.pi,
    parts: int = 4,
    margin: float = 0.0,
) -> None:
    """Turn one axis of 2-D or 3-D axes into the axis of a joint angle.

    Args:
        axes: matplotlib axes.
        letter: "x", "y" or "z".
        joint: number of the joint, from 1.
        low: lower end [rad].
        high: upper end [rad].
        parts: number of intervals between ticks.
        margin: distance of the first and the last tick from the ends [rad].
    """
    ticks = np.linspace(low + margin, high - margin, parts + 1)
    getattr(axes, f"set_{letter}lim")(low, high)
    getattr(axes, f"set_{letter}ticks")(ticks, [pi_text(tick) for tick in ticks], fontsize=TICK)
    getattr(axes, f"set_{letter}label")(rf"$q_{joint}$ [rad]", fontsize=LABEL)


def joint_plane(axes: Any, low: float = -np.pi, high: float = np.pi, parts: int = 4) -> None:
    """Set up axes of the (q1, q2) plane with equal scales."""
    find_axis(axes, "x", 1, low, high, parts)
    find_axis(axes, "y", 2, low, high, parts)
    axes.set_aspect("equal")


def joint_cube(
    axes: Any, low: ArrayLike = -np.pi, high: ArrayLike = np.pi, parts: int = 2, margin: float = 0.0
) -> None:
    """Set up axes of a box of (q1, q2, q3) without panes; `Scene.add_cube` draws its edges with correct depth."""
    lower, upper = np.broadcast_to(low, 3), np.broadcast_to(high, 3)
    for k, letter in enumerate("xyz"):
        find_axis(axes, letter, k + 1, lower[k], upper[k], parts, margin)
        axis = getattr(axes, f"{letter}axis")
        axis.set_pane_color((1.0, 1.0, 1.0, 0.0))
        axis.line.set_visible(False)
        axis.labelpad = -3
        axis.set_tick_params(pad=0)
    axes.zaxis.set_rotate_label(False)
    axes.zaxis.label.set_rotation(90)
    axes.grid(False)


def line_legend(figure: Figure, entries: Mapping[str, str]) -> None:
    """Add a legend line of text -> colour at the bottom, for 3-D scenes, which have no matplotlib legend."""
    handles = [Line2D([], [], color=colour, linewidth=3, label=text) for text, colour in entries.items()]
    figure.legend(handles=handles, loc="lower center", ncols=len(handles), fontsize=TICK, frameon=False, borderpad=0.2)
