"""[AS2023] Fig. 20: angles between dxi_j and grad_M h_i of fitted coordinates, with and without exact solutions.

The arm is the planar arm with three joints and A = M, with the task x (exact coordinates exist) and the task (x, y)
(they do not). The paper does not state on what part of joint space it fits. Here both tasks use the box of
`orthocas.problems.planar_3r_x`, in which neither is singular.
"""

from orthocas import problems
from orthocas.bases import Polynomial
from orthocas.charts.quality import Report, evaluate

from .angle_histogram import draw_histogram
from .chosen_fit import USUAL, ChosenFit
from .drawing import Drawing
from .style import EXTRA, LABEL, TASK, new_figure

_PANELS = {
    "involutive": ("planar_3r_x", "(a) involutive: task $x$", TASK),
    "non_involutive": ("planar_3r_xy", "(b) non-involutive: task $(x, y)$", EXTRA),
}
_MEANING = r"$\angle(\mathrm{d}\xi_j,\,\nabla_M h_i)$"


def draw(quick: bool, chosen: ChosenFit = USUAL) -> Drawing:
    """Draw both histograms, each with its own scale of shares; the numbers are their means and standard deviations."""
    figure = new_figure(2.9)
    panels = figure.subplots(1, 2, sharex=True)
    numbers: dict[str, float] = {}
    for axes, (key, (name, title, colour)) in zip(panels, _PANELS.items(), strict=True):
        report = _judged(name, quick, chosen)
        draw_histogram(axes, report.task_angle, title, colour, _MEANING)
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


def _judged(name: str, quick: bool, chosen: ChosenFit) -> Report:
    chart = chosen.chart(problems.get(name), Polynomial(4 if quick else 6), quick, 1500 if quick else None)
    return evaluate(chart, 10_000 if quick else 100_000)
