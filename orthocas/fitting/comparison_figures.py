"""Figures of a comparison: the front of task and mutual angles, and the training loss over time."""

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from orthocas.tools.picture import Picture

if TYPE_CHECKING:
    from orthocas.fitting.compare import CellResult, Comparison, Summary

Colour = tuple[float, float, float, float]
_HUES = {"linear": "Greys", "polynomial": "Blues", "fourier": "Greens", "mlp": "Oranges", "sew": "Purples"}
_MARKERS = "osD^vPX*"
_ASIDE, _LETTER, _HIGH = 16.0, 5.4, 13.0  # of labels: distance from the point, room for a letter, and height [pt]
_ROOM = 2.0  # the largest loss in the picture, over the largest final one
_STYLES = ("-", "--", ":", "-.", (0, (5, 1, 1, 1, 1, 1)))


def front_figure(comparison: "Comparison") -> Figure:
    """Task angle against mutual angle of all fits. Fits further down and left are better.

    The colour shows the parametrisation, the marker the solver, and the size the number of parameters. Each
    parametrisation has one label, at its least task angle. A grey line connects the fits that no other one beats in
    both directions (medians over seeds). With one extra coordinate there is no mutual angle, so the axis shows the 1 %
    quantile of the conditioning.

    For wide fits, two plots show the part of the branch where coordinates are not regular, and the conditioning, over
    the leak. Lines connect the fits of one parametrisation with several weights, which stand at the points.
    """
    if comparison.wide:
        return _wide_front_figure(comparison)
    summaries = [summary for summary in comparison.summaries() if summary.failed < summary.seeds]
    figure = Picture(figsize=(8.6, 5.2), layout="constrained")
    axes = figure.add_subplot()
    good = [result for result in comparison.results if not result.failed]
    single = all(math.isnan(result.mutual_std_deg) for result in good)
    colours, markers = _colours(good), dict(zip(_names(good, "solver"), _MARKERS * 3, strict=False))
    # A point for each fit.
    for result in good:
        axes.scatter(
            result.task_std_deg,
            result.conditioning_p01 if single else result.mutual_std_deg,
            s=30 + 25 * math.log10(1 + result.parameters),
            color=colours[result.parametrisation],
            marker=markers[result.solver],
            alpha=0.8,
            edgecolor="black",
            linewidth=0.4,
        )
    axes.set_xlabel("task angle, standard deviation [deg]")
    axes.set_ylabel("conditioning, 1 % quantile (1 is best)" if single else "mutual angle, standard deviation [deg]")
    _scale(axes, [r.task_std_deg for r in good], [] if single else [r.mutual_std_deg for r in good])
    # A line through the points that no other one beats in both directions; the least task angle comes first.
    front: list[tuple[float, float]] = []
    for summary in summaries:
        x, y = _place(summary, single)
        if not front or (y > front[-1][1] if single else y < front[-1][1]):
            front.append((x, y))
    axes.plot(*zip(*front, strict=True), color="0.6", linewidth=1.0, zorder=0)
    handles = [Line2D([], [], marker=m, linestyle="", color="0.4", label=name) for name, m in markers.items()]
    axes.legend(handles=handles, fontsize=8)
    axes.set_title(f"{_problem(comparison)}: held-out quality; size is the number of parameters", fontsize=10)
    axes.grid(alpha=0.3, which="both")
    _label(axes, summaries, single, colours)
    return figure


def _wide_front_figure(comparison: "Comparison") -> Figure:
    """Two plots over the leak of wide fits: the part of the branch that is not regular, and the conditioning."""
    figure = Picture(figsize=(8.6, 5.2), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True)
    summaries = [summary for summary in comparison.summaries() if summary.failed < summary.seeds]
    colours = _colours([result for result in comparison.results if not result.failed])
    # A line for each parametrisation, a point for each set of weights
    for name, colour in colours.items():
        own = [summary for summary in summaries if summary.parametrisation == name]
        leaks = [summary.leak_rms_deg for summary in own]
        left_out = [100 * (1 - summary.regular_share) for summary in own]
        for axes, values in ((upper, left_out), (lower, [summary.conditioning_p01 for summary in own])):
            axes.plot(leaks, values, "o-", color=colour, label=name)
            for summary, *place in zip(own, leaks, values, strict=True):
                axes.annotate(summary.weights, place, xytext=(5, 4), textcoords="offset points", fontsize=7)
    upper.set(ylabel="not regular [% of the branch]")
    lower.set(xlabel="leak, root mean square [deg]", ylabel="conditioning, 1 % quantile")
    upper.set_title(f"{_problem(comparison)}: what less leak costs, by weights", fontsize=10)
    upper.legend(fontsize=8)
    for axes in (upper, lower):
        axes.set_ylim(0, 1.2 * axes.get_ylim()[1])
        axes.margins(x=0.12)
        axes.grid(alpha=0.3)
    return figure


def convergence_figure(comparison: "Comparison") -> Figure:
    """Training loss over time, one line per fit, from the beginning of its last stage: that of all its parameters."""
    figure = Picture(figsize=(8.6, 5.2), layout="constrained")
    axes = figure.add_subplot()
    drawn = [result for result in comparison.results if result.history]
    colours, styles = _colours(drawn), dict[str, Any](zip(_names(drawn, "solver"), _STYLES * 3, strict=False))
    for result in drawn:
        seconds, loss = zip(*result.history, strict=True)
        colour = colours[result.parametrisation]
        axes.plot(seconds, loss, color=colour, linestyle=styles[result.solver], linewidth=1.2, alpha=0.75)
        axes.plot(seconds[-1], loss[-1], ".", color=colour)
    axes.set_xscale("log")
    axes.set_yscale("log")
    # Cut off the high losses at the random starts of networks.
    if drawn:
        axes.set_ylim(top=_ROOM * max(result.history[-1][1] for result in drawn))
    axes.set_xlabel("time [s]")
    axes.set_ylabel("training loss")
    axes.set_title(f"{_problem(comparison)}: training loss over time", fontsize=10)
    # One legend for parametrisations and solvers, beside the plot.
    handles = [Line2D([], [], color=colour, linewidth=3, label=name) for name, colour in colours.items()]
    handles += [Line2D([], [], linestyle=style, color="0.3", label=name) for name, style in styles.items()]
    axes.legend(handles=handles, fontsize=8, loc="upper left", bbox_to_anchor=(1.01, 1.0), borderaxespad=0.0)
    axes.grid(alpha=0.3, which="both")
    return figure


def _problem(comparison: "Comparison") -> str:
    return comparison.results[0].problem if comparison.results else ""


def _names(results: "Sequence[CellResult]", attribute: str) -> list[str]:
    return list(dict.fromkeys(str(getattr(result, attribute)) for result in results))


def _colours(results: "Sequence[CellResult]") -> dict[str, Colour]:
    """One hue for each kind of parametrisation, darker for labels later in the alphabet."""
    kinds: dict[str, list[str]] = {}
    for name in sorted(_names(results, "parametrisation")):
        kinds.setdefault(name.partition(":")[0], []).append(name)
    colours = {}
    for kind, names in kinds.items():
        for k, name in enumerate(names):
            colours[name] = mpl.colormaps[_HUES.get(kind, "Reds")](0.35 + 0.6 * (k + 1) / len(names))
    return colours


def _place(summary: "Summary", single: bool) -> tuple[float, float]:
    """Coordinates (x, y) of a summary in the plot."""
    return summary.task_std_deg, summary.conditioning_p01 if single else summary.mutual_std_deg


def _key(summary: "Summary") -> tuple[str, str, str]:
    return summary.parametrisation, summary.solver, summary.weights


def _label(axes: Axes, summaries: "Sequence[Summary]", single: bool, colours: Mapping[str, Colour]) -> None:
    """Write each parametrisation once, beside its least task angle. Labels that would overlap move up or down."""
    # Summaries are sorted by their task angle, so the first one of a parametrisation is its best
    best: dict[str, Summary] = {}
    for summary in summaries:
        best.setdefault(summary.parametrisation, summary)
    axes.margins(x=0.12)
    axes.figure.draw_without_rendering()  # type: ignore[union-attr]  # so that places in points are known
    scale = 72 / axes.figure.dpi
    points = {_key(s): scale * axes.transData.transform(_place(s, single)) for s in summaries}
    # Left end, right end and height of the points and, later, of labels [pt].
    boxes = [(x - _HIGH / 2, x + _HIGH / 2, y) for x, y in points.values()]
    frame = axes.get_window_extent()
    low, high, end = scale * frame.y0 + _HIGH / 2, scale * frame.y1 - _HIGH / 2, scale * frame.x1
    for name, summary in sorted(best.items(), key=lambda entry: points[_key(entry[1])][1]):
        # The label is to the right of the point if there is room, at a free height
        x, y = points[_key(summary)]
        wide = _LETTER * len(name)
        side = 1 if x + _ASIDE + wide < end else -1
        left, right = sorted((x + side * _ASIDE, x + side * (_ASIDE + wide)))
        taken = [box[2] for box in boxes if left < box[1] and box[0] < right]
        nearest = (height for shift in range(round(high - low)) for height in (y + shift, y - shift))
        free = (own for own in nearest if low <= own <= high and all(abs(own - other) >= _HIGH for other in taken))
        height = next(free, y)
        boxes.append((left, right, height))
        axes.annotate(
            name,
            _place(summary, single),
            xytext=(side * _ASIDE, height - y),
            textcoords="offset points",
            fontsize=9,
            color=colours[name],
            horizontalalignment="left" if side > 0 else "right",
            verticalalignment="center",
            arrowprops={"arrowstyle": "-", "color": colours[name], "linewidth": 0.7, "relpos": (side < 0, 0.5)},
        )


def _scale(axes: Axes, *values: Sequence[float]) -> None:
    """Use a logarithmic axis if the values are positive and spread over more than a factor of four."""
    for name, numbers in zip(("x", "y"), values, strict=True):
        if numbers and max(numbers) > 4 * min(numbers) > 1e-3 * max(numbers):
            getattr(axes, f"set_{name}scale")("log")
            axis = getattr(axes, f"{name}axis")
            axis.set_major_locator(LogLocator(subs=(1, 2, 3, 5)))
            axis.set_major_formatter(StrMethodFormatter("{x:g}"))
            axis.set_minor_formatter(NullFormatter())
