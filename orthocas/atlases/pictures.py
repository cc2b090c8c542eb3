"""Pictures of an atlas: quality over the workspace, and coverage by joint (ours)."""

from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from orthocas.atlases.coverage import Coverage
from orthocas.checks import Array
from orthocas.files.atomic import published

_SLICES = 4  # of the workspace, from inside out
_CELLS = 60  # of each slice along its longer side
_NAMES = ("workspace.png", "coverage_by_joint.png")


def draw_coverage(coverage: Coverage, folder: Path, force: bool = False) -> list[Path]:
    """Write both pictures to a folder, and return their paths.

    Raises:
        ArchiveError: if files of these names are there that orthocas did not write.
    """
    with published(folder, listed=True, force=force) as drafts:
        for name, figure in zip(_NAMES, (_workspace(coverage), _by_joint(coverage)), strict=True):
            FigureCanvasAgg(figure)
            figure.savefig(drafts / name, dpi=110)
    return [folder / name for name in _NAMES]


def _workspace(coverage: Coverage) -> Figure:
    """Slices of the tool's positions: distance from the base axis against height, for sectors of depth around it.

    Each cell shows the best value of the postures that reach it: least leak above, largest conditioning below.
    """
    figure = Figure(figsize=(3.1 * _SLICES, 6.2), layout="constrained")
    axes = figure.subplots(2, _SLICES, sharex=True, sharey=True, squeeze=False)
    tool = coverage.tool
    edges = np.quantile(tool[:, 1], np.linspace(0, 1, _SLICES + 1)) if len(tool) else np.linspace(-1, 1, _SLICES + 1)
    extent = _extent(tool)
    shown: list[tuple[str, Array, np.ufunc, str, tuple[float, float]]] = [
        ("least leak [deg]", coverage.leak_deg, np.fmin, "viridis_r", (0.0, 10.0)),
        ("largest conditioning", coverage.conditioning, np.fmax, "viridis", (0.0, 1.0)),
    ]
    for row, (title, values, best, colours, limits) in enumerate(shown):
        for k in range(_SLICES):
            inside = (tool[:, 1] >= edges[k]) & (tool[:, 1] <= edges[k + 1])
            image = _map(tool[inside][:, [0, 2]], values[inside], extent, best)
            picture = axes[row, k].imshow(
                image.T, origin="lower", extent=extent, cmap=colours, vmin=limits[0], vmax=limits[1], aspect="equal"
            )
            axes[row, k].set_title(f"y from {edges[k]:.2f} to {edges[k + 1]:.2f} m", fontsize=9)
        axes[row, 0].set_ylabel("z [m]")
        figure.colorbar(picture, ax=axes[row, :].tolist(), label=title)
    for axis in axes[1]:
        axis.set_xlabel("x [m]")
    return figure


def _extent(tool: Array) -> tuple[float, float, float, float]:
    if not len(tool):
        return (-1.0, 1.0, -1.0, 1.0)
    low, high = tool.min(axis=0) - 0.05, tool.max(axis=0) + 0.05
    return float(low[0]), float(high[0]), float(low[2]), float(high[2])


def _map(points: Array, values: Array, extent: tuple[float, ...], best: np.ufunc) -> Array:
    """The best value of the points in each cell, NaN where there is none, (cells, cells)."""
    found = np.full((_CELLS, _CELLS), np.nan)
    known = np.isfinite(values)
    x = ((points[known, 0] - extent[0]) / (extent[1] - extent[0]) * _CELLS).astype(int).clip(0, _CELLS - 1)
    z = ((points[known, 1] - extent[2]) / (extent[3] - extent[2]) * _CELLS).astype(int).clip(0, _CELLS - 1)
    best.at(found, (x, z), values[known])
    return found


def _by_joint(coverage: Coverage) -> Figure:
    """The share of samples with a chart over the range of every joint."""
    n = len(coverage.joint_names)
    figure = Figure(figsize=(2.6 * min(n, 4), 2.4 * -(-n // 4)), layout="constrained")
    axes = figure.subplots(-(-n // 4), min(n, 4), sharey=True, squeeze=False).ravel()
    for joint, name in enumerate(coverage.joint_names):
        edges, share = coverage.by_joint(joint)
        axes[joint].stairs(100 * share, edges, fill=True)
        axes[joint].set_title(name, fontsize=9)
        axes[joint].set_ylim(0, 100)
    for axis in axes[n:]:
        axis.set_visible(False)
    figure.supylabel("covered [%]")
    figure.supxlabel("joint position [rad or m]")
    return figure
