"""The inverse map of a chart in compiled C, for large batches on machines with a compiler."""

import ctypes
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from orthocas.charts.chart import Chart
from orthocas.charts.newton import SUSPICIOUS, Attempt, Newton
from orthocas.charts.solutions import Solutions
from orthocas.codegen.compiled import kept_library, loaded, template
from orthocas.codegen.generate import generate_c
from orthocas.codegen.library import STRICT
from orthocas.tools.batch import in_threads
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array, require_kind
from orthocas.tools.display import Shown
from orthocas.tools.files import draft_folder

_FLAGS = (*STRICT, "-O3")
_ROWS = "inverse_rows.c"
_PIECE = 512  # rows that a thread takes at once


@dataclass(frozen=True, eq=False, repr=False)
class CompiledInverse(Shown):
    """`Chart.solve` in compiled C; `orthocas.compile_inverse` makes it."""

    chart: Chart
    library: Path  #: the shared library

    def facts(self) -> dict[str, str]:
        """What `str` shows: the chart's problem and the file of the library."""
        return {"inverse": f"compiled, of the chart of {self.chart.problem.name}", "library": str(self.library)}

    def solve(
        self, phi: ArrayLike, q_start: ArrayLike | None = None, *, tolerance: float = 1e-9, inside: bool = False
    ) -> Solutions:
        """As `Chart.solve`: the same status for each row and the same q to 1e-9, unless starts are far away."""
        return self.chart.solve(phi, q_start, tolerance=tolerance, inside=inside, local=self._local)

    def _local(self, targets: Array, starts: Array) -> Attempt:
        """Search from starts (N, n); where C finds nothing, NumPy finds how near one can get."""
        attempt, condition = Attempt.empty(*targets.shape), np.empty(len(targets))
        given = np.ascontiguousarray(targets), np.ascontiguousarray(starts)

        def solve_piece(first: int) -> None:
            rows = slice(first, first + _PIECE)
            phi, q_start, q, found = (array[rows] for array in (*given, attempt.q, attempt.residual))
            arrays = (phi, q_start, self.chart.phi_sizes, q, found, condition[rows])
            self._c(ctypes.c_long(len(phi)), *(ctypes.c_void_p(array.ctypes.data) for array in arrays))

        in_threads(solve_piece, range(0, len(targets), _PIECE))
        phi_map = self.chart.phi_map
        attempt.residual[:] = phi_map.difference(targets, attempt.residual) / phi_map.scale(targets)
        attempt.iterations[:], attempt.suspicious[:] = 1, ~(condition < SUSPICIOUS)
        failed = np.flatnonzero(condition < 0)
        if failed.size:
            attempt.replace(failed, Newton(phi_map)(targets[failed], starts[failed]))
        return attempt

    @cached_property
    def _c(self) -> Any:
        function = loaded(self.library).arm_inverse_rows
        function.restype = None
        return function


def compile_inverse(chart: Chart, folder: str | Path | None = None) -> CompiledInverse:
    """Compile the inverse map of a chart, or find it compiled earlier; for batches of 100,000 rows and more.

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
    with draft_folder() as drafts:
        generate_c(chart, drafts, name="arm")
        sources = {name: (drafts / name).read_text(encoding="utf-8") for name in ("arm.h", "arm.c")}
    sources[_ROWS] = template(_ROWS)
    return CompiledInverse(chart, kept_library("inverse", sources, (*_FLAGS, f"-DN={chart.n}"), folder))
