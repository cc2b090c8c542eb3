"""`orthocas evaluate`: the quality of a chart file on held-out samples; and how far each coordinate reaches alone."""

from typing import Annotated, Any

import typer

from orthocas.charts import quality
from orthocas.charts.chart import Chart
from orthocas.charts.coordinates import InvertibleMap
from orthocas.charts.self_motion import XiRange
from orthocas.cli.output import AsJson, ChartPath, format_report_rows, parse_whole_number, print_json, print_rows
from orthocas.errors import InvalidValueError
from orthocas.tools.json import clean


def evaluate(
    chart: ChartPath,
    samples: Annotated[
        int, typer.Option("--samples", parser=parse_whole_number, help="Number of held-out samples.")
    ] = 100_000,
    seed: Annotated[
        int,
        typer.Option(
            "--seed", parser=parse_whole_number, help="Seed of the samples; use another one than for the fit."
        ),
    ] = 1,
    json: AsJson = False,
) -> None:
    """Measure the quality of a chart on held-out samples of its domain."""
    judged = Chart.load(chart)
    report = quality.evaluate(judged, samples, seed)
    if json:
        print_json({**report.as_dict(), **build_reach_data(judged)})
    else:
        print_rows({**format_report_rows(report), **format_reach_rows(judged)})


def reach_of(chart: Chart) -> XiRange | None:
    """The ranges of xi at the centre; None for grown charts, which take seconds, and where the task is not finite."""
    if isinstance(chart.coordinates, InvertibleMap):
        return None
    try:
        return chart.xi_range(chart.problem.domain.centre)
    except InvalidValueError:
        return None


def build_reach_data(chart: Chart) -> dict[str, Any]:
    """The ranges of xi and what stops them there, for JSON."""
    if (reach := reach_of(chart)) is None:
        return {}
    return {
        "xi_range": {part.label: [clean(part.low), clean(part.high)] for part in reach},
        "xi_stops": {part.label: [str(part.low_stop), str(part.high_stop)] for part in reach},
    }


def format_reach_rows(chart: Chart) -> dict[str, str]:
    """The ranges of xi in one row."""
    if (reach := reach_of(chart)) is None:
        return {}
    return {"xi reach": ", ".join(f"{part.label} {part.low:.3g} to {part.high:.3g}" for part in reach)}
