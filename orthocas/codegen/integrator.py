"""Integrates closed loops of compiled functions (ours)."""

import ctypes
from typing import Any

import numpy as np

from orthocas.casadi_tools.interrupts import deferred
from orthocas.checks import Array
from orthocas.codegen.compiled_functions import Kernel, runner
from orthocas.errors import SimulationError

_STAGES = 12  # as in templates/runner.c.in


class _State(ctypes.Structure):
    """`loop` of templates/runner.c.in."""

    _fields_ = (
        *((name, Kernel) for name in ("law", "plant", "profile")),
        *((name, ctypes.c_int) for name in ("n", "k", "size", "load_size")),
        *((name, ctypes.c_double) for name in ("tolerance", "step")),
        ("work", ctypes.c_void_p),
    )


class Integrator:
    """Dormand and Prince's method of order 8 for a closed loop, for one thread. It remembers the length of its steps.

    Args:
        kernels: law, plant and profile of the reference.
        sizes: numbers of joints, quantities, of a state, and of a load.
        tolerance: of a step, relative and absolute.
        step: to try first [s].
    """

    def __init__(
        self, kernels: tuple[Kernel, Kernel, Kernel], sizes: tuple[int, int, int, int], tolerance: float, step: float
    ) -> None:
        n, k, size, _ = sizes
        self._alive = kernels, np.zeros((_STAGES + 2) * size + 2 * n + 3 * k + 1)
        self._state = _State(*kernels, *sizes, tolerance, step, self._alive[1].ctypes.data)

    def continuous(
        self, parts: int, span: tuple[float, float], since: float, parameters: Array, load: Array, start: Array
    ) -> Array:
        """States at the ends of equal parts of a time span, (parts, s).

        Args:
            parts: number of parts.
            span: begin and end [s].
            since: when the segment of the reference began [s].
            parameters: of the segment.
            load: a row of the loads.
            start: state at the begin, (s,).

        Raises:
            SimulationError: if the steps become too short.
        """
        states = np.empty((parts, len(start)))
        times = [ctypes.c_double(t) for t in (*span, since)]
        given = [np.ascontiguousarray(array) for array in (parameters, load)]
        self._run("continuous", *times, *given, ctypes.c_long(parts), np.ascontiguousarray(start), states)
        return states

    def ticks(self, period: float, start: Array, *columns: Array) -> tuple[Array, Array, Array]:
        """States after ticks (N, s), commands (N, n) and status (N, 1).

        Args:
            period: length of a tick [s].
            start: state at the begin, (s,).
            columns: references with derivatives (N, 3 k), noise (N, s) and loads.

        Raises:
            SimulationError: if the steps become too short.
        """
        N, given = len(columns[0]), [np.ascontiguousarray(column) for column in columns]
        found = np.empty((N, len(start))), np.empty((N, self._state.n)), np.empty((N, 1))
        self._run("ticks", ctypes.c_double(period), ctypes.c_long(N), np.ascontiguousarray(start), *given, *found)
        return found

    def _run(self, name: str, *arguments: Any) -> None:
        pointers = [ctypes.c_void_p(a.ctypes.data) if isinstance(a, np.ndarray) else a for a in arguments]
        with deferred():
            failed = runner(name)(ctypes.byref(self._state), *pointers)
        if failed:
            raise SimulationError("the integrator gave up: its steps became too short, or too many")
