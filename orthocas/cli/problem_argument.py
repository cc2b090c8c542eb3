"""Arguments that describe a problem: a name or a robot file, task, metric, domain, weights."""

import warnings
from collections.abc import Callable
from dataclasses import astuple, dataclass, replace
from pathlib import Path
from typing import Annotated, Any, cast

import numpy as np
import typer

from orthocas import problems
from orthocas.bases.family import Parametrisation
from orthocas.cli.output import number, parse_whole_number, spread
from orthocas.errors import BranchWarning, InvalidValueError, OptionError, UnknownNameError
from orthocas.fitting.probe import Bounds
from orthocas.fitting.suggest_domain import DomainSuggestion, suggest_domain
from orthocas.fitting.terms import DEFAULT_WEIGHTS, Angles, Weights
from orthocas.fitting.wide import CLEARANCE, WideFit, fit_wide
from orthocas.robots.robot import Robot
from orthocas.tasks.domains import default_box
from orthocas.tasks.metric import Metric
from orthocas.tasks.problem import Problem
from orthocas.tasks.regular_box import regular_box
from orthocas.tasks.task import Task, list_task_kinds
from orthocas.tools.checks import Array
from orthocas.tools.progress import Monitor

_OPTIONS: dict[str, Any] = {
    "tip": Annotated[
        str | None,
        typer.Option("--tip", help="Tip frame of a robot file, or LEFT,RIGHT; default: the end of its chain."),
    ],
    "base": Annotated[
        str | None,
        typer.Option("--base", help="Moving base of a robot file: planar, rail:x, floating, ..."),
    ],
    "lock": Annotated[
        list[str] | None,
        typer.Option(
            "--lock", metavar="JOINT=VALUE", help="Lock a joint of a robot file at a value [rad or m]; repeat for more."
        ),
    ],
    "tool": Annotated[
        str | None,
        typer.Option("--tool", help='Pose of a tool on the tip, "x,y,z" or "x,y,z,roll,pitch,yaw" [m, rad].'),
    ],
    "gravity": Annotated[
        str | None,
        typer.Option(
            "--gravity",
            help='Gravity in the axes of the base of a robot file, "x,y,z" [m/s^2]; default: that of an MJCF file, '
            "or 0,0,-9.81.",
        ),
    ],
    "task": Annotated[
        str | None,
        typer.Option("--task", help=f"Task: {', '.join(list_task_kinds())}; AXES such as xy, AXIS x, y or z."),
    ],
    "metric": Annotated[str | None, typer.Option("--metric", help="Metric: euclidean or inertia.")],
    "centre": Annotated[str | None, typer.Option("--centre", help='Centre of the domain, "0,0.5,..." [rad or m].')],
    "home": Annotated[
        str | None,
        typer.Option(
            "--home", help="Named posture as centre of the domain, from an MJCF file or the SRDF beside a URDF."
        ),
    ],
    "half_width": Annotated[
        str | None, typer.Option("--half-width", help='Half-width of the domain, "0.4" or one per joint [rad or m].')
    ],
    "least_singular_value": Annotated[
        float | None,
        typer.Option(
            "--least-singular-value",
            parser=number,
            help="Leave positions out of the domain where the task's relative singular value is smaller, such as 0.1.",
        ),
    ],
}  #: command-line options of the fields of `ProblemOptions`
ROBOT = ("tip", "lock", "tool", "base", "gravity")
CHAIN = (*ROBOT, "task", "metric")
DOMAIN = ("centre", "home", "half_width")
_NUMBERS = ("task", "mutual", "regularity", "length", "folds")

ProblemName = Annotated[str, typer.Argument(metavar="PROBLEM|FILE.urdf", help="A named problem or a URDF file.")]
DomainText = Annotated[
    str | None,
    typer.Option(
        "--domain",
        help="auto: the widest box around the home on which the fit keeps --leak-deg and --conditioning; "
        "branch: all of a branch of the joint range (a wide chart).",
    ),
]
BranchName = Annotated[
    str | None,
    typer.Option("--branch", help="A branch by its name, see orthocas info --branches; default: that of the home."),
]
LikeName = Annotated[
    str | None,
    typer.Option("--like", help="What the first coordinates are like: a joint or swivel; several: NAME,NAME."),
]
BRANCH = "branch"  #: the word of --domain for wide charts


@dataclass(frozen=True)
class ProblemOptions:
    """The command-line options that describe a problem."""

    tip: str | None = None
    lock: tuple[str, ...] = ()
    tool: str | None = None
    base: str | None = None
    gravity: str | None = None
    task: str | None = None
    metric: str | None = None
    centre: str | None = None
    home: str | None = None
    half_width: str | None = None
    least_singular_value: float | None = None

    def given(self) -> bool:
        """Whether any option was given."""
        return any(value not in (None, ()) for value in astuple(self))

    def require_no_robot(self, owner: str) -> None:
        """Raise OptionError if an option describes a robot, because `owner` has its own."""
        for option in ROBOT:
            if getattr(self, option):
                raise OptionError(f"{owner} has its own robot: leave out --{option}")


def parse_whole_number(*names: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """A decorator of commands: options of these names take the place of the parameter `words`, a `ProblemOptions`."""
    options = {name: _OPTIONS[name] for name in names}
    return spread("words", options, lambda given: ProblemOptions(**{**given, "lock": tuple(given.get("lock") or ())}))


def is_robot_file(name: str) -> bool:
    """Whether a PROBLEM argument means a robot file."""
    return Path(name).suffix.lower() in (".urdf", ".xml", ".xacro")


def build_robot(path: str, options: ProblemOptions) -> Robot:
    """Build the joints that a command line describes. Those that move no tip are locked.

    Raises:
        OrthocasError: if anything does not fit together.
    """
    tool = None if options.tool is None else parse_numbers("--tool", options.tool)
    gravity = None if options.gravity is None else parse_numbers("--gravity", options.gravity)
    tips = [name.strip() for name in (options.tip or "").split(",") if name.strip()]
    locked = locked_joints(options.lock)
    return Robot.from_file(path, None, locked, tool, tips=tips, base=options.base, gravity=gravity)


def build_problem(name: str, options: ProblemOptions) -> Problem:
    """Build the problem that a command line describes.

    Raises:
        UnknownNameError: if `name` is neither a named problem nor a robot file.
        OrthocasError: if anything does not fit together.
    """
    if is_robot_file(name):
        return _from_file(name, options)
    if name not in problems.names():
        raise UnknownNameError("problem", name, (*problems.names(), "or a FILE.urdf"))
    base: Problem = problems.get(name)
    if not options.given():
        return base
    options.require_no_robot(f"the named problem '{name}'")
    centre, half_width = chosen_centre(base.robot, options), _half_width(options)
    domain = base.domain
    if centre is not None or half_width is not None:
        domain = default_box(base.robot, base.domain.centre if centre is None else centre, half_width)
    task = base.task if options.task is None else Task.named(base.robot, options.task)
    metric = base.metric if options.metric is None else options.metric
    return Problem(base.robot, task, metric, domain, name, options.least_singular_value)


def parse_numbers(option: str, text: str) -> Array:
    """Parse "0,0.5,..."."""
    words = [part.strip() for part in text.split(",")]
    try:
        return np.array([float(word) for word in words])
    except ValueError:
        raise InvalidValueError(option, words, "an array of numbers") from None


def _from_file(name: str, options: ProblemOptions) -> Problem:
    robot = build_robot(name, options)
    task = Task.named(robot, "position" if options.task is None else options.task)
    centre = chosen_centre(robot, options)
    centre = regular_box(robot, task).centre if centre is None else centre
    domain = default_box(robot, centre, _half_width(options))
    metric = "euclidean" if options.metric is None else options.metric
    return Problem(robot, task, metric, domain, Path(name).stem, options.least_singular_value)


def chosen_centre(robot: Robot, options: ProblemOptions) -> Array | None:
    """The centre that --centre or --home gives; None without either."""
    if options.home is None:
        return None if options.centre is None else parse_numbers("--centre", options.centre)
    if options.centre is not None:
        raise OptionError("--home and --centre both give the centre of the domain: leave out one")
    return robot.home(options.home)


def _half_width(options: ProblemOptions) -> Array | None:
    """One number for all joints, or one per joint."""
    if options.half_width is None:
        return None
    numbers = parse_numbers("--half-width", options.half_width)
    return numbers[0] if len(numbers) == 1 else numbers


def locked_joints(words: tuple[str, ...]) -> dict[str, float]:
    """Parse "joint=value" words."""
    locked = {}
    for word in words:
        joint, equals, value = word.rpartition("=")
        if not (joint and equals):
            raise InvalidValueError("--lock", word, "JOINT=VALUE")
        locked[joint] = float(parse_numbers(f"--lock {joint}", value)[0])
    return locked


SampleCount = Annotated[
    int | None,
    typer.Option(
        "--samples", parser=parse_whole_number, help="Number of training samples; default: from the problem size."
    ),
]
WeightsText = Annotated[
    str, typer.Option("--weights", help='"lambda1,lambda2", up to lambda5; "NAME=WEIGHT" for terms of your own.')
]
AnglesName = Annotated[
    str | None,
    typer.Option(
        "--angles",
        help="Angles in the loss: paper (Euclidean norms) or metric; default: metric with --metric inertia and for "
        "tasks that turn the tool.",
    ),
]
PrecisionName = Annotated[
    str,
    typer.Option(
        "--precision", help="Of the large products of a fit: double, or single, which is faster and takes less memory."
    ),
]
WEIGHTS_TEXT = ",".join(f"{getattr(DEFAULT_WEIGHTS, name):g}" for name in _NUMBERS)


def parse_weights(text: str, angles: str | None) -> Weights:
    """Read two to five numbers and terms by name, such as "1000,30,quiet=5", with the kind of angles."""
    words = [word.strip() for word in text.split(",")]
    numbers = [float(value) for word in words if "=" not in word for value in parse_numbers("--weights", word)]
    if not (2 <= len(numbers) <= 5 or (not numbers and text)):
        raise InvalidValueError("--weights", repr(text), "two to five numbers, and NAME=NUMBER for terms of your own")
    extra = {}
    for name, _, value in (word.partition("=") for word in words if "=" in word):
        extra[name.strip()] = float(parse_numbers(f"--weights {name}", value)[0])
    return replace(Weights.of(numbers) if numbers else Weights(), extra=extra, angles=cast(Angles | None, angles))


def suggested(
    name: str,
    options: ProblemOptions,
    parametrisation: Parametrisation | None,
    bounds: Bounds,
    weights: Weights,
    seed: int,
    monitor: Monitor,
) -> tuple[Problem, DomainSuggestion]:
    """Build the problem of `--domain auto`, and the suggestion that its domain comes from.

    Raises:
        UnknownNameError: if `name` is neither a named problem nor a robot file.
        OrthocasError: if anything does not fit together.
    """
    if options.half_width is not None:
        raise OptionError("--domain auto finds the half-width: leave out --half-width")
    if options.least_singular_value is not None:
        raise OptionError("--domain auto stays clear of singular postures: leave out --least-singular-value")
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
        weights=weights,
        seed=seed,
        monitor=monitor,
    )
    return Problem(robot, task, metric, found.domain, Path(name).stem if base is None else base.name), found


def wide_fit(
    name: str,
    options: ProblemOptions,
    branch: str | None,
    like: str | None,
    parametrisation: Parametrisation | None,
    samples: int | None,
    seed: int,
    monitor: Monitor,
) -> WideFit:
    """Fit the wide chart of `--domain branch`.

    Raises:
        UnknownNameError: if `name` is neither a named problem nor a robot file.
        OrthocasError: if anything does not fit together.
    """
    for option in ("centre", "half_width"):
        if getattr(options, option) is not None:
            raise OptionError(f"--domain branch is a domain: leave out --{option.replace('_', '-')}")
    base = None if is_robot_file(name) else build_problem(name, replace(options, least_singular_value=None))
    robot = build_robot(name, options) if base is None else base.robot
    known = options.least_singular_value
    quantities = None if like is None else [word.strip() for word in like.split(",")]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", BranchWarning)  # commands print a note
        return fit_wide(
            robot,
            Task.named(robot, options.task or "position") if base is None else base.task,
            branch,
            (options.metric or "euclidean") if base is None else base.metric,
            clearance=CLEARANCE if known is None else known,
            parametrisation=parametrisation,
            home=options.home if base is None else base.domain.centre if branch is None else None,
            like=quantities[0] if quantities and len(quantities) == 1 else quantities,
            samples=samples,
            seed=seed,
            monitor=monitor,
        )
