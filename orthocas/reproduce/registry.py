"""All reproduced figures, by name."""

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from orthocas.errors import UnknownNameError
from orthocas.files.atomic import output_folder, require_replaceable_files
from orthocas.minimising.watch import Monitor, Progress, silent
from orthocas.reproduce import (
    fig01,
    fig02,
    fig06,
    fig07,
    fig08,
    fig09,
    fig10,
    fig11,
    fig12,
    fig13,
    fig14,
    fig15,
    fig17,
    fig18,
    fig19,
    fig20,
    fig21,
    fig22,
    fig23,
    fig24,
    fig25,
    fig26,
    fig28,
    fig30,
)
from orthocas.reproduce.drawing import Drawing, save


@dataclass(frozen=True)
class Recipe:
    """The title of a figure, and the function that draws it."""

    title: str
    draw: Callable[[bool], Drawing]  #: takes `quick`, for a coarser version in tests


FIGURES: dict[str, Recipe] = {
    "fig01": Recipe("The idea of orthogonal foliations, task x in the 3-torus", fig01.draw),
    "fig02": Recipe("A geodetic spring, and a spring that a projector hides", fig02.draw),
    "fig06": Recipe("Leaves of the task x on the 2-torus", fig06.draw),
    "fig07": Recipe("Leaves of the task x in the 3-torus", fig07.draw),
    "fig08": Recipe("Self-motion curves of the task (x, y) in the 3-torus", fig08.draw),
    "fig09": Recipe("Orthogonal foliations for dynamic consistency", fig09.draw),
    "fig10": Recipe("A distribution that is not involutive, task (x, y)", fig10.draw),
    "fig11": Recipe("Rows of the task Jacobian in Cartesian and polar coordinates", fig11.draw),
    "fig12": Recipe("Following the gradient flow, A = I", fig12.draw),
    "fig13": Recipe("The grown coordinate, A = I and A = M", fig13.draw),
    "fig14": Recipe("Following the gradient flow, A = M", fig14.draw),
    "fig15": Recipe("Coordinates grown from a leaf that is a disk", fig15.draw),
    "fig17": Recipe("Isolines of fitted coordinates, A = I and A = M", fig17.draw),
    "fig18": Recipe("Surfaces of the task and of a fitted coordinate", fig18.draw),
    "fig19": Recipe("A fitted coordinate, task (x, y), in a section of joint space", fig19.draw),
    "fig20": Recipe("Angles of fitted coordinates, involutive and not", fig20.draw),
    "fig21": Recipe("The closed loop of the simulations", fig21.draw),
    "fig22": Recipe("Interleaved steps with linear coordinates", fig22.draw),
    "fig23": Recipe("Interleaved steps with fitted coordinates", fig23.draw),
    "fig24": Recipe("Steps in all coordinates, linear and fitted, task x", fig24.draw),
    "fig25": Recipe("Feedback only, and the parts of unwanted task acceleration", fig25.draw),
    "fig26": Recipe("Steps in x and xi, linear and fitted, task (x, y)", fig26.draw),
    "fig28": Recipe("A journey of the 7-DoF arm that ends where it began", fig28.draw),
    "fig30": Recipe("Steps in all coordinates, fitted, task (x, y)", fig30.draw),
}


def chosen(name: str) -> list[str]:
    """Names of the figures that a word selects: "all", or one figure as "fig07", "fig7", "07" or "7".

    Raises:
        UnknownNameError: if no figure has that name.
    """
    if name == "all":
        return list(FIGURES)
    number = re.fullmatch(r"(?:fig)?0*(\d{1,4})", name)
    figure = f"fig{int(number[1]):02d}" if number else name
    if figure not in FIGURES:
        raise UnknownNameError("figure", name, [*FIGURES, "all"])
    return [figure]


def reproduce(
    name: str, out: str | Path, quick: bool = False, monitor: Monitor = silent, force: bool = False
) -> dict[str, dict[str, float]]:
    """Reproduce figures of [AS2023], and save pictures, numbers and meshes.

    Ctrl-C keeps the files of the finished figures.

    Args:
        name: a figure, or "all".
        out: folder for the files, created if needed.
        quick: coarser and faster, for tests.
        monitor: called before each figure and at the end.
        force: replace files that orthocas did not write, too.

    Returns:
        The numbers of each figure.

    Raises:
        UnknownNameError: if no figure has that name.
        InvalidValueError: if the folder is not writable.
        ArchiveError: if it has files with the name of a figure that orthocas did not write, or symbolic links.
        KeyboardInterrupt: after Ctrl-C.
    """
    names, numbers = chosen(name), {}
    with output_folder("out", out) as folder:
        for figure in names:
            files = re.compile(rf"{figure}\w?(_\w+)?\.(png|pdf|stl|json)")
            require_replaceable_files(folder, [f.name for f in folder.iterdir() if files.fullmatch(f.name)], force)
        for done, figure in enumerate(names):
            monitor(Progress("reproducing", done / len(names), f"{figure}: {FIGURES[figure].title}"))
            drawing = FIGURES[figure].draw(quick)
            save(drawing, figure, folder, force)
            numbers[figure] = dict(drawing.numbers)
    monitor(Progress("reproducing", 1.0, f"{len(names)} figures"))
    return numbers
