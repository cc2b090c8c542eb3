"""Builds the problem of `--domain auto`, whose domain is found by fits."""

from pathlib import Path

from orthocas.checks import Array
from orthocas.cli.problem_argument import ProblemOptions, build_problem, build_robot, chosen_centre, is_robot_file
from orthocas.errors import InvalidValueError
from orthocas.metrics import Metric
from orthocas.minimising.watch import Monitor
from orthocas.parametrisations import Parametrisation
from orthocas.postures.probe import Bounds
from orthocas.postures.suggest import suggest_domain
from orthocas.postures.suggestion import DomainSuggestion
from orthocas.problem import Problem
from orthocas.tasks import Task


def suggested(
    name: str,
    options: ProblemOptions,
    parametrisation: Parametrisation | None,
    bounds: Bounds,
    seed: int,
    monitor: Monitor,
) -> tuple[Problem, DomainSuggestion]:
    """Build the problem of `--domain auto`, and the suggestion that its domain comes from.

    Raises:
        UnknownNameError: if `name` is neither a named problem nor a robot file.
        OrthocasError: if anything does not fit together.
    """
    if options.half_width is not None:
        raise InvalidValueError("--half-width", options.half_width, "none with --domain auto, which finds it")
    if options.least_singular_value is not None:
        given = options.least_singular_value
        raise InvalidValueError("--least-singular-value", given, "none with --domain auto, which stays clear by itself")
    base = None if is_robot_file(name) else build_problem(name, options)
    robot = build_robot(name, options) if base is None else base.robot
    task = Task.named(robot, options.task or "position") if base is None else base.task
    metric: Metric | str = (options.metric or "euclidean") if base is None else base.metric
    home: Array | str | None = chosen_centre(robot, options) if base is None else base.domain.centre
    if options.home is not None:
        home = options.home
    found = suggest_domain(
        robot,
        task,
        home,
        metric,
        leak_deg=bounds.leak_deg,
        conditioning=bounds.conditioning,
        parametrisation=parametrisation,
        seed=seed,
        monitor=monitor,
    )
    return Problem(robot, task, metric, found.domain, Path(name).stem if base is None else base.name), found
