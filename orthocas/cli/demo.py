"""`orthocas demo`: the first minute. Coordinates for the 7-DoF arm, their quality, a chart file and two pictures."""

from pathlib import Path
from typing import Annotated

import typer

from orthocas import problems
from orthocas.bases.products import Polynomial
from orthocas.charts.figures import quality_figure, self_motion_figure
from orthocas.charts.quality import evaluate
from orthocas.cli.evaluate import format_reach_rows
from orthocas.cli.output import Force, terminal_monitor
from orthocas.fitting.fit import Fit
from orthocas.fitting.fit import fit as fit_chart
from orthocas.tools.files import open_output_folder, publish

_PAPER = {"task": 2.06, "mutual": 3.44, "minutes": 100.64}  # [AS2023] Sec. 9


def demo(
    out: Annotated[Path, typer.Option("--out", help="Folder for chart and pictures.")] = Path("out"),
    force: Force = False,
) -> None:
    """Fit coordinates for the 7-DoF arm of the paper, print their quality, save a chart and pictures (10 s)."""
    fit, found = made(out, force=force)
    lines = (
        "KUKA iiwa, flange position, 4 extra coordinates on a cube of edge pi/2",
        f"  task angles    std {found['task_std_deg']:.2f} deg   (paper's network: {_PAPER['task']})",
        f"  mutual angles  std {found['mutual_std_deg']:.2f} deg   (paper's network: {_PAPER['mutual']})",
        f"  conditioning   mean {found['conditioning_mean']:.3f}, least found {found['conditioning_min']:.3f}",
        *(f"  {name:<13}  {text}" for name, text in format_reach_rows(fit.chart).items()),
        f"  fitted in      {found['seconds']:.1f} s       (paper: {_PAPER['minutes']} min on a GPU)",
        f"  chart and pictures in {out}/; try orthocas view {out / 'iiwa.orthocas'}",
    )
    for line in lines:
        typer.echo(line)


def made(out: Path, quick: bool = False, force: bool = False) -> tuple[Fit, dict[str, float]]:
    """Fit, evaluate and save.

    Args:
        out: folder for chart and pictures.
        quick: degree 3 and few samples.
        force: replace files that orthocas did not write.

    Returns:
        The fit; standard deviations [deg], conditioning and seconds.
    """
    with terminal_monitor() as monitor:
        fit = fit_chart(problems.get("iiwa"), Polynomial(degree=3 if quick else 5), monitor=monitor)
    report = evaluate(fit.chart, samples=5_000 if quick else 100_000)
    with open_output_folder("--out", out) as folder, publish(folder, listed=True, force=force) as drafts:
        fit.chart.save(drafts / "iiwa.orthocas")
        quality_figure(report).savefig(drafts / "iiwa_quality.png", dpi=150)
        self_motion_figure(fit.chart, reach=None).savefig(drafts / "iiwa_self_motion.png", dpi=150)
    return fit, {
        "task_std_deg": report.task_angle.std,
        "mutual_std_deg": report.mutual_angle.std,
        "conditioning_mean": report.conditioning.mean,
        "conditioning_p01": report.conditioning.p01,
        "conditioning_min": report.conditioning.min,
        "seconds": fit.seconds,
    }
