"""`generate_c`: a chart, the robot's dynamics and a controller as a small C library."""

import os
import re
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import casadi as ca

from orthocas.archive import require_writable
from orthocas.chart import Chart
from orthocas.codegen.interface import filled, template_values
from orthocas.codegen.kernels import Kernels, generate_kernels
from orthocas.control import Controller
from orthocas.errors import ArchiveError, InvalidValueError
from orthocas.scalar_code import scalar_code

_LOCALS = 5 * 1024  # bytes; 1 to 4.5 KiB with gcc and clang for up to seven joints (tests/test_c_safety.py)
_TEMPLATES = ("robot.h", "robot.c", "CMakeLists.txt", "pkgconfig.pc", "README.md")


@dataclass(frozen=True)
class GeneratedC:
    """What was written where."""

    folder: Path
    name: str  #: prefix of every C name, and of the files
    stack_bytes: int  #: that a call needs at most


def generate_c(
    chart: Chart, out: str | Path, controller: Controller | None = None, name: str | None = None
) -> GeneratedC:
    """Write C99 for a chart, the robot's dynamics, the inverse map, and a controller.

    NAME.c and NAME.h have an interface of their own (plain C types, a status for every call, finite outputs in every
    case); CMakeLists.txt builds a static and a shared library, NAME.pc.in is for pkg-config, README.md describes them.
    The parameters of the chart are constant; state, reference and gains are arguments.

    Args:
        chart: a chart with a closed expression.
        out: folder, made if its parent exists; files in it with the same names are replaced.
        controller: of the same robot; default none.
        name: a C identifier; default from the problem and the controller.

    Raises:
        NoExpressionError: if the chart is grown; `orthocas.distil` makes one that can be generated.
        InvalidValueError: if the name is no C identifier, or the controller belongs to another robot.
        ArchiveError: if the folder cannot be written.
    """
    name = _name(chart, controller) if name is None else name
    if not re.fullmatch(r"[A-Za-z]\w*", name, flags=re.ASCII) or name == "math":  # math.h is taken
        raise InvalidValueError("name", repr(name), "a C identifier, such as arm_controller")
    if controller is not None and controller.problem.robot is not chart.problem.robot:
        raise InvalidValueError("controller", f"one of another robot ({controller.name})", "one of the chart's robot")
    kernels = generate_kernels(_functions(chart, controller), f"{name}_kernel")
    stack_bytes = _stack_bytes(kernels, chart.n)
    values = template_values(chart, controller, name, kernels, stack_bytes)
    folder = _folder(Path(out))
    names = {"robot.h": f"{name}.h", "robot.c": f"{name}.c", "pkgconfig.pc": f"{name}.pc.in"}
    _write(folder, {names.get(template, template): filled(template, values) for template in _TEMPLATES})
    return GeneratedC(folder, name, stack_bytes)


def _functions(chart: Chart, controller: Controller | None) -> list[ca.Function]:
    """The kernels; matrices row by row. Mass matrix, bias and gravity share much, so they are written out together."""
    n, robot = chart.n, chart.problem.robot
    q, dq = ca.MX.sym("q", n), ca.MX.sym("dq", n)
    found = [
        ca.Function("chart", [q], [chart.function("phi")(q), chart.function("jacobian")(q).T]),
        scalar_code(ca.Function("dynamics", [q, dq], [robot.mass_matrix(q), robot.bias(q, dq), robot.gravity(q)])),
    ]
    if controller is not None:
        graph = controller.graph
        inputs = graph.mx_in()
        found.append(ca.Function("control", inputs, graph.call(inputs)))
    return found


def _stack_bytes(kernels: Kernels, n: int) -> int:
    """Work arrays, those of the inverse map, and an allowance for local variables and for math.h."""
    inverse = kernels.array_bytes("chart") + 8 * n * (n + 6)
    locals_ = round(_LOCALS * max(1.0, n / 7) ** 2)  # compilers keep matrices there
    return max(inverse, *map(kernels.array_bytes, kernels.work)) + locals_


def _name(chart: Chart, controller: Controller | None) -> str:
    words = f"{chart.problem.name}_{'chart' if controller is None else controller.name}"
    return re.sub(r"\W", "_", words if words[0].isalpha() else f"robot_{words}", flags=re.ASCII)


def _folder(out: Path) -> Path:
    """The folder, made if needed."""
    if out.exists() and not out.is_dir():
        raise InvalidValueError("out", str(out), "a folder")
    require_writable(out / "README.md" if out.is_dir() else out, ArchiveError)
    out.mkdir(exist_ok=True)
    return out


def _write(folder: Path, contents: Mapping[str, str]) -> None:
    """All files or, if one cannot be written, none."""
    with tempfile.TemporaryDirectory(dir=folder, prefix=".orthocas-") as drafts:
        for name, text in contents.items():
            (Path(drafts) / name).write_text(text, encoding="utf-8")
        for name in contents:
            os.replace(Path(drafts) / name, folder / name)
