"""What all control laws share: gains, guard at the boundary, status, and the function for C."""

from collections.abc import Mapping
from enum import IntEnum
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Protocol, Self

import casadi as ca
import numpy as np

from orthocas.control.gains import Setting
from orthocas.control.reference import Reference
from orthocas.errors import InvalidValueError
from orthocas.tasks.domains import Domain
from orthocas.tasks.problem import Problem
from orthocas.tools.checks import Array
from orthocas.tools.display import listed, number_list

if TYPE_CHECKING:
    from orthocas.charts.chart import Chart

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

    @property
    def words(self) -> str:
        """For example 'near boundary'."""
        return self.name.lower().replace("_", " ")


#: statuses of commands that are not the fallback
FROM_THE_LAW = (ControlStatus.OK, ControlStatus.SATURATED, ControlStatus.NEAR_BOUNDARY)


def guard(domain: Domain | None, n: int, numbers: int, keep_direction: bool) -> ca.Function:
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
    command, fallback, limit, q = (ca.SX.sym(name, n) for name in ("command", "fallback", "limit", "q"))
    inputs, volume, smallest = ca.SX.sym("inputs", numbers), ca.SX.sym("volume"), ca.SX.sym("smallest")
    regular = ca.logic_and(volume > smallest, _all_finite(command))
    status = ca.if_else(regular, float(ControlStatus.OK), float(ControlStatus.SINGULAR))
    status = ca.if_else(_is_inside(domain, q), status, float(ControlStatus.OUTSIDE_DOMAIN))
    meant = ca.logic_and(_all_finite(inputs), _all(limit > 0))
    status = ca.if_else(meant, status, float(ControlStatus.NOT_FINITE))
    from_law = status == float(ControlStatus.OK)
    chosen = _chosen(from_law, command, fallback)
    cut = _cut(chosen, limit, keep_direction)
    saturated = ca.logic_and(from_law, ca.logic_not(_all(ca.fabs(chosen) <= limit)))
    status = ca.if_else(saturated, float(ControlStatus.SATURATED), status)
    given = [command, fallback, limit, q, inputs, volume, smallest]
    names = ["command", "fallback", "limit", "q", "inputs", "volume", "smallest"]
    return ca.Function(GUARD, given, [cut, status], names, ["cut", "status"])


def _chosen(from_law: ca.SX, command: ca.SX, fallback: ca.SX) -> ca.SX:
    rows = range(command.shape[0])
    safe = [ca.if_else(_is_finite(fallback[i]), fallback[i], 0) for i in rows]
    return ca.vertcat(*(ca.if_else(from_law, command[i], safe[i]) for i in rows))


def _cut(command: ca.SX, limit: ca.SX, keep_direction: bool) -> ca.SX:
    """The command within +- limit; zero where the limit is NaN or not > 0."""
    rows = range(command.shape[0])
    bound = ca.vertcat(*(ca.if_else(limit[i] > 0, limit[i], 0) for i in rows))
    if keep_direction:
        excess = [ca.if_else(ca.fabs(command[i]) > bound[i], ca.fabs(command[i]) / bound[i], 1) for i in rows]
        command = command / ca.mmax(ca.vertcat(1, *excess))
    return ca.fmin(ca.fmax(command, -bound), bound)


def _is_inside(domain: Domain | None, q: ca.SX) -> ca.SX:
    """Whether q (n, 1) lies in the domain: between its boundaries, and where its condition holds, if it has one."""
    condition = None if domain is None else domain.condition
    clear = ca.SX(1) if condition is None else _all(condition.pivots(q) > 0)
    return ca.logic_and(_is_between_boundaries(domain, q), clear)


def _is_between_boundaries(domain: Domain | None, q: ca.SX) -> ca.SX:
    """Whether q (n, 1) lies in the box; always true for joints without boundaries, such as the angles of a torus."""
    widths = np.full(q.shape[0], np.inf) if domain is None else domain.reach
    bounded = np.flatnonzero(np.isfinite(widths)).tolist()
    if domain is None or not bounded:
        return ca.SX(1)
    return _all(ca.fabs(q[bounded] - ca.DM(domain.centre[bounded])) <= ca.DM(widths[bounded]))


def _is_finite(value: ca.SX) -> ca.SX:
    """Whether a number is finite; false also for NaN, since comparisons with NaN are false."""
    return ca.fabs(value) <= LARGEST


def _all_finite(values: ca.SX) -> ca.SX:
    return _all(_is_finite(values))


def _all(conditions: ca.SX) -> ca.SX:
    """Whether all conditions hold. Their sum needs no branches, and less code than `ca.logic_all`."""
    return ca.sum1(conditions) == conditions.shape[0]


Command = Literal["torque", "velocity"]


class Controller(Protocol):
    """A control law for a robot and a task."""

    name: ClassVar[str]  #: short name, for example 'pd_plus'
    command: ClassVar[Command]  #: joint torques [N m] or joint velocities [rad/s]

    @property
    def formula(self) -> str:
        """The law in one line, for generated C."""
        ...

    @property
    def chart(self) -> "Chart | None":
        """The chart whose coordinates the law uses and whose domain it respects; None for laws without a chart."""
        ...

    @property
    def problem(self) -> Problem:
        """Robot (the model that the law uses), task, metric and domain."""
        ...

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the k controlled quantities, in the order of the reference."""
        ...

    @property
    def gains(self) -> dict[str, Array]:
        """Values of the gains by input name."""
        ...

    @property
    def gain_units(self) -> Mapping[str, str]:
        """Units and admissible values of the gains, in words, by name."""
        ...

    @property
    def settings(self) -> Mapping[str, str]:
        """Choices that are not numbers, for example the coupling."""
        ...

    def remarks(self) -> list[str]:
        """Warnings to read before the controller is switched on, as sentences; empty if there are none."""
        ...

    @property
    def function(self) -> ca.Function:
        """q, dq (n, 1), reference and two derivatives (k, 1), gains -> command (n, 1), status (1, 1).

        Joints that turn without end count from the domain's centre, so that q and q + 2 pi give the same command.
        """
        ...

    @property
    def graph(self) -> ca.Function:
        """The same function as a graph with shared subexpressions, whole turns of joints counted by the caller.

        C is generated from it, and simulations use it.
        """
        ...

    @property
    def fallback(self) -> ca.Function:
        """q (n, 1), gains -> command without the law (n, 1): the gravity torque, or zero for velocity controllers."""
        ...

    @property
    def energy(self) -> ca.Function | None:
        """The same inputs -> storage V [J] and power dissipated by damping [W]; None for velocity controllers."""
        ...

    @property
    def energy_graph(self) -> ca.Function | None:
        """The same function as a graph with shared subexpressions; compiled simulations use it."""
        ...

    @property
    def measured(self) -> ca.Function:
        """q (n, 1) -> the controlled quantities (k, 1)."""
        ...

    def require_reachable(self, reference: Reference, q_start: Array) -> None:
        """Raise UnreachableReferenceError, with time and place, if the law cannot follow the reference."""
        ...


class Law(Controller, Protocol):
    """A controller that can be built by name on a chart, for the command line; see `orthocas.control.registry`."""

    options: ClassVar[Mapping[str, Setting]]  #: the settings that `on_chart` takes, by name

    @classmethod
    def on_chart(cls, *args: Any, **settings: Any) -> Self:
        """Build the law on a chart, or on the problem of the chart.

        Args:
            args: the chart, and the largest command of each joint, which may be left out or None.
            settings: gains and choices by the names in `options`; those left out take their defaults.
        """
        ...


def law_facts(controller: Controller) -> dict[str, str]:
    """The facts that every controller displays: quantities, gains, other settings and problem."""
    return {
        "law": f"{controller.name}, commands {controller.command} of {controller.problem.n} joints",
        "quantities": listed(controller.labels),
        **{name: number_list(gain) for name, gain in controller.gains.items()},
        **controller.settings,
        "problem": controller.problem.heading,
    }


def require_controller(controller: Controller) -> None:
    """Raise InvalidValueError for an object without the attributes of a controller. Builds none of its functions."""
    if not all(hasattr(controller, name) for name in ("name", "problem", "command", "labels", "gains")):
        raise InvalidValueError("controller", f"a {type(controller).__name__}", "a controller, such as PDPlus")


def named_inputs(n: int, gains: dict[str, Array], k: int) -> dict[str, ca.MX]:
    """Symbols for the inputs of a controller, in order."""
    sizes = {"q": n, "dq": n, "reference": k, "reference_velocity": k, "reference_acceleration": k}
    sizes |= {name: len(value) for name, value in gains.items()}
    return {name: ca.MX.sym(name, size) for name, size in sizes.items()}


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
    check = guard(domain, command.shape[0], numbers.shape[0], keep_direction)
    smallest = ca.MX(SMALLEST_VOLUME**2)
    safe, status = check(command, fallback, inputs["limit"], inputs["q"], numbers, volume, smallest)
    return named_function(name, inputs, {"command": safe, "status": status})


def count_turns_from_centre(graph: ca.Function, problem: Problem) -> ca.Function:
    """The same function of q and other inputs, with turns of the joints that turn counted from the domain's centre.

    A function without a memory cannot know the last position of a joint. With this, sensors may report q or q + 2 pi,
    and the result is the same. It jumps where such a joint is half a turn from the centre, if coordinates depend on its
    turns; `Remembering` and the supervised law in C count from the last position instead.
    """
    if not problem.turning:
        return graph
    inputs = graph.mx_in()
    k = graph.name_in().index("q")
    counted = [*inputs[:k], problem.unwrap(inputs[k], ca.DM(problem.domain.centre)), *inputs[k + 1 :]]
    return ca.Function(graph.name(), inputs, graph.call(counted), graph.name_in(), graph.name_out())


def counted_function(controller: Controller, name: Literal["function", "energy"] = "function") -> Any:
    """The function or energy of a law for joint positions whose turns are counted already, as in simulations."""
    graph = {"function": "graph", "energy": "energy_graph"}[name]
    return getattr(controller, graph if controller.problem.turning else name)


def with_smallest_volume(graph: ca.Function, smallest: float) -> ca.Function:
    """The same graph of a controller, with another smallest volume of the gradients, relative to the median."""
    inputs, call = _guard_call(graph)
    if call is None:
        return graph
    check = call.which_function()
    outputs = check(*(call.dep(i) for i in range(check.n_in() - 1)), ca.MX(smallest**2))
    return ca.Function(graph.name(), inputs, list(outputs), graph.name_in(), graph.name_out())


def squared_volume(graph: ca.Function) -> ca.Function | None:
    """Inputs of a controller -> squared volume of its gradients, relative to the median; None without a guard."""
    inputs, call = _guard_call(graph)
    if call is None:
        return None
    return ca.Function("squared_volume", inputs, [call.dep(call.which_function().n_in() - 2)])


def _guard_call(graph: ca.Function) -> tuple[list[ca.MX], ca.MX | None]:
    """Inputs of a graph, and the call of the guard that all its outputs come from, if it has one."""
    inputs = graph.mx_in()
    call = graph.call(inputs, True, False)[0].dep(0)
    is_guarded = call.is_call() and call.which_function().name() == GUARD
    return inputs, call if is_guarded else None


def fallback_function(inputs: dict[str, ca.MX], command: ca.MX) -> ca.Function:
    """The fallback of a controller as a function of q and its gains."""
    state = ("dq", "reference", "reference_velocity", "reference_acceleration")
    chosen = {key: value for key, value in inputs.items() if key not in state}
    return named_function("fallback", chosen, {"command": command})


def named_function(name: str, inputs: dict[str, ca.MX], outputs: dict[str, ca.MX]) -> ca.Function:
    """A function with named inputs and dense outputs."""
    dense = [ca.densify(out) for out in outputs.values()]
    return ca.Function(name, list(inputs.values()), dense, list(inputs), list(outputs))
