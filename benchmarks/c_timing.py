"""Compiles CasADi functions to a shared library and times them in C, several functions in one process."""

import ctypes
import re
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from statistics import median

import casadi as ca
import numpy as np

_HARNESS = r"""
#include <time.h>
#include <stddef.h>
typedef int (*function)(const double**, double**, long long*, double*, int);
/* nanoseconds of this thread per call, over `calls` calls on `states` consecutive input sets */
double time_calls(function f, const double* inputs, int n_in, const int* sizes, int states, double** out,
                  long long* iw, double* w, long calls) {
  struct timespec a, b;
  const double* arg[8];
  int total = 0;
  for (int i = 0; i < n_in; ++i) total += sizes[i];
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &a);
  for (long k = 0; k < calls; ++k) {
    const double* p = inputs + (size_t)(k % states) * total;
    for (int i = 0; i < n_in; ++i) { arg[i] = p; p += sizes[i]; }
    f(arg, out, iw, w, 0);
  }
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &b);
  return ((b.tv_sec - a.tv_sec) * 1e9 + (b.tv_nsec - a.tv_nsec)) / calls;
}
"""


def nanoseconds_per_call(
    functions: dict[str, ca.Function],
    rounds: int = 9,
    calls: int = 100_000,
    sources: Mapping[str, str] | None = None,
    pick: Callable[[list[float]], float] = median,
) -> dict[str, float]:
    """Time of each function over alternating rounds, their median or what `pick` takes, by gcc -O3 -march=native.

    All functions take the same inputs, 64 random states. CasADi generates the C code, except for functions with their
    own code in `sources`, which has the same interface.
    """
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None:
        raise RuntimeError("no C compiler found, expected gcc or cc on the PATH")
    first = next(iter(functions.values()))
    sizes = np.array([first.numel_in(i) for i in range(first.n_in())], dtype=np.int32)
    inputs = np.random.default_rng(0).uniform(-1, 1, (64, int(sizes.sum())))
    with tempfile.TemporaryDirectory() as folder:
        library = _compile(compiler, Path(folder), functions, sources or {})
        times: dict[str, list[float]] = {name: [] for name in functions}
        for _ in range(rounds):
            for name, function in functions.items():
                times[name].append(_time(library, name, function, inputs, sizes, calls))
    return {name: pick(values) for name, values in times.items()}


def _compile(compiler: str, folder: Path, functions: dict[str, ca.Function], sources: Mapping[str, str]) -> ctypes.CDLL:
    files = [folder / "harness.c"]
    files[0].write_text(_HARNESS)
    for name, function in functions.items():
        files.append(folder / f"{name}.c")
        if name in sources:
            files[-1].write_text(sources[name])
            continue
        generator = ca.CodeGenerator(f"{name}.c", {"main": False, "mex": False})
        generator.add(_renamed(name, function))
        generator.generate(f"{folder}/")
    target = folder / "timing.so"
    command = [compiler, "-O3", "-march=native", "-shared", "-fPIC", "-o", str(target), *map(str, files), "-lm"]
    subprocess.run(command, check=True)
    return ctypes.CDLL(str(target))


def _renamed(name: str, function: ca.Function) -> ca.Function:
    symbols = [ca.SX.sym(f"i{i}", *function.size_in(i)) for i in range(function.n_in())]
    return ca.Function(re.sub(r"\W", "_", name), symbols, function.call(symbols))


def _time(
    library: ctypes.CDLL, name: str, function: ca.Function, inputs: np.ndarray, sizes: np.ndarray, calls: int
) -> float:
    outputs = [np.zeros(max(1, function.nnz_out(i))) for i in range(function.n_out())]
    pointers = (ctypes.c_void_p * 8)(*(out.ctypes.data for out in outputs))
    work, integers = np.zeros(function.sz_w() + 10_000), np.zeros(1000, dtype=np.int64)
    library.time_calls.restype = ctypes.c_double
    return float(
        library.time_calls(
            ctypes.cast(getattr(library, name), ctypes.c_void_p),
            inputs.ctypes.data_as(ctypes.c_void_p),
            ctypes.c_int(len(sizes)),
            sizes.ctypes.data_as(ctypes.c_void_p),
            ctypes.c_int(len(inputs)),
            pointers,
            integers.ctypes.data_as(ctypes.c_void_p),
            work.ctypes.data_as(ctypes.c_void_p),
            ctypes.c_long(calls),
        )
    )
