"""CasADi functions and integrators compiled for this process; equal code shares one library."""

import ctypes
from collections.abc import Sequence
from functools import cache
from typing import Any

import casadi as ca
import numpy as np
import scipy

from orthocas.codegen.rendering import render
from orthocas.errors import SimulationError
from orthocas.native.kernels import generate_kernels
from orthocas.native.libraries import keep_library, load_library, pointer
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array
from orthocas.tools.interrupts import deferred

# -O3 takes twice as long to compile, and gains little.
_FLAGS = ("-O2",)
_PREFIX = "kernel"
_ENTRY = """int {name}(const double **arg, double **res, int *iw, double *w) {{
  return {prefix}_{name}(arg, res, iw, w, 0);
}}"""
# As in templates/runner.c.jinja.
_STAGES = 12


class Kernel(ctypes.Structure):
    """The struct `kernel` of templates/runner.c.jinja: a function with its own work arrays, for one thread."""

    _fields_ = (
        ("run", ctypes.c_void_p),
        ("arg", ctypes.c_void_p),
        ("res", ctypes.c_void_p),
        ("iw", ctypes.c_void_p),
        ("w", ctypes.c_void_p),
    )
    # Keeps the targets of the pointers alive.
    _alive: tuple[Any, ...]


class CompiledFunctions:
    """Dense functions of columns in one shared library, which threads may share.

    Args:
        functions: functions with different names, whose inputs and outputs are columns.

    Raises:
        CompileError: as in `keep_library`.
    """

    def __init__(self, functions: Sequence[ca.Function]) -> None:
        kernels = generate_kernels(list(functions), _PREFIX)
        # Lengths of the work arrays and of the outputs, by function name.
        self._work = kernels.work
        self._outputs = {f.name(): [f.nnz_out(i) for i in range(f.n_out())] for f in functions}
        entries = [_ENTRY.format(name=name, prefix=_PREFIX) for name in self._outputs]
        code = "\n\n".join(["#include <math.h>\n#include <string.h>", kernels.code, *entries, ""])
        self.library = keep_library("functions", {"functions.c": code}, _FLAGS)

    def kernel(self, name: str, constants: Sequence[Array | None] = ()) -> Kernel:
        """A kernel for compiled code.

        Args:
            name: name of the function.
            constants: fixed inputs; None for those that the caller sets.
        """
        # The kernel owns its work arrays, and keeps the constants alive.
        arg, res, iw, w = (max(1, size) for size in self._work[name])
        arguments, results = (ctypes.c_void_p * arg)(), (ctypes.c_void_p * res)()
        integers, doubles = np.zeros(iw, dtype=np.intc), np.zeros(w)
        kept = [None if value is None else np.ascontiguousarray(value, dtype=float) for value in constants]
        for i, value in enumerate(kept):
            arguments[i] = None if value is None else value.ctypes.data
        run = ctypes.cast(getattr(self._c, name), ctypes.c_void_p)
        result = Kernel(
            run, ctypes.addressof(arguments), ctypes.addressof(results), integers.ctypes.data, doubles.ctypes.data
        )
        result._alive = (arguments, results, integers, doubles, kept)
        return result

    def rows(self, name: str, *arguments: Array) -> list[Array]:
        """Evaluate a function for N rows of each argument: (N, size), or (size,) for an argument equal in all rows."""
        N = max(len(argument) for argument in arguments if argument.ndim == 2)
        kernel = self.kernel(name, [None] * len(arguments))
        inputs = [np.ascontiguousarray(argument, dtype=float) for argument in arguments]
        outputs = [np.empty((N, size)) for size in self._outputs[name]]
        # Pointers to inputs and outputs, and strides from row to row, which are 0 if all rows are equal.
        places = [
            (ctypes.c_void_p * len(arrays))(*(array.ctypes.data for array in arrays)) for arrays in (inputs, outputs)
        ]
        strides = [
            (ctypes.c_long * len(arrays))(*(array.shape[1] if array.ndim == 2 else 0 for array in arrays))
            for arrays in (inputs, outputs)
        ]
        counts = [ctypes.c_int(len(arrays)) for arrays in (inputs, outputs)]
        rows = get_runner("rows")
        rows(ctypes.byref(kernel), ctypes.c_long(N), counts[0], places[0], strides[0], counts[1], places[1], strides[1])
        return outputs

    @cached_property
    def _c(self) -> ctypes.CDLL:
        return load_library(self.library)


@cache
def get_runner(name: str) -> Any:
    """A function of templates/runner.c.jinja that calls kernels."""
    method = scipy.integrate.DOP853
    tables = {"a": method.A, "b": method.B, "c": method.C, "e3": method.E3[:-1], "e5": method.E5[:-1]}
    source = render("runner.c", tables)
    return getattr(load_library(keep_library("runner", {"runner.c": source}, ("-O3",))), f"orthocas_{name}")


class _State(ctypes.Structure):
    """The struct `loop` of templates/runner.c.jinja."""

    _fields_ = (
        *((name, Kernel) for name in ("law", "plant", "profile")),
        *((name, ctypes.c_int) for name in ("n", "k", "size", "load_size")),
        *((name, ctypes.c_double) for name in ("tolerance", "step")),
        ("work", ctypes.c_void_p),
    )


class Integrator:
    """Dormand and Prince's method of order 8 for a closed loop, in one thread. It keeps its step length between calls.

    Args:
        kernels: law, plant, and profile of the reference.
        sizes: number of joints, number of quantities, size of the state, size of a load.
        tolerance: relative and absolute tolerance of a step.
        step: length of the first step [s].
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
            since: start time of the segment of the reference [s].
            parameters: parameters of this segment.
            load: one row of the loads.
            start: initial state, (s,).

        Raises:
            SimulationError: if the steps become too short.
        """
        states = np.empty((parts, len(start)))
        times = [ctypes.c_double(t) for t in (*span, since)]
        inputs = [np.ascontiguousarray(array) for array in (parameters, load)]
        self._run("continuous", *times, *inputs, ctypes.c_long(parts), np.ascontiguousarray(start), states)
        return states

    def ticks(self, period: float, start: Array, *columns: Array) -> tuple[Array, Array, Array]:
        """States after ticks (N, s), commands (N, n) and status (N, 1).

        Args:
            period: length of a tick [s].
            start: initial state, (s,).
            columns: references with derivatives (N, 3 k), noise (N, s) and loads.

        Raises:
            SimulationError: if the steps become too short.
        """
        N, inputs = len(columns[0]), [np.ascontiguousarray(column) for column in columns]
        result = np.empty((N, len(start))), np.empty((N, self._state.n)), np.empty((N, 1))
        self._run("ticks", ctypes.c_double(period), ctypes.c_long(N), np.ascontiguousarray(start), *inputs, *result)
        return result

    def _run(self, name: str, *arguments: Any) -> None:
        pointers = [pointer(a) if isinstance(a, np.ndarray) else a for a in arguments]
        with deferred():
            failed = get_runner(name)(ctypes.byref(self._state), *pointers)
        if failed:
            raise SimulationError("the integrator failed: it needs too many or too short steps")
