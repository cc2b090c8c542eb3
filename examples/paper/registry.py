"""All reproduced figures, by name."""

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from orthocas.charts.chart import Chart
from orthocas.errors import InvalidValueError, UnknownNameError
from orthocas.tools.files import open_output_folder, require_replaceable_files
from orthocas.tools.progress import Monitor, Progress, silent

from . import (
    fig01,
    fig02,
    fig03,
    fig04,
    fig05,
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
    fig16,
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
    fig27,
    fig28,
    fig29,
    fig30,
)
from .chosen_fit import USUAL, ChosenFit
from .drawing import Drawing, save


@dataclass(frozen=True)
class Recipe:
    """The title of a figure, and the function that draws it."""

    title: str
    draw: Callable[[bool], Drawing]  #: takes `quick`, for a coarser version in tests
    draw_fit: Callable[[bool, ChosenFit], Drawing] | None = None  #: the same with another fit; None: it shows no fit


def _of_fit(title: str, draw: Callable[..., Drawing]) -> Recipe:
    return Recipe(title, draw, draw)


FIGURES: dict[str, Recipe] = {
    "fig01": Recipe("The idea of orthogonal foliations, task x in the 3-torus", fig01.draw),
    "fig02": Recipe("A geodetic spring, and a spring that a projector hides", fig02.draw),
    "fig03": Recipe("The forward kinematics as a map to SE(2)", fig03.draw),
    "fig04": Recipe("The push-forward of a velocity", fig04.draw),
    "fig05": Recipe("The planar arms with two and three joints", fig05.draw),
    "fig06": Recipe("Leaves of the task x on the 2-torus", fig06.draw),
    "fig07": Recipe("Leaves of the task x in the 3-torus", fig07.draw),
    "fig08": Recipe("Self-motion curves of the task (x, y) in the 3-torus", fig08.draw),
    "fig09": Recipe("Orthogonal foliations for dynamic consistency", fig09.draw),
    "fig10": _of_fit("A distribution that is not involutive, task (x, y)", fig10.draw),
    "fig11": Recipe("Rows of the task Jacobian in Cartesian and polar coordinates", fig11.draw),
    "fig12": Recipe("Following the gradient flow, A = I", fig12.draw),
    "fig13": Recipe("The grown coordinate, A = I and A = M", fig13.draw),
    "fig14": Recipe("Following the gradient flow, A = M", fig14.draw),
    "fig15": Recipe("Coordinates grown from a leaf that is a disk", fig15.draw),
    "fig16": Recipe("The network and its number of parameters", fig16.draw),
    "fig17": _of_fit("Isolines of a network on the torus: untrained, A = I and A = M", fig17.draw),
    "fig18": _of_fit("Surfaces of the task and of a fitted coordinate", fig18.draw),
    "fig19": _of_fit("A fitted coordinate, task (x, y), in a section of joint space", fig19.draw),
    "fig20": _of_fit("Angles of fitted coordinates, involutive and not", fig20.draw),
    "fig21": Recipe("The closed loop of the simulations", fig21.draw),
    "fig22": Recipe("Interleaved steps with linear coordinates", fig22.draw),
    "fig23": _of_fit("Interleaved steps with fitted coordinates", fig23.draw),
    "fig24": _of_fit("Steps in all coordinates, linear and fitted, task x", fig24.draw),
    "fig25": _of_fit("Feedback only, and the parts of unwanted task acceleration", fig25.draw),
    "fig26": _of_fit("Steps in x and xi, linear and fitted, task (x, y)", fig26.draw),
    "fig27": _of_fit("Angles of the coordinates of the 7-DoF arm", fig27.draw),
    "fig28": _of_fit("A journey of the 7-DoF arm that ends where it began", fig28.draw),
    "fig29": Recipe("Angles opposite an edge of a mesh (a guess: the text never cites this figure)", fig29.draw),
    "fig30": _of_fit("Steps in all coordinates, fitted, task (x, y)", fig30.draw),
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
        raise UnknownNameError("figure", name, [f"{min(FIGURES)} to {max(FIGURES)}", "all"])
    return [figure]


def require_fit(name: str, fit: ChosenFit) -> None:
    """Raise InvalidValueError if a fit is chosen for a figure that shows none."""
    if fit != USUAL and name != "all" and FIGURES[chosen(name)[0]].draw_fit is None:
        known = ", ".join(figure for figure, recipe in FIGURES.items() if recipe.draw_fit is not None)
        raise InvalidValueError("fit", f"chosen for {name}", f"a figure of a fit: {known}, or all")


def reproduce(
    name: str,
    out: str | Path,
    quick: bool = False,
    monitor: Monitor = silent,
    force: bool = False,
    fit: ChosenFit = USUAL,
) -> dict[str, dict[str, float]]:
    """Reproduce figures of [AS2023], and save pictures, numbers and meshes.

    Ctrl-C keeps the files of the finished figures.

    Args:
        name: a figure, or "all".
        out: folder for the files, created if needed.
        quick: coarser and faster, for tests.
        monitor: called before each figure and at the end.
        force: replace files that orthocas did not write, too.
        fit: parametrisation and seed for figures that show a fit, such as `ChosenFit(MLP((64, 64)), seed=1)`. With
            "all", the other figures are drawn as they are.

    Returns:
        The numbers of each figure.

    Raises:
        UnknownNameError: if no figure has that name.
        InvalidValueError: if the folder is not writable, or a fit is chosen for a figure that shows none.
        ArchiveError: if it has files with the name of a figure that orthocas did not write, or symbolic links.
        KeyboardInterrupt: after Ctrl-C.
    """
    names, numbers = chosen(name), {}
    require_fit(name, fit)
    with open_output_folder("out", out) as folder:
        for figure in names:
            files = re.compile(rf"{figure}\w?(_\w+)?\.(png|pdf|stl|json)")
            require_replaceable_files(folder, [f.name for f in folder.iterdir() if files.fullmatch(f.name)], force)
        for done, figure in enumerate(names):
            monitor(Progress("reproducing", done / len(names), f"{figure}: {FIGURES[figure].title}"))
            recipe = FIGURES[figure]
            drawing = recipe.draw(quick) if recipe.draw_fit is None else recipe.draw_fit(quick, fit)
            save(drawing, figure, folder, force)
            numbers[figure] = dict(drawing.numbers)
    monitor(Progress("reproducing", 1.0, f"{len(names)} figures"))
    return numbers


def reproduce_log(
    log: str | Path, out: str | Path, chart: Chart | None = None, force: bool = False, fit: ChosenFit = USUAL
) -> dict[str, dict[str, float]]:
    """Draw Fig. 28 for joint positions that a lab has logged, and save picture and numbers.

    Args:
        log: CSV file with the columns time_s, one for each joint by its name, and if they are known desired_x,
            desired_xi1 and so on.
        out: folder for the files, created if needed.
        chart: a chart of the arm. Default: the one of Fig. 28, of the KUKA LBR iiwa R800.
        force: replace files that orthocas did not write, too.
        fit: parametrisation and seed of the default chart.

    Returns:
        The numbers of the figure, by its name.

    Raises:
        PathFileError: if the log cannot be read.
        InvalidValueError, ArchiveError: as in `reproduce`.
    """
    with open_output_folder("out", out) as folder:
        drawing = fig28.draw_log(log, fig28.arm_chart(False, fit) if chart is None else chart)
        save(drawing, "fig28", folder, force)
    return {"fig28": dict(drawing.numbers)}
