"""`generate_c`: writes charts, the robot's dynamics and a controller as a small C library."""

from pathlib import Path
from typing import Protocol

from orthocas.charts.chart import Chart
from orthocas.codegen.boundary import Source
from orthocas.codegen.chart_source import ChartSource
from orthocas.codegen.library import GeneratedC
from orthocas.codegen.library_files import write_library
from orthocas.control.controller import Controller
from orthocas.control.safety import Safety
from orthocas.errors import InvalidValueError
from orthocas.tools.checks import part_hint


class Charts(Protocol):
    """Several charts that become one library: an atlas, or a part of one."""

    def c_source(self) -> Source:
        """What C is written from."""
        ...


def generate_c(
    chart: Chart | Charts,
    out: str | Path,
    controller: Controller | None = None,
    name: str | None = None,
    force: bool = False,
    safety: Safety | None = None,
    single_precision: bool = False,
    rows: bool = False,
) -> GeneratedC:
    """Write C99 for a chart, the robot's dynamics, the inverse map, and a controller.

    NAME.c and NAME.h have a plain C interface, with a status for every call and outputs that are always finite.
    CMakeLists.txt builds a static and a shared library, NAME.pc.in is for pkg-config, README.md describes the library.
    The parameters of the chart are constants; state, reference and gains are arguments.

    Args:
        chart: a chart with a closed expression; or an atlas, or a part of it (`orthocas.AtlasPart`), whose charts
            become tables with one code for all.
        out: folder, created if its parent exists; replaces a library with the same name that was generated there.
        controller: a controller of this chart, or of its problem (projectors); for atlases a law on any chart of the
            atlas, whose settings hold for all charts; default none.
        name: a C identifier; default from the names of problem and controller.
        force: also replace files of the same names that were not generated.
        safety: settings of the supervised law; default `Safety.of(controller)`.
        single_precision: whether numbers are `float` instead of `double`, for processors that compute in single
            precision only.
        rows: also write NAME_rows.c and NAME_rows.h with NAME_phi_rows, phi of many joint positions, for vector
            instructions. Not for large networks, and not for atlases.

    Raises:
        NoExpressionError: if the chart is grown; `orthocas.distil` turns it into a chart with a closed expression.
        InvalidValueError: if the name is not a C identifier, the controller belongs to another chart, the chart has
            too many operations for rows, or the folder has a file of the same name that was not generated.
        ArchiveError: if the folder is not writable, or a file there is a symbolic link.
        CompileError: if this version of CasADi generates C of an unexpected form.

    Example:
        >>> from tempfile import TemporaryDirectory
        >>> import orthocas as oc
        >>> from orthocas import problems
        >>> chart = oc.fit(problems.get("planar_3r_xy"), oc.Polynomial(degree=2), samples=300).chart
        >>> with TemporaryDirectory() as folder:
        ...     generated = oc.generate_c(chart, folder, name="arm")
        ...     sorted(path.name for path in generated.folder.iterdir())
        ['CMakeLists.txt', 'README.md', 'arm.c', 'arm.h', 'arm.pc.in']
    """
    source = _source(chart)
    if rows and not isinstance(source, ChartSource):
        raise InvalidValueError("rows", rows, "False for an atlas, whose charts are evaluated one position at a time")
    return write_library(source, out, controller, name, force, safety, single_precision, rows)


def _source(charts: Chart | Charts) -> Source:
    """What C is written from."""
    if isinstance(charts, Chart):
        return ChartSource(charts)
    if not hasattr(charts, "c_source"):
        wanted = f"a Chart, an Atlas or a part of one{part_hint(charts, Chart)}"
        raise InvalidValueError("chart", f"a {type(charts).__name__}", wanted)
    return charts.c_source()
