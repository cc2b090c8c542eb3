"""Closed loops with a sampled controller: the command is held between ticks while the plant is integrated."""

from collections.abc import Callable, Iterator

import casadi as ca
import numpy as np

from orthocas.casadi_tools.cached import building
from orthocas.casadi_tools.interrupts import deferred
from orthocas.checks import Array
from orthocas.control.reference import Reference
from orthocas.simulation.closed_loop import ClosedLoop, Held, Piece, cvodes_options, run_compiled
from orthocas.simulation.compiled_loop import CompiledLoop
from orthocas.simulation.disturbances import Noise

_TICKS = 50  # ticks per integrator call
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
    run = _by_cvodes(loop, period, k, tolerance) if compiled is None else compiled.ticks(period, tolerance)
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


def _by_cvodes(loop: ClosedLoop, period: float, k: int, tolerance: float) -> Ticks:
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
