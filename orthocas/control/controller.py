"""What every controller offers: one CasADi function of state, reference and gains, with the gains it was made with."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Protocol, Self

import casadi as ca
from numpy.typing import ArrayLike

from orthocas.checks import Array
from orthocas.control.reference import Reference
from orthocas.control.status import guard
from orthocas.domains import Domain
from orthocas.errors import InvalidValueError
from orthocas.problem import Problem
from orthocas.showing import listed, number_list

if TYPE_CHECKING:
    from orthocas.chart import Chart

Command = Literal["torque", "velocity"]


class Controller(Protocol):
    """A control law for a robot and a task."""

    @property
    def name(self) -> str:
        """Short name, for example 'pd_plus'."""
        ...

    @property
    def formula(self) -> str:
        """The law in one line, for generated C."""
        ...

    @property
    def chart(self) -> "Chart | None":
        """The chart whose coordinates it uses, and whose domain it keeps to; None for laws without one."""
        ...

    @property
    def problem(self) -> Problem:
        """Robot (the model the law uses), task, metric and domain."""
        ...

    @property
    def command(self) -> Command:
        """What comes out: joint torques [N m] or velocities [rad/s]."""
        ...

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the k controlled quantities, in the order of the reference."""
        ...

    @property
    def gains(self) -> dict[str, Array]:
        """Values of the gains, by the names of their inputs."""
        ...

    @property
    def gain_units(self) -> Mapping[str, str]:
        """Units of the gains and what they allow, in words, by name."""
        ...

    @property
    def settings(self) -> Mapping[str, str]:
        """Choices that are no numbers, for example the coupling."""
        ...

    def remarks(self) -> list[str]:
        """What to know before it is switched on, in sentences; empty if there is nothing."""
        ...

    @property
    def function(self) -> ca.Function:
        """Inputs q, dq (n, 1), reference and two derivatives (k, 1), gains -> command (n, 1), status (1, 1)."""
        ...

    @property
    def graph(self) -> ca.Function:
        """The same function as a graph of shared parts, which C is generated from."""
        ...

    @property
    def energy(self) -> ca.Function | None:
        """Same inputs -> storage V [J] and power dissipated by damping [W]; None for velocity controllers."""
        ...

    @property
    def measured(self) -> ca.Function:
        """The controlled quantities, q (n, 1) -> (k, 1)."""
        ...

    def require_reachable(self, reference: Reference, q_start: Array) -> None:
        """Raise UnreachableReferenceError, with time and place, if the reference leaves what the law can follow."""
        ...


class Law(Controller, Protocol):
    """A controller that can be built by name on a chart, for the command line; see `orthocas.control.registry`."""

    name: ClassVar[str]
    command: ClassVar[Command]
    options: ClassVar[tuple[str, ...]]  #: names of the settings that `on_chart` takes

    @classmethod
    def on_chart(cls, chart: "Chart", limit: ArrayLike | None = None, **settings: Any) -> Self:
        """The law on a chart, or on its problem.

        Args:
            chart: the chart.
            limit: largest command of each joint.
            settings: gains and choices by the names in `options`; those left out have defaults.
        """
        ...


def law_facts(controller: Controller) -> dict[str, str]:
    """What a controller shows: quantities, gains, other settings and problem."""
    return {
        "law": f"{controller.name}, commands {controller.command} of {controller.problem.n} joints",
        "quantities": listed(controller.labels),
        **{name: number_list(gain) for name, gain in controller.gains.items()},
        **controller.settings,
        "problem": controller.problem.heading,
    }


def require_controller(controller: Controller) -> None:
    """Raise InvalidValueError for what has not the attributes of a controller; none of its functions is built."""
    if not all(hasattr(controller, name) for name in ("name", "problem", "command", "labels", "gains")):
        raise InvalidValueError("controller", f"a {type(controller).__name__}", "a controller, such as PDPlus")


def named_inputs(n: int, gains: dict[str, Array], k: int) -> dict[str, ca.MX]:
    """Symbols of the inputs of a controller, in order."""
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
) -> ca.Function:
    """The graph of a controller: its law behind the guard of `orthocas.control.status`."""
    numbers = ca.vertcat(*(value for key, value in inputs.items() if key != "limit"))
    check = guard(domain, command.shape[0], numbers.shape[0])
    safe, status = check(command, fallback, inputs["limit"], inputs["q"], numbers, volume)
    return named_function(name, inputs, {"command": safe, "status": status})


def named_function(name: str, inputs: dict[str, ca.MX], outputs: dict[str, ca.MX]) -> ca.Function:
    """A function with named inputs and dense outputs."""
    dense = [ca.densify(out) for out in outputs.values()]
    return ca.Function(name, list(inputs.values()), dense, list(inputs), list(outputs))
