"""Animations of runs as GIF or MP4 files."""

import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from orthocas.checks import require_known
from orthocas.errors import ArchiveError, InvalidValueError
from orthocas.files.atomic import published, require_replaceable_files, require_writable
from orthocas.minimising.watch import Monitor, Progress, silent
from orthocas.problem import Problem
from orthocas.simulation.moving_picture import MovingPicture, Picture
from orthocas.simulation.trajectory import Trajectory

FORMATS = ("gif", "mp4")
_RATE = 20  # frames per second
_MOST = 400  # frames; longer runs play faster than real time
_COLOURS = 128


def require_format(name: str) -> None:
    """Check early that an animation of this format can be made on this machine.

    Raises:
        UnknownNameError: if the format is neither gif nor mp4.
        InvalidValueError: for mp4 without ffmpeg on the PATH.
    """
    require_known("animation format", name, FORMATS)
    if name == "mp4" and shutil.which("ffmpeg") is None:
        raise InvalidValueError("animation", "mp4", "gif, because mp4 needs ffmpeg, which is not on the PATH")


def save_animation(
    path: str | Path, trajectory: Trajectory, problem: Problem, monitor: Monitor = silent, force: bool = False
) -> None:
    """Write an animation of the arm and its controlled quantities. The file appears whole or not at all.

    The arm is drawn in 3-D, or in its plane if it is planar. The animation has 20 frames per second and runs in real
    time for runs of up to 20 s.

    Args:
        path: of the file, ending in .gif or .mp4.
        trajectory: the run.
        problem: robot and task.
        monitor: called with progress.
        force: replace any file of that name; default only those that the list `.orthocas.json` of the folder has, which
            is kept there.

    Raises:
        UnknownNameError, InvalidValueError: if the format is unknown, or ffmpeg is missing.
        ArchiveError: if the file cannot be written, or there is one that orthocas did not write, or a symbolic link.
    """
    target = Path(path)
    require_format(target.suffix.removeprefix("."))
    require_writable(target, ArchiveError)
    require_replaceable_files(target.parent, [target.name], force)
    instants, speed = _chosen(trajectory.times)
    film = MovingPicture(trajectory, problem, speed)
    samples = np.vstack(list(film.pictures(instants[[0, -1]])))
    pictures = _watched(film.pictures(instants), len(instants), monitor)
    with published(target.parent, listed=True, force=force) as folder:
        draft = folder / target.name
        if target.suffix == ".gif":
            _write_gif(draft, pictures, samples)
        else:
            _write_mp4(draft, pictures, (len(samples) // 2, samples.shape[1]))


def _chosen(times: NDArray[np.float64]) -> tuple[NDArray[np.int_], float]:
    """Indices of the instants to show, and the factor by which they play faster than real time."""
    length = float(times[-1] - times[0])
    speed = max(1.0, length * _RATE / _MOST)
    wanted = np.arange(times[0], times[-1] + 1e-9, speed / _RATE)
    return np.clip(np.searchsorted(times, wanted - 1e-9), 0, len(times) - 1), speed


def _watched(pictures: Iterator[Picture], count: int, monitor: Monitor) -> Iterator[Picture]:
    for k, picture in enumerate(pictures, start=1):
        yield picture
        monitor(Progress("draw animation", k / count, f"frame {k} of {count}"))


def _write_gif(path: Path, pictures: Iterator[Picture], samples: Picture) -> None:
    """Write frames in the palette of the samples; each frame stores only what changes."""
    palette = Image.fromarray(samples).quantize(_COLOURS)
    frames = (Image.fromarray(p).quantize(palette=palette, dither=Image.Dither.NONE) for p in pictures)
    first = next(frames)
    with path.open("wb") as file:  # unlike a file that Pillow opens, this one is closed even after Ctrl-C
        first.save(file, "GIF", save_all=True, append_images=frames, duration=1000 // _RATE, loop=0, optimize=True)


def _write_mp4(path: Path, pictures: Iterator[Picture], size: tuple[int, int]) -> None:
    """Send raw frames of size (height, width) to ffmpeg through a pipe."""
    come = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{size[1]}x{size[0]}", "-r", str(_RATE), "-i", "-"]
    command = ["ffmpeg", "-loglevel", "error", "-y", *come, "-pix_fmt", "yuv420p", str(path)]
    with tempfile.TemporaryFile() as said:
        ffmpeg = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=said, stderr=said)
        try:
            with suppress(BrokenPipeError), ffmpeg:  # if ffmpeg gives up, its messages tell why
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
