"""The result of a figure recipe (pictures, numbers and meshes), and its output files."""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import trimesh
from matplotlib.figure import Figure

from orthocas.tools.files import publish

from .style import DPI


@dataclass(frozen=True, eq=False)
class Drawing:
    """A reproduced figure of the paper."""

    figures: Mapping[str, Figure]  #: suffix of the file name -> picture, {"": ...} or {"a": ..., "b": ...}
    numbers: Mapping[str, float]  #: numbers that are printed, saved and tested; finite
    meshes: Mapping[str, trimesh.Trimesh] = field(default_factory=dict)  #: suffix -> printable solid [mm]


def save(drawing: Drawing, name: str, out: str | Path, force: bool = False) -> list[Path]:
    """Write `<name><suffix>.png`, `<name>_<suffix>.stl` and `<name>.json`. Each file appears whole or not at all.

    Beside each picture, `<name><suffix>.pdf` holds vector graphics. Surfaces in 3-D are pixels there too.

    Args:
        drawing: the drawing to write.
        name: prefix of the file names, for example "fig07".
        out: an existing folder.
        force: also replace files that orthocas did not write.

    Returns:
        The files, with the numbers last.

    Raises:
        ValueError: if a number is not finite.
        ArchiveError: if there is a file that orthocas did not write, or a symbolic link.
        OSError: if a file cannot be written.
    """
    folder = Path(out)
    text = json.dumps(dict(drawing.numbers), indent=1, allow_nan=False) + "\n"
    writers: dict[str, Callable[[Path], object]] = {}
    for suffix, figure in drawing.figures.items():
        writers[f"{name}{suffix}.png"] = partial(figure.savefig, dpi=DPI)
        writers[f"{name}{suffix}.pdf"] = partial(figure.savefig, dpi=DPI, metadata={"CreationDate": None})
    for suffix, mesh in drawing.meshes.items():
        writers[f"{name}_{suffix}.stl"] = mesh.export
    writers[f"{name}.json"] = lambda draft: draft.write_text(text)
    with publish(folder, listed=True, force=force) as drafts:  # all at once, so that the numbers match the pictures
        for file, write in writers.items():
            write(drafts / file)
    return [folder / file for file in writers]
