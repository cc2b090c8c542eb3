"""Arm files: the chart files of all branches in one archive."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from orthocas.charts.chart import Chart, load_file
from orthocas.errors import ChartFileError
from orthocas.tools.archive import Kind, read_archive, require_free, write_archive
from orthocas.tools.files import is_archive, open_draft_folder, write_temporary

ARM = Kind("arm", 1, ChartFileError)
_MOST = 256  # largest number of charts of an arm


def is_arm(path: Path) -> bool:
    """Whether a file is marked as an arm file."""
    return is_archive(path, ARM.format)


def write_charts(path: Path, charts: Sequence[Chart], force: bool) -> None:
    """Write the charts of an arm, each as the bytes of its own file.

    Raises:
        ChartFileError: as `orthocas.tools.archive.write_archive`.
    """
    require_free(path, ARM, force)
    arrays = {}
    with open_draft_folder() as drafts:
        for k, chart in enumerate(charts):
            chart.save(drafts / f"{k}.orthocas")
            arrays[f"chart_{k}"] = np.frombuffer((drafts / f"{k}.orthocas").read_bytes(), dtype=np.uint8)
    write_archive(path, ARM, {"charts": len(charts)}, arrays, force)


def read_charts(path: Path) -> tuple[Chart, ...]:
    """The charts of an arm file.

    Raises:
        ChartFileError: if the file or a chart in it is missing, truncated, edited, foreign, or from a newer version.
    """
    header, arrays = read_archive(path, ARM)
    count = header.get("charts")
    if not isinstance(count, int) or isinstance(count, bool) or not 1 <= count <= _MOST or len(arrays) != count:
        raise ChartFileError(f"{path} has {len(arrays)} charts, expected 1 to {_MOST}, as many as its header says")
    charts = []
    with open_draft_folder() as drafts:
        for k in range(count):
            content = arrays.get(f"chart_{k}")
            if content is None or content.dtype != np.uint8 or content.ndim != 1:
                raise ChartFileError(f"{path} has no chart {k}, expected {count} of them")
            write_temporary(drafts / f"{k}.orthocas", content.tobytes())
            try:
                charts.append(load_file(drafts / f"{k}.orthocas"))
            except ChartFileError as error:
                text = str(error).replace(str(drafts / f"{k}.orthocas"), f"chart {k} of {path}")
                raise ChartFileError(text) from None
    return tuple(charts)
