"""`orthocas charts`, `evaluate` and `certify`: ready charts, and quality and proofs of a chart."""

import os
import time
from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from orthocas.charts import quality
from orthocas.charts.certificate import METHODS
from orthocas.charts.chart_file import CHART
from orthocas.charts.ready import card, load, names
from orthocas.cli.options import AsJson, ChartPath, Force, Number, SolidOptions, Whole, parse_whole_number, spread
from orthocas.cli.output import (
    build_reach_data,
    format_reach_rows,
    format_report_rows,
    note,
    print_json,
    print_rows,
    print_table,
    terminal_monitor,
)
from orthocas.errors import Interrupted, OptionError
from orthocas.tools.archive import require_free
from orthocas.tools.checks import require_count
from orthocas.tools.interrupts import INTERRUPTED

# Exit code.
_NOT_PROVED = 1


def charts(
    name: Annotated[
        str | None, typer.Argument(metavar="[NAME]", help="A ready chart; without it, all are listed.")
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", help="Chart file to write, for the other commands.")] = None,
    force: Force = False,
    json: AsJson = False,
) -> None:
    """List the ready charts of known arms, show the card of one, or write it to a file."""
    if name is None:
        if out is not None:
            raise OptionError("--out requires the name of a ready chart")
        cards = [card(ready) for ready in names()]
        if json:
            print_json({"charts": [ready.as_dict() for ready in cards]})
        else:
            head = ("name", "robot", "n m r", "leak [deg]", "least conditioning", "licence")
            rows: list[tuple[str, ...]] = [head]
            for ready in cards:
                numbers = ready.quality
                sizes = " ".join(str(numbers[size]) for size in "nmr")
                leak, least = f"{numbers['leak_deg']['rms']:.2f}", f"{numbers['conditioning']['min']:.2f}"
                rows.append((ready.name, ready.model.robot, sizes, leak, least, ready.model.licence))
            print_table(rows, f"orthocas view {cards[0].name}")
        return
    # With a name, print its card, and write its file on request.
    ready = card(name)
    if out is not None:
        load(name).save(out, force)
    written = {} if out is None else {"chart": str(out)}
    if json:
        print_json({**ready.as_dict(), **written})
    else:
        commands = {f"command {k}": line for k, line in enumerate(ready.commands, 1)}
        print_rows({**ready.facts(), **commands, **written})


@spread("solids", SolidOptions)
def evaluate(
    chart: ChartPath,
    samples: Annotated[int, Whole("--samples", help="Number of held-out samples.")] = 100_000,
    *,
    solids: SolidOptions,
    json: AsJson = False,
) -> None:
    """Measure the quality of a chart on held-out samples of its domain."""
    loaded = load(chart)
    report = quality.evaluate(loaded, samples, collisions=solids.build_model(loaded.problem.robot))
    if json:
        print_json({**report.as_dict(), **build_reach_data(loaded)})
    else:
        print_rows({**format_report_rows(report, loaded), **format_reach_rows(loaded)}, f"orthocas view {chart}")


def certify(
    chart: ChartPath,
    bound: Annotated[
        float | None, Number("--bound", help="Also prove that the conditioning is at least this; default: 0.")
    ] = None,
    seconds: Annotated[float | None, Number("--seconds", help="Time limit; what is proved by then is kept.")] = None,
    check: Annotated[
        bool, typer.Option("--check", help="Check the certificate in the file, without a search.")
    ] = False,
    out: Annotated[
        Path | None, typer.Option("--out", help="Chart file to write, with the certificate; default: CHART itself.")
    ] = None,
    workers: Annotated[
        str, typer.Option("--workers", help="Number of processes, or the address of a Dask scheduler, tcp://host:8786.")
    ] = "1",
    force: Force = False,
    json: AsJson = False,
) -> None:
    """Prove that a chart does not fold anywhere on its domain, and save the proof in its file.

    An unfinished certificate without a fold is resumed. The exit code is 1 if not everything is proved, also with
    --check.
    """
    # multiprocessing takes long to import, and other commands do not need it.
    from orthocas import certificates

    processes = 0 if "://" in workers else require_count("--workers", parse_whole_number(workers))
    target = out or chart
    require_free(target, CHART, force)
    loaded = load(chart)
    with _start_workers(processes, workers) as executor, terminal_monitor() as monitor:
        start = time.monotonic()
        # Check the proof in the file only.
        if check:
            holds = certificates.check_certificate(loaded, executor=executor, monitor=monitor)
            assert loaded.certificate is not None
            took = time.monotonic() - start
            if json:
                print_json({"holds": holds, **loaded.certificate.as_dict(), "seconds": took})
            else:
                verdict = "holds" if holds else "does NOT hold"
                partly = "" if loaded.certificate.proved or not holds else " for the part that is proved"
                line = f"the certificate {verdict}{partly}, {took:.3g} s"
                print_rows({"check": line, **loaded.certificate.facts()})
            raise typer.Exit(0 if holds and loaded.certificate.proved else _NOT_PROVED)
        # Continue the certificate of the file if possible; Ctrl-C keeps what is proved so far.
        saved = loaded.certificate
        resumable = saved is not None and saved.method in METHODS and saved.digest and not (saved.proved or saved.fold)
        resume = saved if resumable and saved and bound in (None, saved.bound) else None
        try:
            certificate = certificates.certify(
                loaded,
                resume.bound if bound is None and resume else bound or 0.0,
                time_limit=seconds,
                executor=executor,
                monitor=monitor,
                resume=resume,
            )
            interrupted = False
        except Interrupted as stop:
            certificate, interrupted = stop.result, True
    replace(loaded, certificate=certificate).save(target, force)
    if json:
        print_json({"chart": str(target), **certificate.as_dict()})
    else:
        print_rows(
            {**certificate.facts(), "chart": str(target)}, f"orthocas codegen {target} --controller pd_plus --out c"
        )
    if interrupted:
        note("interrupted: the file holds what is proved so far; the same command goes on from it")
        raise typer.Exit(INTERRUPTED)
    raise typer.Exit(0 if certificate.proved else _NOT_PROVED)


@contextmanager
def _start_workers(processes: int, address: str) -> Iterator[Executor | None]:
    """The executor: local processes, a Dask scheduler if their number is 0, or None if it is 1."""
    # Slow to import, as in `certify`.
    from orthocas.tools.processes import Processes, begin_worker, scheduler_executor

    if processes == 0:
        with scheduler_executor(address) as executor:
            yield executor
    elif processes > 1:
        with Processes(processes, begin_worker, os.getpid()) as executor:
            yield executor
    else:
        yield None
