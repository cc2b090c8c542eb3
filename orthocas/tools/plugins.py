"""Plug-ins: packages that add commands and kinds of files to orthocas, found by their entry points.

A plug-in names functions in its `pyproject.toml`, as `orthocas.atlas` does:

    [project.entry-points."orthocas.commands"]
    atlas = "orthocas.atlas:command"

    [project.entry-points."orthocas.files"]
    atlas = "orthocas.atlas:opened"

`command()` returns what typer takes as a command; the first line of its docstring is the help. `opened(path)` returns
what the file holds, or None for a file of another kind; what it returns may have `c_source` (`orthocas.generate_c`)
and `view_session` (`orthocas.view`).
"""

from collections.abc import Callable
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any


@cache
def plug_ins(group: str) -> dict[str, Callable[..., Any]]:
    """The functions that installed packages name in a group of entry points, by their names."""
    return {entry.name: entry.load() for entry in sorted(entry_points(group=group), key=lambda entry: entry.name)}


def opened(path: Path) -> Any:
    """What a file of a plug-in holds; None for other files, such as charts.

    Raises:
        ArchiveError: if a file of a plug-in cannot be read.
    """
    for read in plug_ins("orthocas.files").values():
        found = read(path)
        if found is not None:
            return found
    return None
