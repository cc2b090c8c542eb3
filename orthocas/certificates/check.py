"""Check a certificate again: one evaluation for each of its parts, no search."""

from collections.abc import Callable, Iterable
from concurrent.futures import Executor

import numpy as np

from orthocas.certificates.certify import checked_bound, checked_options, require_same
from orthocas.certificates.chart_rows import chart_rows
from orthocas.certificates.judges import Judge, Verdicts
from orthocas.certificates.one_to_one import one_to_one_judge
from orthocas.certificates.outside import judge_of
from orthocas.charts.certificate import PROVED, Certificate, Subdivision
from orthocas.charts.chart import Chart
from orthocas.errors import CertifyError
from orthocas.tasks.domains import contains
from orthocas.tools.checks import Array
from orthocas.tools.progress import Monitor, Progress, silent

_AT_ONCE = 512
_OFF_CENTRE = 1e-6  # of the width of a box
Mapped = Callable[..., Iterable[Verdicts]]


def check_certificate(
    chart: Chart,
    certificate: Certificate | None = None,
    *,
    executor: Executor | None = None,
    monitor: Monitor = silent,
) -> bool:
    """Whether a certificate holds: all that it says of the chart is computed once more.

    That is each part of the domain, the bound of the conditioning, the two signs of a fold, and the one-to-one box. The
    number of boxes that were judged and the seconds are history, which only the digest of the certificate covers.

    Args:
        chart: the chart.
        certificate: its certificate. Default: the one in the chart's file.
        executor: shares the work, see `certify`.
        monitor: called with progress.

    Raises:
        CertifyError: if there is no certificate, if it belongs to another chart or method or has been changed, or if
            `certify` would refuse the chart.

    Example:
        >>> import orthocas as oc
        >>> from orthocas import problems
        >>> chart = oc.fit(problems.get("planar_3r_xy"), oc.Polynomial(degree=2), samples=300).chart
        >>> oc.check_certificate(chart, oc.certify(chart))
        True
    """
    checked_options(chart, None, executor)
    certificate = chart.certificate if certificate is None else certificate
    if certificate is None:
        raise CertifyError("the chart has no certificate, expected one made by `certify`")
    require_same(chart, certificate)
    bound, rows = checked_bound(chart, certificate.bound), chart_rows(chart)
    judge = judge_of(chart, rows, bound)
    mapped: Mapped = map if executor is None else executor.map
    if certificate.fold and not _folds(chart, judge, np.array(certificate.fold)):
        return False
    if not _regular(certificate, _judged(judge, certificate.regular, mapped, monitor)):
        return False
    box = certificate.injective
    if box is None:
        return True
    one_to_one = one_to_one_judge(chart, rows, box)
    if one_to_one is None or not box.complete or not _around_the_centre(certificate, box):
        return False
    return all(verdicts.proved.all() for verdicts in _judged(one_to_one, box, mapped, monitor))


def _regular(certificate: Certificate, found: list[Verdicts]) -> bool:
    """Whether the parts are proved, with one sign unless the chart folds, and the conditioning is what it says."""
    signs = {int(sign) for verdicts in found for sign in np.unique(verdicts.sign) if sign}
    least = min((float(verdicts.conditioning.min()) for verdicts in found), default=0.0)
    proved = all(verdicts.proved.all() for verdicts in found)
    return proved and (len(signs) < 2 or bool(certificate.fold)) and least >= certificate.conditioning


def _folds(chart: Chart, judge: Judge, points: Array) -> bool:
    """Whether det J is proved to have opposite signs at two points (2, n) of the domain."""
    found = judge(points, points)
    return bool(contains(chart.problem.domain, points).all() and found.regular.all() and found.sign.prod() < 0)


def _around_the_centre(certificate: Certificate, box: Subdivision) -> bool:
    """Whether a box lies in the domain, around its centre."""
    domain = certificate.regular
    off = (box.low + box.high - domain.low - domain.high) / (box.high - box.low)
    inside = (box.low >= domain.low).all() and (box.high <= domain.high).all()
    return bool(inside and np.abs(off).max() < _OFF_CENTRE)


def _judged(judge: Judge, parts: Subdivision, mapped: Mapped, monitor: Monitor) -> list[Verdicts]:
    low, high = parts.leaves(PROVED)
    found = []
    for verdicts in mapped(judge, _cut(low), _cut(high)):
        found.append(verdicts)
        monitor(Progress("check", min(len(found) * _AT_ONCE / len(low), 1.0), f"{len(low)} boxes"))
    return found


def _cut(corners: Array) -> list[Array]:
    return [corners[k : k + _AT_ONCE] for k in range(0, len(corners), _AT_ONCE)]
