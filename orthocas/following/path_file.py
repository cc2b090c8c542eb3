"""Files of tool paths: CSV with a header of the chart's labels and one waypoint a line. Format: docs/paths.md."""

from collections.abc import Sequence
from pathlib import Path

from orthocas.chart import Chart
from orthocas.checks import Array
from orthocas.files.csv_table import LONGEST, places, read_table
from orthocas.following.splines import MOST_WAYPOINTS


def read_path(path: str | Path, chart: Chart) -> tuple[Array, Array | None]:
    """Waypoints (N, m), and their coordinates (N, r) if the file has columns for them.

    Raises:
        PathFileError: names the file, the line, and what is wrong there.
    """
    values = read_table(path, "path file", "waypoints", MOST_WAYPOINTS, lambda names: _columns(names, chart))
    return values[:, : chart.m], values[:, chart.m :] if values.shape[1] > chart.m else None


def _columns(names: Sequence[str], chart: Chart) -> list[int]:
    """The columns in the order of the chart's labels, without those of the coordinates if there are none."""
    task, extra = chart.labels[: chart.m], chart.labels[chart.m :]
    wanted = (*task, *extra) if set(extra) & set(names) else task
    for name in names:
        if name not in chart.labels:
            known = f"{', '.join(task)}, and if the path has a schedule {', '.join(extra)}"
            raise ValueError(f"line 1: unknown column {name[:LONGEST]!r}, expected {known}")
    return places(names, wanted)
