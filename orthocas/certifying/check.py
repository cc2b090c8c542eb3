"""Check a certificate again: one evaluation for each of its parts, no search."""

from collections.abc import Callable, Iterable
from concurrent.futures import Executor

import numpy as np

from orthocas.certificates.certificate import Certificate
from orthocas.certificates.subdivision import PROVED, Subdivision
from orthocas.certifying.certify import checked_options, require_same
from orthocas.certifying.chart_rows import chart_rows
from orthocas.certifying.judges import Judge, Verdicts
from orthocas.certifying.one_to_one import one_to_one_judge
from orthocas.certifying.outside import judge_of
from orthocas.chart import Chart
from orthocas.checks import Array
from orthocas.errors import CertifyError
from orthocas.minimising.watch import Monitor, Progress, silent

_AT_ONCE = 512
Mapped = Callable[..., Iterable[Verdicts]]


def check_certificate(
    chart: Chart,
    certificate: Certificate | None = None,
    *,
    executor: Executor | None = None,
    monitor: Monitor = silent,
) -> bool:
    """Whether a certificate holds: the bounds of each of its parts are computed once more.

    Args:
        chart: the chart.
        certificate: its certificate. Default: the one in the chart's file.
        executor: shares the work, see `certify`.
        monitor: called with progress.

    Raises:
        CertifyError: if there is no certificate, or it belongs to another chart or method.

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
    rows = chart_rows(chart)
    mapped: Mapped = map if executor is None else executor.map
    regular = _judged(judge_of(chart, rows, certificate.bound), certificate.regular, mapped, monitor)
    signs = {int(sign) for verdicts in regular for sign in np.unique(verdicts.sign) if sign}
    least = min((float(verdicts.conditioning.min()) for verdicts in regular), default=0.0)
    holds = all(verdicts.proved.all() for verdicts in regular) and len(signs) < 2 and least >= certificate.conditioning
    if certificate.injective is None or not holds:
        return holds
    judge = one_to_one_judge(chart, rows, certificate.injective)
    found = _judged(judge, certificate.injective, mapped, monitor)
    return certificate.injective.complete and all(verdicts.proved.all() for verdicts in found)


def _judged(judge: Judge, parts: Subdivision, mapped: Mapped, monitor: Monitor) -> list[Verdicts]:
    low, high = parts.leaves(PROVED)
    found = []
    for verdicts in mapped(judge, _cut(low), _cut(high)):
        found.append(verdicts)
        monitor(Progress("check", min(len(found) * _AT_ONCE / len(low), 1.0), f"{len(low)} boxes"))
    return found


def _cut(corners: Array) -> list[Array]:
    return [corners[k : k + _AT_ONCE] for k in range(0, len(corners), _AT_ONCE)]
