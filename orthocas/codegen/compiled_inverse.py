"""The inverse map of a chart in compiled C, for large batches on machines with a compiler."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from orthocas.charts.chart import Chart
from orthocas.charts.curve_tracer import SearchKernel, has_library
from orthocas.charts.inverse import Inverse, Solutions, build_phi, build_phi_of_wish, solve_rows
from orthocas.charts.newton import NEWTON, Attempt, Newton
from orthocas.codegen.generate import generate_c
from orthocas.codegen.rendering import get_source
from orthocas.native.libraries import keep_library, load_library, pointer
from orthocas.tools.batch import run_in_threads
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array, require_kind
from orthocas.tools.display import Shown
from orthocas.tools.files import open_draft_folder

# Warnings are not errors here, because compilers warn about CasADi's pointers past the end of an array.
_FLAGS = ("-O3",)
_ROWS = "inverse_rows.c"
# Largest number of evaluations of phi; the second is for searches that another search follows.
_ITERATIONS, _FEW_ITERATIONS = 100, 12
# Rows per task of a thread.
_PIECE = 512


def compile_inverse(chart: Chart, folder: str | Path | None = None) -> CompiledInverse:
    """Compile the inverse map of a chart, or load it if it was compiled before; for large batches.

    The first call for a chart generates and compiles C, which takes some seconds. Later calls, also in other processes,
    find the library in the folder by its name, which is a digest of the C code, the compiler and its options.

    Args:
        chart: a chart with a closed expression.
        folder: cache of compiled libraries; default `orthocas/libraries` in $XDG_CACHE_HOME or ~/.cache. Only the user
            and root may have the right to write there.

    Raises:
        CompileError: if there is no C compiler, or others may write to the folder.
        NoExpressionError: if the chart is grown.
        InvalidValueError: if the folder is not writable.

    Example:
        >>> from tempfile import TemporaryDirectory
        >>> import orthocas as oc
        >>> from orthocas import problems
        >>> chart = oc.fit(problems.get("planar_3r_xy"), oc.Polynomial(degree=2), samples=300).chart
        >>> with TemporaryDirectory() as folder:  # or without a folder, to keep the library
        ...     compiled = oc.compile_inverse(chart, folder)
        ...     solutions = compiled.solve(chart.phi([[0.7, 0.9, 0.6], [0.6, 0.8, 0.8]]))
        >>> solutions.found.tolist()
        [True, True]
    """
    require_kind("chart", chart, Chart)
    # The library of the chart and a loop over many rows; the tracer of self-motions is a separate library.
    with open_draft_folder() as drafts:
        generate_c(chart, drafts, name="arm")
        sources = {path.name: path.read_text(encoding="utf-8") for path in sorted(drafts.glob("*.[hc]"))}
    sources[_ROWS] = get_source(_ROWS)
    library = keep_library("inverse", sources, (*_FLAGS, f"-DN={chart.n}"), folder)
    # Compile it now, so that no later call waits for it.
    has_library(SearchKernel(chart, library.parent))
    return CompiledInverse(chart, library)


@dataclass(frozen=True, eq=False, repr=False)
class CompiledInverse(Shown):
    """`Chart.solve` and `Chart.nearest_xi` in compiled C, built by `orthocas.compile_inverse`."""

    chart: Chart
    library: Path  #: the shared library

    def facts(self) -> dict[str, str]:
        """The chart's problem and the file of the library."""
        return {"inverse": f"compiled, of the chart of {self.chart.problem.name}", "library": str(self.library)}

    def solve(
        self,
        phi: ArrayLike | None = None,
        q_start: ArrayLike | None = None,
        *,
        x: Any = None,
        xi: ArrayLike | None = None,
        tolerance: float = 1e-9,
        inside: bool = False,
    ) -> Solutions:
        """Solve like `Chart.solve`, with equal statuses and equal q to 1e-9, unless starts are far away."""
        return solve_rows(self.chart, self._parts, build_phi(self.chart, phi, x, xi), q_start, tolerance, inside)

    def nearest_xi(self, q_wish: ArrayLike, x: Any = None, *, tolerance: float = 1e-9) -> Solutions:
        """Solve like `Chart.nearest_xi`."""
        phi, wishes = build_phi_of_wish(self.chart, q_wish, x)
        return self.solve(phi, wishes, tolerance=tolerance, inside=True)

    @cached_property
    def _parts(self) -> Inverse:
        """The parts of the chart's inverse map, with compiled searches."""
        parts = self.chart.parts.inverse
        curves = parts.curves
        if curves is not None:
            curves = replace(curves, kernel=SearchKernel(self.chart, self.library.parent))
        local, brief = partial(self._search, _ITERATIONS), partial(self._search, _FEW_ITERATIONS)
        return replace(parts, local=local, brief=brief, curves=curves)

    def _search(self, iterations: int, targets: Array, starts: Array) -> Attempt:
        """Search from starts (N, n) in C."""
        N, phi_map = len(targets), self.chart.parts.phi_map
        # C expects contiguous rows, whatever the memory order of the targets.
        q, residual, condition = starts.copy(), np.empty(targets.shape), np.empty(N)
        inside = np.empty(N, dtype=np.bool_)
        arrays = np.ascontiguousarray(targets), q, residual, condition, inside

        def solve_piece(first: int) -> None:
            rows = slice(first, first + _PIECE)
            places = (pointer(array[rows]) for array in arrays)
            self._c.arm_inverse_rows(ctypes.c_long(min(_PIECE, N - first)), iterations, *places)

        run_in_threads(solve_piece, range(0, N, _PIECE))
        attempt = Attempt(q, residual, np.ones(N, dtype=np.int64), ~(condition < NEWTON.suspicious), inside)
        # Where C finds no solution, NumPy finds the nearest point, unless another search follows.
        failed = np.flatnonzero(condition < 0)
        if failed.size and iterations == _FEW_ITERATIONS:
            residual[failed] = phi_map.residual(targets[failed], starts[failed])
        elif failed.size:
            attempt.replace(failed, Newton(phi_map)(targets[failed], starts[failed]))
        return attempt

    @cached_property
    def _c(self) -> Any:
        return load_library(self.library)
