"""How much of a region an atlas covers, how well, and where its holes are (ours)."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from orthocas.atlases.atlas import Atlas
from orthocas.atlases.outcomes import Outcome
from orthocas.checks import Array, Indices, require_count, require_kind, require_memory
from orthocas.judging.gradients import in_the_metric
from orthocas.samples import samples_at
from orthocas.showing import Shown

_PIECE = 20_000  # joint positions at once
_NUMBERS = 8  # for each sample, beside joint positions
_BINS = 24  # of the coverage by joint
REASONS = {
    Outcome.SINGULAR: "most of the box is too near to singular positions",
    Outcome.POOR: "leak or conditioning is worse than asked, and no split is left",
    Outcome.FAILED: "the fit failed or its workers died",
    5: "not built yet",
}


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
        """Shares and quality."""
        data = self.as_dict()
        leak, conditioning = data["leak_deg"], data["conditioning"]
        return {
            "coverage": f"{self.share:.2%} of {len(self.q)} samples clear of singular positions have a chart",
            "charts": f"{self.charts} in {self.bytes / 2**20:.3g} MiB",
            "clear": f"{len(self.q) / self.drawn:.2%} of the region",
            "leak": ", ".join(f"{name} {value:.2f}" for name, value in leak.items()) + " deg",
            "conditioning": ", ".join(f"{name} {value:.3f}" for name, value in conditioning.items()),
            "as asked": f"at {self.share_as_asked:.2%} of the samples leak and conditioning themselves are as asked",
            **{f"hole {share:.2%}": text for text, share in self.holes.items()},
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
