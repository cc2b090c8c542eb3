"""Closed loops in compiled C: law, plant and integrator (ours).

Law and plant are compiled on their own. Gains, masses and friction are arguments of the C, so runs that differ in them
share one library.
"""

from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from importlib import import_module
from typing import Any

import casadi as ca

from orthocas.casadi_tools.cached import building
from orthocas.casadi_tools.interrupts import deferred
from orthocas.casadi_tools.scalar_code import scalar_code
from orthocas.checks import Array
from orthocas.control.controller import Controller
from orthocas.control.reference import Reference
from orthocas.simulation.closed_loop import KEPT, ClosedLoop, Keyed


class CompiledLoop:
    """A closed loop in C. Building it compiles what is not yet in the cache.

    Args:
        loop: the loop.
        reference: what it follows.

    Raises:
        CompileError: if there is no C compiler.
    """

    def __init__(self, loop: ClosedLoop, reference: Reference) -> None:
        with deferred(), building:  # CasADi may lose Ctrl-C while it builds functions
            self._law = _law(loop.controller)
            self._plant = _plant(Keyed(loop.plant_key, loop))
            self._profile = _profile(reference.profile)
        self._loop, self._gains = loop, list(loop.controller.gains.values())

    def continuous(self, step: float, tolerance: float, outputs: int) -> Callable[..., Array]:
        """What `integrate` calls, for one thread; the first step has the given length [s]."""
        return partial(self._integrator(step, tolerance).continuous, outputs)

    def ticks(self, period: float, tolerance: float) -> Callable[..., tuple[Array, Array, Array]]:
        """What `run_ticks` calls, for one thread, for ticks of a length [s]."""
        return partial(self._integrator(period, tolerance).ticks, period)

    def rows(self, name: str, *arguments: Array) -> list[Array]:
        """`command`, `energy` or `measured` of the law for N rows of arguments; gains are added."""
        gains = [] if name == "measured" else self._gains
        return list(self._law.rows(name, *arguments, *gains))

    def _integrator(self, step: float, tolerance: float) -> Any:
        loop, none = self._loop, [None] * 5
        kernels = (
            self._law.kernel("command", [*none, *self._gains]),
            self._plant.kernel("plant", [None, None, None, loop.plant_numbers]),
            self._profile.kernel("profile"),
        )
        sizes = (loop.n, len(loop.controller.labels), loop.size, loop.loads.size)
        return _codegen("integrator").Integrator(kernels, sizes, tolerance, step)


def _law(controller: Controller) -> Any:
    """`command`, `measured` and `energy` of a law, compiled."""
    return _law_of(controller.graph, controller.measured, controller.energy_graph)


@lru_cache(KEPT)
def _law_of(graph: ca.Function, measured: ca.Function, energy: ca.Function | None) -> Any:
    functions = {"command": graph, "measured": measured, **({} if energy is None else {"energy": energy})}
    return _compiled([_renamed(name, function) for name, function in functions.items()])


@lru_cache(KEPT)
def _plant(keyed: Keyed) -> Any:
    return _compiled([_with_shared_parts(keyed.loop.plant_of_numbers)])


@lru_cache(KEPT)
def _profile(profile: ca.Function) -> Any:
    return _compiled([_renamed("profile", profile)])


def _compiled(functions: Sequence[ca.Function]) -> Any:
    return _codegen("compiled_functions").CompiledFunctions(functions)


def _codegen(module: str) -> Any:
    return import_module(f"orthocas.codegen.{module}")  # not above: few runs need a code generator and a compiler


def _renamed(name: str, function: ca.Function) -> ca.Function:
    inputs = function.mx_in()
    return ca.Function(name, inputs, [ca.densify(out) for out in function.call(inputs)])


def _with_shared_parts(function: ca.Function) -> ca.Function:
    return scalar_code(_renamed(function.name(), function))
