"""Pictures of runs: the figure and the animation."""

import shutil
import subprocess
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image

from orthocas.control.controller import FROM_THE_LAW, ControlStatus
from orthocas.errors import ArchiveError, InvalidValueError
from orthocas.tasks.problem import Problem
from orthocas.tools.checks import Array, require_known
from orthocas.tools.files import publish, require_replaceable_files, require_writable
from orthocas.tools.picture import Picture
from orthocas.tools.progress import Monitor, Progress, silent

if TYPE_CHECKING:
    from orthocas.simulation.trajectory import Trajectory

ACTUAL, FALLBACK = "#3d85c6", "#d62728"
_REFERENCE, _STORAGE = "#222222", "#1b9e77"
_ARM, _TRAIL, _TARGET, _SHADOW = "#444c56", ACTUAL, FALLBACK, "#cfcfcf"
_LEGEND: dict[str, Any] = {"fontsize": 8, "ncols": 2, "frameon": False}
FORMATS = ("gif", "mp4")
Frame = NDArray[np.uint8]  #: (height, width, 3)


@dataclass(frozen=True, slots=True)
class PictureRules:
    """Numbers of figures and animations of runs."""

    font: float = 8.0  #: [pt]
    #: smallest range of a panel, relative to the widest, so that a constant quantity looks constant
    narrowest: float = 1e-2
    width: float = 8.6  #: width of an animation [inch]
    dpi: int = 100
    panel: float = 0.66  #: height of a quantity's panel [inch]
    margin: float = 0.08  #: around the arm, as a fraction of the widest range
    flat: float = 1e-9  #: [m], largest extent of a planar arm across its plane
    rate: int = 20  #: frames per second
    most_frames: int = 400  #: longer runs play faster than real time
    colours: int = 128


RULES = PictureRules()


def units_of(problem: Problem) -> dict[str, str]:
    """Units of task components and joints, by label. Extra coordinates have none."""
    joints = {"revolute": "rad", "prismatic": "m"}
    tree = problem.robot.tree
    units = {name: joints[kind] for name, kind in zip(tree.joint_names, tree.joint_kinds, strict=True)}
    return units | {label: unit for label, unit in zip(problem.task.labels, problem.task.units, strict=True) if unit}


def trajectory_figure(trajectory: "Trajectory", units: Mapping[str, str] | None = None) -> Figure:
    """Draw controlled quantities on the left; joints, commands and storage on the right. Red: fallback, not the law.

    Args:
        trajectory: the run.
        units: units of the quantities by label, see `units_of`; quantities without an entry are shown without a unit.
    """
    k = len(trajectory.labels)
    figure = Picture(figsize=(10.5, max(5.4, 1.05 * k + 0.9)), layout="constrained")
    halves: Any = figure.subfigures(1, 2)
    left, right = halves
    # Left: each controlled quantity with its target and its largest error.
    units = units or {}
    quantities = left.subplots(k, 1, sharex=True, squeeze=False)[:, 0]
    draw_quantities(quantities, trajectory, units)
    for axes, label, worst in zip(quantities, trajectory.labels, trajectory.tracking_error, strict=True):
        axes.set_title(f"largest error {worst:.2g} {units.get(label, '')}", loc="right", fontsize=7.5, pad=2)
    quantities[0].legend(fontsize=RULES.font, loc="lower left", bbox_to_anchor=(0, 1), ncols=2, frameon=False)
    # Right: joints and commands. Units depend on whether joints turn, slide, or both.
    torque = trajectory.kind == "torque"
    others = right.subplots(2 + torque, 1, sharex=True)
    unit = " or ".join(sorted({units.get(name, "rad or m") for name in trajectory.joint_names}, reverse=True))
    force = " or ".join({"rad": "N m", "m": "N"}[part] for part in unit.split(" or "))
    speed = " or ".join(f"{part}/s" for part in unit.split(" or "))
    others[0].plot(trajectory.times, trajectory.q, linewidth=1.3, label=trajectory.joint_names)
    others[0].set_ylabel(f"joints q [{unit}]", fontsize=9)
    names = len(trajectory.joint_names)
    others[0].legend(fontsize=7, loc="lower left", bbox_to_anchor=(0, 1), ncols=min(names, 4), frameon=False)
    others[1].plot(trajectory.times, trajectory.command, linewidth=1.3)
    others[1].set_ylabel(f"torque [{force}]" if torque else f"velocity [{speed}]", fontsize=9)
    # For torque controllers, draw the storage below.
    if torque:
        storage = np.where(trajectory.fell_back, np.nan, trajectory.storage)
        others[2].plot(trajectory.times, storage, color=_STORAGE, linewidth=1.3)
        others[2].set_ylabel("storage V [J]", fontsize=9)
    for axes in others:
        _set_style(axes, trajectory)
    for axes in (*quantities, *others):
        shade_fallback(axes, trajectory)
    for axes in (quantities[-1], others[-1]):
        axes.set_xlabel("time [s]", fontsize=9)
    for column in (left, right):
        column.align_ylabels()
    figure.suptitle(_build_title(trajectory), fontsize=10.5)
    return figure


def draw_quantities(panels: Array, trajectory: "Trajectory", units: Mapping[str, str], drawn: bool = True) -> None:
    """Draw the reference and, if `drawn`, the actual value of each quantity in its own axes."""
    good = ~trajectory.fell_back & np.isfinite(trajectory.value).all(axis=1)
    # Chart coordinates are meaningless outside the domain.
    seen = np.vstack([trajectory.value[good], trajectory.reference])
    lows, highs = seen.min(axis=0), seen.max(axis=0)
    spans = np.maximum(highs - lows, max(RULES.narrowest * (highs - lows).max(), 1e-9))
    middles = (lows + highs) / 2
    for i, (axes, label) in enumerate(zip(panels, trajectory.labels, strict=True)):
        if drawn:
            axes.plot(trajectory.times, trajectory.value[:, i], color=ACTUAL, linewidth=2.2, label="actual")
        axes.plot(trajectory.times, trajectory.reference[:, i], "--", color=_REFERENCE, linewidth=1, label="reference")
        axes.set_ylim(middles[i] - 0.58 * spans[i], middles[i] + 0.58 * spans[i])
        unit = f" [{units[label]}]" if label in units else ""
        # Write xi1 as a mathematical symbol; leave other labels unchanged.
        number = label.removeprefix("xi")
        symbol = rf"$\xi_{{{number}}}$" if label.startswith("xi") and number.isdigit() else label
        axes.set_ylabel(f"{symbol}{unit}", fontsize=9)
        _set_style(axes, trajectory)


def shade_fallback(axes: Axes, trajectory: "Trajectory") -> None:
    """Shade in red the times at which the controller used its fallback."""
    edges = np.flatnonzero(np.diff(trajectory.status)) + 1
    for start, end in zip([0, *edges], [*edges, len(trajectory.times) - 1], strict=True):
        status = ControlStatus(int(trajectory.status[start]))
        if status not in FROM_THE_LAW:
            axes.axvspan(trajectory.times[start], trajectory.times[end], color=FALLBACK, alpha=0.15, linewidth=0)


def _set_style(axes: Axes, trajectory: "Trajectory") -> None:
    axes.set_xlim(trajectory.times[0], max(trajectory.times[-1], 1e-9))
    axes.ticklabel_format(useOffset=False)
    axes.tick_params(labelsize=RULES.font)
    axes.grid(alpha=0.3)


def _build_title(trajectory: "Trajectory") -> str:
    # State how the run ended, for how long the fallback was active, and for how long the command was limited.
    text = f"{trajectory.controller}, {trajectory.times[-1]:.4g} s"
    if trajectory.outcome.value != "complete":
        text += f": {trajectory.outcome.value}, {trajectory.reason or 'run ended early'}"
    lasting = trajectory.seconds_in_status
    cut, red = ([status for status in lasting if (status in FROM_THE_LAW) == kind] for kind in (True, False))
    if red:
        text += f"\nred: {'catcher' if trajectory.catches else 'fallback'}, {_format_durations(lasting, red)}"
    if cut := [status for status in cut if status is not ControlStatus.OK]:
        text += f"\n{_format_durations(lasting, cut)}"
    return text


def _format_durations(lasting: Mapping[ControlStatus, float], chosen: Sequence[ControlStatus]) -> str:
    return ", ".join(f"{status.words} {lasting[status]:.3g} s" for status in chosen)


class MovingPicture:
    """Draws moving parts over a background that is drawn once, so that a frame takes milliseconds.

    Args:
        trajectory: the run.
        problem: robot and task.
        speed: playback speed relative to real time, for the title.
    """

    def __init__(self, trajectory: "Trajectory", problem: Problem, speed: float = 1.0) -> None:
        k = len(trajectory.labels)
        height = max(4.2, RULES.panel * k + 0.8)
        # MP4 needs an even height.
        size = (RULES.width, round(height * RULES.dpi / 2) * 2 / RULES.dpi)
        figure = Figure(figsize=size, dpi=RULES.dpi)
        self._canvas = cast(Any, FigureCanvasAgg(figure))
        self._times, self._values = trajectory.times, trajectory.value
        self._arm = _Arm(figure, trajectory, problem)
        grid = figure.add_gridspec(k, 1, left=0.61, right=0.98, bottom=0.5 / height, top=1 - 0.35 / height, hspace=0.18)
        panels = np.array([figure.add_subplot(grid[i]) for i in range(k)])
        draw_quantities(panels, trajectory, units_of(problem), drawn=False)
        self._lines: list[Any] = []
        for axes in panels:
            axes.tick_params(labelbottom=axes is panels[-1])
            shade_fallback(axes, trajectory)
            self._lines += axes.plot([], [], color=ACTUAL, linewidth=2, label="actual", animated=True)
            self._lines += axes.plot([], [], color=FALLBACK, linewidth=1, animated=True)
        panels[-1].set_xlabel("time [s]", fontsize=9)
        figure.align_ylabels(panels)
        handles = [self._lines[0], *panels[0].lines[:1]]
        figure.legend(handles=handles, loc=(0.605, 1 - 0.34 / height), **_LEGEND)
        self.title = trajectory.controller + ("" if speed == 1 else f", {speed:.3g} x real time")
        self.axes = tuple(figure.axes)  #: axes of the arm, then of each quantity
        figure.text(0.02, 1 - 0.25 / height, self.title, fontsize=10)
        self._clock = figure.text(0.42, 1 - 0.25 / height, "", fontsize=10, animated=True)
        self._canvas.draw()
        self._background = self._canvas.copy_from_bbox(figure.bbox)

    def pictures(self, instants: NDArray[np.int_]) -> Iterator[Frame]:
        """Frames of the run at the given instants, by index."""
        for index in instants:
            self._canvas.restore_region(self._background)
            # Draw everything that moves at this instant over the background.
            now = self._times[index]
            for i in range(self._values.shape[1]):
                done, cursor = self._lines[2 * i : 2 * i + 2]
                done.set_data(self._times[: index + 1], self._values[: index + 1, i])
                cursor.set_data([now, now], cursor.axes.get_ylim())
            self._clock.set_text(f"t = {now:.2f} s")
            for artist in (*self._arm.moved(int(index)), *self._lines, self._clock):
                self._canvas.figure.draw_artist(artist)
            yield np.asarray(self._canvas.buffer_rgba())[..., :3].copy()


class _Arm:
    """The arm, the path of its tip and the target of the tip, in 2-D axes for planar arms, otherwise in 3-D."""

    def __init__(self, figure: Figure, trajectory: "Trajectory", problem: Problem) -> None:
        points = problem.robot.joint_points(trajectory.q)  # (N, points, 3)
        low, high = points.min(axis=(0, 1)), points.max(axis=(0, 1))
        # A planar arm gets two axes.
        flat = np.flatnonzero(high - low < RULES.flat)
        shown = np.delete(np.arange(3), flat[-1]) if flat.size else np.arange(3)
        axes = _build_axes(figure, low[shown], high[shown], ["xyz"[i] for i in shown])
        self._points, self._targets = points[..., shown], _compute_tip_targets(trajectory, problem)[:, shown]
        # The base is fixed; path, arm and target move in each frame.
        zero = np.zeros((len(shown), 0))
        axes.plot(*self._points[0, :1].T, "s", color=_ARM, markersize=9)
        self._lines: list[Any] = [
            *axes.plot(*zero, color=_TRAIL, linewidth=1.5, animated=True, label="tip path"),
            *axes.plot(*zero, "-o", color=_ARM, linewidth=3.5, markersize=5.5, animated=True),
            *axes.plot(*zero, "+", color=_TARGET, markersize=13, markeredgewidth=1.6, animated=True, label="target"),
        ]
        self._shadow: list[Any] = [] if flat.size else axes.plot(*zero, color=_SHADOW, linewidth=3, animated=True)
        known = self._lines[0], self._lines[2]
        figure.legend(handles=known[: 1 + np.isfinite(self._targets).all()], loc=(0.02, 0.01), **_LEGEND)

    def moved(self, index: int) -> list[Artist]:
        """The lines, moved to their positions at an instant."""
        now = self._points[index]
        shapes = [self._points[: index + 1, -1], now, self._targets[index : index + 1]]
        for line, shape in zip(self._lines, shapes, strict=True):
            (line.set_data if shape.shape[1] == 2 else line.set_data_3d)(*shape.T)
        for line in self._shadow:
            line.set_data_3d(now[:, 0], now[:, 1], np.full(len(now), line.axes.get_zlim()[0]))
        return [*self._shadow, *self._lines]


def _compute_tip_targets(trajectory: "Trajectory", problem: Problem) -> Array:
    """Target of the tip, (N, 3), equal to the tip along free axes; NaN if the task is not a position."""
    if not problem.task.of_tip or not problem.task.name.startswith("position:"):
        return np.full((len(trajectory.times), 3), np.nan)
    target = problem.robot.joint_points(trajectory.q)[:, -1].copy()
    for i, label in enumerate(problem.task.labels):
        target[:, "xyz".index(label)] = trajectory.reference[:, i]
    return target


def _build_axes(figure: Figure, low: Array, high: Array, names: list[str]) -> Any:
    """Axes for the arm, with the same scale in all directions."""
    longest = (high - low).max()
    centres, extent = (low + high) / 2, high - low + 2 * RULES.margin * longest
    if len(names) == 2:
        axes: Any = figure.add_axes((0.075, 0.17, 0.445, 0.74))
        # Use one scale for both axes, whatever the shape of the panel.
        shape = figure.get_size_inches() * axes.get_position().size
        extent = (extent / shape).max() * shape
        axes.grid(alpha=0.3)
    else:
        axes = figure.add_axes((-0.02, 0.05, 0.52, 0.88), projection="3d")
        extent = np.maximum(extent, longest / 2)
        axes.set_box_aspect(extent, zoom=0.95)
        axes.view_init(elev=22, azim=-60)
        axes.locator_params(nbins=4)
    for letter, name, centre, length in zip("xyz", names, centres, extent, strict=False):
        getattr(axes, f"set_{letter}lim")(centre - length / 2, centre + length / 2)
        getattr(axes, f"set_{letter}label")(f"{name} [m]", fontsize=9)
    axes.tick_params(labelsize=8)
    return axes


def require_format(name: str) -> None:
    """Check early that this machine can make an animation of this format.

    Raises:
        UnknownNameError: if the format is neither gif nor mp4.
        InvalidValueError: for mp4 without ffmpeg on the PATH.
    """
    require_known("animation format", name, FORMATS)
    if name == "mp4" and shutil.which("ffmpeg") is None:
        raise InvalidValueError("animation", "mp4", "gif, because mp4 needs ffmpeg, which is not on the PATH")


def save_animation(
    path: str | Path, trajectory: "Trajectory", problem: Problem, monitor: Monitor = silent, force: bool = False
) -> None:
    """Write an animation of the arm and its controlled quantities. The file appears complete or not at all.

    The arm is drawn in 3-D, or in its plane if it is planar. The animation has 20 frames per second. Runs of up to 20 s
    play in real time.

    Args:
        path: output file, ending in .gif or .mp4.
        trajectory: the run.
        problem: robot and task.
        monitor: receives progress.
        force: replace any file of that name. Default: replace only files listed in `.orthocas.json` of the folder,
            which `save_animation` maintains.

    Raises:
        UnknownNameError, InvalidValueError: if the format is unknown, or ffmpeg is missing.
        ArchiveError: if the file cannot be written, or the path is a symbolic link or a file that orthocas did not
            write.
    """
    target = Path(path)
    require_format(target.suffix.removeprefix("."))
    require_writable(target, ArchiveError)
    require_replaceable_files(target.parent, [target.name], force)
    # Choose the instants of the frames; long runs play faster than real time.
    times = trajectory.times
    speed = max(1.0, float(times[-1] - times[0]) * RULES.rate / RULES.most_frames)
    shown = np.arange(times[0], times[-1] + 1e-9, speed / RULES.rate)
    instants = np.clip(np.searchsorted(times, shown - 1e-9), 0, len(times) - 1)
    film = MovingPicture(trajectory, problem, speed)
    samples = np.vstack(list(film.pictures(instants[[0, -1]])))

    def draw() -> Iterator[Frame]:
        for k, picture in enumerate(film.pictures(instants), start=1):
            yield picture
            monitor(Progress("draw animation", k / len(instants), f"frame {k} of {len(instants)}"))

    with publish(target.parent, listed=True, force=force) as folder:
        draft = folder / target.name
        if target.suffix == ".mp4":
            _write_mp4(draft, draw(), (len(samples) // 2, samples.shape[1]))
            return
        # Use the palette of sample frames for all frames; each frame stores only changes.
        palette = Image.fromarray(samples).quantize(RULES.colours)
        frames = (Image.fromarray(p).quantize(palette=palette, dither=Image.Dither.NONE) for p in draw())
        first, pause = next(frames), 1000 // RULES.rate
        # Unlike a file that Pillow opens, this one is closed even after Ctrl-C.
        with draft.open("wb") as file:
            first.save(file, "GIF", save_all=True, append_images=frames, duration=pause, loop=0, optimize=True)


def _write_mp4(path: Path, pictures: Iterator[Frame], size: tuple[int, int]) -> None:
    """Send raw frames of size (height, width) to ffmpeg through a pipe."""
    come = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{size[1]}x{size[0]}", "-r", str(RULES.rate), "-i", "-"]
    command = ["ffmpeg", "-loglevel", "error", "-y", *come, "-pix_fmt", "yuv420p", str(path)]
    with tempfile.TemporaryFile() as said:
        ffmpeg = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=said, stderr=said)
        try:
            # If ffmpeg stops early, its messages state the reason.
            with suppress(BrokenPipeError), ffmpeg:
                assert ffmpeg.stdin is not None
                for picture in pictures:
                    ffmpeg.stdin.write(picture.tobytes())
        except BaseException:
            ffmpeg.kill()
            raise
        said.seek(0)
        if ffmpeg.returncode != 0:
            text = said.read().decode(errors="replace").strip()[-200:]
            raise ArchiveError(f"ffmpeg could not write {path.name}: {text or f'exit code {ffmpeg.returncode}'}")
