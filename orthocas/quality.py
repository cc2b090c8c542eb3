"""The quality of a chart: angles and conditioning on held-out samples ([AS2023] Figs. 20 and 27, and ours)."""

from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from orthocas.chart import Chart
from orthocas.checks import Array, require_count, require_kind, require_memory
from orthocas.domains import sample_uniform
from orthocas.errors import SingularTaskError
from orthocas.files.json import plain
from orthocas.fitting.loss import pairs
from orthocas.samples import Samples, samples_at
from orthocas.showing import Shown

DEGENERATE = 0.1  #: 1 % quantile of the conditioning below which a chart is reported as degenerate
_CHUNK = 5000
_BIN_EDGES = np.linspace(-0.05, 180.05, 1802)  # 90 degrees lies in the middle of its bin


@dataclass(frozen=True, eq=False)
class AngleStatistics:
    """Angles between gradients over all samples and pairs, in degrees. 90 is perfect; NaN if there are no pairs."""

    mean: float
    std: float
    max: float  #: largest deviation from 90 degrees
    histogram: Array = field(repr=False)  #: counts in bins of 0.1 degree, centred at 0.0, 0.1, ..., 180.0

    @classmethod
    def of_cosines(cls, cosines: Array) -> "AngleStatistics":
        """Statistics of the angles arccos(cosines), in degrees."""
        angles = np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0))).ravel()
        counts = np.histogram(angles, _BIN_EDGES)[0].astype(float)
        if angles.size == 0:
            return cls(np.nan, np.nan, np.nan, counts)
        return cls(float(angles.mean()), float(angles.std()), float(np.abs(angles - 90).max()), counts)


@dataclass(frozen=True)
class Conditioning:
    """Smallest singular value of [A-orthonormal task basis; unit coordinate gradients]: 1 is perfect, 0 degenerate."""

    min: float
    p01: float  #: 1 % quantile
    mean: float


@dataclass(frozen=True, eq=False, repr=False)
class Report(Shown):
    """Quality of a chart on uniform samples of its domain."""

    n: int
    m: int
    r: int
    samples: int
    seed: int
    metric: str
    task_angle: AngleStatistics
    mutual_angle: AngleStatistics
    conditioning: Conditioning
    worst_point: tuple[float, ...]  #: the sampled joint position with the smallest conditioning
    singular_samples: int  #: samples left out: a gradient vanishes, or a grown coordinate has no value
    length_ratio: float  #: 99 % over 1 % quantile of the gradient length, for the worst coordinate
    folded_samples: int  #: samples where det J has the opposite sign of most samples: the chart folds over

    @property
    def degenerate(self) -> bool:
        """Whether coordinates are nearly parallel to each other or to the task gradients on over 1 % of the domain."""
        return self.conditioning.p01 < DEGENERATE

    def facts(self) -> dict[str, str]:
        """Angles, conditioning, lengths, and the faults of the chart if there are any."""
        task, mutual, values = self.task_angle, self.mutual_angle, self.conditioning
        facts = {
            "problem": f"n = {self.n} joints, m = {self.m} task, r = {self.r} extra, metric {self.metric}",
            "task angle": f"mean {task.mean:.2f}, std {task.std:.2f}, largest deviation {task.max:.1f} deg",
            "mutual angle": f"mean {mutual.mean:.2f}, std {mutual.std:.2f}, largest deviation {mutual.max:.1f} deg",
            "conditioning": f"mean {values.mean:.3f}, 1 % quantile {values.p01:.3f}, min {values.min:.3g}",
            "lengths": f"of gradients differ by a factor of {self.length_ratio:.3g} (99 % to 1 % quantile)",
            "samples": f"{self.samples} held out, seed {self.seed}",
        }
        if self.r == 1:
            facts["mutual angle"] = "none, r = 1"
        return facts | self._faults()

    def _faults(self) -> dict[str, str]:
        faults = {}
        if self.folded_samples:
            at = ", ".join(f"{value:.2f}" for value in self.worst_point)
            share = self.folded_samples / self.samples
            faults["folded"] = f"{share:.3%} of the domain, where det J changes sign; conditioning worst at q = ({at})"
        if self.singular_samples:
            share = self.singular_samples / self.samples
            faults["left out"] = f"{share:.3%} of the domain: singular, or without a value"
        if self.degenerate:
            advice = "another domain, a larger lambda2 of the fit, or another leaf of a grown chart may help"
            faults["DEGENERATE"] = f"coordinates are nearly parallel to each other or to the task: {advice}"
        return faults

    def as_dict(self) -> dict[str, Any]:
        """Plain data for JSON. NaN becomes None."""

        def angle(s: AngleStatistics) -> dict[str, float]:
            return {"mean": s.mean, "std": s.std, "max": s.max}

        data = {
            "n": self.n,
            "m": self.m,
            "r": self.r,
            "samples": self.samples,
            "seed": self.seed,
            "metric": self.metric,
            "task_angle_deg": angle(self.task_angle),
            "mutual_angle_deg": angle(self.mutual_angle),
            "conditioning": asdict(self.conditioning),
            "worst_point": list(self.worst_point),
            "singular_samples": self.singular_samples,
            "folded_samples": self.folded_samples,
            "length_ratio": self.length_ratio,
            "degenerate": self.degenerate,
        }
        return dict(plain(data))


def evaluate(chart: Chart, samples: int = 100_000, seed: int = 1) -> Report:
    """Measure the quality of a chart on uniform samples of its domain. Use another seed than that of the fit.

    The angles are those of [AS2023] eq. (24): between each dxi_j and grad_A h_i, over all m r pairs, and between the
    coordinates, over all r (r - 1) / 2 pairs. The conditioning is computed in coordinates where A is the identity, so
    it does not depend on the task's own conditioning or units.

    Args:
        chart: the chart.
        samples: number of samples N.
        seed: seed of the samples.

    Example:
        >>> import orthocas as oc
        >>> from orthocas import problems
        >>> chart = oc.fit(problems.get("planar_3r_xy"), oc.Polynomial(degree=2), samples=300).chart
        >>> report = oc.evaluate(chart, samples=2000)
        >>> 85 < report.task_angle.mean < 95, report.folded_samples
        (True, 0)
    """
    require_kind("chart", chart, Chart)
    samples, seed = require_count("samples", samples), require_count("seed", seed, least=0)
    require_memory(f"evaluating {samples} samples", 8.0 * samples * chart.n * (chart.n + 4))
    points = sample_uniform(chart.problem.domain, samples, seed)
    parts = [_judge(chart, points[start : start + _CHUNK]) for start in range(0, samples, _CHUNK)]
    task, mutual, smallest, signs, lengths, kept = (np.concatenate([part[i] for part in parts]) for i in range(6))
    if len(kept) == 0:
        raise SingularTaskError(
            f"a gradient vanishes, or a coordinate has no value, at all {samples} samples of the domain"
        )
    worst = int(np.argmin(smallest))
    short, long = np.quantile(lengths, [0.01, 0.99], axis=0)
    return Report(
        n=chart.n,
        m=chart.m,
        r=chart.r,
        samples=samples,
        seed=seed,
        metric=chart.problem.metric.name,
        task_angle=AngleStatistics.of_cosines(task),
        mutual_angle=AngleStatistics.of_cosines(mutual),
        conditioning=Conditioning(float(smallest[worst]), float(np.quantile(smallest, 0.01)), float(smallest.mean())),
        worst_point=tuple(kept[worst].tolist()),
        singular_samples=samples - len(kept),
        length_ratio=float((long / short).max()),
        folded_samples=int(min((signs > 0).sum(), (signs <= 0).sum())),
    )


def _judge(chart: Chart, points: Array) -> tuple[Array, ...]:
    """The quantities of each point that is kept.

    They are task cosines (N, m, r), mutual cosines (N, pairs), smallest singular values (N,), signs of det J (N,),
    lengths of the coordinate gradients (N, r), and the points (N, n).
    """
    samples = samples_at(chart.problem, points)
    J = chart.coordinates.jacobian(samples.points)
    lengths = np.linalg.norm(J, axis=2)
    alive = lengths.min(axis=1) > 0  # also false for NaN, where grown coordinates have no value
    samples, J, lengths = samples[alive], J[alive], lengths[alive]
    raised = samples.raised(J)
    task = samples.unit_task_gradients @ (J / lengths[:, :, None]).transpose(0, 2, 1)
    first, second = (np.array([pair[k] for pair in pairs(chart.r)], dtype=int) for k in (0, 1))
    products = np.einsum("spn,spn->sp", raised[:, first], J[:, second])
    mutual = products / (np.linalg.norm(raised, axis=2)[:, first] * lengths[:, second])
    signs = np.sign(np.linalg.det(np.concatenate([samples.task_jacobian, J], axis=1)))
    return task, mutual, _smallest_singular_values(samples, J, raised), signs, lengths, samples.points


def _smallest_singular_values(samples: Samples, J: Array, raised: Array) -> Array:
    """Roots of the smallest eigenvalues of the Gram matrix [[I, E v], [v^T E^T, v^T A^-1 v]], (N,)."""
    unit = 1 / np.sqrt(np.einsum("sjn,sjn->sj", J, raised))[:, :, None]
    basis = samples.task_basis
    leaning = basis @ (J * unit).transpose(0, 2, 1)  # (N, m, r)
    mutual = (raised * unit) @ (J * unit).transpose(0, 2, 1)  # (N, r, r)
    identity = np.broadcast_to(np.eye(basis.shape[1]), (len(J), basis.shape[1], basis.shape[1]))
    above = np.concatenate([identity, leaning], axis=2)
    below = np.concatenate([leaning.transpose(0, 2, 1), mutual], axis=2)
    gram = np.concatenate([above, below], axis=1)
    return np.sqrt(np.maximum(np.linalg.eigvalsh(gram)[:, 0], 0.0))
