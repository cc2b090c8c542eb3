"""Atlases: many charts that cover the joint range of a robot. A plug-in: nothing in the core imports it.

- `plan` holds what the boxes share, `lattice` cuts the range into tiles, of which many are images of others.
- `box_fit` fits and judges the chart of one box; `build` runs such jobs and appends results to the `atlas_file`.
- `building` has `build_atlas`; `index` finds the chart of a joint position.
- `atlas` is what users see, `coverage` measures it, `chart_along` goes from chart to chart.
- `c_source`, `view_session` and `command` are what C, the viewer and the command line ask for.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from orthocas.atlas.atlas import Atlas

__all__ = ["command", "opened"]


def command() -> Any:
    """Build, evaluate and show atlases: charts that cover the joint range of an arm."""
    from orthocas.atlas.command import atlas  # imports take half a second, and `orthocas --help` needs the line above

    return atlas


def opened(path: Path) -> "Atlas | None":
    """The atlas of a file, None for other files; for `orthocas view` and `orthocas codegen`."""
    from orthocas.atlas.atlas import Atlas  # the same for files that are no atlas
    from orthocas.atlas.atlas_file import ATLAS
    from orthocas.tools.block_file import begins

    return Atlas.load(path) if begins(path, ATLAS) else None
