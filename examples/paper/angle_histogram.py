"""Histograms of the angles between gradients, for Figs. 20 and 27."""

from typing import Any

import numpy as np

from orthocas.charts.quality import AngleStatistics

from .style import LABEL, TICK

_GROUP = 3  # bins of 0.1 degree per bar
_FIRST_EDGE = 0.15  # [deg]; a right angle is at the centre of its bar


def draw_histogram(axes: Any, angles: AngleStatistics, title: str, colour: str, meaning: str) -> None:
    """Draw shares per degree, with mean and standard deviation; `meaning` names the angle on the x axis."""
    counts = angles.histogram[2:-2].reshape(-1, _GROUP).sum(axis=1)
    edges = _FIRST_EDGE + _GROUP / 10 * np.arange(len(counts) + 1)
    axes.stairs(counts / counts.sum() / (_GROUP / 10), edges, fill=True, color=colour)
    axes.set_xlim(78, 102)
    axes.set_title(title, fontsize=LABEL)
    text = rf"$\mu = {angles.mean:.2f}$°" + "\n" + rf"$\sigma = {angles.std:.3g}$°"
    axes.text(0.04, 0.95, text, fontsize=LABEL, va="top", transform=axes.transAxes)
    axes.set_xlabel(f"{meaning} [deg]", fontsize=LABEL)
    axes.tick_params(labelsize=TICK)
    axes.grid(alpha=0.3)
