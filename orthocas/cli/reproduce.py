"""`orthocas reproduce`: redraws figures of the paper."""

from pathlib import Path
from typing import Annotated

import typer

from orthocas.cli.output import AsJson, Force, print_json, print_rows
from orthocas.cli.progress import terminal_monitor
from orthocas.files.atomic import output_folder
from orthocas.reproduce.registry import FIGURES, chosen
from orthocas.reproduce.registry import reproduce as reproduce_figures


def reproduce(
    figure: Annotated[str, typer.Argument(metavar="figNN|all", help=f"One of {', '.join(FIGURES)}, or all.")],
    out: Annotated[Path, typer.Option("--out", help="Folder for pictures, numbers and meshes.")],
    quick: Annotated[bool, typer.Option("--quick", help="Use coarser settings that run faster.")] = False,
    force: Force = False,
    json: AsJson = False,
) -> None:
    """Redraw figures of the paper and print the numbers they show."""
    chosen(figure)
    with output_folder("--out", out) as folder, terminal_monitor() as monitor:
        numbers = reproduce_figures(figure, folder, quick, monitor, force)
    if json:
        print_json(numbers)
        return
    for name, values in numbers.items():
        typer.echo(f"{name}: {FIGURES[name].title}")
        print_rows({f"  {key}": f"{value:.6g}" for key, value in values.items()})
    print_rows({"files": str(out)})
