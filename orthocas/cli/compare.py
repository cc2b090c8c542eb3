"""`orthocas compare`: parametrisations and solvers side by side."""

from pathlib import Path
from typing import Annotated, cast

import typer

from orthocas.bases.registry import parse_parametrisation
from orthocas.cli.options import (
    CHAIN,
    DOMAIN,
    WEIGHTS_TEXT,
    AnglesName,
    PrecisionName,
    ProblemName,
    ProblemOptions,
    SampleCount,
    WeightsText,
    build_problem,
    parse_weights,
    parse_whole_number,
)
from orthocas.cli.output import AsJson, Force, note, parse_whole_number, print_json, print_table, terminal_monitor
from orthocas.errors import Interrupted, printable
from orthocas.fitting.compare import Comparison
from orthocas.fitting.compare import compare as compare_fits
from orthocas.fitting.comparison_figures import convergence_figure, front_figure
from orthocas.fitting.settings import PRECISIONS, Precision
from orthocas.solvers import get as get_solver
from orthocas.tools.files import open_output_folder, publish, require_replaceable_files
from orthocas.tools.interrupts import INTERRUPTED

_FILES = ("comparison.csv", "comparison.json", "front.png", "convergence.png")
_PARAMETRISATIONS = ["linear", "polynomial:2", "polynomial:3", "polynomial:4", "mlp:32x32"]


@parse_whole_number(*CHAIN, *DOMAIN)
def compare(
    problem: ProblemName,
    words: ProblemOptions,
    param: Annotated[
        list[str] | None, typer.Option("--param", help="Parametrisation; repeat for more. Default: a small selection.")
    ] = None,
    solver: Annotated[
        list[str] | None, typer.Option("--solver", help="Solver; repeat for more. Default: one that suits each.")
    ] = None,
    seeds: Annotated[int, typer.Option("--seeds", parser=parse_whole_number, help="Number of seeds per fit.")] = 1,
    samples: SampleCount = None,
    held_out: Annotated[
        int,
        typer.Option(
            "--held-out", parser=parse_whole_number, help="Number of held-out samples that every fit is evaluated on."
        ),
    ] = 100_000,
    weights: WeightsText = WEIGHTS_TEXT,
    angles: AnglesName = None,
    precision: PrecisionName = PRECISIONS[0],
    jobs: Annotated[
        int | None,
        typer.Option(
            "--jobs", parser=parse_whole_number, help="Number of processes, one thread each; default: all cores."
        ),
    ] = None,
    out: Annotated[Path, typer.Option("--out", help="Folder for tables, pictures and charts.")] = Path("comparison"),
    force: Force = False,
    json: AsJson = False,
) -> None:
    """Fit a grid of parametrisations, solvers and seeds; write tables, pictures and charts."""
    built = build_problem(problem, words)
    parametrisations = [parse_parametrisation(name) for name in param or _PARAMETRISATIONS]
    minimisers = [get_solver(name) for name in solver] if solver else None
    loss = parse_weights(weights, angles)
    with open_output_folder("--out", out) as folder, open_output_folder("--out", folder / "charts") as charts:
        require_replaceable_files(folder, _FILES, force)
        try:
            with terminal_monitor() as monitor:
                found = compare_fits(
                    built,
                    parametrisations,
                    minimisers,
                    seeds=seeds,
                    weights=loss,
                    samples=samples,
                    precision=cast(Precision, precision),
                    held_out=held_out,
                    jobs=jobs,
                    charts=charts,
                    control_ticks=True,
                    monitor=monitor,
                    force=force,
                )
        except Interrupted as stop:
            found = stop.result
        save(found, folder, force)
    _tell(found, out, json)


def _tell(found: Comparison, out: Path, json: bool) -> None:
    """Print the table, or all as JSON."""
    if json:
        print_json(found.as_dict())
    else:
        print_table(found.rows())
        typer.echo(f"\nTables, pictures and charts are in {printable(str(out))}.")
    failed = sum(result.failed for result in found.results)
    if failed:
        note(f"{failed} of {len(found.results)} fits failed, see comparison.csv")
    if found.interrupted:
        note(f"interrupted after {len(found.results)} fits")
        raise typer.Exit(INTERRUPTED)


def save(found: Comparison, out: Path, force: bool = False) -> None:
    """Write tables and pictures."""
    found.write(out, force)
    if all(result.failed for result in found.results):
        return
    with publish(out, listed=True, force=force) as drafts:
        front_figure(found).savefig(drafts / "front.png", dpi=150)
        convergence_figure(found).savefig(drafts / "convergence.png", dpi=150)
