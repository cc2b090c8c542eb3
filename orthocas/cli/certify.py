"""`orthocas certify`: prove that a chart does not fold, or check the proof in its file."""

import os
import time
from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from orthocas import certificates
from orthocas.charts.certificate import METHODS, Certificate
from orthocas.charts.chart import Chart
from orthocas.charts.chart_file import CHART
from orthocas.cli.output import (
    AsJson,
    ChartPath,
    Force,
    Scheduler,
    note,
    number,
    print_json,
    print_rows,
    terminal_monitor,
    whole_number,
)
from orthocas.errors import Interrupted
from orthocas.tools.archive import require_free
from orthocas.tools.checks import require_count
from orthocas.tools.interrupts import INTERRUPTED
from orthocas.tools.processes import Processes, begin_worker, scheduler_executor

_NOT_PROVED = 1  # exit code


def certify(
    chart: ChartPath,
    bound: Annotated[
        float | None,
        typer.Option("--bound", parser=number, help="Also prove that the conditioning is at least this; default: 0."),
    ] = None,
    seconds: Annotated[
        float | None, typer.Option("--seconds", parser=number, help="Time limit; what is proved by then is kept.")
    ] = None,
    check: Annotated[
        bool, typer.Option("--check", help="Check the certificate in the file, without a search.")
    ] = False,
    out: Annotated[
        Path | None, typer.Option("--out", help="Chart file to write, with the certificate; default: CHART itself.")
    ] = None,
    workers: Annotated[int, typer.Option("--workers", parser=whole_number, help="Number of processes.")] = 1,
    scheduler: Scheduler = None,
    force: Force = False,
    json: AsJson = False,
) -> None:
    """Prove that a chart does not fold anywhere on its domain, and keep the proof in its file.

    A certificate without a fold that does not cover the domain is resumed. The exit code is 1 if not all is proved,
    with --check too.
    """
    require_count("--workers", workers)
    target = out or chart
    require_free(target, CHART, force)
    known = Chart.load(chart)
    with _executor(workers, scheduler) as executor, terminal_monitor() as monitor:
        start = time.monotonic()
        if check:
            holds = certificates.check_certificate(known, executor=executor, monitor=monitor)
            _report_check(known.certificate, holds, time.monotonic() - start, json)
            raise typer.Exit(0 if holds and known.certificate and known.certificate.proved else _NOT_PROVED)
        resume = _unfinished(known, bound)
        try:
            found = certificates.certify(
                known,
                resume.bound if bound is None and resume else bound or 0.0,
                time_limit=seconds,
                executor=executor,
                monitor=monitor,
                resume=resume,
            )
            interrupted = False
        except Interrupted as stop:
            found, interrupted = stop.result, True
    replace(known, certificate=found).save(target, force)
    _report(found, target, json)
    if interrupted:
        note("interrupted: the file holds what is proved so far; the same command goes on from it")
        raise typer.Exit(INTERRUPTED)
    raise typer.Exit(0 if found.proved else _NOT_PROVED)


@contextmanager
def _executor(workers: int, scheduler: str | None) -> Iterator[Executor | None]:
    """What shares the work: processes, a Dask scheduler, or nothing."""
    if scheduler is not None:
        with scheduler_executor(scheduler) as executor:
            yield executor
    elif workers > 1:
        with Processes(workers, begin_worker, os.getpid()) as executor:
            yield executor
    else:
        yield None


def _unfinished(chart: Chart, bound: float | None) -> Certificate | None:
    """The certificate in the file if there is more to prove, it is about the same bound, and it can be resumed."""
    known = chart.certificate
    if known is None or known.method not in METHODS or not known.digest:
        return None
    if known.proved or known.fold or (bound is not None and bound != known.bound):
        return None
    return known


def _report(certificate: Certificate, target: Path, json: bool) -> None:
    if json:
        print_json({"chart": str(target), **certificate.as_dict()})
    else:
        print_rows({**certificate.facts(), "chart": str(target)})


def _report_check(certificate: Certificate | None, holds: bool, seconds: float, json: bool) -> None:
    assert certificate is not None
    if json:
        print_json({"holds": holds, **certificate.as_dict(), "seconds": seconds})
    else:
        verdict = "holds" if holds else "does NOT hold"
        partly = "" if certificate.proved or not holds else " for the part that is proved"
        print_rows({"check": f"the certificate {verdict}{partly}, {seconds:.3g} s", **certificate.facts()})
