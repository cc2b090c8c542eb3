"""`orthocas compare` and `demo`: parametrisations and solvers side by side, and a first example with pictures."""

from pathlib import Path
from typing import Annotated

import typer

from orthocas import problems
from orthocas.bases.family import parse_parametrisation
from orthocas.bases.products import Polynomial
from orthocas.charts.figures import quality_figure, self_motion_figure
from orthocas.charts.quality import evaluate
from orthocas.charts.ready import load
from orthocas.cli.options import AsJson, Force, ProblemOptions, SampleCount, Whole, is_robot_file, parse_weights
from orthocas.cli.output import format_reach_rows, note, print_json, print_table, terminal_monitor
from orthocas.errors import Interrupted, InvalidValueError, printable
from orthocas.fitting.compare import Comparison
from orthocas.fitting.compare import compare as compare_fits
from orthocas.fitting.comparison_figures import convergence_figure, front_figure
from orthocas.fitting.fit import Fit
from orthocas.fitting.fit import fit as fit_chart
from orthocas.solvers import get as get_solver
from orthocas.solvers.protocol import Solver
from orthocas.tasks.branches import branches
from orthocas.tools.files import open_output_folder, publish, require_replaceable_files
from orthocas.tools.interrupts import INTERRUPTED

_FILES = ("comparison.csv", "comparison.json", "front.png", "convergence.png")
_PARAMETRISATIONS = ["linear", "polynomial:2", "polynomial:3", "polynomial:4", "mlp:32x32"]


def compare(
    problem: Annotated[
        str, typer.Argument(metavar="PROBLEM|CHART|FILE.urdf", help="A named problem, that of a chart, or a robot.")
    ],
    param: Annotated[
        list[str] | None, typer.Option("--param", help="Parametrisation; repeat for more. Default: a small selection.")
    ] = None,
    solver: Annotated[
        list[str] | None, typer.Option("--solver", help="Solver; repeat for more. Default: one that suits each.")
    ] = None,
    seeds: Annotated[int, Whole("--seeds", help="Number of seeds per fit.")] = 1,
    samples: SampleCount = None,
    domain: Annotated[
        str | None,
        typer.Option(
            "--domain",
            help="branch: wide fits on the branch of the problem's centre, with the front of leak and regular share; "
            "branch:NAME: of another one.",
        ),
    ] = None,
    weights: Annotated[
        list[str] | None,
        typer.Option("--weights", help='"lambda1,lambda2", up to lambda5, as in fit; repeat for a front.'),
    ] = None,
    jobs: Annotated[
        int | None, Whole("--jobs", help="Number of processes, one thread each; default: all cores.")
    ] = None,
    out: Annotated[Path, typer.Option("--out", help="Folder for tables, pictures and charts.")] = Path("comparison"),
    force: Force = False,
    json: AsJson = False,
) -> None:
    """Fit a grid of parametrisations, solvers and seeds; write tables, pictures and charts."""
    # A chart file contributes its problem.
    is_name = problem in problems.names() or is_robot_file(problem) or not Path(problem).exists()
    built = ProblemOptions().build_problem(problem) if is_name else load(problem).problem
    parametrisations = [parse_parametrisation(name) for name in param or _PARAMETRISATIONS]
    minimisers: list[Solver] | None = [get_solver(name) for name in solver] if solver else None
    # Branch named by --domain, by default the one of the problem's centre; None without the option.
    if domain is None:
        branch = None
    else:
        kind, _, name = domain.partition(":")
        if kind != "branch":
            raise InvalidValueError("--domain", repr(domain), "branch or branch:NAME")
        parts = branches(built.robot, built.task)
        branch = parts[name.strip()] if name else parts.of(built.domain.home) or parts[0]
    losses = [parse_weights(text, None) for text in weights] if weights else None
    with open_output_folder("--out", out) as folder, open_output_folder("--out", folder / "charts") as charts:
        require_replaceable_files(folder, _FILES, force)
        try:
            with terminal_monitor() as monitor:
                comparison = compare_fits(
                    built,
                    parametrisations,
                    minimisers,
                    branch=branch,
                    seeds=seeds,
                    weights=losses,
                    samples=samples,
                    jobs=jobs,
                    charts=charts,
                    control_ticks=True,
                    monitor=monitor,
                    force=force,
                )
        except Interrupted as stop:
            comparison = stop.result
        write_comparison(comparison, folder, force)
    if json:
        print_json(comparison.as_dict())
    else:
        print_table(comparison.rows())
        typer.echo(f"\nTables, pictures and charts are in {printable(str(out))}.")
    failed = sum(result.failed for result in comparison.results)
    if failed:
        note(f"{failed} of {len(comparison.results)} fits failed, see comparison.csv")
    if comparison.interrupted:
        note(f"interrupted after {len(comparison.results)} fits")
        raise typer.Exit(INTERRUPTED)


def write_comparison(comparison: Comparison, folder: Path, force: bool) -> None:
    """Write tables and pictures."""
    comparison.write(folder, force)
    if all(result.failed for result in comparison.results):
        return
    with publish(folder, listed=True, force=force) as drafts:
        front_figure(comparison).savefig(drafts / "front.png", dpi=150)
        convergence_figure(comparison).savefig(drafts / "convergence.png", dpi=150)


# values of [AS2023] Sec. 9
_PAPER = {"task": 2.06, "mutual": 3.44, "minutes": 100.64}


def demo(
    out: Annotated[Path, typer.Option("--out", help="Folder for chart and pictures.")] = Path("out"),
    force: Force = False,
) -> None:
    """Fit coordinates for the 7-DoF arm of the paper, print their quality, save a chart and pictures (10 s)."""
    fit, numbers = fit_demo(out, force=force)
    lines = (
        "KUKA iiwa, flange position, 4 extra coordinates on a cube of edge pi/2",
        f"  task angles    std {numbers['task_std_deg']:.2f} deg   (paper's network: {_PAPER['task']})",
        f"  mutual angles  std {numbers['mutual_std_deg']:.2f} deg   (paper's network: {_PAPER['mutual']})",
        f"  conditioning   mean {numbers['conditioning_mean']:.3f}, least found {numbers['conditioning_min']:.3f}",
        *(f"  {name:<13}  {text}" for name, text in format_reach_rows(fit.chart).items()),
        f"  fitted in      {numbers['seconds']:.1f} s       (paper: {_PAPER['minutes']} min on a GPU)",
        f"  chart and pictures in {out}/; try orthocas view {out / 'iiwa.orthocas'}",
    )
    for line in lines:
        typer.echo(line)


def fit_demo(out: Path, quick: bool = False, force: bool = False) -> tuple[Fit, dict[str, float]]:
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
        self_motion_figure(fit.chart).savefig(drafts / "iiwa_self_motion.png", dpi=150)
    return fit, {
        "task_std_deg": report.task_angle.std,
        "mutual_std_deg": report.mutual_angle.std,
        "conditioning_mean": report.conditioning.mean,
        "conditioning_p01": report.conditioning.p01,
        "conditioning_min": report.conditioning.min,
        "seconds": fit.seconds,
    }
