"""How far each coordinate of a chart reaches alone from the centre of its domain, for commands that print it."""

from typing import Any

from orthocas.charts.chart import Chart
from orthocas.charts.coordinates import InvertibleMap
from orthocas.charts.self_motion import XiRange
from orthocas.errors import InvalidValueError
from orthocas.tools.json import plain


def reach_of(chart: Chart) -> XiRange | None:
    """The ranges of xi at the centre; None for grown charts, which take seconds, and where the task is not finite."""
    if isinstance(chart.coordinates, InvertibleMap):
        return None
    try:
        return chart.xi_range(chart.problem.domain.centre)
    except InvalidValueError:
        return None


def reach_data(chart: Chart) -> dict[str, Any]:
    """The ranges of xi and what stops them there, for JSON."""
    if (reach := reach_of(chart)) is None:
        return {}
    return {
        "xi_range": {part.label: [plain(part.low), plain(part.high)] for part in reach},
        "xi_stops": {part.label: [str(part.low_stop), str(part.high_stop)] for part in reach},
    }


def reach_rows(chart: Chart) -> dict[str, str]:
    """The ranges of xi in one row."""
    if (reach := reach_of(chart)) is None:
        return {}
    return {"xi reach": ", ".join(f"{part.label} {part.low:.3g} to {part.high:.3g}" for part in reach)}
