"""[AS2023] Fig. 18: surfaces of the task x and of the fitted coordinate of Fig. 17, A = I."""

from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LightSource, Normalize
from matplotlib.ticker import MaxNLocator

from orthocas.tools.checks import Array

from .chosen_fit import USUAL, ChosenFit
from .drawing import Drawing
from .planar_fit import freely_fitted
from .planar_flow import cell_centres, corners, deviations
from .style import LABEL, TICK, add_3d, find_axis, new_figure


def draw(quick: bool, chosen: ChosenFit = USUAL) -> Drawing:
    """Draw both surfaces; the numbers give their ranges and show right angles almost everywhere."""
    chart = freely_fitted("euclidean", quick, chosen)
    cells = 40 if quick else 160
    q, points = corners(cells)
    h, xi = (values.reshape(cells + 1, cells + 1) for values in chart.phi(points).T)
    figure = new_figure(3.1, layout=None)
    panels = (("(a) task $h(q) = x$ [m]", h), (r"(b) fitted coordinate $\xi(q)$ [1]", xi))
    for k, (title, values) in enumerate(panels):
        axes = add_3d(figure, -0.01 + 0.495 * k, 0.02, 0.44, 0.94)
        _draw_surface(axes, q, values)
        scale = ScalarMappable(Normalize(values.min(), values.max()), "viridis")
        bar = figure.colorbar(scale, cax=figure.add_axes((0.44 + 0.495 * k, 0.28, 0.01, 0.5)))
        bar.ax.tick_params(labelsize=TICK)
        axes.text2D(0.5, 0.97, title, fontsize=LABEL, ha="center", transform=axes.transAxes)
    centres = cell_centres(cells)
    angles = deviations(chart.problem, centres, chart.jacobian(centres)[:, 1])
    numbers = {
        "least_task_value": float(h.min()),
        "largest_task_value": float(h.max()),
        "least_xi": float(xi.min()),
        "largest_xi": float(xi.max()),
        "difference_across_the_edges": float(max(np.abs(np.diff(v[[0, -1]], axis=0)).max() for v in (xi, xi.T))),
        "median_deviation_deg": float(np.median(angles)),
    }
    return Drawing({"": figure}, numbers)


def _draw_surface(axes: Any, q: Array, values: Array) -> None:
    """Draw a shaded surface with isolines below it."""
    low, high = values.min(), values.max()
    shades = LightSource(315, 50).shade(values, mpl.colormaps["viridis"], blend_mode="soft", vert_exag=0.4)
    surface = axes.plot_surface(
        *np.meshgrid(q, q), values, facecolors=shades, rcount=len(q), ccount=len(q), linewidth=0, antialiased=False
    )
    surface.set_rasterized(True)  # in vector graphics
    floor = low - 0.45 * (high - low)
    axes.contour(
        q,
        q,
        values,
        levels=np.linspace(low, high, 16)[1:-1],
        zdir="z",
        offset=floor,
        cmap="viridis",
        linewidths=0.8,
        linestyles="-",
    )
    axes.set_zlim(floor, high)
    ticks = MaxNLocator(4, steps=[1, 2, 5, 10]).tick_values(low, high)
    axes.set_zticks(ticks[(ticks > low - 1e-9) & (ticks < high + 1e-9)])
    for joint, letter in enumerate("xy", 1):
        find_axis(axes, letter, joint)
    axes.tick_params(labelsize=TICK, pad=0)
    axes.view_init(32, -62)
    axes.set_box_aspect((1, 1, 1), zoom=0.83)
