"""`orthocas fit`: from a robot to a chart file."""

import time
import warnings
from collections.abc import Mapping
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Annotated, Any

import typer

from orthocas.bases.family import Parametrisation
from orthocas.charts.chart_file import CHART
from orthocas.charts.quality import Report, evaluate
from orthocas.cli.options import (
    ALL,
    AUTO,
    BRANCH,
    CHAIN,
    DOMAIN,
    AsJson,
    FitOptions,
    Force,
    ProblemName,
    ProblemOptions,
    is_robot_file,
    parse_weights,
    spread,
)
from orthocas.cli.output import (
    build_reach_data,
    format_reach_rows,
    format_report_rows,
    note,
    print_json,
    print_rows,
    terminal_monitor,
)
from orthocas.control.gains import find_holding_doubts
from orthocas.errors import BranchWarning, Interrupted, InvalidValueError, OptionError
from orthocas.fitting.fit import Fit
from orthocas.fitting.fit import fit as fit_chart
from orthocas.fitting.stages import choose_parametrisation
from orthocas.fitting.suggest_domain import CONDITIONING, LEAK_DEG, DomainSuggestion, suggest_domain
from orthocas.fitting.terms import Weights
from orthocas.fitting.wide import CLEARANCE, WideFit, fit_wide
from orthocas.paths.chart_along import corridor_problem
from orthocas.robots.robot import Robot
from orthocas.solvers import get as get_solver
from orthocas.solvers.protocol import Status
from orthocas.tasks.corridor import RADIUS, read_postures
from orthocas.tasks.metric import Metric
from orthocas.tasks.problem import Problem
from orthocas.tasks.task import Task
from orthocas.tools.archive import require_free
from orthocas.tools.display import listed, number_list, percent
from orthocas.tools.interrupts import INTERRUPTED
from orthocas.tools.json import clean, collect_attributes
from orthocas.tools.progress import Monitor

# facts of wide fits to print
_WIDE_ROWS = ("regular", "left out", "least leak", "meaning")


@spread("words", ProblemOptions, *CHAIN, *DOMAIN)
@spread("options", FitOptions)
def fit(
    problem: ProblemName,
    words: ProblemOptions,
    options: FitOptions,
    out: Annotated[
        Path | None, typer.Option("--out", help="Chart file; default: PROBLEM.orthocas in the current folder.")
    ] = None,
    force: Force = False,
    json: AsJson = False,
) -> None:
    """Fit extra coordinates to a problem and save the chart."""
    if options.domain == ALL:
        _fit_arm(problem, words, options, out, force, json)
        return
    # Check arguments before anything takes time.
    kind, branch = options.parse_domain()
    built = None if kind else _build_problem(problem, words, options.corridor)
    target = out or Path(f"{Path(problem).stem if built is None else built.name}.orthocas")
    require_free(target, CHART, force)
    parametrisation, like = options.parametrisation, options.quantities
    solver = None if options.solver is None else get_solver(options.solver)
    loss = parse_weights(options.weights, options.angles)
    wide_loss = options.wide_weights if kind == BRANCH else None

    suggestion, result = None, None
    try:
        with terminal_monitor() as monitor:
            if kind == AUTO:
                built, suggestion = _suggest_problem(problem, words, options, parametrisation, loss, monitor)
                # Reuse the fit that confirmed the domain if it has the requested family.
                default = choose_parametrisation(built, True) == choose_parametrisation(built, False)
                same = parametrisation is not None or default
                if same and (solver, options.samples, like) == (None,) * 3:
                    result = replace(suggestion.fit, chart=replace(suggestion.fit.chart, problem=built))
            elif kind == BRANCH:
                result = _fit_wide(problem, words, options, branch, parametrisation, wide_loss, monitor)
            if result is None:
                assert built is not None
                result = fit_chart(
                    built,
                    parametrisation,
                    solver,
                    weights=loss,
                    samples=options.samples,
                    seed=options.seed,
                    monitor=monitor,
                    like=like,
                )
    except Interrupted as stop:
        result = stop.result
    _save_and_report(result, suggestion, target, options.seed, force, json)


def _fit_arm(name: str, words: ProblemOptions, options: FitOptions, out: Path | None, force: bool, json: bool) -> None:
    """Fit a chart to every branch, and write and print the arm."""
    # Imports all modules for arms, which other fits do not need.
    from orthocas.arms.arm import Arm
    from orthocas.arms.arm_file import ARM

    plain = FitOptions(domain=options.domain, seed=options.seed)
    if given := [part.name for part in fields(plain) if getattr(plain, part.name) != getattr(options, part.name)]:
        raise OptionError(f"--domain all chooses this itself: leave out --{given[0].replace('_', '-')}")
    words.require_none(("centre", "half_width", "home", "least_singular_value"), "--domain all is all there is")
    # Check arguments before anything takes time.
    target = out or Path(f"{Path(name).stem}.arm")
    require_free(target, ARM, force)
    base = None if is_robot_file(name) else words.build_problem(name)
    robot, task, metric = _build_parts(name, replace(words, task=words.task or "pose"), base)
    begin = time.perf_counter()
    with terminal_monitor() as monitor:
        arm = Arm.fit(robot, task, metric, seed=options.seed, monitor=monitor)
    seconds = time.perf_counter() - begin
    arm.save(target, force)
    if json:
        shares = [clean(chart.notes.get("share of the branch")) for chart in arm.charts]
        branches = [{"branch": branch, "share": share} for branch, share in zip(arm.branch_names, shares, strict=True)]
        print_json({"arm": str(target), "task": task.name, "branches": branches, "seconds": seconds})
    else:
        rows = {**arm.facts(), "fit": f"{seconds:.1f} s", "file": str(target)}
        print_rows(rows, f"orthocas solve {target} --x ... --xi 0")


def _build_problem(name: str, words: ProblemOptions, corridor: Path | None) -> Problem:
    """The problem of a command line, on a corridor around the postures of a file if one is given."""
    if corridor is None:
        return words.build_problem(name)
    words.require_none(("centre", "home", "least_singular_value"), "--corridor defines the domain")
    radius = words.parse_half_width()
    if radius is not None and not isinstance(radius, float):
        raise InvalidValueError("--half-width", words.half_width, "one number, which is the radius of the corridor")
    problem = replace(words, half_width=None).build_problem(name)
    return corridor_problem(problem, read_postures(corridor, problem.robot), RADIUS if radius is None else radius)


def _suggest_problem(
    name: str,
    words: ProblemOptions,
    options: FitOptions,
    parametrisation: Parametrisation | None,
    weights: Weights,
    monitor: Monitor,
) -> tuple[Problem, DomainSuggestion]:
    """The problem of `--domain auto`, and the domain suggestion that it comes from."""
    words.require_none(("half_width",), "--domain auto finds the half-width")
    words.require_none(("least_singular_value",), "--domain auto stays clear of singular postures")
    # Take a named problem, or the problem that the options describe for a robot file.
    base = None if is_robot_file(name) else words.build_problem(name)
    robot, task, metric = _build_parts(name, words, base)
    home = words.home or (words.find_centre(robot) if base is None else base.domain.home)
    suggestion = suggest_domain(
        robot,
        task,
        home,
        metric,
        leak_deg=LEAK_DEG if options.leak_deg is None else options.leak_deg,
        conditioning=CONDITIONING if options.conditioning is None else options.conditioning,
        parametrisation=parametrisation,
        weights=weights,
        seed=options.seed,
        monitor=monitor,
    )
    return Problem(robot, task, metric, suggestion.domain, Path(name).stem if base is None else base.name), suggestion


def _fit_wide(
    name: str,
    words: ProblemOptions,
    options: FitOptions,
    branch: str,
    parametrisation: Parametrisation | None,
    weights: Weights | Mapping[str, float] | None,
    monitor: Monitor,
) -> WideFit:
    """Fit the wide chart of `--domain branch`; without a name, the branch is that of the home."""
    words.require_none(("centre", "half_width"), "--domain branch defines the domain")
    base = None if is_robot_file(name) else replace(words, least_singular_value=None).build_problem(name)
    robot, task, metric = _build_parts(name, words, base)
    solid = options.add_to(robot)
    # Rebuild the task on the robot with solids.
    task = task if solid is robot else Task.from_recipe(solid, task.recipe)
    centre = None if base is None or branch else base.domain.home
    with warnings.catch_warnings():
        # Commands print a note instead.
        warnings.simplefilter("ignore", BranchWarning)
        return fit_wide(
            solid,
            task,
            branch or None,
            metric,
            clearance=CLEARANCE if words.least_singular_value is None else words.least_singular_value,
            parametrisation=parametrisation,
            collisions=options.collisions is not None,
            home=words.home if base is None else centre,
            like=options.quantities,
            exact=options.exact or None,
            weights=weights,
            samples=options.samples,
            seed=options.seed,
            monitor=monitor,
        )


def _build_parts(name: str, words: ProblemOptions, base: Problem | None) -> tuple[Robot, Task, Metric | str]:
    """Robot, task and metric of a named problem, or those described by the options for a robot file."""
    if base is not None:
        return base.robot, base.task, base.metric
    robot = words.build_robot(name)
    return robot, Task.named(robot, words.task or "position"), words.metric or "euclidean"


def _save_and_report(
    result: Fit, suggestion: DomainSuggestion | None, target: Path, seed: int, force: bool, json: bool
) -> None:
    """Save the chart, print its quality, and exit with the code of Ctrl-C if that ended the fit."""
    if isinstance(result, WideFit) and result.left_out:
        note(f"the chart of branch '{result.chart.notes['branch']}' leaves out {result.left_out}")
    fitted = result.chart.problem
    for doubt in find_holding_doubts(fitted.robot, fitted.domain, fitted.robot.effort_limits):
        note(doubt)
    result.chart.save(target, force)
    report = evaluate(result.chart, seed=seed + 1)
    if json:
        print_json(_describe_fit(result, report, target, suggestion))
    else:
        rows = _format_fit(result, report, target)
        if suggestion is not None:
            # Show what limits the domain in each joint.
            rows["home"] = f"{number_list(suggestion.home)} ({suggestion.home_source})"
            rows |= {end.joint: f"half-width {end.half_width:.3g}, {end.explanation}" for end in suggestion.joints}
        print_rows(rows, f"orthocas view {target}")
    if result.status is Status.INTERRUPTED:
        note("interrupted: the chart holds the best coordinates found so far")
        raise typer.Exit(INTERRUPTED)


def _format_fit(result: Fit, report: Report, target: Path) -> dict[str, str]:
    """The rows that a fit prints."""
    coordinates, robot = result.chart.coordinates, result.chart.problem.robot
    rows = format_report_rows(report, result.chart)
    rows["robot"] = f"{robot.n} joints, {'tip' if len(robot.tips) == 1 else 'tips'} {listed(robot.tips)}"
    if not isinstance(result, WideFit):
        rows |= result.chart.problem.domain.describe_condition()
    # Adam follows a schedule, so reaching its last step is no failure.
    planned = result.status is Status.ITERATION_LIMIT and result.chart.notes.get("solver") == "adam"
    ended = "all steps made" if planned else result.status.value
    rows["fit"] = f"{coordinates.label}, {result.seconds:.2f} s, {ended}"
    if isinstance(result, WideFit):
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
        jumps = percent(check.half_turn_share, 2, fault=True)
        rows["half a turn"] = f"x of the task jumps on {jumps} of the domain: half a turn from its reference"
    if offer is not None:
        bound, kept = offer.least_singular_value, percent(offer.share)
        rows["clear part"] = f"--least-singular-value {bound:g} leaves out singular positions and keeps {kept}"
    return {**rows, **format_reach_rows(result.chart), "chart": str(target)}


def _describe_fit(result: Fit, report: Report, target: Path, suggestion: DomainSuggestion | None) -> dict[str, Any]:
    check = result.problem_check
    wide: dict[str, Any] = {}
    if isinstance(result, WideFit):
        named = result.chart.parts.named_coordinates[0].partition(": ")[2]
        wide = {
            "branch": result.branch.name,
            **collect_attributes(result, "regular_share", "left_out", "least_leak"),
            "meaning": None if result.meaning is None else {"like": named, **asdict(result.meaning)},
        }
    return {
        **({} if suggestion is None else {"suggested_domain": suggestion.as_dict()}),
        "chart": str(target),
        "tips": list(result.chart.problem.robot.tips),
        **build_reach_data(result.chart),
        "parametrisation": result.chart.coordinates.label,
        "status": result.status.value,
        "seconds": result.seconds,
        "idle_joints": list(result.idle_joints),
        **wide,
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
