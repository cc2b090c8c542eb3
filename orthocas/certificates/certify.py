"""Certifies charts: proves by rigorous arithmetic that they do not fold, and where they are one-to-one."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import BrokenExecutor, Executor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from orthocas.certificates.box_checks import BoxCheck, BoxResults
from orthocas.certificates.one_to_one import choose_one_to_one_check
from orthocas.certificates.outside import choose_check
from orthocas.certificates.rows import ChartRows, build_chart_rows
from orthocas.certificates.search import Limits, Look, Search
from orthocas.charts.certificate import COFACTORS, ELIMINATION, METHODS, OPEN, PROVED, Certificate, Subdivision
from orthocas.charts.chart import Chart
from orthocas.charts.chart_file import fingerprint
from orthocas.errors import CertifyError, Interrupted, InvalidValueError
from orthocas.robots.tree import require_driven
from orthocas.tasks.domains import Domain
from orthocas.tasks.samples import sample_boundary_weighted
from orthocas.tools.checks import Array, as_number, require_at_least, require_executor, require_kind
from orthocas.tools.display import percent
from orthocas.tools.processes import in_order
from orthocas.tools.progress import Monitor, Progress, silent


@dataclass(frozen=True, slots=True)
class CertifyRules:
    """Numbers of proofs and of their check."""

    samples: int = 20_000  #: samples at which folds are searched before the proof
    scales: int = 51  #: number of scales of the domain that are tried for one-to-one boxes
    shrink: float = 0.95  #: ratio of consecutive scales
    few_boxes: int = 300  #: boxes to try for one scale at first
    least_boxes: int = 500  #: smallest budget of boxes of the one-to-one proof
    most_boxes: int = 45_000
    #: half-width of a leading joint on which J does not depend, if its whole range fails [rad] or [m]
    held_range: float = 1.0
    guarded_boxes: int = 1_000_000  #: budget of boxes for charts whose domain excludes folds
    at_once: int = 512  #: boxes per task of the check
    same_fraction: float = 1e-4  #: tolerance of sampled fractions between machines that round differently
    off_centre: float = 1e-6  #: tolerance of the centre of a box, relative to its width


RULES = CertifyRules()
#: budget of the one-to-one proof, as a multiple of the boxes that the proof of no fold took
_MORE_BOXES = {ELIMINATION: 3, COFACTORS: 30}
Mapped = Callable[..., Iterable[BoxResults]]


def certify(
    chart: Chart,
    bound: float = 0.0,
    *,
    time_limit: float | None = None,
    executor: Executor | None = None,
    monitor: Monitor = silent,
    resume: Certificate | None = None,
) -> Certificate:
    """Prove that a chart does not fold: det J has one sign on its domain, and the conditioning is above a bound.

    The domain is halved repeatedly until J is proved nonsingular on each part. The proof uses Taylor models of degree 3
    whose remainders include all rounding. They are multiplied by the singular vectors of their centre, then eliminated.
    For one polynomial coordinate without a bound, det J itself is bounded, as one polynomial of degree 5 on each part.
    The numbers of the robot and of the chart are taken as exact. Samples are not part of the proof; they only find
    folds early.

    A second proof finds a large box around the centre on which phi is one-to-one: the average of J between any two of
    its points is nonsingular, see `orthocas.certificates.one_to_one`. The box has the proportions of the domain, but a
    joint on which J does not depend keeps its whole range if possible.

    In a `ClearBox`, a part needs no proof if it is proved, by the same arithmetic, to lie outside: the relative
    singular value of the task is at most the bound there. Such parts count as proved in the share of the box. The same
    holds for parts of the box of a `Corridor` that are farther from its path than the radius.

    The domain of a wide chart, a `RegularPart`, excludes folds by a test of its own. There the certificate proves where
    the clear box does not need this test. Parts without a proof rely on the test, and the search ends after a million
    boxes.

    Args:
        chart: a fitted chart.
        bound: bound of the conditioning as in `evaluate`, from 0 (det J != 0 only) to below 1; Euclidean metric only.
            The proof uses a sufficient condition, which is 4 to 14 % below the true conditioning.
        time_limit: seconds after which the search stops. The certificate then holds the share proved so far.
        executor: distributes the work, for example `concurrent.futures.ProcessPoolExecutor`, or
            `distributed.Client(...).get_executor(pure=False)` of Dask. Default: this process.
        monitor: receives progress.
        resume: an unfinished certificate of the same chart and bound to continue.

    Returns:
        The certificate. `certificate.proved` is True if everything is proved.

    Raises:
        CertifyError: if the chart is grown or uses operations without proven bounds, or `resume` is for another chart.
        Interrupted: after Ctrl-C; its `result` is the certificate so far.

    Example:
        >>> import orthocas as oc
        >>> from orthocas import problems
        >>> chart = oc.fit(problems.get("planar_3r_xy"), oc.Polynomial(degree=2), samples=300).chart
        >>> certificate = oc.certify(chart)
        >>> certificate.proved, certificate.share
        (True, 1.0)
    """
    start = time.monotonic()
    limits = Limits(seconds=check_options(chart, time_limit, executor))
    bound = check_bound(chart, bound)
    rows = build_chart_rows(chart)
    base = cover_domain(chart.problem.domain)
    if resume is not None:
        # Continue the open parts of the earlier search with the same method.
        require_same(chart, resume)
        if resume.bound != bound or resume.fold:
            raise CertifyError(
                f"resume is a certificate for bound {resume.bound:g}, expected one for {bound:g} without a fold"
            )
        base = resume.regular
    check = choose_check(chart, rows, bound, None if resume is None else resume.method)
    guarded = chart.problem.domain.room_to_fold is not None
    # Near the boundary of a domain that excludes folds, some parts always stay open.
    if guarded:
        limits = replace(limits, boxes=RULES.guarded_boxes)
    search = Search(check, base, limits, executor)
    injective: Subdivision | None = None

    def build_so_far() -> Certificate:
        """The certificate of what is proved so far, with the boxes and the bounds of an earlier search."""
        boxes, conditioning, seconds = search.evaluated, search.conditioning, time.monotonic() - start
        if resume is not None:
            boxes, seconds = boxes + resume.boxes, seconds + resume.seconds
            if resume.conditioning:
                conditioning = min(conditioning, resume.conditioning)
        domain, parts = chart.problem.domain, search.build_subdivision()
        return Certificate(
            fingerprint(chart.problem, chart.coordinates),
            check.method,
            bound,
            parts,
            conditioning * (1 - 1e-9) if bound > 0 and np.isfinite(conditioning) else 0.0,
            injective,
            tuple(tuple(point.tolist()) for point in search.signs.values()) if search.folded else (),
            boxes,
            seconds,
            getattr(domain, "least_singular_value", 0.0),
            getattr(domain, "least_volume", 0.0),
            _estimate_proved_fraction(domain, parts),
        ).seal()

    # First look for folds, then prove all parts. The remaining time is for the one-to-one box.
    try:
        search.visit(_sample_suspects(chart))
        search.run(_report_search(monitor, "regular", guarded=guarded))
        left = limits.seconds - (time.monotonic() - start)
        if search.finished and left > 0:
            most = int(np.clip(_MORE_BOXES[check.method] * search.evaluated, RULES.least_boxes, RULES.most_boxes))
            injective = _find_one_to_one_box(chart, rows, base, Limits(left, boxes=most), executor, monitor)
    except KeyboardInterrupt:
        raise Interrupted(build_so_far()) from None
    return build_so_far()


def check_certificate(
    chart: Chart, certificate: Certificate | None = None, *, executor: Executor | None = None, monitor: Monitor = silent
) -> bool:
    """Check a certificate by repeating all its proofs.

    These are the proof of each part of the domain, the bound of the conditioning, the two signs of a fold, and the
    one-to-one box. The number of evaluated boxes and the seconds are not repeated; only the digest protects them.

    Args:
        chart: the chart.
        certificate: its certificate. Default: the one in the chart's file.
        executor: distributes the work, see `certify`.
        monitor: called with progress.

    Raises:
        CertifyError: if there is no certificate, if it belongs to another chart or method or was changed, or if
            `certify` would refuse the chart.

    Example:
        >>> import orthocas as oc
        >>> from orthocas import problems
        >>> from orthocas.certificates import check_certificate
        >>> chart = oc.fit(problems.get("planar_3r_xy"), oc.Polynomial(degree=2), samples=300).chart
        >>> check_certificate(chart, oc.certify(chart))
        True
    """
    # Make sure that the certificate belongs to this chart before its numbers are used.
    check_options(chart, None, executor)
    certificate = chart.certificate if certificate is None else certificate
    if certificate is None:
        raise CertifyError("the chart has no certificate, expected one made by `certify`")
    require_same(chart, certificate)
    # Repeat the proofs of all parts with the method that made them.
    bound, rows = check_bound(chart, certificate.bound), build_chart_rows(chart)
    check = choose_check(chart, rows, bound, certificate.method)
    mapped: Mapped = map if executor is None else partial(in_order, executor)
    domain, whole = chart.problem.domain, certificate.regular
    # A fold is proved by two points of the domain at which det J has opposite signs.
    if certificate.fold:
        points = np.array(certificate.fold)
        ends = check(points, points)
        if not (domain.contains(points).all() and ends.regular.all() and ends.sign.prod() < 0):
            return False
    # All parts must be proved, with one sign unless the chart folds, and with the bounds that the certificate states.
    parts = _check_parts(check, whole, mapped, monitor)
    signs = {int(sign) for results in parts for sign in np.unique(results.sign) if sign}
    least = min((float(results.conditioning.min()) for results in parts), default=0.0)
    one_sign = len(signs) < 2 or bool(certificate.fold)
    if not (all(results.proved.all() for results in parts) and one_sign and least >= certificate.conditioning):
        return False
    if abs(_estimate_proved_fraction(domain, whole) - certificate.clear_share) > RULES.same_fraction:
        return False
    # The one-to-one box has its own check. It must lie in the domain, around its centre.
    box = certificate.injective
    if box is None:
        return True
    one_to_one = choose_one_to_one_check(chart, rows, box)
    if one_to_one is None or not box.complete:
        return False
    off = (box.low + box.high - whole.low - whole.high) / (box.high - box.low)
    inside = (box.low >= whole.low).all() and (box.high <= whole.high).all() and np.abs(off).max() < RULES.off_centre
    return bool(inside) and all(results.proved.all() for results in _check_parts(one_to_one, box, mapped, monitor))


def check_options(chart: Chart, time_limit: float | None, executor: Executor | None) -> float:
    """Check chart, time limit and executor; returns the limit in seconds, inf for none."""
    require_kind("chart", chart, Chart)
    require_driven("a certificate", chart.problem.robot.tree)
    require_executor(executor)
    if time_limit is None:
        return float("inf")
    return require_at_least("time_limit", time_limit, 0)


def check_bound(chart: Chart, bound: float) -> float:
    """Check and return a bound of the conditioning."""
    bound = as_number("bound", bound)
    if not 0 <= bound < 1:
        raise InvalidValueError("bound", bound, "a number from 0 to below 1")
    # Bounds above 0 require a fixed base and the Euclidean metric.
    if bound > 0 and build_chart_rows(chart).base:
        raise CertifyError(f"bound is {bound:g} on a moving base, expected 0: the sign of det J is proved there")
    if bound > 0 and not chart.problem.metric.is_identity:
        metric = chart.problem.metric.name
        raise CertifyError(
            f"bound is {bound:g} with metric {metric}, expected 0: conditioning is proved for the Euclidean metric"
        )
    return bound


def cover_domain(domain: Domain) -> Subdivision:
    """The domain as a box of one part, widened by its tolerance; unbounded joints have their half-width.

    The half-width of a full turn is pi, rounded down. With the tolerance, the box contains every angle.
    """
    half = domain.reach
    half = np.where(np.isfinite(half), half, domain.half_width + domain.slack)
    low, high = domain.centre - half, domain.centre + half
    return Subdivision.whole(np.nextafter(low, -np.inf), np.nextafter(high, np.inf))


def require_same(chart: Chart, certificate: Certificate) -> None:
    """Raise CertifyError unless the certificate belongs to this chart and to this version's method."""
    require_kind("certificate", certificate, Certificate)
    if certificate.method not in METHODS:
        expected = " or ".join(METHODS)
        raise CertifyError(f"the certificate is of method {certificate.method}, expected {expected}: certify it again")
    certificate.require_for(fingerprint(chart.problem, chart.coordinates))
    if not certificate.digest:
        raise CertifyError("the certificate has no digest, expected one made by `certify`")
    # A certificate is valid only for the domain that it was made for, with the same bounds on singular values and
    # folds.
    left_out = getattr(chart.problem.domain, "least_singular_value", 0.0)
    if certificate.least_singular_value != left_out:
        raise CertifyError(
            f"the certificate is void: its domain excludes singular values up to {certificate.least_singular_value:g}, "
            f"the domain {left_out:g}"
        )
    if certificate.least_volume != getattr(chart.problem.domain, "least_volume", 0.0):
        raise CertifyError("the certificate is void: the domain now excludes folds by another bound on the volume")
    domain = cover_domain(chart.problem.domain)
    if not (
        np.array_equal(domain.low, certificate.regular.low) and np.array_equal(domain.high, certificate.regular.high)
    ):
        raise CertifyError("the certificate is void: it covers another domain")


def _sample_suspects(chart: Chart) -> Array:
    """Two suspected points of a fold: the home, and the sample with the least det J relative to the sign at home."""
    domain = chart.problem.domain
    # Powers of uniform samples are nearer to faces and corners.
    rng = np.random.default_rng(0)
    unit = rng.uniform(-1, 1, (RULES.samples, chart.n))
    powers = rng.choice([1.0, 0.5, 0.25], (RULES.samples, 1))
    points = np.vstack([domain.home, domain.centre + domain.half_width * np.sign(unit) * np.abs(unit) ** powers])
    points = points[domain.contains(points)]
    if domain.draws_itself:
        points = sample_boundary_weighted(domain, RULES.samples, 0)
    # det J at the samples, relative to its sign at the home.
    J_x = chart.problem.task.batched_jacobian(points)[0].reshape(-1, chart.m, chart.n)
    volumes = np.linalg.det(np.nan_to_num(np.concatenate([J_x, chart.coordinates.jacobian(points)], axis=1)))
    worst = int(np.argmin(volumes * np.sign(volumes[0])))
    return np.asarray(points[[0, worst]])


def _find_one_to_one_box(
    chart: Chart, rows: ChartRows, base: Subdivision, limits: Limits, executor: Executor | None, monitor: Monitor
) -> Subdivision | None:
    """The largest box around the centre with a proof, and its parts; None if no box has a proof.

    Leading joints on which J does not depend keep their whole range, or 1 rad. Most scales get a small budget of boxes.
    Then larger scales get more, until one exceeds the budget.
    """
    end = time.monotonic() + limits.seconds
    best: Subdivision | None = None
    check = choose_one_to_one_check(chart, rows, base)
    if check is None:
        return None

    def prove(fraction: Array, most: int) -> bool:
        nonlocal best
        # A box about the same centre, with this fraction of each width, except for leading joints.
        centre, whole = (base.low + base.high) / 2, fraction == 1
        reach = fraction * half
        low, high = np.where(whole, base.low, centre - reach), np.where(whole, base.high, centre + reach)
        part = Subdivision.whole(low, high)
        point, own = (part.low + part.high)[None] / 2, replace(check, low=part.low, high=part.high)
        # First try the centre, where two points of the box can be farthest apart.
        if not own(point, point).proved.all():
            return False
        left = Limits(max(end - time.monotonic(), 0.0), boxes=most, hopeless=most // 4)
        search = Search(own, part, left, executor)
        search.run(_report_search(monitor, "one-to-one"))
        if search.finished:
            best = search.build_subdivision()
        return search.finished

    joints = np.arange(chart.n)
    scales = [RULES.shrink**k for k in range(RULES.scales - 1, -1, -1)]
    # Idle joints are coordinates themselves, so their range is arbitrary.
    idle = ~np.isin(joints, rows.active)
    held, half = np.isin(joints, check.still_joints), (base.high - base.low) / 2
    for range_ in (np.inf, RULES.held_range) if held.any() else (np.inf,):
        fraction = np.where(idle, 1.0, np.minimum(1.0, range_ / half))
        _try_scales([np.where(idle | held, fraction, scale) for scale in scales], prove, limits.boxes)
        if best is not None:
            break
    return best


def _try_scales(boxes: Sequence[Array], prove: Callable[[Array, int], bool], most: int) -> None:
    """Find the largest box with a proof: the largest one, then bisection with a small budget, then larger budgets."""
    if prove(boxes[-1], RULES.few_boxes):
        return
    # Boxes before `low` are proved; boxes from `high` on are not, with the small budget.
    low, high = 0, len(boxes) - 1
    while low < high:
        half_way = (low + high) // 2
        low, high = (half_way + 1, high) if prove(boxes[half_way], RULES.few_boxes) else (low, half_way)
    if low == 0:
        return
    while low + 1 < len(boxes) and prove(boxes[low + 1], most):
        low += 2
    if low < len(boxes):
        prove(boxes[low], most)


def _estimate_proved_fraction(domain: Domain, parts: Subdivision) -> float:
    """Fraction of the clear positions in proved parts, for a domain that excludes folds; 0 for other domains.

    It is estimated from samples of the box, and of the parts that are not proved.
    """
    bound = domain.singular_bound
    if bound is None or domain.room_to_fold is None:
        return 0.0
    low, high = parts.leaves(OPEN)
    if not len(low):
        return 1.0
    rng, volumes = np.random.default_rng(0), (high - low).prod(axis=1)

    # Fraction of positions between corners whose relative singular value is above the bound.
    def measure_clear(low: Array, high: Array) -> float:
        values = bound.singular_values(rng.uniform(low, high, (RULES.samples, parts.n)))
        return float(np.mean(values > bound.least_singular_value))

    chosen = rng.choice(len(low), RULES.samples, p=volumes / volumes.sum())
    left = float(volumes.sum() / (parts.high - parts.low).prod()) * measure_clear(low[chosen], high[chosen])
    # Some parts are not proved, so stay below 1 whatever the samples give.
    return float(np.clip(1 - left / measure_clear(parts.low, parts.high), 0.0, 1 - 2**-53))


def _report_search(monitor: Monitor, stage: str, *, guarded: bool = False) -> Look:
    """Report progress: the used share of boxes or of time, or the proved volume if that is larger.

    In a domain that is `guarded` against folds, most boxes are spent near the boundary, on hardly any volume. There,
    the proved volume does not show how much work remains.
    """
    start = time.monotonic()

    def show(search: Search) -> None:
        # While a box is open, report less than 100 %.
        limits, proved = search.limits, search.proved_volume
        if search.open_count:
            proved = min(proved, 1 - 2**-53)
        spent = max(search.evaluated / limits.boxes, (time.monotonic() - start) / max(limits.seconds, 1e-9))
        done = 1.0 if not search.open_count else min(1.0, spent if guarded else max(proved, spent))
        detail = f"{search.evaluated:,} boxes, {search.open_count:,} open, {percent(proved, 2)} proved"
        monitor(Progress(stage, done, detail))

    return show


def _check_parts(check: BoxCheck, parts: Subdivision, mapped: Mapped, monitor: Monitor) -> list[BoxResults]:
    # Split the proved leaves of the tree into pieces for the workers; results keep their order.
    low, high = parts.leaves(PROVED)
    pieces = [slice(k, k + RULES.at_once) for k in range(0, len(low), RULES.at_once)]
    results = []
    try:
        for part in mapped(check, [low[piece] for piece in pieces], [high[piece] for piece in pieces]):
            results.append(part)
            monitor(Progress("check", min(len(results) * RULES.at_once / len(low), 1.0), f"{len(low)} boxes"))
    except BrokenExecutor:
        raise CertifyError("the executor is broken, because one of its processes died: create a new one") from None
    return results
