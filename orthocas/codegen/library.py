"""Generated C as a compiled library, called from Python."""

import ctypes
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from orthocas.codegen.precision import DOUBLE, SINGLE, Precision
from orthocas.control.controller import Controller
from orthocas.errors import CompileError
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array, require_shape
from orthocas.tools.processes import run_program

STRICT = ("-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wshadow", "-Werror")
NO_DOUBLE = ("-Wdouble-promotion", "-Wfloat-conversion")  #: for code in single precision
_POINTER = ctypes.c_void_p


@dataclass(frozen=True)
class GeneratedC:
    """The location and names of a generated library."""

    folder: Path
    name: str  #: prefix of every C name, and of the files
    stack_bytes: int  #: largest stack use of a call
    single_precision: bool = False  #: whether its numbers are `float`, not `double`


def compilers() -> tuple[str, ...]:
    """Those of gcc and clang that are on the PATH, or cc if neither is.

    Raises:
        CompileError: if there is no compiler.
    """
    found = [path for name in ("gcc", "clang") if (path := shutil.which(name)) is not None]
    found = found or [path for path in (shutil.which("cc"),) if path is not None]
    if not found:
        raise CompileError("no C compiler found, expected gcc, clang or cc on the PATH")
    return tuple(found)


def compile_shared(
    generated: GeneratedC, folder: Path, flags: tuple[str, ...] = ("-O2",), compiler: str | None = None
) -> Path:
    """Compile a shared library in a folder, with warnings as errors; default compiler: the first of `compilers`.

    Raises:
        CompileError: if compilation fails; the message starts with the compiler's first lines.
    """
    library = folder / f"lib{generated.name}.so"
    source = generated.folder / f"{generated.name}.c"
    compiler = compilers()[0] if compiler is None else compiler
    warnings = (*STRICT, *(NO_DOUBLE if generated.single_precision else ()))
    command = [compiler, *warnings, *flags, "-fPIC", "-shared", "-o", str(library), str(source), "-lm"]
    run_program(command)
    return library


@dataclass(frozen=True, eq=False)
class CompiledLibrary:
    """The functions of a compiled library, with NumPy arrays and matrices (n, n)."""

    path: Path
    name: str
    n: int
    single_precision: bool = False

    @property
    def precision(self) -> Precision:
        """The number type of the library."""
        return SINGLE if self.single_precision else DOUBLE

    def chart(self, q: Array) -> tuple[Array, Array, int]:
        """phi (n,), J (n, n), status."""
        phi, J = self._zeros(self.n), self._zeros(self.n, self.n)
        return phi, J, self._call("chart", [q], [phi, J])

    def check(self) -> float:
        """Largest relative difference that the library finds between itself and the numbers it was generated with."""
        run = self.function("check")
        run.restype = self.precision.c_type
        return float(run())

    def curvature(self, q: Array, dq: Array, v: Array) -> tuple[Array, int]:
        """dJ/dt v (n,), status."""
        curvature = self._zeros(self.n)
        return curvature, self._call("chart_curvature", [q, dq, v], [curvature])

    def inverse(self, phi: Array, q_start: Array, *, max_iterations: int = 100) -> tuple[Array, int]:
        """q (n,), status; after at most so many evaluations of phi."""
        q, arrays = self._zeros(self.n), [self.numbers(array) for array in (phi, q_start)]
        for name, array in zip(("phi", "q_start"), arrays, strict=True):
            require_shape(name, array.shape, (self.n,))
        places = [array.ctypes.data_as(_POINTER) for array in (*arrays, q)]
        return q, int(self.function("inverse")(*places[:2], int(max_iterations), places[2]))

    def nearest(self, phi: Array, q_start: Array, largest_step: float) -> tuple[Array, int]:
        """q (n,), status."""
        run, q = self.function("nearest"), self._zeros(self.n)
        run.argtypes, run.restype = [_POINTER, _POINTER, self.precision.c_type, _POINTER], ctypes.c_int
        arrays = [self.numbers(array) for array in (phi, q_start)]
        for name, array in zip(("phi", "q_start"), arrays, strict=True):
            require_shape(name, array.shape, (self.n,))
        return q, int(run(*(array.ctypes.data for array in arrays), largest_step, q.ctypes.data))

    def dynamics(self, q: Array, dq: Array) -> tuple[Array, Array, Array, int]:
        """M (n, n), bias (n,), gravity (n,), status."""
        M, bias, gravity = self._zeros(self.n, self.n), self._zeros(self.n), self._zeros(self.n)
        return M, bias, gravity, self._call("dynamics", [q, dq], [M, bias, gravity])

    def control(self, q: Array, dq: Array, reference: Array, gains: Array) -> tuple[Array, int]:
        """Command (n,), status. Reference (3 k,) and gains hold the numbers of the C structs in order."""
        command = self._zeros(self.n)
        return command, self._call("control", [q, dq, reference, gains], [command])

    def spline(self, start: Array, target: Array, duration: float, time: float, last: Array | None = None) -> Array:
        """The reference (3 k,) at a time on the spline from a reference to rest at a target (k,).

        Where that is not finite, C returns the value of the last reference (default 0), at rest.
        """
        run, number = self.function("reference_spline"), self.precision.c_type
        run.argtypes, run.restype = [*[ctypes.c_void_p] * 2, number, number, ctypes.c_void_p], ctypes.c_int
        reference = self._zeros(3 * len(target)) if last is None else self.numbers(last).copy()
        ends = [self.numbers(end) for end in (start, target)]
        run(*(end.ctypes.data for end in ends), duration, time, reference.ctypes.data)
        return reference

    @property
    def domain(self) -> tuple[Array, Array]:
        """Lower and upper bounds, (n,) each."""
        lower, upper = (self._table(f"domain_{side}", self.n) for side in ("lower", "upper"))
        return lower, upper

    def default_gains(self, count: int) -> Array:
        """The gains that the library was generated with, (count,)."""
        return self._table("default_gains", count)

    def function(self, name: str) -> Any:
        """A function of the library, by its name without the prefix."""
        return getattr(self._c, f"{self.name}_{name}")

    def address(self, name: str) -> Any:
        """Pointer to a constant of the library, by its name without the prefix."""
        return ctypes.addressof(ctypes.c_char.in_dll(self._c, f"{self.name}_{name}"))

    def _table(self, name: str, count: int) -> Array:
        return np.array((self.precision.c_type * count).in_dll(self._c, f"{self.name}_{name}"), dtype=float)

    def numbers(self, values: ArrayLike) -> Array:
        """Values as a C array of the library's number type."""
        array = np.asarray(values)
        if array.dtype == self.precision.scalar:
            return np.ascontiguousarray(array)
        with np.errstate(over="ignore"):
            return np.ascontiguousarray(array, dtype=self.precision.scalar)

    def _zeros(self, *shape: int) -> Array:
        return np.zeros(shape, dtype=self.precision.scalar)

    @cached_property
    def _c(self) -> ctypes.CDLL:
        return ctypes.CDLL(str(self.path))

    def _call(self, function: str, inputs: list[Array], outputs: list[Array]) -> int:
        run = getattr(self._c, f"{self.name}_{function}")
        arrays = [self.numbers(array) for array in inputs] + outputs
        for array in arrays[: len(inputs)][:2]:  # q and dq; C would read beyond the end of a short array
            require_shape(f"an argument of {function}", array.shape[:1], (self.n,))
        return int(run(*(array.ctypes.data_as(ctypes.c_void_p) for array in arrays)))


def gain_numbers(controller: Controller) -> Array:
    """The gains of a controller in the order of the C struct."""
    return np.concatenate(list(controller.gains.values()))
