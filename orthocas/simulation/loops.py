"""Closed loops with CasADi's or compiled dynamics: in continuous time, and with a sampled controller."""

from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache, partial
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np

from orthocas.control.controller import Controller
from orthocas.control.reference import Reference
from orthocas.simulation.closed_loop import KEPT, ClosedLoop, Held, Keyed, Piece, cvodes_options, run_compiled
from orthocas.simulation.disturbances import Noise, Push
from orthocas.tools.cached import building
from orthocas.tools.checks import Array
from orthocas.tools.expressions import scalar_code
from orthocas.tools.interrupts import deferred

_OUTPUTS = 25  # instants per integrator call: one integrator serves all calls, and Ctrl-C waits for one call at most
_SAME = 1e-9  # [s]: events closer than this differ only by rounding
_TICKS = 50  # ticks per integrator call


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
        from orthocas.codegen import compiled  # few runs need a code generator and a compiler

        loop, none = self._loop, [None] * 5
        kernels = (
            self._law.kernel("command", [*none, *self._gains]),
            self._plant.kernel("plant", [None, None, None, loop.plant_numbers]),
            self._profile.kernel("profile"),
        )
        sizes = (loop.n, len(loop.controller.labels), loop.size, loop.loads.size)
        return compiled.Integrator(kernels, sizes, tolerance, step)


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
    from orthocas.codegen.compiled import CompiledFunctions  # few runs need a code generator and a compiler

    return CompiledFunctions(functions)


def _renamed(name: str, function: ca.Function) -> ca.Function:
    inputs = function.mx_in()
    return ca.Function(name, inputs, [ca.densify(out) for out in function.call(inputs)])


def _with_shared_parts(function: ca.Function) -> ca.Function:
    return scalar_code(_renamed(function.name(), function))


#: span [s], start of the reference's segment [s], its parameters, load, state -> states at 25 equally spaced instants
Integrator = Callable[[tuple[float, float], float, Array, Array, Array], Array]


def integrate(
    loop: ClosedLoop,
    reference: Reference,
    start: Array,
    step: float,
    tolerance: float,
    compiled: CompiledLoop | None = None,
) -> Iterator[Piece]:
    """Yield pieces of 25 instants, from just after the start to the end of the reference.

    Raises:
        SimulationError: if the integrator gives up.
    """
    run: Integrator = (
        _continuous_by_cvodes(loop, reference, tolerance)
        if compiled is None
        else compiled.continuous(step, tolerance, outputs=_OUTPUTS)
    )
    state = start
    for begin, end in _pieces(reference, loop.loads.pushes, step * _OUTPUTS):
        middle = np.array([(begin + end) / 2])
        segment, load = int(reference.segment(middle)[0]), loop.loads.at(middle)[0]
        states = run((begin, end), reference.times[segment], reference.parameters[segment], load, state)
        state = states[-1]
        yield Piece(begin + (end - begin) * np.arange(1, _OUTPUTS + 1) / _OUTPUTS, states)


def _continuous_by_cvodes(loop: ClosedLoop, reference: Reference, tolerance: float) -> Integrator:
    with deferred(), building:  # CasADi may lose Ctrl-C while it builds functions
        integrator = _integrator(loop, reference, tolerance)

    def run(span: tuple[float, float], since: float, parameters: Array, load: Array, state: Array) -> Array:
        p = np.concatenate([[span[1] - span[0], span[0] - since], parameters, load])
        return np.asarray(run_compiled(integrator, x0=ca.DM(state), p=ca.DM(p))["xf"]).T

    return run


def _pieces(reference: Reference, pushes: tuple[Push, ...], longest: float) -> Iterator[tuple[float, float]]:
    """Intervals of at most the given length, without a step of the reference or a change of load inside."""
    edges = np.array([*reference.times, *(t for push in pushes for t in (push.start, push.end))])
    boundaries = np.unique(edges[edges <= reference.duration])
    boundaries = boundaries[np.diff(boundaries, prepend=-1.0) > _SAME]
    for begin, end in pairwise(boundaries):
        count = max(1, int(np.ceil((end - begin) / longest - 1e-9)))
        cuts = np.linspace(begin, end, count + 1)
        yield from pairwise(cuts)


def _integrator(loop: ClosedLoop, reference: Reference, tolerance: float) -> ca.Function:
    """x0, p = [length; time since segment start; parameters; load] -> states at 25 equally spaced instants."""
    rate = loop.rate(reference)
    state_size, _, p_size, load_size = (rate.size1_in(i) for i in range(4))
    kind: Any = ca.SX if rate.is_a("SXFunction") else ca.MX
    x, s = kind.sym("x", state_size), kind.sym("s")
    p = kind.sym("p", 2 + p_size + load_size)
    length, since, parameters, load = p[0], p[1], p[2 : 2 + p_size], p[2 + p_size :]
    ode = length * rate(x, since + s * length, parameters, load)
    grid = np.arange(1, _OUTPUTS + 1) / _OUTPUTS
    return ca.integrator(
        "closed_loop", "cvodes", {"x": x, "t": s, "p": p, "ode": ode}, 0.0, grid, cvodes_options(tolerance, loop.stiff)
    )


#: state; references with derivatives (N, 3 k), noise and loads of N ticks -> states after them, commands, status (N, 1)
Ticks = Callable[..., tuple[Array, Array, Array]]


def run_ticks(
    loop: ClosedLoop,
    reference: Reference,
    start: Array,
    rate: float,
    noise: Noise,
    tolerance: float,
    compiled: CompiledLoop | None = None,
) -> Iterator[Piece]:
    """Yield pieces of 50 ticks, with the commands that were held.

    Raises:
        SimulationError: if the integrator gives up.
    """
    ticks = int(np.floor(reference.duration * rate + 1e-9))  # whole ticks: the reference ends with its last segment
    times = np.arange(ticks) / rate
    columns = (
        np.hstack(reference.sample(times)),
        noise.sample(ticks, loop.n)[:, : loop.size],
        loop.loads.mean(times, 1 / rate),
    )
    k, period = len(reference.labels), 1 / rate
    run = _ticks_by_cvodes(loop, period, k, tolerance) if compiled is None else compiled.ticks(period, tolerance)
    state = start
    for first in range(0, ticks, _TICKS):
        part = slice(first, min(first + _TICKS, ticks))
        states, commands, status = run(state, *(column[part] for column in columns))
        state = states[-1]
        yield Piece(times[part] + period, states, Held(commands, status[:, 0], 0 * status[:, 0]))


def pieces(tick: Callable[[int], Array], times: Array, period: float, size: int) -> Iterator[Piece]:
    """Yield pieces of 50 ticks for a plant that is driven tick by tick.

    Args:
        tick: number of the tick -> [state at its end (size,); command (n,); status; cause].
        times: starts of the ticks (N,) [s].
        period: their length [s].
        size: of a state.
    """
    for first in range(0, len(times), _TICKS):
        held = range(first, min(first + _TICKS, len(times)))
        with deferred():
            rows = np.array([tick(k) for k in held])
        states, commands, known = np.split(rows, [size, rows.shape[1] - 2], axis=1)
        yield Piece(times[held] + period, states, Held(commands, known[:, 0], known[:, 1]))


def held_plant(loop: ClosedLoop, length: float, tolerance: float) -> ca.Function:
    """x0, p = [command; load] -> xf, the state after a tick in which command and load are constant."""
    x, u, w = (ca.SX.sym(*of) for of in (("x", loop.plant_rate.size1_in(0)), ("u", loop.n), ("load", loop.loads.size)))
    ode = {"x": x, "p": ca.vertcat(u, w), "ode": loop.plant_rate(x, u, w)}
    return ca.integrator("plant", "cvodes", ode, 0.0, length, cvodes_options(tolerance, loop.stiff))


def _ticks_by_cvodes(loop: ClosedLoop, period: float, k: int, tolerance: float) -> Ticks:
    with deferred(), building:  # CasADi may lose Ctrl-C while it builds functions
        ticks = _tick(loop, period, k, tolerance).mapaccum(_TICKS)

    def run(state: Array, *columns: Array) -> tuple[Array, Array, Array]:
        inputs = [ca.DM(_filled(column).T) for column in columns]
        outputs = run_compiled(ticks, ca.DM(state), *inputs)
        states, commands, status = (np.asarray(out).T[: len(columns[0])] for out in outputs)
        return states, commands, status

    return run


def _filled(rows: Array) -> Array:
    """Repeat the last row until there are as many rows as one call takes."""
    return np.vstack([rows, np.repeat(rows[-1:], _TICKS - len(rows), axis=0)])


def _tick(loop: ClosedLoop, length: float, k: int, tolerance: float) -> ca.Function:
    """state, reference with derivatives (3 k, 1), noise, load -> state after the tick, command, status."""
    size = loop.plant_rate.size1_in(0)
    plant = held_plant(loop, length, tolerance)
    state, reference = ca.MX.sym("state", size), ca.MX.sym("reference", 3 * k)
    noise, load = ca.MX.sym("noise", size), ca.MX.sym("load", loop.loads.size)
    command, status = loop.commanded(state + noise, (reference[:k], reference[k : 2 * k], reference[2 * k :]))
    end = plant(x0=state, p=ca.vertcat(command, load))["xf"]
    return ca.Function("tick", [state, reference, noise, load], [end, command, status])
