"""The inverse map of a chart in compiled C, for large batches on machines with a compiler."""

import ctypes
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from orthocas.charts.chart import Chart
from orthocas.charts.curves import SelfMotionCurves
from orthocas.charts.inverse import Inverse, Solutions
from orthocas.charts.methods import solve_with, targets_of_wish
from orthocas.charts.newton import NEWTON, Attempt, Newton
from orthocas.codegen.compiled import kept_library, loaded, template
from orthocas.codegen.compiled_curves import CompiledCurves, curve_source
from orthocas.codegen.generate import generate_c
from orthocas.tools.batch import run_in_threads
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array, Indices, require_kind
from orthocas.tools.display import Shown
from orthocas.tools.files import open_draft_folder

_FLAGS = ("-O3",)  # no warnings as errors: compilers doubt pointers of CasADi that pass the end of an array
_ROWS = "inverse_rows.c"
_ITERATIONS, _FEW_ITERATIONS = 100, 12  # evaluations of phi, also where another search follows
_PIECE = 512  # rows that a thread takes at once


@dataclass(frozen=True, eq=False, repr=False)
class CompiledInverse(Shown):
    """`Chart.solve` and `Chart.nearest_xi` in compiled C; `orthocas.compile_inverse` makes it."""

    chart: Chart
    library: Path  #: the shared library

    def facts(self) -> dict[str, str]:
        """What `str` shows: the chart's problem and the file of the library."""
        return {"inverse": f"compiled, of the chart of {self.chart.problem.name}", "library": str(self.library)}

    def solve(
        self, phi: ArrayLike, q_start: ArrayLike | None = None, *, tolerance: float = 1e-9, inside: bool = False
    ) -> Solutions:
        """As `Chart.solve`: the same status for each row and the same q to 1e-9, unless starts are far away."""
        return solve_with(self._parts, self.chart, phi, q_start, tolerance, inside)

    def nearest_xi(self, q_wish: ArrayLike, x: ArrayLike | None = None, *, tolerance: float = 1e-9) -> Solutions:
        """As `Chart.nearest_xi`."""
        phi, wishes = targets_of_wish(self.chart, q_wish, x)
        return self.solve(phi, wishes, tolerance=tolerance, inside=True)

    @cached_property
    def _parts(self) -> Inverse:
        """Those of the chart, with compiled searches in their places."""
        parts = self.chart.parts.inverse
        curves = parts.curves
        if isinstance(curves, SelfMotionCurves):
            curves = CompiledCurves(curves, lambda: self._c)
        return replace(parts, local=self._local, brief=self._brief, curves=curves)

    def _local(self, targets: Array, starts: Array) -> Attempt:
        """Search from starts (N, n); where C finds nothing, NumPy finds how near one can get."""
        attempt, failed = self._attempt(targets, starts, _ITERATIONS)
        if failed.size:
            attempt.replace(failed, Newton(self.chart.parts.phi_map)(targets[failed], starts[failed]))
        return attempt

    def _brief(self, targets: Array, starts: Array) -> Attempt:
        """Search from starts (N, n); rows where C finds nothing soon stay there."""
        attempt, failed = self._attempt(targets, starts, _FEW_ITERATIONS)
        attempt.q[failed] = starts[failed]
        attempt.residual[failed] = self.chart.parts.phi_map.residual(targets[failed], starts[failed])
        return attempt

    def _attempt(self, targets: Array, starts: Array, iterations: int) -> tuple[Attempt, Indices]:
        """What C finds from starts (N, n), and the rows where that is nothing."""
        attempt, condition = Attempt.empty(*targets.shape), np.empty(len(targets))
        given, rows_in_c = (np.ascontiguousarray(targets), np.ascontiguousarray(starts)), self._c.arm_inverse_rows
        rows_in_c.restype = None

        def solve_piece(first: int) -> None:
            rows = slice(first, first + _PIECE)
            phi, q_start, q, found = (array[rows] for array in (*given, attempt.q, attempt.residual))
            arrays = (phi, q_start, self.chart.parts.phi_sizes, q, found, condition[rows])
            rows_in_c(
                ctypes.c_long(len(phi)),
                ctypes.c_int(iterations),
                *(ctypes.c_void_p(array.ctypes.data) for array in arrays),
            )

        run_in_threads(solve_piece, range(0, len(targets), _PIECE))
        phi_map = self.chart.parts.phi_map
        attempt.residual[:] = phi_map.difference(targets, attempt.residual) / phi_map.scale(targets)
        attempt.iterations[:], attempt.suspicious[:] = 1, ~(condition < NEWTON.suspicious)
        return attempt, np.flatnonzero(condition < 0)

    @cached_property
    def _c(self) -> Any:
        return loaded(self.library)


def compile_inverse(chart: Chart, folder: str | Path | None = None) -> CompiledInverse:
    """Compile the inverse map of a chart, or find it compiled earlier; for large batches.

    The first call for a chart generates and compiles C, which takes some seconds. Later calls, also in other processes,
    find the library in the folder: its name is a digest of the C code, the compiler and its options.

    Args:
        chart: a chart with a closed expression.
        folder: where compiled libraries are kept; default `orthocas/libraries` in $XDG_CACHE_HOME
            or ~/.cache. Only the user and root may be able to write there.

    Raises:
        CompileError: if there is no C compiler, or others may write to the folder.
        NoExpressionError: if the chart is grown.
        InvalidValueError: if the folder cannot be written.

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
    with open_draft_folder() as drafts:
        generate_c(chart, drafts, name="arm")
        sources = {name: (drafts / name).read_text(encoding="utf-8") for name in ("arm.h", "arm.c")}
    sources[_ROWS] = template(_ROWS)
    curves = chart.parts.inverse.curves
    if isinstance(curves, SelfMotionCurves):
        sources["curves.c"] = curve_source(chart, curves)
    return CompiledInverse(chart, kept_library("inverse", sources, (*_FLAGS, f"-DN={chart.n}"), folder))
