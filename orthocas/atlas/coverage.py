"""How much of the reachable space an atlas covers, in numbers and pictures."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from orthocas.atlas.atlas import Atlas
from orthocas.atlas.lattice import Outcome
from orthocas.charts.point_quality import in_the_metric
from orthocas.tasks.samples import samples_at
from orthocas.tools.checks import Array, Indices, require_count, require_kind, require_memory
from orthocas.tools.display import Shown, percent
from orthocas.tools.files import published

_PIECE = 20_000  # joint positions at once
_NUMBERS = 8  # for each sample, beside joint positions
_BINS = 24  # of the coverage by joint
REASONS = {
    Outcome.SINGULAR: "most of the box is too near to singular positions",
    Outcome.POOR: "leak or conditioning is worse than asked, and no split is left",
    Outcome.FAILED: "the fit failed",
    5: "not built yet",
}
_SLICES = 4  # of the workspace, from inside out
_CELLS = 60  # of each slice along its longer side
_NAMES = ("workspace.png", "coverage_by_joint.png")


@dataclass(frozen=True, eq=False, repr=False)
class Coverage(Shown):
    """Charts and quality at samples of a region that are clear of singular positions."""

    charts: int
    bytes: int
    drawn: int  #: samples of the region
    q: Array  #: those clear of singular positions, (N, n)
    chart: Indices  #: chart of each, -1 where there is none, (N,)
    certified: Any  #: whether that chart is proved not to fold, (N,)
    leak_deg: Array  #: root mean square over coordinates without idle joints, NaN without a chart, (N,)
    conditioning: Array  #: NaN without a chart, (N,)
    outcome: Indices  #: `Outcome` of the cell of each sample; 5 for not built yet, (N,)
    tool: Array  #: position of the tip, (N, 3)
    joint_names: tuple[str, ...]
    limits: tuple[Array, Array]  #: of the region, (n,) each
    as_asked: Any  #: whether leak and conditioning at each sample are as asked, (N,)

    @property
    def share(self) -> float:
        """Share of the samples that have a chart; of an atlas with proofs, one that is proved."""
        inside = self.chart >= 0
        return float((inside & self.certified).mean() if self.certified.any() else inside.mean())

    @property
    def share_as_asked(self) -> float:
        """Share of the samples at which leak and conditioning themselves are as asked for charts on average."""
        return float(self.as_asked.mean())

    @property
    def holes(self) -> dict[str, float]:
        """Reasons why samples have no chart, with their shares."""
        outside = self.chart < 0
        found = {text: float((outside & (self.outcome == code)).mean()) for code, text in REASONS.items()}
        return {text: value for text, value in found.items() if value > 0}

    def by_joint(self, joint: int) -> tuple[Array, Array]:
        """Edges of bins of a joint's range (bins + 1,), and the share of samples with a chart in each (bins,)."""
        edges = np.linspace(self.limits[0][joint], self.limits[1][joint], _BINS + 1)
        inside = self.chart >= 0
        all_counts, counts = (np.histogram(self.q[rows, joint], edges)[0] for rows in (slice(None), inside))
        return edges, counts / np.maximum(all_counts, 1)

    def facts(self) -> dict[str, str]:
        """What `str` shows: the share of samples that have a chart, leak and conditioning there."""
        data = self.as_dict()
        leak, conditioning = data["leak_deg"], data["conditioning"]
        return {
            "coverage": f"{percent(self.share, 2)} of {len(self.q)} samples clear of singular positions have a chart",
            "charts": f"{self.charts} in {self.bytes / 2**20:.3g} MiB",
            "clear": f"{percent(len(self.q) / self.drawn, 2)} of the region",
            "leak": ", ".join(f"{name} {value:.2f}" for name, value in leak.items()) + " deg",
            "conditioning": ", ".join(f"{name} {value:.3f}" for name, value in conditioning.items()),
            "as asked": f"at {percent(self.share_as_asked, 2)} of the samples leak and conditioning are as asked",
            **{f"hole {percent(share, 2, fault=True)}": text for text, share in self.holes.items()},
        }

    def as_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        known = np.isfinite(self.conditioning)
        leak, conditioning = self.leak_deg[known], self.conditioning[known]
        if not known.any():
            leak = conditioning = np.array([np.nan])  # None in JSON
        return {
            "charts": self.charts,
            "bytes": self.bytes,
            "coverage": self.share,
            "leak_deg": {
                "rms": float(np.sqrt((leak**2).mean())),
                "p99": float(np.quantile(leak, 0.99)),
            },
            "conditioning": {
                "min": float(conditioning.min()),
                "p01": float(np.quantile(conditioning, 0.01)),
                "mean": float(conditioning.mean()),
            },
        }


def evaluate_atlas(atlas: Atlas, samples: int = 100_000, seed: int = 1) -> Coverage:
    """Measure coverage and quality at random samples of the atlas's region.

    Samples at which the relative singular value of the task is not above the bound of the atlas do not count.

    Args:
        atlas: the atlas.
        samples: number of samples of the region.
        seed: their seed.

    Returns:
        `Coverage`, with values at each sample that counts.
    """
    require_kind("atlas", atlas, Atlas)
    count, seed = require_count("samples", samples), require_count("seed", seed, least=0)
    plan, domain = atlas.plan, atlas.problem.domain
    require_memory(f"{count} samples of an atlas", 8.0 * count * (3 * plan.problem.n + _NUMBERS))
    joints = list(plan.joints)
    low, high = domain.centre - domain.half_width, domain.centre + domain.half_width
    drawn = np.random.default_rng((seed, 1)).uniform(low, high, (count, plan.problem.n))
    drawn[:, joints] = atlas.stock.region.sample(count, seed)
    clear = np.concatenate(
        [
            plan.singular_values(drawn[k : k + _PIECE]) > plan.settings.least_singular_value
            for k in range(0, count, _PIECE)
        ]
    )
    q = drawn[clear]
    charts = atlas.chart_at(q)
    leak, conditioning = _quality(atlas, q, charts)
    records = atlas.stock.records
    proved = np.zeros(len(q), dtype=bool)
    inside = charts >= 0
    fitted = atlas.stock.charts[atlas.index.rows(charts[inside])[1]]
    proved[inside] = records["certified"][fitted] > 0
    asked = plan.settings
    return Coverage(
        len(atlas),
        atlas.stock.contents.size,
        count,
        q,
        charts,
        proved,
        leak,
        conditioning,
        atlas.index.outcomes(q[:, joints]),
        np.asarray(plan.problem.robot.tip_position(q)),
        plan.problem.robot.joint_names,
        (low, high),
        (leak <= asked.leak_deg) & (conditioning >= asked.conditioning),
    )


def _quality(atlas: Atlas, q: Array, charts: Indices) -> tuple[Array, Array]:
    """Leak [deg], root mean square over fitted coordinates, and conditioning at each position; NaN without a chart."""
    plan = atlas.plan
    leak, conditioning = np.full(len(q), np.nan), np.full(len(q), np.nan)
    active = list(plan.active)
    inside = np.flatnonzero(charts >= 0)
    for start in range(0, len(inside), _PIECE):
        rows = inside[start : start + _PIECE]
        samples = samples_at(plan.local, q[rows]).restricted_to(active)
        J = atlas.jacobian(q[rows], charts[rows])[:, : plan.fitted][:, :, active]
        sines, smallest, _ = in_the_metric(samples, J)
        leak[rows] = np.degrees(np.sqrt((np.arcsin(np.minimum(sines, 1.0)) ** 2).mean(axis=1)))
        conditioning[rows] = smallest
    return leak, conditioning


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
