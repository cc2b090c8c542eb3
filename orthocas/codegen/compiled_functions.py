"""CasADi functions in compiled C, called from Python and by other compiled code (ours)."""

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from string import Template
from typing import Any

import casadi as ca
import numpy as np
import scipy

from orthocas.casadi_tools.cached import cached_property
from orthocas.checks import Array
from orthocas.codegen.kept_libraries import kept_library, loaded, template
from orthocas.codegen.kernels import generate_kernels

_FLAGS = ("-O2",)  # -O3 takes twice as long, and gains little
_PREFIX = "kernel"


class Kernel(ctypes.Structure):
    """`kernel` of templates/runner.c.in: a function with its own work arrays, for one thread."""

    _fields_ = (
        ("run", ctypes.c_void_p),
        ("arg", ctypes.c_void_p),
        ("res", ctypes.c_void_p),
        ("iw", ctypes.c_void_p),
        ("w", ctypes.c_void_p),
    )
    _alive: tuple[Any, ...]  # what the pointers point to


@dataclass(frozen=True, eq=False)
class _Function:
    """Sizes of a compiled function."""

    work: tuple[int, int, int, int]  #: lengths of arg, res, iw and w
    outputs: tuple[int, ...]


class CompiledFunctions:
    """Dense functions of columns in one shared library. Threads may share it.

    Args:
        functions: functions with different names. Inputs and outputs are columns.
        folder: where compiled libraries are kept; default as in `orthocas.compile_inverse`.

    Raises:
        CompileError: if there is no C compiler.
    """

    def __init__(self, functions: Sequence[ca.Function], folder: Path | None = None) -> None:
        kernels = generate_kernels(list(functions), _PREFIX)
        sizes = {f.name(): tuple(f.nnz_out(i) for i in range(f.n_out())) for f in functions}
        self._functions = {name: _Function(kernels.work[name], outputs) for name, outputs in sizes.items()}
        entries = [_ENTRY.format(name=name, prefix=_PREFIX) for name in sizes]
        code = "\n\n".join(["#include <math.h>\n#include <string.h>", kernels.code, *entries, ""])
        self.library = kept_library("functions", {"functions.c": code}, _FLAGS, folder)

    def kernel(self, name: str, constants: Sequence[Array | None] = ()) -> Kernel:
        """A function for compiled code.

        Args:
            name: of the function.
            constants: inputs that stay; None for those that the caller sets.
        """
        arg, res, iw, w = (max(1, size) for size in self._functions[name].work)
        arguments, results = (ctypes.c_void_p * arg)(), (ctypes.c_void_p * res)()
        integers, doubles = np.zeros(iw, dtype=np.intc), np.zeros(w)
        kept = [None if value is None else np.ascontiguousarray(value, dtype=float) for value in constants]
        for i, value in enumerate(kept):
            arguments[i] = None if value is None else value.ctypes.data
        run = ctypes.cast(getattr(self._c, name), ctypes.c_void_p)
        found = Kernel(
            run, ctypes.addressof(arguments), ctypes.addressof(results), integers.ctypes.data, doubles.ctypes.data
        )
        found._alive = (arguments, results, integers, doubles, kept)
        return found

    def rows(self, name: str, *arguments: Array) -> list[Array]:
        """Evaluate a function for N rows of each argument, (N, size) or, where all rows are equal, (size,)."""
        N = max(len(argument) for argument in arguments if argument.ndim == 2)
        kernel = self.kernel(name, [None] * len(arguments))
        inputs = [np.ascontiguousarray(argument, dtype=float) for argument in arguments]
        outputs = [np.empty((N, size)) for size in self._functions[name].outputs]
        places = [_pointers(arrays) for arrays in (inputs, outputs)]
        strides = [
            (ctypes.c_long * len(arrays))(*(array.shape[1] if array.ndim == 2 else 0 for array in arrays))
            for arrays in (inputs, outputs)
        ]
        counts = [ctypes.c_int(len(arrays)) for arrays in (inputs, outputs)]
        rows = runner("rows")
        rows(ctypes.byref(kernel), ctypes.c_long(N), counts[0], places[0], strides[0], counts[1], places[1], strides[1])
        return outputs

    @cached_property
    def _c(self) -> ctypes.CDLL:
        return loaded(self.library)


@cache
def runner(name: str) -> Any:
    """A function of templates/runner.c.in, which calls kernels."""
    method = scipy.integrate.DOP853
    tables = {"a": method.A, "b": method.B, "c": method.C, "e3": method.E3[:-1], "e5": method.E5[:-1]}
    values = {key: ", ".join(repr(float(x)) for x in table.ravel()) for key, table in tables.items()}
    source = Template(template("runner.c.in")).substitute(values)
    return getattr(loaded(kept_library("runner", {"runner.c": source}, ("-O3",))), f"orthocas_{name}")


def _pointers(arrays: Sequence[Array]) -> Any:
    return (ctypes.c_void_p * len(arrays))(*(array.ctypes.data for array in arrays))


_ENTRY = """int {name}(const double **arg, double **res, int *iw, double *w) {{
  return {prefix}_{name}(arg, res, iw, w, 0);
}}"""
