"""Closed loops in continuous time, integrated segment by segment, so that no step goes across a jump."""

from collections.abc import Callable, Iterator
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np

from orthocas.casadi_tools.cached import building
from orthocas.casadi_tools.interrupts import deferred
from orthocas.checks import Array
from orthocas.control.reference import Reference
from orthocas.simulation.closed_loop import ClosedLoop, Piece, cvodes_options, run_compiled
from orthocas.simulation.compiled_loop import CompiledLoop
from orthocas.simulation.disturbances import Push

_OUTPUTS = 25  # instants per integrator call: one integrator serves all calls, and Ctrl-C waits for one call at most


_SAME = 1e-9  # [s]: events closer than this differ only by rounding


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
        _by_cvodes(loop, reference, tolerance)
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


def _by_cvodes(loop: ClosedLoop, reference: Reference, tolerance: float) -> Integrator:
    with deferred(), building:  # CasADi may lose Ctrl-C while it builds functions
        integrator = _integrator(loop, reference, tolerance)

    def run(span: tuple[float, float], since: float, parameters: Array, load: Array, state: Array) -> Array:
        p = np.concatenate([[span[1] - span[0], span[0] - since], parameters, load])
        return np.asarray(run_compiled(integrator, x0=ca.DM(state), p=ca.DM(p))["xf"]).T

    return run


def _pieces(reference: Reference, pushes: tuple[Push, ...], longest: float) -> Iterator[tuple[float, float]]:
    """Intervals of at most the given length, without a step of the reference or a change of load inside."""
    edges = np.array([*reference.times, *(t for push in pushes for t in (push.start, push.end))])
    borders = np.unique(edges[edges <= reference.duration])
    borders = borders[np.diff(borders, prepend=-1.0) > _SAME]
    for begin, end in pairwise(borders):
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
