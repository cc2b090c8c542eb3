"""[AS2023] Fig. 20: angles between dxi_j and grad_M h_i of fitted coordinates, with and without exact solutions.

The arm is the planar arm with three joints and A = M, with the task x (exact coordinates exist) and the task (x, y)
(they do not). The paper does not state on what part of joint space it fits. Here both tasks use the box of
`orthocas.problems.planar_3r_x`, in which neither is singular.
"""

from typing import Any

import numpy as np

from orthocas import problems
from orthocas.fitting.fit import fit
from orthocas.judging.statistics import AngleStatistics
from orthocas.parametrisations import Polynomial
from orthocas.quality import Report, evaluate
from orthocas.reproduce.drawing import Drawing
from orthocas.reproduce.paper_loss import PAPER_LOSS
from orthocas.reproduce.style import EXTRA, LABEL, TASK, TICK, new_figure

_PANELS = {
    "involutive": ("planar_3r_x", "(a) involutive: task $x$", TASK),
    "non_involutive": ("planar_3r_xy", "(b) non-involutive: task $(x, y)$", EXTRA),
}
_GROUP, _FIRST_EDGE = (
    3,
    0.15,
)  # bins of 0.1 degree per bar, and the first edge [deg]; a right angle is at the centre of its bar


def draw(quick: bool) -> Drawing:
    """Draw both histograms with the same axes; the numbers are their means and standard deviations."""
    figure = new_figure(2.9)
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    numbers: dict[str, float] = {}
    for axes, (key, (name, title, colour)) in zip(panels, _PANELS.items(), strict=True):
        report = _judged(name, quick)
        _draw_histogram(axes, report.task_angle, title, colour)
        numbers |= {
            f"{key}_mean_deg": report.task_angle.mean,
            f"{key}_std_deg": report.task_angle.std,
            f"{key}_largest_deviation_deg": report.task_angle.max,
            f"{key}_least_conditioning": report.conditioning.min,
            f"{key}_angles": float(report.task_angle.histogram.sum()),
        }
    panels[0].set_ylabel("share of angles per degree", fontsize=LABEL)
    numbers["ratio_of_stds"] = numbers["non_involutive_std_deg"] / numbers["involutive_std_deg"]
    return Drawing({"": figure}, numbers)


def _judged(name: str, quick: bool) -> Report:
    found = fit(problems.get(name), Polynomial(4 if quick else 6), weights=PAPER_LOSS, samples=1500 if quick else None)
    return evaluate(found.chart, 10_000 if quick else 100_000)


def _draw_histogram(axes: Any, angles: AngleStatistics, title: str, colour: str) -> None:
    counts = angles.histogram[2:-2].reshape(-1, _GROUP).sum(axis=1)
    edges = _FIRST_EDGE + _GROUP / 10 * np.arange(len(counts) + 1)
    axes.stairs(counts / counts.sum() / (_GROUP / 10), edges, fill=True, color=colour)
    axes.set_xlim(78, 102)
    axes.set_title(title, fontsize=LABEL)
    text = rf"$\mu = {angles.mean:.2f}$°" + "\n" + rf"$\sigma = {angles.std:.3g}$°"
    axes.text(0.04, 0.95, text, fontsize=LABEL, va="top", transform=axes.transAxes)
    axes.set_xlabel(r"$\angle(\mathrm{d}\xi_j,\,\nabla_M h_i)$ [deg]", fontsize=LABEL)
    axes.tick_params(labelsize=TICK)
    axes.grid(alpha=0.3)
