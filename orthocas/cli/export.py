"""`orthocas export`: a chart as a module of NumPy, PyTorch or JAX."""

from pathlib import Path
from typing import Annotated

import typer

from orthocas.charts.chart import Chart
from orthocas.cli.output import AsJson, ChartPath, Force, print_json, print_rows
from orthocas.codegen.export import LIBRARIES
from orthocas.codegen.export import export as export_chart


def export(
    chart: ChartPath,
    to: Annotated[str, typer.Option("--to", help=f"Library: {', '.join(LIBRARIES)}.")],
    out: Annotated[Path, typer.Option("--out", help="The module to write, NAME.py.")],
    force: Force = False,
    json: AsJson = False,
) -> None:
    """Write task, xi, phi, Jacobian and inverse of a chart as one Python module that needs the library only."""
    loaded = Chart.load(chart)
    module = export_chart(loaded, to, out, force)
    if json:
        print_json({"module": str(module), "library": to, "joints": loaded.n, "labels": list(loaded.labels)})
    else:
        print_rows({"module": f"{module}, with {to} alone", "functions": "task, xi, phi, jacobian, inverse"})
