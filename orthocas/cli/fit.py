"""`orthocas fit`: from a robot to a chart file."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from orthocas.cli.output import AsJson, Force, note, number, print_json, print_rows, report_rows, whole_number
from orthocas.cli.problem_argument import (
    CentreText,
    HalfWidth,
    HomeName,
    Locks,
    MetricName,
    ProblemName,
    ProblemOptions,
    TaskName,
    TipName,
    ToolText,
    build_problem,
    parse_numbers,
)
from orthocas.cli.progress import terminal_monitor
from orthocas.errors import Interrupted, InvalidValueError
from orthocas.files.archive import require_free
from orthocas.files.chart_file import CHART
from orthocas.fitting.fit import Fit
from orthocas.fitting.fit import fit as fit_chart
from orthocas.fitting.loss import DEFAULT_WEIGHTS, Weights
from orthocas.minimising.solver import Status
from orthocas.parametrisations import parse_parametrisation
from orthocas.quality import Report, evaluate
from orthocas.solvers import get as get_solver

AnglesName = Annotated[
    str | None,
    typer.Option(
        "--angles",
        help="Angles in the loss: paper (Euclidean norms) or metric; default: metric with --metric inertia.",
    ),
]
WEIGHTS_TEXT = f"{DEFAULT_WEIGHTS.task:g},{DEFAULT_WEIGHTS.mutual:g},{DEFAULT_WEIGHTS.regularity:g}"


def fit(
    problem: ProblemName,
    tip: TipName = None,
    lock: Locks = None,
    tool: ToolText = None,
    task: TaskName = None,
    metric: MetricName = None,
    param: Annotated[
        str, typer.Option("--param", help="Parametrisation: polynomial:4, fourier:2, mlp:64x64, linear or sew.")
    ] = "polynomial:4",
    solver: Annotated[
        str | None,
        typer.Option(
            "--solver",
            help="gauss_newton, lbfgs, ipopt, adam or gradient_flow; default: one that suits the parametrisation.",
        ),
    ] = None,
    centre: CentreText = None,
    home: HomeName = None,
    half_width: HalfWidth = None,
    samples: Annotated[
        int | None,
        typer.Option(
            "--samples", parser=whole_number, help="Number of training samples; default: from the problem size."
        ),
    ] = None,
    seed: Annotated[
        int, typer.Option("--seed", parser=whole_number, help="Seed of the samples and of random starts.")
    ] = 0,
    weights: Annotated[
        str, typer.Option("--weights", help='"lambda1,lambda2", optionally followed by lambda3 and lambda4.')
    ] = WEIGHTS_TEXT,
    angles: AnglesName = None,
    max_mutual_deg: Annotated[
        float | None,
        typer.Option(
            "--max-mutual-deg",
            parser=number,
            help="Bound on the rms deviation of the mutual angles from 90 deg; Ipopt minimises the task angle.",
        ),
    ] = None,
    checkpoint: Annotated[
        Path | None,
        typer.Option(
            "--checkpoint", help="File for the state of a long fit. If the file exists, the fit resumes from it."
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", help="Chart file; default: PROBLEM.orthocas in the current folder.")
    ] = None,
    force: Force = False,
    json: AsJson = False,
) -> None:
    """Fit extra coordinates to a problem and save the chart."""
    words = ProblemOptions(tip, tuple(lock or ()), tool, task, metric, centre, home, half_width)
    built = build_problem(problem, words)
    target = out or Path(f"{built.name}.orthocas")
    require_free(target, CHART, force)
    parametrisation = parse_parametrisation(param)
    minimiser = None if solver is None else get_solver(solver)
    loss = parse_weights(weights, angles)
    try:
        with terminal_monitor() as monitor:
            result = fit_chart(
                built,
                parametrisation,
                minimiser,
                weights=loss,
                samples=samples,
                seed=seed,
                monitor=monitor,
                max_mutual_deg=max_mutual_deg,
                checkpoint=checkpoint,
            )
    except Interrupted as stop:
        result = stop.result
    result.chart.save(target, force)
    report = evaluate(result.chart, seed=seed + 1)
    if json:
        print_json(_as_dict(result, report, target))
    else:
        print_rows(_rows(result, report, target))
    if result.status is Status.INTERRUPTED:
        note("interrupted: the chart holds the best coordinates found so far")
        raise typer.Exit(130)


def parse_weights(text: str, angles: str | None) -> Weights:
    """Read "1000,30", "1000,30,150" or "1000,30,150,0.01", with the kind of angles."""
    numbers = parse_numbers("--weights", text).tolist()
    if not 2 <= len(numbers) <= 4:
        raise InvalidValueError("--weights", repr(text), "two to four numbers")
    return replace(Weights.of(numbers), angles=angles)


def _rows(result: Fit, report: Report, target: Path) -> dict[str, str]:
    coordinates = result.chart.coordinates
    rows = report_rows(report)
    rows["fit"] = f"{coordinates.label}, {result.seconds:.2f} s, {result.status.value}"
    if result.idle_joints:
        rows["exact"] = f"joints that do not move the task: {', '.join(result.idle_joints)}"
    if result.problem_check.singular_samples:
        check = result.problem_check
        at = ", ".join(f"{value:.2f}" for value in check.most_singular_point)
        rows["singular"] = f"{check.singular_share:.2%} of the domain is near-singular, worst at q = ({at})"
    rows["chart"] = str(target)
    return rows


def _as_dict(result: Fit, report: Report, target: Path) -> dict[str, Any]:
    check = result.problem_check
    return {
        "chart": str(target),
        "parametrisation": result.chart.coordinates.label,
        "status": result.status.value,
        "seconds": result.seconds,
        "idle_joints": list(result.idle_joints),
        "near_singular_share": check.singular_share,
        "most_singular_point": list(check.most_singular_point),
        "stages": [
            {
                "parametrisation": stage.label,
                "parameters": stage.parameters,
                "samples": stage.samples,
                "loss": stage.result.value,
                "status": stage.result.status.value,
                "iterations": stage.result.iterations,
                "seconds": stage.result.seconds,
            }
            for stage in result.stages
        ],
        **report.as_dict(),
    }
