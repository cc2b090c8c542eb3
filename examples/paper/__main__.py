"""`python -m examples.paper FIGURE|all --out DIR`: redraws figures of the paper, and prints the numbers they show."""

import os
import sys
from pathlib import Path
from typing import Annotated

import typer

from orthocas.bases import parse_parametrisation
from orthocas.charts.ready import load
from orthocas.cli.commands import run
from orthocas.cli.options import AsJson, Force, parse_whole_number
from orthocas.cli.output import print_json, print_rows, terminal_monitor
from orthocas.errors import InvalidValueError
from orthocas.tools.files import open_output_folder

from .chosen_fit import ChosenFit
from .registry import FIGURES, chosen, reproduce_log, require_fit
from .registry import reproduce as reproduce_figures


def paper(
    figure: Annotated[str, typer.Argument(metavar="figNN|all", help=f"One of {', '.join(FIGURES)}, or all.")],
    out: Annotated[Path, typer.Option("--out", help="Folder for pictures, numbers and meshes.")],
    param: Annotated[
        str | None,
        typer.Option("--param", help="Parametrisation for figures of a fit, such as mlp:64x64 or polynomial:6."),
    ] = None,
    seed: Annotated[int, typer.Option("--seed", parser=parse_whole_number, help="Seed for figures of a fit.")] = 0,
    log: Annotated[
        Path | None, typer.Option("--log", help="CSV file of logged joint positions, for fig28; see docs/paper.md.")
    ] = None,
    chart: Annotated[Path | None, typer.Option("--chart", help="Chart file of the arm of the log.")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Use coarser settings that run faster.")] = False,
    force: Force = False,
    json: AsJson = False,
) -> None:
    """Redraw figures of the paper and print the numbers they show."""
    fit = ChosenFit(None if param is None else parse_parametrisation(param), seed)
    names = chosen(figure)
    require_fit(figure, fit)
    _require_log(names, log, chart)
    known = None if chart is None else load(chart)
    with open_output_folder("--out", out) as folder, terminal_monitor() as monitor:
        if log is None:
            numbers = reproduce_figures(figure, folder, quick, monitor, force, fit)
        else:
            numbers = reproduce_log(log, folder, known, force, fit)
    if json:
        print_json(numbers)
        return
    for name, values in numbers.items():
        typer.echo(f"{name}: {FIGURES[name].title}")
        print_rows({f"  {key}": f"{value:.6g}" for key, value in values.items()})
    print_rows({"files": str(out)})


def _require_log(names: list[str], log: Path | None, chart: Path | None) -> None:
    """Raise InvalidValueError unless a log is given for Fig. 28 only, and a chart only for a log."""
    if log is not None and names != ["fig28"]:
        raise InvalidValueError("--log", f"given for {', '.join(names[:3])}", "fig28, the figure of a motion")
    if chart is not None and log is None:
        raise InvalidValueError("--chart", "given", "a log to draw on it: --log FILE.csv")


def main() -> None:
    """Run the command; bad input gives one line and exit code 2."""
    os.environ["MPLBACKEND"] = "agg"  # pictures go to files
    app = typer.Typer(
        name="examples.paper", add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None
    )
    app.command()(paper)
    sys.exit(run(app))


if __name__ == "__main__":
    main()
