"""`orthocas fit`: from a robot to a chart file."""

from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Any, cast

import typer

from orthocas.bases.family import Parametrisation
from orthocas.bases.registry import parse_parametrisation
from orthocas.charts.chart_file import CHART
from orthocas.charts.quality import Report, evaluate
from orthocas.cli.evaluate import build_reach_data, format_reach_rows
from orthocas.cli.options import (
    BRANCH,
    CHAIN,
    DOMAIN,
    WEIGHTS_TEXT,
    AnglesName,
    BranchName,
    DomainText,
    LikeName,
    PrecisionName,
    ProblemName,
    ProblemOptions,
    SampleCount,
    WeightsText,
    build_problem,
    parse_weights,
    parse_whole_number,
    suggested,
    wide_fit,
)
from orthocas.cli.output import (
    AsJson,
    Force,
    format_report_rows,
    note,
    number,
    parse_whole_number,
    print_json,
    print_rows,
    terminal_monitor,
)
from orthocas.control.gains import find_holding_doubts
from orthocas.errors import Interrupted, InvalidValueError, OptionError
from orthocas.fitting.fit import Fit
from orthocas.fitting.fit import fit as fit_chart
from orthocas.fitting.probe import Bounds
from orthocas.fitting.settings import PRECISIONS, Precision, choose_parametrisation
from orthocas.fitting.suggest_domain import CONDITIONING, LEAK_DEG, DomainSuggestion
from orthocas.fitting.wide import WideFit
from orthocas.paths.chart_along import RADIUS, corridor_problem
from orthocas.solvers import get as get_solver
from orthocas.solvers.protocol import Status
from orthocas.tasks.corridor import read_postures
from orthocas.tasks.problem import Problem
from orthocas.tools.archive import require_free
from orthocas.tools.display import listed, number_list, percent
from orthocas.tools.interrupts import INTERRUPTED
from orthocas.tools.json import collect_attributes

_WIDE_ROWS = ("regular", "left out", "meaning")  # facts of wide fits
_IN_CORRIDOR = "polynomial:3:cyclic"  # more terms gain little there


@parse_whole_number(*CHAIN, *DOMAIN, "least_singular_value")
def fit(
    problem: ProblemName,
    words: ProblemOptions,
    param: Annotated[
        str | None,
        typer.Option(
            "--param",
            help="Parametrisation: polynomial:5, polynomial:5:cyclic, polynomial:4:joints=2, fourier:2, mlp:64x64, "
            "mlp:64x64:raw, linear or sew; default: polynomial:5, or polynomial:4 for more than seven joints; "
            "polynomial:3:cyclic with --corridor; what is regular on the branch with --domain branch.",
        ),
    ] = None,
    solver: Annotated[
        str | None,
        typer.Option(
            "--solver",
            help="gauss_newton, quasi_newton, lbfgs, ipopt, adam or gradient_flow; "
            "default: one that suits the parametrisation.",
        ),
    ] = None,
    domain: DomainText = None,
    branch: BranchName = None,
    like: LikeName = None,
    corridor: Annotated[
        Path | None,
        typer.Option(
            "--corridor",
            metavar="POSTURES.csv",
            help="Domain: the surroundings of a path of postures, one a line, with the joint names in the first line.",
        ),
    ] = None,
    radius: Annotated[
        float | None,
        typer.Option("--radius", parser=number, help=f"Of the corridor [rad]; default {RADIUS:g}."),
    ] = None,
    leak_deg: Annotated[
        float | None, typer.Option("--leak-deg", parser=number, help="Largest leak for --domain auto [deg]; default 8.")
    ] = None,
    conditioning: Annotated[
        float | None,
        typer.Option("--conditioning", parser=number, help="Smallest conditioning for --domain auto; default 0.2."),
    ] = None,
    samples: SampleCount = None,
    seed: Annotated[
        int, typer.Option("--seed", parser=parse_whole_number, help="Seed of the samples and of random starts.")
    ] = 0,
    weights: WeightsText = WEIGHTS_TEXT,
    angles: AnglesName = None,
    precision: PrecisionName = PRECISIONS[0],
    max_mutual_deg: Annotated[
        float | None,
        typer.Option(
            "--max-mutual-deg",
            parser=number,
            help="Bound on the rms deviation of the mutual angles from 90 deg; Ipopt minimises the task angle.",
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", help="Chart file; default: PROBLEM.orthocas in the current folder.")
    ] = None,
    force: Force = False,
    json: AsJson = False,
) -> None:
    """Fit extra coordinates to a problem and save the chart."""
    bounds = _bounds(domain, leak_deg, conditioning, corridor)
    wide = domain == BRANCH
    if branch is not None and not wide:
        raise OptionError("--branch requires --domain branch")
    if wide:
        usual_loss = weights == WEIGHTS_TEXT and angles is None and precision == PRECISIONS[0]
        _require_none({"solver": solver, "max-mutual-deg": max_mutual_deg})
        _require_none({"weights, --angles and --precision": None if usual_loss else weights})
    built = _corridor_or_box(problem, words, corridor, radius) if bounds is None and not wide else None
    target = out or Path(f"{Path(problem).stem if built is None else built.name}.orthocas")
    require_free(target, CHART, force)
    param = _IN_CORRIDOR if param is None and corridor is not None else param
    parametrisation = None if param is None else parse_parametrisation(param)
    minimiser = None if solver is None else get_solver(solver)
    loss = parse_weights(weights, angles)
    suggestion = None
    try:
        with terminal_monitor() as monitor:
            if bounds is not None:
                built, suggestion = suggested(problem, words, parametrisation, bounds, loss, seed, monitor)
            if built is None:
                result: Fit = wide_fit(problem, words, branch, like, parametrisation, samples, seed, monitor)
            else:
                others = (minimiser, samples, max_mutual_deg, like)
                usual = others == (None,) * 4 and precision == PRECISIONS[0]
                result = (_confirming(suggestion, built, parametrisation) if usual else None) or fit_chart(
                    built,
                    parametrisation,
                    minimiser,
                    weights=loss,
                    samples=samples,
                    seed=seed,
                    monitor=monitor,
                    max_mutual_deg=max_mutual_deg,
                    precision=cast(Precision, precision),
                    like=None if like is None else [word.strip() for word in like.split(",")],
                )
    except Interrupted as stop:
        result = stop.result
    if isinstance(result, WideFit) and result.left_out:
        note(f"the chart of branch '{result.chart.notes['branch']}' leaves out {result.left_out}")
    known = result.chart.problem
    for doubt in find_holding_doubts(known.robot, known.domain, known.robot.effort_limits):
        note(doubt)
    result.chart.save(target, force)
    report = evaluate(result.chart, seed=seed + 1)
    if json:
        print_json(_as_dict(result, report, target, suggestion))
    else:
        print_rows({**_rows(result, report, target), **({} if suggestion is None else _domain_rows(suggestion))})
    if result.status is Status.INTERRUPTED:
        note("interrupted: the chart holds the best coordinates found so far")
        raise typer.Exit(INTERRUPTED)


def _require_none(given: dict[str, Any]) -> None:
    """Raise OptionError for options that wide charts do not have."""
    for option, value in given.items():
        if value is not None:
            raise OptionError(f"--domain branch has a solver of its own: leave out --{option}")


def _confirming(
    suggestion: DomainSuggestion | None, built: Problem, parametrisation: Parametrisation | None
) -> Fit | None:
    """The fit that confirmed the domain, if it has the family that is asked for."""
    default = choose_parametrisation(built, True) == choose_parametrisation(built, False)
    if suggestion is None or (parametrisation is None and not default):
        return None
    return replace(suggestion.fit, chart=replace(suggestion.fit.chart, problem=built))


def _corridor_or_box(name: str, options: ProblemOptions, path: Path | None, radius: float | None) -> Problem:
    """The problem of a command line, near the postures of a file if one is given.

    Raises:
        OrthocasError: if anything does not fit together.
    """
    if path is None:
        if radius is not None:
            raise OptionError("--radius requires --corridor")
        return build_problem(name, options)
    for option in ("centre", "home", "half_width", "least_singular_value"):
        value = getattr(options, option)
        if value is not None:
            raise OptionError(f"--corridor is a domain: leave out --{option.replace('_', '-')}")
    known = build_problem(name, options)
    return corridor_problem(known, read_postures(path, known.robot), RADIUS if radius is None else radius)


def _bounds(
    domain: str | None, leak_deg: float | None, conditioning: float | None, corridor: Path | None
) -> Bounds | None:
    """What --domain auto asks for; None without it."""
    if domain is not None and corridor is not None:
        raise OptionError("--corridor is a domain: leave out --domain")
    given = {"--leak-deg": leak_deg, "--conditioning": conditioning}
    if domain in (None, BRANCH):
        for option, value in given.items():
            if value is not None:
                raise OptionError(f"{option} requires --domain auto")
        return None
    if domain != "auto":
        raise InvalidValueError(
            "--domain", repr(domain), "auto, branch, or --centre and --half-width for a box of your own"
        )
    return Bounds(LEAK_DEG if leak_deg is None else leak_deg, CONDITIONING if conditioning is None else conditioning)


def _rows(result: Fit, report: Report, target: Path) -> dict[str, str]:
    coordinates, robot = result.chart.coordinates, result.chart.problem.robot
    rows = report.facts() if isinstance(result, WideFit) else format_report_rows(report)  # wide fits have no --weights
    rows["robot"] = f"{robot.n} joints, {'tip' if len(robot.tips) == 1 else 'tips'} {listed(robot.tips)}"
    rows["fit"] = f"{coordinates.label}, {result.seconds:.2f} s, {result.status.value}"
    if isinstance(result, WideFit) and result.branch is not None:
        rows["branch"] = (
            f"{result.branch.name}, {percent(result.branch.share)} of the clear positions of the joint range"
        )
        rows |= {name: text for name, text in result.facts().items() if name in _WIDE_ROWS}
    if result.like:
        rows["like"] = ", ".join(f"{name} {angle:.3g} deg off" for name, angle in result.like.items())
    if result.idle_joints:
        rows["exact"] = f"joints that do not move the task: {', '.join(result.idle_joints)}"
    if result.cyclic_joints:
        rows["cyclic"] = f"holds at all positions of {', '.join(result.cyclic_joints)}"
    check, offer = result.problem_check, result.clear_part
    if check.singular_samples:
        at = ", ".join(f"{value:.2f}" for value in check.most_singular_point)
        rows["singular"] = (
            f"{percent(check.singular_share, 2, fault=True)} of the domain is near-singular, worst at q = ({at})"
        )
        if offer is None:
            rows["singular"] += "; --domain auto, or another --centre or --home, stays clear"
    if check.half_turn_samples:
        rows["half a turn"] = (
            f"at {percent(check.half_turn_share, 2, fault=True)} of the domain the task's own orientation ends"
        )
    if offer is not None:
        bound, share = offer.least_singular_value, offer.share
        rows["clear part"] = (
            f"--least-singular-value {bound:g} leaves out singular positions and keeps {percent(share)}"
        )
    return {**rows, **format_reach_rows(result.chart), "chart": str(target)}


def _domain_rows(suggestion: DomainSuggestion) -> dict[str, str]:
    """What ends the domain in each joint."""
    rows = {"home": f"{number_list(suggestion.home)} ({suggestion.home_source})"}
    for joint in suggestion.joints:
        rows[joint.joint] = f"half-width {joint.half_width:.3g}, {joint.explanation}"
    return rows


def _wide(result: Fit) -> dict[str, Any]:
    if not isinstance(result, WideFit) or result.branch is None:
        return {}
    meaning = None if result.meaning is None else {"like": result.chart.notes["meaning"], **asdict(result.meaning)}
    return {
        "branch": result.branch.name,
        **collect_attributes(result, "regular_share", "left_out"),
        "meaning": meaning,
    }


def _as_dict(result: Fit, report: Report, target: Path, suggestion: DomainSuggestion | None) -> dict[str, Any]:
    check = result.problem_check
    return {
        **({} if suggestion is None else {"suggested_domain": suggestion.as_dict()}),
        "chart": str(target),
        "tips": list(result.chart.problem.robot.tips),
        **build_reach_data(result.chart),
        "parametrisation": result.chart.coordinates.label,
        "status": result.status.value,
        "seconds": result.seconds,
        "idle_joints": list(result.idle_joints),
        **_wide(result),
        "least_conditioning": None if result.worst is None else result.worst.least,
        "cyclic_joints": list(result.cyclic_joints),
        "near_singular_share": check.singular_share,
        "half_turn_share": check.half_turn_share,
        "most_singular_point": list(check.most_singular_point),
        "clear_part": None if result.clear_part is None else asdict(result.clear_part),
        "stages": [
            {
                "parametrisation": stage.label,
                **collect_attributes(stage, "parameters", "samples"),
                "loss": stage.result.value,
                "status": stage.result.status.value,
                **collect_attributes(stage.result, "iterations", "seconds"),
            }
            for stage in result.stages
        ],
        **report.as_dict(),
    }
