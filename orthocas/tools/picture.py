"""Figures that notebooks show inline, with any matplotlib backend."""

import io
from typing import Any

from matplotlib.figure import Figure

from orthocas.tools.checks import Array


class Picture(Figure):
    """A matplotlib figure that shows itself in a notebook. It needs no pyplot."""

    def _repr_png_(self) -> bytes:
        """The picture as PNG."""
        file = io.BytesIO()
        self.savefig(file, format="png", dpi=120)
        return file.getvalue()


def equal_axes(axes: Any, points: Array) -> None:
    """Use the same scale on all three axes, around the points. A planar arm is drawn from above."""
    low, high = points.min(axis=0), points.max(axis=0)
    half = (high - low).max() / 2 * 1.05
    # Use a cube around the points, and small labels.
    for name, middle in zip("xyz", (low + high) / 2, strict=True):
        getattr(axes, f"set_{name}lim")(middle - half, middle + half)
        getattr(axes, f"set_{name}label")(f"{name} [m]", fontsize=8)
        getattr(axes, f"{name}axis").labelpad = -3
    axes.tick_params(labelsize=7, pad=0)
    axes.locator_params(nbins=4)
    axes.set_box_aspect((1, 1, 1), zoom=1.05)
    flat = (high - low)[2] < 1e-9
    axes.view_init(elev=90 if flat else 22, azim=-90 if flat else -60)
    if flat:
        axes.set(zticks=[], zlabel="")
