"""`generate_c`: writes a chart, the robot's dynamics and a controller as a small C library."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from orthocas.charts.chart import Chart
from orthocas.charts.chart_file import fingerprint
from orthocas.codegen.distance import bound_distance_stack, render_distance
from orthocas.codegen.rendering import (
    DOUBLE,
    SINGLE,
    Precision,
    clean_word,
    clean_words,
    find_bounds_inside,
    get_runtime,
    is_generated,
    render,
)
from orthocas.codegen.supervision import build_supervision_kernels, describe_law, describe_supervision, find_condition
from orthocas.control.controller import Controller, require_controller
from orthocas.control.memory import find_memory
from orthocas.control.safety import Safety
from orthocas.errors import ArchiveError, InvalidValueError
from orthocas.native.kernels import Kernels, generate_kernels, share_calls, share_sines
from orthocas.robots.capsules import FittedCapsules
from orthocas.robots.kinematics import TipTurn
from orthocas.tools.checks import Array, as_path, require_kind, require_shape
from orthocas.tools.expressions import choose_form, expand_scalars
from orthocas.tools.files import open_output_folder, publish, require_writable
from orthocas.version import VERSION

# Names of C headers and libraries, which are not allowed for our libraries.
_TAKEN = (
    *("assert", "complex", "ctype", "errno", "fenv", "float", "inttypes", "iso646", "limits", "locale", "math"),
    *("setjmp", "signal", "stdarg", "stdbool", "stddef", "stdint", "stdio", "stdlib", "string", "tgmath", "time"),
    *("wchar", "wctype", "features", "endian", "strings", "unistd", "pthread", "sched", "dlfcn", "alloca", "threads"),
    *("orthocas", "orthocas_runtime", "orthocas_runtime_float"),
    *("uchar", "stdalign", "stdatomic", "stdnoreturn", "m", "c", "dl", "rt"),
)


@dataclass(frozen=True, slots=True)
class LibraryRules:
    """Numbers of generated libraries."""

    #: stack for local variables [bytes]; 1 to 4.5 KiB with up to seven joints (tests/codegen/test_c_safety.py)
    locals_bytes: int = 5120
    evaluations: int = 100  #: largest number of evaluations of the chart in one call of the inverse map
    contact_margin: float = 0.02  #: clearance between links under the supervised law [m]


RULES = LibraryRules()


@dataclass(frozen=True)
class GeneratedC:
    """The location and names of a generated library."""

    folder: Path
    name: str  #: prefix of every C name and of the files
    stack_bytes: int  #: largest stack use of a call
    single_precision: bool = False  #: whether numbers are `float` instead of `double`


def generate_c(
    chart: Chart,
    out: str | Path,
    controller: Controller | None = None,
    name: str | None = None,
    force: bool = False,
    safety: Safety | None = None,
    single_precision: bool = False,
    capsules: FittedCapsules | None = None,
) -> GeneratedC:
    """Write C99 for a chart, the robot's dynamics, the inverse map, and a controller.

    NAME.c and NAME.h have a plain C interface, with a status for every call and outputs that are always finite.
    CMakeLists.txt builds a static and a shared library, NAME.pc.in is for pkg-config, and README.md describes the
    library. The parameters of the chart are constants; state, reference and gains are arguments.

    Args:
        chart: a chart with a closed expression.
        out: output folder, created if its parent exists. A library of the same name that was generated there is
            replaced.
        controller: a controller of this chart, or one of its problem without a chart; default: none.
        name: a C identifier; default: made from the names of problem and controller.
        force: also replace files of the same names that were not generated.
        safety: settings of the supervised law; default: `Safety.of(controller)`.
        single_precision: whether numbers are `float` instead of `double`, for processors with single precision only.
        capsules: result of `oc.fit_capsules(robot.collisions)`. Then NAME_distance.c and NAME_distance.h are written
            too, with NAME_distance, which returns the least distance between links and its gradient. With a torque law,
            the supervised law then keeps links 2 cm apart, and treats contacts as a part of its boundary.

    Raises:
        NoExpressionError: if the chart is grown. `orthocas.distil` fits an expression to such a chart.
        InvalidValueError: if the name is not a C identifier, the controller belongs to another chart, or the
            folder has a file of the same name that was not generated.
        ArchiveError: if the folder is not writable, or a file there is a symbolic link.
        CompileError: if this version of CasADi generates C in an unexpected form.

    Example:
        >>> from tempfile import TemporaryDirectory
        >>> import orthocas as oc
        >>> from orthocas import problems
        >>> chart = oc.fit(problems.get("planar_3r_xy"), oc.Polynomial(degree=2), samples=300).chart
        >>> with TemporaryDirectory() as folder:
        ...     generated = oc.generate_c(chart, folder, name="arm")
        ...     sorted(path.name for path in generated.folder.iterdir())
        ['CMakeLists.txt', 'README.md', 'arm.c', 'arm.h', 'arm.pc.in', 'orthocas_runtime.c', 'orthocas_runtime.h']
    """
    require_kind("chart", chart, Chart)
    if capsules is not None:
        require_kind("capsules", capsules, FittedCapsules)
        capsules.collisions.require_for(chart.problem.robot.tree)
    if controller is not None:
        safety = _check_law(chart, controller, safety)
    if name is None:
        words = f"{chart.problem.name}_{'chart' if controller is None else controller.name}"
        words = re.sub(r"\W", "_", words, flags=re.ASCII)[-90:]
        name = words if words[0].isalpha() else f"robot_{words}"
    require_name(name)

    # CasADi writes the functions as kernels; templates add the interface.
    precision = SINGLE if single_precision else DOUBLE
    kernels = generate_kernels(_build_functions(chart, controller, precision), f"{name}_kernel")
    stack_bytes = _bound_stack(kernels, chart, controller, precision.size)
    # The supervised law calls the distance within a tick.
    if capsules is not None and controller is not None:
        stack_bytes += bound_distance_stack(capsules, precision.size)
    values = _describe_library(chart, controller, name, precision, kernels) | {"stack_bytes": stack_bytes}
    values |= {"distances": capsules is not None, "contact_margin": RULES.contact_margin}
    values |= _describe_chart(chart, precision) | {"check": _compute_check(chart, controller, precision)}
    if controller is not None and safety is not None:
        values |= describe_law(controller) | describe_supervision(controller, safety)
    contents = {
        f"{name}.h": precision.translate(render("robot.h", values)),
        f"{name}.c": precision.translate(render("robot.c", values)),
        "CMakeLists.txt": render("CMakeLists.txt", values),
        f"{name}.pc.in": render("pkgconfig.pc", values),
        "README.md": render("README.md", values),
        **{f"{precision.runtime}.{end}": get_runtime(precision, end) for end in ("h", "c")},
    }
    if capsules is not None:
        contents |= render_distance(capsules, values, precision)

    # Write all files or, if one fails, none.
    folder = as_path("out", out)
    try:
        require_free_folder(folder, name, contents, force)
        with open_output_folder("out", folder) as place, publish(place) as drafts:
            for file, text in contents.items():
                (drafts / file).write_text(text, encoding="utf-8")
    except OSError as error:
        # The name may be too long, for example.
        raise ArchiveError(f"cannot write to {out}: {error.strerror}") from error
    return GeneratedC(folder, name, stack_bytes, single_precision)


def _check_law(chart: Chart, controller: Controller, safety: Safety | None) -> Safety:
    """Return the settings of the supervised law; raise InvalidValueError for a law of another chart."""
    require_controller(controller)
    if (controller.chart or chart) is not chart or controller.problem is not chart.problem:
        raise InvalidValueError("controller", f"a {controller.name} of another chart", "a controller of this chart")
    # Settings must have the same shapes as the default settings.
    default = Safety.of(controller)
    if safety is None:
        return default
    require_kind("safety", safety, Safety)
    for field in fields(Safety):
        require_shape(field.name, np.shape(getattr(safety, field.name)), np.shape(getattr(default, field.name)))
    return safety


def _build_functions(chart: Chart, controller: Controller | None, precision: Precision) -> list[ca.Function]:
    """The kernels, with matrices row by row. One kernel computes mass matrix, bias and gravity, which share code."""
    n, robot = chart.n, chart.problem.robot
    q, dq, v = (ca.MX.sym(name, n) for name in ("q", "dq", "v"))
    functions = [
        ca.Function("chart", [q], [chart.function("phi")(q), chart.function("jacobian")(q).T]),
        ca.Function("curvature", [q, dq, v], [chart.function("second_derivative")(q, dq, v)]),
        choose_form(ca.Function("dynamics", [q, dq], [robot.mass_matrix(q), robot.bias(q, dq), robot.gravity(q)]), n),
    ]
    if chart.parts.relative.turned:
        x, target = ca.MX.sym("x", chart.m), ca.MX.sym("target", chart.m)
        difference = ca.densify(chart.parts.relative.difference(target, x))
        functions.append(ca.Function("turned", [q, x, target], [difference, chart.parts.relative.rates(q).T]))
    near = chart.parts.reaching
    functions.append(ca.Function("near", near.mx_in(), near.call(near.mx_in())))
    domain = find_condition(chart)
    # A condition that contains network coordinates stays a graph.
    if domain is not None and domain.condition is not None:
        pivots = ca.Function("pivots", [q], [domain.condition.pivots(q)])
        functions.append(pivots if domain.condition.pivots.is_a("MXFunction") else expand_scalars(pivots))
    # The law and its supervision share values that depend on the state only.
    if controller is not None:
        graph = precision.graph(controller)
        inputs = graph.mx_in()
        law = [ca.Function("control", inputs, graph.call(inputs)), *build_supervision_kernels(controller)]
        functions += share_calls(law, {"control": 2, "deviation": 1, "implied": 2})
    return share_sines(functions)


def _bound_stack(kernels: Kernels, chart: Chart, controller: Controller | None, size: int) -> int:
    """Upper bound of the stack: work arrays of kernels and runtime, plus an allowance for other variables."""
    n, rooms = chart.n, max(1, chart.parts.reaching.size1_out(2))
    # Size of `work` in the runtime (orthocas_runtime.h), and copies of reference and gains.
    system = 2 * n + rooms
    inverse, law = n * (n + 7), 0
    nearest = 4 * n * n + 14 * n + 4 * rooms + 3 * n * rooms + system * (system + 1)
    if controller is not None:
        k, memory = len(controller.labels), find_memory(controller)
        remembered = 0 if memory is None else sum(map(len, memory.start.values()))
        law = 3 * n * n + 10 * n + 9 * k + kernels.numbers["shared"] + remembered
        law += 3 * k + sum(map(len, controller.gains.values()))
    # Compilers keep matrices in local variables, and some kernels run inside others.
    locals_ = round(RULES.locals_bytes * max(1.0, n / 7) ** 2)
    inner = [name for name in ("pivots", "gram", "room") if name in kernels.work]
    nested = sum(kernels.array_bytes(name, size) for name in inner)
    work = max(kernels.array_bytes(name, size) for name in kernels.work)
    longest = max(work + size * max(inverse, law), kernels.array_bytes("near", size) + size * nearest)
    return longest + nested + locals_


def _describe_library(
    chart: Chart, controller: Controller | None, name: str, precision: Precision, kernels: Kernels
) -> dict[str, Any]:
    """Values of the templates about names, versions, number type and kernels, but not about the law."""
    # `describe_law` adds the law later.
    what = "chart" if controller is None else f"{controller.name} controller"
    problem, label = chart.problem, chart.coordinates.label
    title = f"{what} of {problem.name}: {label}, task {problem.task.name}, metric {problem.metric.name}"
    return {
        "name": name,
        "NAME": name.upper(),
        "title": clean_word(title),
        "version": VERSION,
        "casadi_version": ca.CasadiMeta.version(),
        "max_evaluations": RULES.evaluations,
        "runtime": precision.runtime,
        **precision.describe(),
        "kernels": kernels.code,
        "work": kernels.sizes(),
        "arrays": kernels.declare_arrays,
        "call": kernels.write_call,
        "law": None,
    }


def _describe_chart(chart: Chart, precision: Precision) -> dict[str, Any]:
    """Values of the templates about the robot, its joints, task, coordinates and domain."""
    problem, tree, domain, condition = chart.problem, chart.problem.robot.tree, chart.problem.domain, None
    names, units = clean_words(tree.joint_names), ["m" if sliding else "rad" for sliding in tree.prismatic]
    if (conditioned := find_condition(chart)) is not None and (part := conditioned.condition) is not None:
        condition = {"heading": clean_word(part.heading), "size": part.pivots.size1_out(0)}
    # The boundaries, one line per joint.
    low, high = domain.bounds
    domain_lines = ["all joint positions"]
    if np.isfinite(low).any():
        ranges = ["all positions" if np.isinf(a) else f"{a:.6g} to {b:.6g}" for a, b in zip(low, high, strict=True)]
        domain_lines = [f"{name}: {range_}" for name, range_ in zip(names, ranges, strict=True)]
    # The convention of orientation components, and their reference rotation, row by row.
    orientation, turn = None, TipTurn.from_kind(problem.task.recipe["kind"])
    if turn is not None and "reference" in problem.task.recipe:
        orientation = {
            "first": turn.labels[3 if turn.with_position else 0],
            "axis": turn.axis,
            "whole": turn.whole,
            "reference": _write_row(np.ravel(problem.task.recipe["reference"])),
        }
    task_units = [f" [{unit}]" if unit else "" for unit in clean_words(problem.task.units)]
    task_labels = zip(clean_words(problem.task.labels), task_units, strict=True)
    proof, turns = chart.certificate, chart.parts.turns
    lower, upper = find_bounds_inside(domain, precision)
    return {
        "n": chart.n,
        "m": chart.m,
        "r": chart.r,
        "nn": chart.n**2,
        "joint_list": ", ".join(names),
        "joints": [
            {
                "name": name,
                "unit": unit,
                "range": f"{tree.lower[i]:.6g} to {tree.upper[i]:.6g}",
                "speed": _write_limit(tree.velocity_limits[i]),
                "effort": f"{_write_limit(tree.effort_limits[i])} {'N' if unit == 'm' else 'N m'}",
            }
            for i, (name, unit) in enumerate(zip(names, units, strict=True))
        ],
        "tip": clean_word(tree.tip_name),
        "gravity": _write_row(tree.gravity),
        "task_labels": ", ".join(label + unit for label, unit in task_labels),
        "orientation": orientation,
        "extra_labels": ", ".join(clean_words(chart.parts.named_coordinates)),
        "angles": [label for label, period in zip(clean_words(chart.labels), turns, strict=True) if period],
        "fingerprint": fingerprint(problem, chart.coordinates),
        "certificate": "none" if proof is None else f"{proof.heading} ({proof.method}, chart {proof.fingerprint[:16]})",
        "domain_lines": domain_lines,
        "condition": condition,
        "domain_lower": lower,
        "domain_upper": upper,
        "domain_centre": domain.centre,
        "domain_half_width": domain.half_width,
        "domain_reach": domain.reach,
        "rooms": max(1, chart.parts.reaching.size1_out(2)),
        "phi_sizes": chart.parts.phi_sizes,
        "phi_turns": turns,
        "phi_rounds": np.where(turns > 0, 1 / np.where(turns > 0, turns, 1.0), 0.0),
        "turned": chart.parts.relative.turned,
        "rotation": chart.parts.relative.turns,
    }


def _write_limit(limit: float) -> str:
    return f"{limit:.6g}" if np.isfinite(limit) else "unknown"


def _write_row(values: Array) -> str:
    return ", ".join(f"{value:.9g}" for value in values)


def _compute_check(chart: Chart, controller: Controller | None, precision: Precision) -> dict[str, Any]:
    """A state and the result of every function there, for `NAME_check`."""
    n, robot = chart.n, chart.problem.robot
    # Between the home and a corner of the domain, or in the middle of a corridor's path.
    domain = chart.problem.domain
    if (path := domain.path_bound) is not None:
        inside = path.postures[path.contains(path.postures)]
        q = np.asarray(inside[len(inside) // 2])
    else:
        corner = domain.centre + domain.half_width - domain.home
        fractions = [0.5**k for k in range(1, 20) if domain.contains(domain.home + 0.5**k * corner)]
        q = np.round(domain.home + (fractions[0] if fractions else 0.0) * corner, 3)
    q = precision.round(q)
    dq = precision.round(np.round(np.linspace(0.1, -0.2, n), 3))
    check: dict[str, Any] = {
        "q": q,
        "dq": dq,
        "phi": chart.phi(q),
        "jacobian": chart.jacobian(q),
        "curvature": chart.function("second_derivative")(q, dq, dq),
        "mass_matrix": robot.mass_matrix(q),
        "bias": robot.bias(q, dq),
    }
    if controller is not None:
        value = controller.measured(q).full().ravel() + 0.001
        reference = [precision.round(part) for part in (value, *np.full((2, len(value)), 0.01))]
        command, _ = controller.function(q, dq, *reference, *controller.gains.values())
        check |= {"reference": reference, "command": command}
    return check


def require_name(name: str) -> None:
    """Raise InvalidValueError unless C allows a name, and no C header or library has it."""
    is_identifier = isinstance(name, str) and re.fullmatch(r"[A-Za-z]\w{0,99}", name, flags=re.ASCII)
    if not is_identifier or name.lower() in _TAKEN:
        raise InvalidValueError(
            "name", repr(name), "a C identifier that is not a C header or library, such as arm_controller"
        )


def require_free_folder(out: Path, name: str, files: Iterable[str], force: bool) -> None:
    """Raise InvalidValueError if the folder contains files of the user that would be overwritten."""
    if out.exists() and not out.is_dir():
        raise InvalidValueError("out", str(out), "a folder")
    require_writable(out / "README.md" if out.is_dir() else out, ArchiveError)
    # Files that orthocas wrote may be replaced, others only with `force`.
    for path in (out / file for file in files):
        if path.is_symlink():
            raise ArchiveError(f"cannot write {path}: it is a symbolic link, expected a regular file or a new name")
        if path.exists() and not (force or is_generated(path)):
            raise InvalidValueError(
                "out",
                f"a folder with a {path.name} that orthocas did not write",
                "another folder, or force (--force) to replace it",
            )
    # The build file of another library must not be replaced either.
    build = out / "CMakeLists.txt"
    other = build.is_file() and f"project({name} " not in build.read_text(encoding="utf-8", errors="replace")
    if other and not force:
        raise InvalidValueError("out", "a folder with a library of another name", "another folder or the same name")
