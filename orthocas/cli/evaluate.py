"""`orthocas evaluate`: the quality of a chart file on held-out samples."""

from pathlib import Path
from typing import Annotated

import typer

from orthocas.charts import quality
from orthocas.charts.chart import Chart
from orthocas.cli.output import AsJson, print_json, print_rows, report_rows, whole_number
from orthocas.cli.reach import reach_data, reach_rows


def evaluate(
    chart: Annotated[Path, typer.Argument(metavar="CHART", help="A chart file.")],
    samples: Annotated[
        int, typer.Option("--samples", parser=whole_number, help="Number of held-out samples.")
    ] = 100_000,
    seed: Annotated[
        int, typer.Option("--seed", parser=whole_number, help="Seed of the samples; use another one than for the fit.")
    ] = 1,
    json: AsJson = False,
) -> None:
    """Measure the quality of a chart on held-out samples of its domain."""
    judged = Chart.load(chart)
    report = quality.evaluate(judged, samples, seed)
    if json:
        print_json({**report.as_dict(), **reach_data(judged)})
    else:
        print_rows({**report_rows(report), **reach_rows(judged)})
