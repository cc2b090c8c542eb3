"""[AS2023] Fig. 27: angles of the coordinates of the 7-DoF arm, those of Fig. 28."""

from orthocas.charts.quality import evaluate

from .angle_histogram import draw_histogram
from .chosen_fit import USUAL, ChosenFit
from .drawing import Drawing
from .fig28 import arm_chart
from .style import EXTRA, LABEL, TASK, new_figure


def draw(quick: bool, chosen: ChosenFit = USUAL) -> Drawing:
    """Draw both histograms; the numbers are means and deviations, and the conditioning, which the paper lacks."""
    report = evaluate(arm_chart(quick, chosen), 10_000 if quick else 100_000)
    figure = new_figure(2.9)
    left, right = figure.subplots(1, 2, sharex=True, sharey=True)
    task, mutual = r"$\angle(\mathrm{d}\xi_j,\,\nabla h_i)$", r"$\angle(\mathrm{d}\xi_i,\,\nabla\xi_j)$"
    draw_histogram(left, report.task_angle, "(a) between task and coordinates", TASK, task)
    draw_histogram(right, report.mutual_angle, "(b) between coordinates", EXTRA, mutual)
    left.set_ylabel("share of angles per degree", fontsize=LABEL)
    numbers = {
        f"{name}_{key}_deg": getattr(angles, key)
        for name, angles in (("task", report.task_angle), ("mutual", report.mutual_angle))
        for key in ("mean", "std", "max")
    }
    if report.without_idle is not None:
        numbers["task_std_without_idle_deg"] = report.without_idle.task_angle.std
        numbers["mutual_std_without_idle_deg"] = report.without_idle.mutual_angle.std
    return Drawing({"": figure}, numbers | {"least_conditioning": report.conditioning.min})
