"""What all control laws share: the protocol, names, errors of phi, the guard at the boundary, and status."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any, ClassVar, Literal, Protocol, Self

import casadi as ca
import numpy as np

from orthocas.charts.chart import Chart
from orthocas.control.reference import Reference, joint_path
from orthocas.errors import InvalidValueError
from orthocas.robots.tree import require_driven
from orthocas.tasks.domains import Domain
from orthocas.tasks.problem import Problem
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array, require_kind, require_known
from orthocas.tools.display import Shown, listed, number_list
from orthocas.tools.expressions import wrap_shortest

LARGEST = 1e100  #: larger numbers count as not finite, because their squares may overflow
GUARD = "guard"  #: name of the guard's function
SMALLEST_VOLUME = 1e-3  #: of the parallelepiped of the gradients, relative to its median over the domain


class ControlStatus(IntEnum):
    """Tells whether a command comes from the control law, or why it is the fallback.

    The fallback is the gravity torque for torque controllers and zero for velocity controllers, within the limit. With
    SATURATED it still comes from the law, but the limit cuts it: torques one by one, velocities all by the same
    factor, which keeps the direction of the task.
    """

    OK = 0
    OUTSIDE_DOMAIN = 1
    SINGULAR = 2
    NOT_FINITE = 3
    SATURATED = 4
    NEAR_BOUNDARY = 5  #: this and the following ones come from the supervised law in C
    CAUGHT = 6
    RETURNING = 7
    BAD_INPUT = 8
    TOO_FAST = 9  #: why the catcher took over: a joint was faster than its limit
    LATE = 10  #: why the catcher took over: a tick came too late
    HELD = 11  #: why the catcher took over: brakes held the arm
    STOPPED_EARLY = 12  #: of the inverse map in C: its iterations were not enough
    LOAD_MISMATCH = 13  #: of the check before a start: another torque holds the arm than the model's
    TOUCHED = 14  #: why the catcher took over: the arm felt a contact, or got more energy than it may

    @property
    def words(self) -> str:
        """For example 'near boundary'."""
        return self.name.lower().replace("_", " ")


#: statuses of commands that are not the fallback
FROM_THE_LAW = (ControlStatus.OK, ControlStatus.SATURATED, ControlStatus.NEAR_BOUNDARY)


Command = Literal["torque", "velocity"]


class Controller(Protocol):
    """A control law for a robot and a task."""

    name: ClassVar[str]  #: short name, for example 'pd_plus'
    command: ClassVar[Command]  #: joint torques [N m] or joint velocities [rad/s]

    @property
    def formula(self) -> str:
        """The law in one line, for generated C."""

    @property
    def chart(self) -> Chart | None:
        """The chart whose coordinates the law uses and whose domain it respects; None for laws without a chart."""

    @property
    def problem(self) -> Problem:
        """Robot (the model that the law uses), task, metric and domain."""

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the k controlled quantities, in the order of the reference."""

    @property
    def gains(self) -> dict[str, Array]:
        """Values of the gains by input name."""

    @property
    def gain_units(self) -> Mapping[str, str]:
        """Units and admissible values of the gains, in words, by name."""

    @property
    def settings(self) -> Mapping[str, str]:
        """Choices that are not numbers, for example the coupling."""

    def remarks(self) -> list[str]:
        """Warnings to read before the controller is switched on, as sentences; empty if there are none."""

    @property
    def function(self) -> ca.Function:
        """q, dq (n, 1), reference and two derivatives (k, 1), gains -> command (n, 1), status (1, 1).

        Joints that turn without end count from the domain's centre, so that q and q + 2 pi give the same command.
        """

    @property
    def graph(self) -> ca.Function:
        """The same function as a graph with shared subexpressions, whole turns of joints counted by the caller.

        C is generated from it, and simulations use it.
        """

    @property
    def fallback(self) -> ca.Function:
        """q (n, 1), gains -> command without the law (n, 1): the gravity torque, or zero for velocity controllers."""

    @property
    def energy(self) -> ca.Function | None:
        """The same inputs -> storage V [J] and power dissipated by damping [W]; None for velocity controllers."""

    @property
    def energy_graph(self) -> ca.Function | None:
        """The same function as a graph with shared subexpressions; compiled simulations use it."""

    @property
    def measured(self) -> ca.Function:
        """q (n, 1) -> the controlled quantities (k, 1)."""

    def require_reachable(self, reference: Reference, q_start: Array) -> None:
        """Raise UnreachableReferenceError, with time and place, if the law cannot follow the reference."""


@dataclass(frozen=True)
class Setting:
    """A setting of a law that commands offer as an option.

    Example:
        >>> from orthocas.control import Setting
        >>> Setting("Damping of the joints [N m s/rad]; default: 1.")
        Setting(help='Damping of the joints [N m s/rad]; default: 1.', is_word=False, codegen_only=False)
    """

    help: str  #: what it is, with its unit and default
    is_word: bool = False  #: passed on as text; otherwise it is one number, or several with commas between
    codegen_only: bool = False  #: about inputs that simulations do not give, so `orthocas simulate` does not offer it
    option: str = field(default="", repr=False)  #: its option of commands, if it is not named after the setting


class Law(Controller, Protocol):
    """A controller that can be built by name on a chart, for the command line; see `register`."""

    options: ClassVar[Mapping[str, Setting]]  #: the settings that `on_chart` takes, by name

    @classmethod
    def on_chart(cls, *args: Any, **settings: Any) -> Self:
        """Build the law on a chart, or on the problem of the chart.

        Args:
            args: the chart, and the largest command of each joint, which may be left out or None.
            settings: gains and choices by the names in `options`; those left out take their defaults.
        """


_LAWS: dict[str, type[Law]] = {}


def register(law: type[Law]) -> None:
    """Register a law under its name, so that `orthocas simulate` and `orthocas codegen` can build it on a chart.

    Raises:
        InvalidValueError: if another law has that name.
    """
    # The name must be free, and options must say what they are.
    named = isinstance(getattr(law, "name", None), str)
    if named and _LAWS.get(law.name, law) is not law:
        raise InvalidValueError("name", repr(law.name), f"a free name, because {_LAWS[law.name].__name__} has this one")
    if not named or not callable(getattr(law, "on_chart", None)):
        raise InvalidValueError("law", repr(law)[:80], "the class of a law")
    options = getattr(law, "options", None)
    if not isinstance(options, Mapping) or not all(isinstance(setting, Setting) for setting in options.values()):
        raise InvalidValueError(f"options of {law.__name__}", repr(options)[:80], "a dictionary of Setting by name")
    _LAWS[law.name] = law


def law_names() -> tuple[str, ...]:
    """Names of all registered laws."""
    return tuple(_LAWS)


def law_of(name: str) -> type[Law]:
    """The law with a name.

    Raises:
        UnknownNameError: if no law has that name.
    """
    require_known("controller", name, _LAWS)
    return _LAWS[name]


def list_law_facts(controller: Controller) -> dict[str, str]:
    """The facts that every controller displays: quantities, gains, other settings and problem."""
    return {
        "law": f"{controller.name}, commands {controller.command} of {controller.problem.n} joints",
        "quantities": listed(controller.labels),
        **{name: number_list(gain) for name, gain in controller.gains.items()},
        **controller.settings,
        "problem": controller.problem.heading,
    }


class LawOfChart(Shown):
    """What laws in the coordinates of a chart have in common."""

    chart: Chart
    graph: Any  #: a `ca.Function`, as `Controller` has it

    @property
    def problem(self) -> Problem:
        """Robot, task, metric and domain of the chart."""
        return self.chart.problem

    @property
    def labels(self) -> tuple[str, ...]:
        """Task labels, then xi1, xi2, ..."""
        return self.chart.labels

    @property
    def measured(self) -> ca.Function:
        """Phi(q)."""
        return self.chart.function("phi")

    @cached_property
    def function(self) -> ca.Function:
        """q, dq (n, 1), reference and its derivatives (n, 1), gains -> command (n, 1), status (1, 1)."""
        return self.chart.parts.runnable(count_turns_from_centre(self.graph, self.problem))

    def facts(self: Any) -> dict[str, str]:
        """Quantities, gains, settings and problem."""
        return list_law_facts(self)

    def require_reachable(self, reference: Reference, q_start: Array) -> None:
        """Raise UnreachableReferenceError if the motion from q_start along the reference leaves the chart's domain."""
        joint_path(self.chart, reference, q_start)


def require_chart(chart: Chart, user: str) -> None:
    """Raise InvalidValueError for other objects, RobotError for a floating base, NoExpressionError for grown charts."""
    require_kind("chart", chart, Chart)
    require_driven(user, chart.problem.robot.tree)
    chart.function("xi")


def require_controller(controller: Controller) -> None:
    """Raise InvalidValueError for an object without the attributes of a controller. Builds none of its functions."""
    if not all(hasattr(controller, name) for name in ("name", "problem", "command", "labels", "gains")):
        raise InvalidValueError("controller", f"a {type(controller).__name__}", "a controller, such as PDPlus")


def named_inputs(n: int, gains: dict[str, Array], k: int) -> dict[str, ca.MX]:
    """Symbols for the inputs of a controller, in order."""
    sizes = {"q": n, "dq": n, "reference": k, "reference_velocity": k, "reference_acceleration": k}
    sizes |= {name: len(value) for name, value in gains.items()}
    return {name: ca.MX.sym(name, size) for name, size in sizes.items()}


def compute_errors(chart: Chart, q: ca.MX, reference: ca.MX) -> tuple[ca.MX, ca.MX]:
    """phi relative to phi_d, e (n, 1), and de/dq (n, n) for a reference at rest.

    For most tasks e = phi - phi_d and de/dq = J. A whole orientation counts from its target, see `Relative`.
    Coordinates that are angles take the shorter way around. No other error is taken modulo anything: whole turns of
    joints are resolved in q, before phi is evaluated (`orthocas.tasks.problem.Problem.unwrap`).
    """
    m, own = chart.m, chart.coordinates.functions
    e, slope = chart.parts.relative.error(q, reference[:m])
    rest = wrap_shortest(own["xi"](q) - reference[m:], chart.parts.turns[m:])
    return ca.vertcat(e, rest), ca.vertcat(slope, own["jacobian"](q))


def compute_drift(chart: Chart, q: ca.MX, reference: ca.MX, velocity: ca.MX) -> ca.MX:
    """The rate de/dq dq at which q stays with a reference that moves, (n, 1): d_phi_d for most tasks."""
    m = chart.m
    return ca.vertcat(chart.parts.relative.compute_drift(q, reference[:m], velocity[:m]), velocity[m:])


def compute_bias(chart: Chart, q: ca.MX, dq: ca.MX, w: ca.MX, reference: tuple[ca.MX, ca.MX, ca.MX]) -> ca.MX:
    """(d/dt) (de/dq w - drift), (n, 1), with phi_d and its two derivatives: dJ/dt w - dd_phi_d for most tasks."""
    m = chart.m
    x, dx, ddx = (part[:m] for part in reference)
    rest = chart.coordinates.functions["second_derivative"](q, dq, w) - reference[2][m:]
    return ca.vertcat(chart.parts.relative.compute_bias(q, dq, w, (x, dx, ddx)), rest)


def guarded_graph(
    name: str,
    inputs: dict[str, ca.MX],
    command: ca.MX,
    fallback: ca.MX,
    volume: ca.MX,
    domain: Domain | None,
    keep_direction: bool = False,
) -> ca.Function:
    """The graph of a controller: its law, protected by the guard of `orthocas.control.controller`."""
    numbers = ca.vertcat(*(value for key, value in inputs.items() if key != "limit"))
    check = build_guard(domain, command.shape[0], numbers.shape[0], keep_direction)
    smallest = ca.MX(SMALLEST_VOLUME**2)
    safe, status = check(command, fallback, inputs["limit"], inputs["q"], numbers, volume, smallest)
    return build_function(name, inputs, {"command": safe, "status": status})


def build_guard(domain: Domain | None, n: int, numbers: int, keep_direction: bool) -> ca.Function:
    """Choose the command if all is well and the fallback otherwise, cut it to +- limit, and report the status.

    Args:
        domain: where the law is valid; None for everywhere.
        n: number of joints.
        numbers: count of input numbers of the law.
        keep_direction: whether the limit scales the whole command, instead of cutting entries one by one.

    Returns:
        A function with the outputs command (n, 1) and status (1, 1). Its inputs are: the command of the law (n, 1),
        which may be NaN; the fallback (n, 1), whose entries become zero where they are not finite; the limit (n, 1) of
        each entry, which may be infinite; q (n, 1); all input numbers of the law; and det(J A^-1 J^T) relative to its
        median over the domain, and the smallest regular value of that.
    """
    # From the least to the most important reason: singular, outside the domain, not finite.
    command, fallback, limit, q = (ca.SX.sym(name, n) for name in ("command", "fallback", "limit", "q"))
    inputs, volume, smallest = ca.SX.sym("inputs", numbers), ca.SX.sym("volume"), ca.SX.sym("smallest")
    regular = ca.logic_and(volume > smallest, _are_finite(command))
    status = ca.if_else(regular, float(ControlStatus.OK), float(ControlStatus.SINGULAR))
    status = ca.if_else(_is_inside(domain, q), status, float(ControlStatus.OUTSIDE_DOMAIN))
    usable = ca.logic_and(_are_finite(inputs), _all_hold(limit > 0))
    status = ca.if_else(usable, status, float(ControlStatus.NOT_FINITE))
    # Only a command of the law can be saturated; a fallback is cut as well.
    from_law = status == float(ControlStatus.OK)
    # Entry by entry, so that no NaN of the law gets through.
    safe = [ca.if_else(_is_finite(entry), entry, 0) for entry in ca.vertsplit(fallback)]
    selected = ca.vertcat(*(ca.if_else(from_law, a, b) for a, b in zip(ca.vertsplit(command), safe, strict=True)))
    cut = _limit(selected, limit, keep_direction)
    saturated = ca.logic_and(from_law, ca.logic_not(_all_hold(ca.fabs(selected) <= limit)))
    status = ca.if_else(saturated, float(ControlStatus.SATURATED), status)
    arguments = [command, fallback, limit, q, inputs, volume, smallest]
    names = ["command", "fallback", "limit", "q", "inputs", "volume", "smallest"]
    return ca.Function(GUARD, arguments, [cut, status], names, ["cut", "status"])


def _limit(command: ca.SX, limit: ca.SX, keep_direction: bool) -> ca.SX:
    """The command within +- limit; zero where the limit is NaN or not > 0."""
    rows = range(command.shape[0])
    bound = ca.vertcat(*(ca.if_else(limit[i] > 0, limit[i], 0) for i in rows))
    if keep_direction:
        excess = [ca.if_else(ca.fabs(command[i]) > bound[i], ca.fabs(command[i]) / bound[i], 1) for i in rows]
        command = command / ca.mmax(ca.vertcat(1, *excess))
    return ca.fmin(ca.fmax(command, -bound), bound)


def _is_inside(domain: Domain | None, q: ca.SX) -> ca.SX:
    """Whether q (n, 1) lies in the domain: between its boundaries, and where its condition holds, if it has one."""
    in_box = meets_condition = ca.SX(1)
    if domain is None:
        return ca.logic_and(in_box, meets_condition)
    # Joints without boundaries, such as the angles of a torus, do not count.
    bounded = np.flatnonzero(np.isfinite(domain.reach)).tolist()
    if bounded:
        in_box = _all_hold(ca.fabs(q[bounded] - ca.DM(domain.centre[bounded])) <= ca.DM(domain.reach[bounded]))
    if domain.condition is not None:
        meets_condition = _all_hold(domain.condition.pivots(q) > 0)
    return ca.logic_and(in_box, meets_condition)


def _is_finite(value: ca.SX) -> ca.SX:
    """Whether a number is finite; false also for NaN, since comparisons with NaN are false."""
    return ca.fabs(value) <= LARGEST


def _are_finite(values: ca.SX) -> ca.SX:
    return _all_hold(_is_finite(values))


def _all_hold(conditions: ca.SX) -> ca.SX:
    """Whether all conditions hold. Their sum needs no branches, and less code than `ca.logic_all`."""
    return ca.sum1(conditions) == conditions.shape[0]


def count_turns_from_centre(graph: ca.Function, problem: Problem) -> ca.Function:
    """The same function of q and other inputs, with turns of the joints that turn counted from the domain's centre.

    A function without a memory cannot know the last position of a joint. With this, sensors may report q or q + 2 pi,
    and the result is the same. It jumps where such a joint is half a turn from the centre, if coordinates depend on its
    turns; `Remembering` and the supervised law in C count from the last position instead.
    """
    if not problem.turning:
        return graph
    # q takes the place of its unwrapped form in a call of the graph.
    inputs = graph.mx_in()
    k = graph.name_in().index("q")
    counted = [*inputs[:k], problem.unwrap(inputs[k], ca.DM(problem.domain.centre)), *inputs[k + 1 :]]
    return ca.Function(graph.name(), inputs, graph.call(counted), graph.name_in(), graph.name_out())


def get_counted_function(controller: Controller, name: Literal["function", "energy"] = "function") -> Any:
    """The function or energy of a law for joint positions whose turns are counted already, as in simulations."""
    graph = {"function": "graph", "energy": "energy_graph"}[name]
    return getattr(controller, graph if controller.problem.turning else name)


def replace_smallest_volume(graph: ca.Function, smallest: float) -> ca.Function:
    """The same graph of a controller, with another smallest volume of the gradients, relative to the median."""
    inputs, call = _find_guard_call(graph)
    if call is None:
        return graph
    # The same call of the guard, with another last input.
    check = call.which_function()
    outputs = check(*(call.dep(i) for i in range(check.n_in() - 1)), ca.MX(smallest**2))
    return ca.Function(graph.name(), inputs, list(outputs), graph.name_in(), graph.name_out())


def find_squared_volume(graph: ca.Function) -> ca.Function | None:
    """Inputs of a controller -> squared volume of its gradients, relative to the median; None without a guard."""
    inputs, call = _find_guard_call(graph)
    if call is None:
        return None
    return ca.Function("squared_volume", inputs, [call.dep(call.which_function().n_in() - 2)])


def _find_guard_call(graph: ca.Function) -> tuple[list[ca.MX], ca.MX | None]:
    """Inputs of a graph, and the call of the guard that all its outputs come from, if it has one."""
    inputs = graph.mx_in()
    call = graph.call(inputs, True, False)[0].dep(0)
    is_guarded = call.is_call() and call.which_function().name() == GUARD
    return inputs, call if is_guarded else None


def fallback_function(inputs: dict[str, ca.MX], command: ca.MX) -> ca.Function:
    """The fallback of a controller as a function of q and its gains."""
    state = ("dq", "reference", "reference_velocity", "reference_acceleration")
    selected = {key: value for key, value in inputs.items() if key not in state}
    return build_function("fallback", selected, {"command": command})


def build_function(name: str, inputs: dict[str, ca.MX], outputs: dict[str, ca.MX]) -> ca.Function:
    """A function with named inputs and dense outputs."""
    dense = [ca.densify(out) for out in outputs.values()]
    return ca.Function(name, list(inputs.values()), dense, list(inputs), list(outputs))
