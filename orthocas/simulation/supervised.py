"""The supervised law of generated C in closed loops, called by a program that asks for the law again after a catch."""

from collections.abc import Iterator
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from orthocas.casadi_tools.cached import building
from orthocas.casadi_tools.interrupts import deferred
from orthocas.checks import Array, as_number, require_kind
from orthocas.control import Controller, Reference, Safety
from orthocas.errors import InvalidValueError
from orthocas.files.drafts import draft_folder
from orthocas.simulation.closed_loop import ClosedLoop, Piece, run_compiled
from orthocas.simulation.disturbances import Noise
from orthocas.simulation.sampled import held_plant, pieces

if TYPE_CHECKING:
    from orthocas.codegen import Supervisor

_CATCHER = 1  # `mode` of the state in C


class SupervisedLaw:
    """A supervised law in compiled C, and the program around it.

    Args:
        controller: a law on a chart.
        safety: its settings.
        resume_after: time from each catch until the program asks for the law again [s]; infinite: never.
        period: of the ticks [s].

    Raises:
        InvalidValueError: for a law without a chart, for other settings, and periods that are always too late.
        CompileError: if there is no C compiler.
    """

    def __init__(self, controller: Controller, safety: Safety, resume_after: float, period: float) -> None:
        require_kind("safety", safety, Safety)
        if not as_number("resume_after", resume_after) >= 0:
            raise InvalidValueError("resume_after", resume_after, "a number >= 0 or infinity")
        if period > safety.longest_period:
            slowest = 1 / safety.longest_period
            raise InvalidValueError("control_rate", 1 / period, f"at least {slowest:g}, as safety.longest_period wants")
        if controller.chart is None:
            raise InvalidValueError("safety", "given", f"none with {controller.name} without a chart")
        self._resume_after, self._period, self._caught_for = resume_after, period, 0.0
        self._law = _compiled(controller, safety)

    def start(self, q: Array) -> None:
        """Begin at joint positions (n,)."""
        self._law.start(q)
        self._caught_for = 0.0

    def tick(self, q: Array, dq: Array, reference: Array) -> Array:
        """[command; status; why the catcher took over last], (n + 2,), for a reference with two derivatives (3 k,)."""
        self._caught_for = self._caught_for + self._period if self._law.mode == _CATCHER else 0.0
        if self._caught_for > self._resume_after:
            self._law.resume()
        command, status = self._law.step(q, dq, reference, self._period)
        return np.concatenate([command, [status, self._law.cause]])


def _compiled(controller: Controller, safety: Safety) -> "Supervisor":
    """The supervised law in C. It stays loaded when its folder is gone."""
    from orthocas import codegen  # few runs need a code generator and a compiler

    with draft_folder() as folder:
        generated = codegen.generate_c(controller.chart, folder / "law", controller, "law", safety=safety)
        library = codegen.compile_shared(generated, generated.folder)
        supervisor: Supervisor = codegen.Supervisor(
            codegen.CompiledLibrary(library, "law", controller.problem.n), controller
        )
        return supervisor


def run_supervised(
    loop: ClosedLoop,
    reference: Reference,
    start: Array,
    rate: float,
    noise: Noise,
    tolerance: float,
    law: SupervisedLaw,
) -> Iterator[Piece]:
    """Yield pieces of 50 ticks, with the commands that were held while CVODES integrated the plant.

    Raises:
        SimulationError: if CVODES gives up.
    """
    n, size = loop.n, len(start)
    ticks = int(np.floor(reference.duration * rate + 1e-9))
    times = np.arange(ticks) / rate
    wanted, errors, loads = np.hstack(reference.sample(times)), noise.sample(ticks, n), loop.loads.mean(times, 1 / rate)
    with deferred(), building:  # CasADi may lose Ctrl-C while it builds functions
        plant = held_plant(loop, 1 / rate, tolerance)
    law.start(start[:n] + errors[0, :n])
    state, sent = start, np.zeros(n + 2)

    def tick(k: int) -> Array:
        nonlocal state, sent
        dq = state[n:] if loop.torque else sent[:n]  # a velocity controller's robot does what it was told
        sent = law.tick(state[:n] + errors[k, :n], dq + errors[k, n:], wanted[k])
        state = run_compiled(plant, x0=ca.DM(state), p=ca.DM(np.concatenate([sent[:n], loads[k]])))["xf"].full().ravel()
        return np.concatenate([state, sent])

    yield from pieces(tick, times, 1 / rate, size)
