"""Options shared by commands, and the objects built from them: numbers, robots, problems and weights."""

import inspect
from collections.abc import Callable, Mapping
from dataclasses import astuple, dataclass, fields, replace
from functools import partial, wraps
from pathlib import Path
from typing import Annotated, Any, cast, get_type_hints

import numpy as np
import typer

from orthocas.bases.family import Parametrisation, parse_parametrisation
from orthocas.cli.output import note
from orthocas.errors import InvalidValueError, OptionError, UnknownNameError
from orthocas.fitting.terms import DEFAULT_WEIGHTS, Angles, Weights
from orthocas.robots.collisions import Collisions
from orthocas.robots.robot import Robot
from orthocas.robots.urdf import find_robot_file, list_robot_files
from orthocas.tasks.corridor import RADIUS
from orthocas.tasks.domains import default_box
from orthocas.tasks.problem import Problem
from orthocas.tasks.regular_box import regular_box
from orthocas.tasks.task import Task, list_task_kinds
from orthocas.tools.checks import Array
from orthocas.tools.display import listed


def parse_whole_number(text: str) -> int:
    """Parse the value of an option that takes a whole number."""
    try:
        return int(text)
    except ValueError:
        raise typer.BadParameter(f"received {text!r}, expected a whole number") from None


def parse_number(text: str) -> float:
    """Parse the value of an option that takes a number."""
    try:
        return float(text)
    except ValueError:
        raise typer.BadParameter(f"received {text!r}, expected a number") from None


Number = partial(typer.Option, parser=parse_number)
Whole = partial(typer.Option, parser=parse_whole_number)

# Options of several commands; an option of one command is in its signature.

AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object on standard output.")]
Force = Annotated[bool, typer.Option("--force", help="Replace files of the same names that orthocas did not write.")]
ChartPath = Annotated[Path, typer.Argument(metavar="CHART", help="A chart file.")]
ProblemName = Annotated[str, typer.Argument(metavar="PROBLEM|FILE.urdf", help="A named problem or a URDF file.")]
SampleCount = Annotated[
    int | None, Whole("--samples", help="Number of training samples; default: from the problem size.")
]
_LIMIT = 'Largest torque or speed, "50" or "50,40,..." per joint; default: the limits of the robot.'
Limit = Annotated[str | None, typer.Option("--limit", help=_LIMIT)]
# Options that describe a robot and a problem. Each command selects the ones it takes.

ROBOT = ("tip", "lock", "tool", "base", "gravity", "payload")
CHAIN = (*ROBOT, "task", "metric")
DOMAIN = ("centre", "home", "half_width", "least_singular_value")
_TIP = "Tip frame of a robot file, or LEFT,RIGHT; default: the end of its chain."
_LOCK = "Lock a joint of a robot file at a value [rad or m]; repeat for more."
_TOOL = 'Pose of a tool on the tip, "x,y,z" or "x,y,z,roll,pitch,yaw" [m, rad].'
_GRAVITY = (
    'Gravity in the axes of the base of a robot file, "x,y,z" [m/s^2]; default: that of an MJCF file, or 0,0,-9.81.'
)
_PAYLOAD = 'What the tip of a robot file carries: "kg", or "kg,x,y,z" with its centre in the tip frame [m].'
_TASK = f"Task: {', '.join(list_task_kinds())}; AXES such as xy, AXIS x, y or z."
_HOME = "Named posture as centre of the domain, from an MJCF file or the SRDF beside a URDF."
_HALF_WIDTH = 'Half-width of the domain, "0.4" or one per joint [rad or m]; radius of a corridor.'
_LEAST = "Leave positions out of the domain where the task's relative singular value is smaller, such as 0.1."

_SOLIDS = "Check collisions with the solids of this URDF file of the robot, or of a known robot such as panda."
_SRDF = "SRDF file whose disabled pairs are not checked; default: that of the URDF file."

# Options of earlier versions, and their replacements. Commands refuse them with these texts.

FORMER = {
    "--branch": "fit names the branch by --domain branch:NAME; Python asks for one: arm.solve(x, xi, branch=NAME)",
    "--radius": "the radius of a corridor is --half-width",
    "--precision": "the precision is set in Python: oc.fit(precision='single')",
    "--scheduler": "the address of a scheduler is a value of --workers",
    "--sphere": "use --obstacle sphere:X,Y,Z,RADIUS",
    "--capsule": "use --obstacle capsule:X,Y,Z,X,Y,Z,RADIUS",
    "--plane": "use --obstacle plane:NORMAL,POINT, with three numbers each",
    "--gravity": "the gravity of a robot is an option of fit; whether a law compensates gravity: "
    "codegen --gravity-compensation law or robot",
    "--cycles": "a comparison has three cycles; orthocas.viewer.cyclic_motions takes their number",
    "--tool": "a tool changes nothing there; fit takes it",
    "--seed": "the seed of noise is a third number of --noise; of an evaluation, oc.evaluate(chart, seed=2) sets it",
    "--held-out": "the number of held-out samples is set in Python: oc.compare(held_out=1000)",
    "--like": "coordinates that are like something are those of fit",
    "--max-mutual-deg": "the bound is set in Python: oc.fit(max_mutual_deg=2)",
    "--compiled": "set in Python: oc.simulate(compiled=True)",
    "--acceleration-limit": "limits of acceleration are set in Python: oc.follow(acceleration_limits=2)",
    "--open": "open the address that the command prints",
    "--host": "the address to listen at is a value of --port, HOST:PORT",
    "--fastest": "set in Python: oc.control.PDPlus.on_chart(chart, fastest=20)",
    "--compliance": "set in Python: oc.control.PDPlus.on_chart(chart, compliance=1e-4)",
    "--damping-stiffness": "set in Python: oc.control.PDPlus.on_chart(chart, damping_stiffness=50)",
    "--start": "the start of a motion is set in Python: oc.follow(chart, path, q_start=q)",
}


@dataclass(frozen=True)
class ProblemOptions:
    """The command-line options that describe a problem."""

    tip: Annotated[str | None, typer.Option("--tip", help=_TIP)] = None
    lock: Annotated[list[str] | None, typer.Option("--lock", metavar="JOINT=VALUE", help=_LOCK)] = None
    tool: Annotated[str | None, typer.Option("--tool", help=_TOOL)] = None
    base: Annotated[
        str | None, typer.Option("--base", help="Moving base of a robot file: planar, rail:x, floating, ...")
    ] = None
    gravity: Annotated[str | None, typer.Option("--gravity", help=_GRAVITY)] = None
    payload: Annotated[str | None, typer.Option("--payload", help=_PAYLOAD)] = None
    task: Annotated[str | None, typer.Option("--task", help=_TASK)] = None
    metric: Annotated[str | None, typer.Option("--metric", help="Metric: euclidean or inertia.")] = None
    centre: Annotated[str | None, typer.Option("--centre", help='Centre of the domain, "0,0.5,..." [rad or m].')] = None
    home: Annotated[str | None, typer.Option("--home", help=_HOME)] = None
    half_width: Annotated[str | None, typer.Option("--half-width", help=_HALF_WIDTH)] = None
    least_singular_value: Annotated[float | None, Number("--least-singular-value", help=_LEAST)] = None

    def require_none(self, names: tuple[str, ...], reason: str) -> None:
        """Raise OptionError with a reason if one of these options was given."""
        for name in names:
            if getattr(self, name) not in (None, []):
                raise OptionError(f"{reason}: leave out --{name.replace('_', '-')}")

    def require_no_robot(self, owner: str) -> None:
        """Raise OptionError if an option describes a robot, because `owner` already has one."""
        self.require_none(ROBOT, f"{owner} has its own robot")

    def build_robot(self, path: str) -> Robot:
        """Build the robot of a file. Joints that move no tip are locked.

        Raises:
            OrthocasError: if the file or an option is invalid.
        """
        tool = None if self.tool is None else parse_numbers("--tool", self.tool)
        gravity = None if self.gravity is None else parse_numbers("--gravity", self.gravity)
        tips = [name.strip() for name in (self.tip or "").split(",") if name.strip()]
        build = Robot.from_name if is_robot_name(path) else Robot.from_file
        robot = build(path, None, self.parse_locks(), tool, tips=tips, base=self.base, gravity=gravity)
        if self.payload is None:
            return robot
        carried = parse_numbers("--payload", self.payload)
        return robot.with_payload(carried[0] if len(carried) == 1 else carried)

    def build_problem(self, name: str) -> Problem:
        """Build a named problem, or the problem of a robot file.

        Raises:
            UnknownNameError: if `name` is neither a named problem nor a robot file.
            OrthocasError: if the options are invalid or do not fit together.
        """
        # This builds arms, which commands on charts do not need.
        from orthocas import problems

        if is_robot_file(name):
            robot = self.build_robot(name)
            task = Task.named(robot, self.task or "position")
            centre, half_width, box = self.find_centre(robot), self.parse_half_width(), None
            if centre is not None or half_width is not None:
                centre = regular_box(robot, task).centre if centre is None else centre
                box = default_box(robot, centre, half_width)
            return Problem(robot, task, self.metric or "euclidean", box, Path(name).stem, self.least_singular_value)
        if name not in problems.names():
            raise UnknownNameError("problem or robot", name, (*problems.names(), *list_robot_files(), "or a FILE.urdf"))
        # Start from a named problem, and apply the options.
        base: Problem = problems.get(name)
        if all(value in (None, []) for value in astuple(self)):
            return base
        self.require_no_robot(f"the named problem '{name}'")
        centre, half_width, domain = self.find_centre(base.robot), self.parse_half_width(), base.domain
        if centre is not None or half_width is not None:
            domain = default_box(base.robot, base.domain.centre if centre is None else centre, half_width)
        task = base.task if self.task is None else Task.named(base.robot, self.task)
        metric = base.metric if self.metric is None else self.metric
        return Problem(base.robot, task, metric, domain, name, self.least_singular_value)

    def parse_locks(self) -> dict[str, float]:
        """The joints and values of --lock."""
        locked = {}
        for word in self.lock or ():
            joint, equals, value = word.rpartition("=")
            if not (joint and equals):
                raise InvalidValueError("--lock", word, "JOINT=VALUE")
            locked[joint] = float(parse_numbers(f"--lock {joint}", value)[0])
        return locked

    def find_centre(self, robot: Robot) -> Array | None:
        """The centre from --centre or --home; None without either option."""
        if self.home is None:
            return None if self.centre is None else parse_numbers("--centre", self.centre)
        if self.centre is not None:
            raise OptionError("--home and --centre both give the centre of the domain: leave out one")
        return robot.home(self.home)

    def parse_half_width(self) -> Array | float | None:
        """One number for all joints, or one per joint."""
        return None if self.half_width is None else parse_one_or_all("--half-width", self.half_width)


@dataclass(frozen=True)
class SolidOptions:
    """Options for the solids of a robot and for the pairs that are not checked."""

    collisions: Annotated[str | None, typer.Option("--collisions", metavar="FILE.urdf|NAME", help=_SOLIDS)] = None
    srdf: Annotated[Path | None, typer.Option("--srdf", help=_SRDF)] = None

    def add_to(self, robot: Robot) -> Robot:
        """The robot with these solids, or the same robot without these options.

        Raises:
            OptionError: for --srdf alone.
            RobotError: if a file cannot be read, or belongs to another robot.
        """
        if self.collisions is None:
            if self.srdf is not None:
                raise OptionError("--srdf requires --collisions FILE.urdf with the solids")
            return robot
        path = find_robot_file(self.collisions) if is_robot_name(self.collisions) else Path(self.collisions)
        solid = robot.with_solids(path, self.srdf)
        if missing := solid.collisions.missing:
            note(f"nothing is known of {listed(missing)}: no mesh in {path}, so contacts with it go unseen")
        return solid

    def build_model(self, robot: Robot) -> Collisions | None:
        """The collision model from the options; None without them. Raises errors as in `add_to`."""
        solid = self.add_to(robot)
        return None if solid is robot else solid.collisions


def is_robot_file(name: str) -> bool:
    """Whether a PROBLEM argument is a robot: a robot file, or a name that an installed package knows."""
    return Path(name).suffix.lower() in (".urdf", ".xml", ".xacro") or is_robot_name(name)


def is_robot_name(name: str) -> bool:
    """Whether a PROBLEM argument is neither a file nor a problem, but a robot that `Robot.from_name` knows."""
    # This builds arms, which commands on files do not need.
    from orthocas import problems

    plain = Path(name).name == name and not Path(name).suffix and name not in problems.names()
    return plain and name in list_robot_files() and not Path(name).exists()


def spread(parameter: str, kind: type, *names: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """A decorator of commands: replaces one parameter by options, one for each (named) field of a dataclass."""
    hints = get_type_hints(kind, include_extras=True)
    options = {
        field.name: (hints[field.name], field.default) for field in fields(kind) if not names or field.name in names
    }
    return spread_options(parameter, options, lambda values: kind(**values))


def spread_options(
    parameter: str, options: Mapping[str, tuple[Any, Any]], build: Callable[[dict[str, Any]], Any]
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """A decorator of commands: replaces one parameter by options.

    Args:
        parameter: name of the parameter.
        options: name -> annotation and default of an option.
        build: computes the parameter from the values of the options.
    """

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        parameters: list[inspect.Parameter] = []
        for part in inspect.signature(command).parameters.values():
            if part.name != parameter:
                parameters.append(part.replace(kind=part.KEYWORD_ONLY))
                continue
            for name, (annotation, default) in options.items():
                parameters.append(inspect.Parameter(name, part.KEYWORD_ONLY, default=default, annotation=annotation))

        @wraps(command)
        def call(**values: Any) -> None:
            own = {name: values.pop(name) for name in options}
            command(**{parameter: build(own)}, **values)

        # typer reads both attributes.
        vars(call)["__signature__"] = inspect.Signature(parameters)
        call.__annotations__ = {part.name: part.annotation for part in parameters}
        return call

    return decorate


def parse_numbers(option: str, text: str, count: int | None = None) -> Array:
    """Parse "0,0.5,...", with `count` numbers if it is given."""
    words = [part.strip() for part in text.split(",")]
    try:
        numbers = np.array([float(word) for word in words])
    except ValueError:
        raise InvalidValueError(option, words, "an array of numbers") from None
    if count is not None and len(numbers) != count:
        raise InvalidValueError(option, repr(text)[:80], f"{'two' if count == 2 else count} numbers")
    return numbers


def parse_one_or_all(option: str, text: str) -> Array | float:
    """Read "100" as a number, "100,50" as an array."""
    numbers = parse_numbers(option, text)
    return float(numbers[0]) if len(numbers) == 1 else numbers


_WEIGHTS = ("task", "mutual", "regularity", "length", "folds")
WEIGHTS_TEXT = ",".join(f"{getattr(DEFAULT_WEIGHTS, name):g}" for name in _WEIGHTS)


def parse_weights(text: str, angles: str | None) -> Weights:
    """Parse two to five numbers, then terms by name, such as "1000,30,quiet=5", with the kind of angles."""
    words = [word.strip() for word in text.split(",")]
    numbers = [float(value) for word in words if "=" not in word for value in parse_numbers("--weights", word)]
    if not (2 <= len(numbers) <= 5 or (not numbers and text)):
        raise InvalidValueError("--weights", repr(text), "two to five numbers, and NAME=NUMBER for terms of your own")
    extra = {}
    for name, _, value in (word.partition("=") for word in words if "=" in word):
        extra[name.strip()] = float(parse_numbers(f"--weights {name}", value)[0])
    return replace(Weights.of(numbers) if numbers else Weights(), extra=extra, angles=cast(Angles | None, angles))


AUTO, BRANCH, ALL = "auto", "branch", "all"  #: keywords of --domain
# Further terms gain little in a corridor.
_IN_CORRIDOR = "polynomial:3:cyclic"
_PARAM = (
    "Parametrisation: polynomial:5, polynomial:5:cyclic, polynomial:4:joints=2, fourier:2, mlp:64x64, mlp:64x64:raw, "
    "linear or sew; default: polynomial:5, or polynomial:4 for more than seven joints; polynomial:3:cyclic with "
    "--corridor; what is regular on the branch with --domain branch."
)
_SOLVER = "gauss_newton, quasi_newton, lbfgs, ipopt, adam or gradient_flow; default: what suits the parametrisation."
_DOMAIN = (
    "auto: the widest box around the home on which the fit keeps --leak-deg and --conditioning; branch: all of the "
    "home's branch of the joint range (a wide chart); branch:NAME: of another one, see orthocas info --branches; all: "
    "a chart of every branch, in an arm file for orthocas solve and oc.Arm."
)
_LIKE = "What the first coordinates are like: a joint or swivel; several: NAME,NAME."
_EXACT = "With --domain branch: they are what --like says itself, on the part of the branch where that can be."
_CORRIDOR = (
    "Domain: the surroundings of a path of postures, one a line, with the joint names in the first line; their radius "
    f"is --half-width [rad], default {RADIUS:g}."
)
_LEAK = "Largest leak for --domain auto [deg]; default 8."
_CONDITIONING = "Smallest conditioning for --domain auto; default 0.2."
_LOSS = (
    '"lambda1,lambda2", up to lambda5; "NAME=WEIGHT" for terms of your own. With --domain branch the first two weigh '
    "leaks and mutual angles, and its own weights are the default."
)
_ANGLES = (
    "Angles in the loss: paper (Euclidean norms) or metric; default: metric with --metric inertia and for tasks that "
    "turn the tool."
)
_AVOID = "With --domain branch: be regular where the robot does not hit itself, by the solids of this file."


@dataclass(frozen=True)
class FitOptions(SolidOptions):
    """Options of a fit, in addition to those of its problem."""

    param: Annotated[str | None, typer.Option("--param", help=_PARAM)] = None
    solver: Annotated[str | None, typer.Option("--solver", help=_SOLVER)] = None
    domain: Annotated[str | None, typer.Option("--domain", help=_DOMAIN)] = None
    like: Annotated[str | None, typer.Option("--like", help=_LIKE)] = None
    exact: Annotated[bool, typer.Option("--exact", help=_EXACT)] = False
    corridor: Annotated[Path | None, typer.Option("--corridor", metavar="POSTURES.csv", help=_CORRIDOR)] = None
    leak_deg: Annotated[float | None, Number("--leak-deg", help=_LEAK)] = None
    conditioning: Annotated[float | None, Number("--conditioning", help=_CONDITIONING)] = None
    samples: SampleCount = None
    seed: Annotated[int, Whole("--seed", help="Seed of the samples and of random starts.")] = 0
    weights: Annotated[str, typer.Option("--weights", help=_LOSS)] = WEIGHTS_TEXT
    angles: Annotated[str | None, typer.Option("--angles", help=_ANGLES)] = None
    collisions: Annotated[str | None, typer.Option("--collisions", metavar="FILE.urdf|NAME", help=_AVOID)] = None

    @property
    def parametrisation(self) -> Parametrisation | None:
        """The parametrisation of --param, or the default of a corridor."""
        param = _IN_CORRIDOR if self.param is None and self.corridor is not None else self.param
        return None if param is None else parse_parametrisation(param)

    @property
    def quantities(self) -> str | list[str] | None:
        """The name or the names of --like."""
        names = [word.strip() for word in (self.like or "").split(",")]
        return None if self.like is None else names[0] if len(names) == 1 else names

    @property
    def wide_weights(self) -> Weights | Mapping[str, float] | None:
        """Weights of a wide fit. Numbers replace its own weights; terms by name alone are added to them."""
        numbers = self.weights != WEIGHTS_TEXT and any("=" not in word for word in self.weights.split(","))
        if self.angles is not None and not numbers:
            raise OptionError(
                "--angles requires the numbers of --weights with --domain branch, such as --weights 12,0.3"
            )
        if self.weights == WEIGHTS_TEXT:
            return None
        weights = parse_weights(self.weights, self.angles)
        return weights if numbers else weights.extra

    def parse_domain(self) -> tuple[str, str]:
        """The kind of a domain and the name of its branch; raises OptionError for options of another kind of domain."""
        kind, _, branch = (self.domain or "").partition(":")
        if self.domain is not None and self.corridor is not None:
            raise OptionError("--corridor defines the domain: leave out --domain")
        if kind != AUTO:
            for option, value in (("leak-deg", self.leak_deg), ("conditioning", self.conditioning)):
                if value is not None:
                    raise OptionError(f"--{option} requires --domain auto")
        if self.domain not in (None, AUTO) and kind != BRANCH:
            want = "auto, branch, branch:NAME, all, or --centre and --half-width for a box of your own"
            raise InvalidValueError("--domain", repr(self.domain), want)
        if kind != BRANCH and (self.collisions, self.srdf) != (None, None):
            raise OptionError("--collisions requires --domain branch")
        if self.exact and (kind != BRANCH or self.like is None):
            raise OptionError("--exact requires --domain branch and --like")
        if kind == BRANCH and self.solver is not None:
            raise OptionError("--domain branch uses its own solver: leave out --solver")
        return kind, branch.strip()
