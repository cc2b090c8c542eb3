"""The quality of a chart on its domain: angles and conditioning ([AS2023] Figs. 20 and 27), leaks and folds."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthocas.charts.chart import Chart
from orthocas.charts.chart_file import FREE
from orthocas.charts.coordinates import Coordinates
from orthocas.charts.point_quality import Judged, WorstPoints, measure_held_speeds, pairs, worst_points
from orthocas.charts.walls import require_collisions
from orthocas.errors import InvalidValueError, SingularTaskError
from orthocas.robots.collisions import Collisions
from orthocas.tasks.samples import evaluate_samples, find_idle_joints, sample_uniform
from orthocas.tools.batch import run_in_threads
from orthocas.tools.checks import Array, Indices, as_point_set, require_count, require_kind, require_memory
from orthocas.tools.display import Shown, listed, percent
from orthocas.tools.json import clean, collect_attributes

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, slots=True)
class ReportRules:
    """Numbers of an evaluation."""

    bin: float = 0.1  #: [deg] width of the bins of histograms; 0 and 90 degrees lie in the middle of a bin
    piece: int = 2**13  #: samples that a thread evaluates at once
    degenerate: float = 0.1  #: 1 % quantile of the conditioning below which a chart is reported as degenerate
    samples: int = 100_000  #: default number of samples
    seed: int = 1  #: default seed
    most: int = 10**18  #: largest number of samples in a call
    telling: int = 200  #: number of samples from which idle joints are identified
    alone: float = 1e-10  #: entries of a gradient up to this fraction of its length count as zero
    held: int = 20_000  #: largest number of samples at which joint speeds with xi held are measured
    mostly: float = 0.9  #: quantile of these speeds that is reported
    postures: int = 10_000  #: largest number of samples that are checked for collisions


RULES = ReportRules()


def evaluate(
    chart: Chart,
    samples: int | None = None,
    seed: int | None = None,
    *,
    points: ArrayLike | None = None,
    collisions: Collisions | None = None,
) -> Report:
    """Measure the quality of a chart on uniform samples of its domain. Use another seed than that of the fit.

    Uniform samples miss folds, so the least conditioning is also searched near faces and corners, and by descent.

    The task and mutual angles are those of [AS2023] eq. (24): between each dxi_j and grad_A h_i, over all m r pairs,
    and between the coordinates, over all r (r - 1) / 2 pairs. Their norms are Euclidean, so for A = M they do not show
    how far a coordinate is from orthogonal to the task. The leak, an angle in the metric, shows it; see
    `LeakStatistics`. The conditioning is computed in coordinates where A is the identity, so it does not depend on the
    conditioning or the units of the task itself.

    Args:
        chart: the chart.
        samples: number of samples N. Default: 100,000.
        seed: seed of the samples. Default: 1.
        points: joint positions (N, n) or (n,) [rad] or [m] in place of samples, for example those of a path.
        collisions: a collision model of the chart's robot, such as `robot.collisions`. The report then says how many of
            up to 10,000 samples are in collision. For charts of `fit_wide(collisions=True)`, the robot's own model is
            the default, and samples in collision are left out.

    Returns:
        The report.

    Raises:
        SingularTaskError: if at every sample a gradient vanishes, or a coordinate is undefined.
        InvalidValueError, ShapeError: if an argument is invalid, or points are given with samples or a seed.

    Example:
        >>> import orthocas as oc
        >>> from orthocas import problems
        >>> chart = oc.fit(problems.get("planar_3r_xy"), oc.Polynomial(degree=2), samples=300).chart
        >>> report = oc.evaluate(chart, samples=2000)
        >>> 85 < report.task_angle.mean < 95, report.folded_samples
        (True, 0)
        >>> oc.evaluate(chart, points=[[0.6, 0.8, 0.8], [0.7, 0.8, 0.8]]).samples
        2
    """
    require_kind("chart", chart, Chart)
    require_collisions(collisions, chart.problem.robot.tree)
    free = FREE in chart.notes
    if free and collisions is None:
        collisions = chart.problem.robot.collisions
    # uniform samples, and a search for the worst points, which samples miss
    if points is None:
        count = _count(chart, RULES.samples if samples is None else samples)
        drawn = require_count("seed", RULES.seed if seed is None else seed, least=0)
        searched = isinstance(chart.coordinates, Coordinates) and not chart.problem.domain.full_turns
        problem, found = chart.problem, chart.coordinates
        worst = worst_points(problem, found, drawn) if searched else None
        return _report(chart, sample_uniform(chart.problem.domain, count, drawn), drawn, worst, collisions, free)
    # the given points alone
    if samples is not None or seed is not None:
        raise InvalidValueError("points", "given with samples or a seed", "points alone")
    given = as_point_set("points", points, chart.n)[0]
    _count(chart, len(given))
    return _report(chart, given, None, None, collisions)


def _count(chart: Chart, samples: int) -> int:
    """Check the number of samples, and that memory suffices for them; return it."""
    count = require_count("samples", samples, most=RULES.most)
    require_memory(f"evaluating {count} samples", 8.0 * count * chart.n * (2 * chart.n + 4))
    return count


def _report(
    chart: Chart,
    points: Array,
    seed: int | None,
    worst: WorstPoints | None,
    collisions: Collisions | None,
    free: bool = False,
) -> Report:
    """The report at joint positions (N, n); with `free`, positions in collision are left out."""
    contacts = None if collisions is None else ContactShare.of(collisions, points[: RULES.postures])
    if collisions is not None and free:
        points = points[collisions.check_free(points)]
        if not len(points):
            raise InvalidValueError("collisions", "a contact at all samples of the domain", "some free samples")
    # singular positions, and those with undefined values, are left out and counted
    judged = Judged.at(chart.problem, chart.coordinates, points)
    if len(judged.points) == 0:
        where = "given points" if seed is None else "samples of the domain"
        raise SingularTaskError(f"a gradient vanishes, or a coordinate has no value, at all {len(points)} {where}")
    # find coordinates that depend on one idle joint alone: on a few samples first, then on all of them
    first = evaluate_samples(chart.problem, sample_uniform(chart.problem.domain, RULES.telling, 0))
    idle: dict[int, str] = {}
    for joint in find_idle_joints(chart.problem, first):
        likely = _functions_of(joint, judged.jacobian[: RULES.telling])
        sure = likely[_functions_of(joint, judged.jacobian[:, likely])]
        idle |= {int(j): chart.problem.robot.joint_names[joint] for j in sure}
    others = [j for j in range(chart.r) if j not in idle]
    floating = {chart.problem.robot.joint_names[k] for k in chart.problem.robot.tree.floating}
    # angles of all coordinates, and without idle joints, which are exact and would make the means look better
    angles, without_idle = Angles.of(judged, [range(chart.r), others])
    short, long = np.quantile(_lengths(judged.jacobian), [0.01, 0.99], axis=0)
    # joint speeds with xi held, at some of the points
    some = slice(RULES.held)
    speeds = measure_held_speeds(chart.problem, judged.points[some], judged.jacobian[some], seed or 0)
    # the point of least conditioning, (n,)
    k = int(np.argmin(judged.conditioning))
    point: Array = judged.points[k]
    return Report(
        n=chart.n,
        m=chart.m,
        r=chart.r,
        samples=len(points),
        seed=seed,
        metric=chart.problem.metric.name,
        task_angle=angles.task_angle,
        mutual_angle=angles.mutual_angle,
        leak=angles.leak,
        metric_mutual_angle=angles.metric_mutual_angle,
        conditioning=Conditioning.of(judged.conditioning, worst),
        worst_point=tuple(
            (point if worst is None or worst.least > judged.conditioning[k] else worst.points[0]).tolist()
        ),
        worst=worst,
        singular_samples=len(points) - len(judged.points),
        held_speed=float(np.quantile(speeds, RULES.mostly)),
        length_ratio=float((long / short).max()),
        folded_samples=int(min((judged.signs > 0).sum(), (judged.signs <= 0).sum())),
        idle_joints=tuple(name for name in idle.values() if name not in floating),
        without_idle=without_idle if idle and others else None,
        contacts=contacts,
    )


def _functions_of(joint: int, J: Array) -> NDArray[np.int_]:
    """Coordinates that depend on one joint alone: their gradients, rows of J (N, r, n), vanish for all other joints."""
    others = np.abs(np.delete(J, joint, axis=2)).max(axis=2, initial=0.0) <= RULES.alone * _lengths(J)
    return np.flatnonzero(others.all(axis=0))


def _lengths(J: Array) -> Array:
    """Norms of the rows of J (N, r, n), (N, r)."""
    return np.asarray(np.sqrt(np.einsum("sij,sij->si", J, J)))


@dataclass(frozen=True, eq=False)
class _Sums:
    """Sums over samples of k angles [deg], each a column, from which statistics are computed."""

    count: int  #: number of samples
    middle: float  #: angle from which deviations are measured [deg]: 90 or 0
    first: Array  #: sum of deviations from the middle, (k,)
    second: Array  #: sum of their squares, (k,)
    largest: Array  #: largest absolute deviation, (k,)
    counts: Array  #: in bins around 0.0, 0.1, ... degrees, (k, bins)

    @classmethod
    def of(cls, inverse: Callable[[Array], Array], values: Array, middle: float, most: int) -> Self:
        """Sums of the angles inverse(values), for cosines or sines `values` (N, k) and arccos or arcsin as `inverse`.

        `most` is the largest possible angle [deg].
        """
        N, k = values.shape
        bins = round(most / RULES.bin) + 1
        first_bins = bins * np.arange(k)[:, None]

        # Threads compute sums over pieces of the samples. They are added in order, so the result is reproducible.
        def one_piece(start: int) -> tuple[Array, Array, Array, Indices]:
            angles = np.degrees(inverse(np.ascontiguousarray(values[start : start + RULES.piece].T)))
            places = (angles / RULES.bin + 0.5).astype(np.intp) + first_bins
            counts = np.bincount(places.ravel(), minlength=k * bins).reshape(k, bins)
            angles -= middle
            return angles.sum(axis=1), (angles * angles).sum(axis=1), np.abs(angles).max(axis=1), counts

        first, second, largest, counts = np.zeros(k), np.zeros(k), np.zeros(k), np.zeros((k, bins))
        for part in run_in_threads(one_piece, range(0, N, RULES.piece) if k else ()):
            first, second, counts = first + part[0], second + part[1], counts + part[3]
            largest = np.maximum(largest, part[2])
        return cls(N, middle, first, second, largest, counts)

    def __getitem__(self, columns: Sequence[int]) -> _Sums:
        """The sums of the selected angles."""
        chosen = list(columns)
        parts = (self.first[chosen], self.second[chosen], self.largest[chosen], self.counts[chosen])
        return _Sums(self.count, self.middle, *parts)

    @property
    def empty(self) -> bool:
        """Whether there are no angles."""
        return self.count * len(self.first) == 0

    @property
    def mean(self) -> float:
        """Mean deviation from `middle` over all angles and samples [deg]."""
        return float(self.first.sum() / (self.count * len(self.first)))

    @property
    def mean_square(self) -> float:
        """Mean squared deviation from `middle` over all angles and samples [deg^2]."""
        return float(self.second.sum() / (self.count * len(self.first)))


def _sums_of_cosines(cosines: Array) -> _Sums:
    """Sums of the angles arccos(cosines) [deg], for cosines (N, k)."""
    return _Sums.of(np.arccos, np.clip(cosines, -1.0, 1.0), 90.0, 180)


@dataclass(frozen=True, eq=False)
class AngleStatistics:
    """Angles between gradients over all samples and pairs, in degrees. 90 is perfect; NaN if there are no pairs."""

    mean: float
    std: float
    max: float  #: largest deviation from 90 degrees
    histogram: Array = field(repr=False)  #: counts in bins of 0.1 degree, centred at 0.0, 0.1, ..., 180.0

    @classmethod
    def of_cosines(cls, cosines: Array) -> Self:
        """Statistics of the angles arccos(cosines), for cosines of any shape."""
        return cls.of_sums(_sums_of_cosines(cosines.reshape(-1, 1)))

    @classmethod
    def of_sums(cls, sums: _Sums) -> Self:
        """Statistics over all angles and samples of the sums."""
        counts = sums.counts.sum(axis=0)
        if sums.empty:
            return cls(np.nan, np.nan, np.nan, counts)
        spread = np.sqrt(max(sums.mean_square - sums.mean**2, 0.0))
        return cls(sums.middle + sums.mean, float(spread), float(sums.largest.max()), counts)

    def as_dict(self) -> dict[str, float]:
        """Mean, standard deviation and largest deviation [deg]."""
        return collect_attributes(self, "mean", "std", "max")


@dataclass(frozen=True, eq=False)
class LeakStatistics:
    """Leaks of coordinates over all samples, in degrees. 0 is perfect; NaN if there are no coordinates.

    The leak of a coordinate is the angle in the metric between its gradient and the space orthogonal to the task:
    sin(leak_j) = |Pi_x grad_A xi_j|_A / |grad_A xi_j|_A with the A-orthogonal projector Pi_x on the task gradients. It
    does not depend on the choice of task coordinates.

    Source:
        ours, docs/explanation/angles.md.
    """

    mean: float
    rms: float
    max: float
    rms_of_each: tuple[float, ...]  #: root mean square of each coordinate
    histogram: Array = field(repr=False)  #: counts in bins of 0.1 degree, centred at 0.0, 0.1, ..., 90.0

    @classmethod
    def of_sums(cls, sums: _Sums) -> Self:
        """Statistics of leaks from their sums; each column is a coordinate."""
        counts = sums.counts.sum(axis=0)
        if sums.empty:
            return cls(np.nan, np.nan, np.nan, (), counts)
        each = tuple(np.sqrt(sums.second / sums.count).tolist())
        return cls(sums.mean, float(np.sqrt(sums.mean_square)), float(sums.largest.max()), each, counts)

    def as_dict(self) -> dict[str, object]:
        """Mean, root mean square and largest leak, and the root mean square of each coordinate [deg]."""
        return collect_attributes(self, "mean", "rms", "max", "rms_of_each")


@dataclass(frozen=True, eq=False)
class Angles:
    """Angles of a set of coordinates: those of [AS2023] eq. (24), with Euclidean norms, and ours, in the metric."""

    task_angle: AngleStatistics  #: between each dxi_j and grad_A h_i, in the paper's cosines
    mutual_angle: AngleStatistics  #: between two coordinates, in the paper's cosines
    leak: LeakStatistics  #: in the metric
    metric_mutual_angle: AngleStatistics  #: between two coordinates, in the metric

    @classmethod
    def of(cls, judged: Judged, chosen: Sequence[Sequence[int]]) -> list[Angles]:
        """The angles of several sets of coordinates; each set is a sequence of their indices."""
        N, m, r = judged.task_cosines.shape
        task = _sums_of_cosines(judged.task_cosines.reshape(N, m * r))
        mutual = _sums_of_cosines(judged.mutual_cosines)
        same = judged.metric_mutual_cosines is judged.mutual_cosines
        in_metric = mutual if same else _sums_of_cosines(judged.metric_mutual_cosines)
        leak = _Sums.of(np.arcsin, np.clip(judged.leak_sines, 0.0, 1.0), 0.0, 90)
        found = []
        for some in chosen:
            together = [k for k, pair in enumerate(pairs(r)) if set(pair) <= set(some)]
            found.append(
                cls(
                    AngleStatistics.of_sums(task[[i * r + j for i in range(m) for j in some]]),
                    AngleStatistics.of_sums(mutual[together]),
                    LeakStatistics.of_sums(leak[some]),
                    AngleStatistics.of_sums(in_metric[together]),
                )
            )
        return found

    def as_dict(self) -> dict[str, dict[str, object]]:
        """Plain data: the four angles in degrees."""
        names = ("task_angle", "mutual_angle", "leak", "metric_mutual_angle")
        return {f"{name}_deg": angles for name, angles in collect_attributes(self, *names).items()}


@dataclass(frozen=True)
class Conditioning:
    """Smallest singular value of [A-orthonormal task basis; unit coordinate gradients]: 1 is perfect, 0 degenerate."""

    min: float  #: least value, of the samples and of the search for the worst points; 0 if the search finds folds
    p01: float  #: 1 % quantile
    mean: float

    @classmethod
    def of(cls, values: Array, worst: WorstPoints | None) -> Conditioning:
        """Statistics of the values at all samples, (N,), and of the worst points of a search."""
        least = values.min() if worst is None else max(0.0, min(values.min(), worst.least))
        return cls(float(least), float(np.quantile(values, 0.01)), float(values.mean()))


@dataclass(frozen=True, eq=False)
class ContactShare:
    """Number of samples in collision, among those that an evaluation checks."""

    samples: int  #: number of samples checked
    touching: int  #: number of these in collision
    pair: tuple[str, str]  #: the pair that touches most often, or the nearest pair if none touches
    deepest: float  #: least distance [m], negative if a pair overlaps

    @classmethod
    def of(cls, collisions: Collisions, points: Array) -> ContactShare:
        """Count the postures (N, n) in collision."""
        found = collisions.distance(points)
        touching = np.flatnonzero(found.distance <= 0)
        pairs = Counter(found.pair[k] for k in touching)
        k = int(np.argmin(found.distance))
        pair = pairs.most_common(1)[0][0] if pairs else found.pair[k]
        return cls(len(points), len(touching), pair, float(found.distance[k]))

    @property
    def fraction(self) -> float:
        """Fraction of the samples in collision."""
        return self.touching / self.samples

    def __str__(self) -> str:
        first, second = self.pair
        if not self.touching:
            return f"none in {self.samples} samples; nearest '{first}' and '{second}', {self.deepest:.3g} m"
        return f"{percent(self.fraction, 2, fault=True)} of the samples, most often '{first}' and '{second}'"

    def as_dict(self) -> dict[str, object]:
        """Plain data for JSON."""
        return collect_attributes(self, "samples", "touching", "fraction", "pair", "deepest")


@dataclass(frozen=True, eq=False, repr=False)
class Report(Shown):
    """Quality of a chart on uniform samples of its domain, or at given joint positions."""

    n: int
    m: int
    r: int
    samples: int
    seed: int | None  #: None for given joint positions
    metric: str
    task_angle: AngleStatistics  #: the paper's, with Euclidean norms
    mutual_angle: AngleStatistics  #: the paper's, with Euclidean norms
    leak: LeakStatistics  #: in the metric; for A = M it measures the inertial coupling of task and coordinates
    metric_mutual_angle: AngleStatistics  #: between two coordinates, in the metric
    conditioning: Conditioning
    worst_point: tuple[float, ...]  #: the joint position with the smallest conditioning, of samples and search
    worst: WorstPoints | None  #: found by a search; None on a torus, at given joint positions, and for grown charts
    singular_samples: int  #: samples left out because a gradient vanishes or a coordinate is undefined
    held_speed: float  #: joint speed with xi held over the least-norm speed, 90 % quantile, see `measure_held_speeds`
    length_ratio: float  #: 99 % over 1 % quantile of the gradient length, for the worst coordinate
    folded_samples: int  #: samples where det J has the opposite sign of most samples: the chart folds over
    idle_joints: tuple[str, ...]  #: names of joints that are exact coordinates themselves
    without_idle: Angles | None  #: angles of the other coordinates; None if no coordinate is an idle joint, or all are
    contacts: ContactShare | None = None  #: samples in collision; None without a collision model

    @property
    def degenerate(self) -> bool:
        """Whether coordinates are nearly parallel to each other or to the task gradients on over 1 % of the domain."""
        return self.conditioning.p01 < RULES.degenerate

    def plot(self) -> Figure:
        """Histograms of angles and leaks, as a matplotlib figure; see `figures.quality_figure`."""
        from orthocas.charts.figures import quality_figure  # imports matplotlib, which takes long

        return quality_figure(self)

    def facts(self) -> dict[str, str]:
        """Angles, conditioning, lengths, and the faults of the chart if there are any."""
        values = self.conditioning
        faults = {}
        # faults of the chart
        if self.folded_samples:
            at = ", ".join(f"{value:.2f}" for value in self.worst_point)
            share = percent(self.folded_samples / self.samples, 3, fault=True)
            worst = f"conditioning worst at q = ({at})"
            faults["folded"] = f"{share} of the {self._where}, where det J changes sign; {worst}"
        if self.singular_samples:
            share = percent(self.singular_samples / self.samples, 3, fault=True)
            faults["left out"] = f"{share} of the {self._where}: singular, or without a value"
        if self.degenerate:
            advice = "another domain, a larger lambda2 of the fit, or another leaf of a grown chart may help"
            faults["DEGENERATE"] = f"coordinates are nearly parallel to each other or to the task: {advice}"
        return {
            "problem": f"n = {self.n} joints, m = {self.m} task, r = {self.r} extra, metric {self.metric}",
            **self._angles(),
            "xi held": f"joints at most {self.held_speed:.3g} times as fast as with least norm, for 90 % of velocities",
            "conditioning": f"mean {values.mean:.3f}, 1 % quantile {values.p01:.3f}, min {values.min:.3g}",
            **({} if self.worst is None else {"searched": f"least conditioning {self.worst.explained}"}),
            **faults,
            **({} if self.contacts is None else {"collisions": str(self.contacts)}),
            "lengths": f"of gradients differ by a factor of {self.length_ratio:.3g} (99 % to 1 % quantile)",
            "samples": f"{self.samples} given" if self.seed is None else f"{self.samples} held out, seed {self.seed}",
        }

    def _angles(self) -> dict[str, str]:
        """The paper's angles and ours, by name."""
        leak, others = self.leak, self.without_idle

        def paper(angles: AngleStatistics) -> str:
            spread = f"mean {angles.mean:.2f}, std {angles.std:.2f}, largest sampled deviation {angles.max:.1f} deg"
            return f"{spread} (the paper's cosines)"

        found = {
            "task angle": paper(self.task_angle),
            "mutual angle": paper(self.mutual_angle),
            "leak": f"rms {leak.rms:.2f}, mean {leak.mean:.2f}, largest sampled {leak.max:.1f} deg (in the metric)",
        }
        # One coordinate has no mutual angles. Exact coordinates of idle joints make the means look better.
        if self.r == 1:
            found["mutual angle"] = "none, r = 1"
        if others is not None:
            several = f", mutual std {others.mutual_angle.std:.2f}" if len(others.leak.rms_of_each) > 1 else ""
            flatters = f"{listed(self.idle_joints)} is exact and" if self.idle_joints else "the floating base"
            found["without idle"] = (
                f"task std {others.task_angle.std:.2f}{several}, leak rms {others.leak.rms:.2f} deg: "
                f"{flatters} makes the mean look better"
            )
        return found

    @property
    def _where(self) -> str:
        """What the samples are a part of, for messages."""
        return "given points" if self.seed is None else "domain"

    def as_dict(self) -> dict[str, Any]:
        """Plain data for JSON. NaN becomes None."""
        angles = Angles(self.task_angle, self.mutual_angle, self.leak, self.metric_mutual_angle)
        data = {
            **collect_attributes(self, "n", "m", "r", "samples", "seed", "metric"),
            **angles.as_dict(),
            **collect_attributes(self, "idle_joints", "without_idle", "conditioning", "worst_point"),
            "least_conditioning_searched": None if self.worst is None else self.worst.least,
            **collect_attributes(
                self, "singular_samples", "folded_samples", "held_speed", "length_ratio", "degenerate"
            ),
            **({} if self.contacts is None else {"contacts": self.contacts.as_dict()}),
        }
        return dict(clean(data))
