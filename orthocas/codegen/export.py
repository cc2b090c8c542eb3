"""`export`: charts and torque laws as small modules for NumPy, PyTorch or JAX that do not need orthocas."""

from __future__ import annotations

import re
import textwrap
from base64 import b64encode
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import casadi as ca
import numpy as np

from orthocas.charts.chart import Chart
from orthocas.charts.chart_file import fingerprint
from orthocas.codegen.distance import build_distance_form
from orthocas.codegen.export_forms import Form, build_form, build_inverse_forms, write_function, write_statuses
from orthocas.codegen.rendering import is_generated, render
from orthocas.control.controller import LARGEST, SMALLEST_VOLUME, ControlStatus
from orthocas.control.linear_algebra import SOFTEST
from orthocas.control.operational_space import Impedance, PDPlus
from orthocas.errors import ArchiveError, InvalidValueError
from orthocas.native.kernels import ROUNDS
from orthocas.robots.capsules import FittedCapsules
from orthocas.tools.batch import dense_function
from orthocas.tools.checks import Array, as_path, require_kind, require_known
from orthocas.tools.expressions import wrap_shortest
from orthocas.tools.files import publish, require_replaceable, require_writable
from orthocas.version import VERSION

_COMMON = ("from base64 import b64decode", "from functools import cache")
_ROUNDS = "LAST_ROUNDS = 2  # of the inverse, at a solution: two, so that third derivatives are right\n"
_SHARED = re.compile(r"_shared\((.*), q\)$", re.MULTILINE)
# Characters per line of base64.
_WIDTH = 100
TORQUE_LAWS = (Impedance, PDPlus)  #: laws that can be exported
_LAW_STATUSES = ("OK", "OUTSIDE_DOMAIN", "SINGULAR", "NOT_FINITE", "SATURATED")


def export(
    chart: Chart | Impedance | PDPlus,
    to: str,
    path: str | Path,
    force: bool = False,
    capsules: FittedCapsules | None = None,
) -> Path:
    """Write a chart as a Python module that needs only one library: "numpy", "torch" or "jax".

    The module has the functions `task`, `xi`, `phi` and `jacobian` of joint positions (n,) or (N, n), like a chart,
    `inverse` of phi from given starts, and `nearest_xi`. Results equal those of the chart up to rounding. With PyTorch
    and JAX, the functions are differentiable, run on GPUs, and keep the precision of q; see docs/how-to/export.md.

    For `control.PDPlus` and `control.Impedance` with PyTorch or JAX, the module also has `command`, the torques of the
    law with their status.

    Args:
        chart: a chart with a closed expression, or one of these laws on such a chart.
        to: the library.
        path: the output file NAME.py. It replaces an exported module of that name.
        force: replace any other file too.
        capsules: result of `oc.fit_capsules(robot.collisions)`. The module then has `distance`, the least distance
            between the capsules of the links, and `pair_distances`, the distances of all pairs.

    Returns:
        The path of the file.

    Raises:
        NoExpressionError: if the chart is grown. `orthocas.distil` fits an expression to such a chart.
        UnknownNameError: if there is no such library.
        InvalidValueError: if the path is not NAME.py, or NAME is that of the library; if a law has inputs at run time,
            or is exported to NumPy; if the capsules belong to another robot, or have no pairs.
        ArchiveError: if the file cannot be written, or an existing file was not exported.

    Example:
        >>> from tempfile import TemporaryDirectory
        >>> import orthocas as oc
        >>> from orthocas import problems
        >>> chart = oc.fit(problems.get("planar_3r_xy"), oc.Polynomial(degree=2), samples=300).chart
        >>> with TemporaryDirectory() as folder:
        ...     oc.export(chart, "torch", f"{folder}/arm.py").name
        'arm.py'
    """
    if not isinstance(chart, TORQUE_LAWS):
        require_kind("chart", chart, Chart)
    require_known("library", to, LIBRARIES)
    # Replace an existing file only if it was exported, or if forced.
    target = as_path("path", path)
    if target.suffix != ".py" or not target.stem.isidentifier() or target.stem in LIBRARIES:
        raise InvalidValueError("path", repr(str(target))[:200], f"a module NAME.py, other than {to}.py")
    require_writable(target)
    require_replaceable(target, is_generated(target), force)
    text = write_module(chart, to, capsules)
    try:
        with publish(target.parent) as drafts:
            (drafts / target.name).write_text(text, encoding="utf-8")
    except OSError as error:
        raise ArchiveError(f"cannot write {target}: {error.strerror}") from None
    return target


def write_module(chart: Chart | Impedance | PDPlus, to: str, capsules: FittedCapsules | None = None) -> str:
    """The text of the module."""
    if capsules is not None:
        require_kind("capsules", capsules, FittedCapsules)
        capsules.collisions.require_for((chart if isinstance(chart, Chart) else chart.chart).problem.robot.tree)
        if not capsules.collisions.pairs:
            raise InvalidValueError("capsules", "a model without pairs", "a model with pairs of links")
    # A law is exported with its chart.
    laws = []
    if isinstance(chart, TORQUE_LAWS):
        if to == "numpy":
            raise InvalidValueError("library", "'numpy'", "'torch' or 'jax', because laws need derivatives")
        laws, chart = [_build_law(chart)], chart.chart
    library, problem, task = LIBRARIES[to], chart.problem, chart.problem.task
    distances = [] if capsules is None else [build_distance_form(capsules)]
    coordinates, *others = forms = [build_form(chart), *build_inverse_forms(chart), *laws, *distances]
    task_code = write_function("_task", "Task values, (m, N), of columns q (n, N).", task.function)
    both = "Task values, then their Jacobian row by row, (m + m n, N)."
    task_code += "\n\n" + write_function("_task_and_slopes", both, task.function, task.jacobian_function)
    code = {
        "coordinates": _write_form(coordinates),
        "task": task_code.strip("\n"),
        "others": "\n\n\n".join(map(_write_form, others)),
    }
    # Names and numbers of the chart, as Python code in plain ASCII.
    values = {
        "to": to,
        "library": library,
        "imports": library.imports_for("".join(code.values())),
        **code,
        "version": VERSION,
        "names": f"{problem.name!a}, {chart.coordinates.label!a}",
        "fingerprint": fingerprint(problem, chart.coordinates),
        "joints": ascii(problem.robot.joint_names),
        "labels": ascii(chart.labels),
        "units": ascii(task.units),
        "centre": tuple(problem.domain.centre.tolist()),
        "half_width": tuple(problem.domain.half_width.tolist()),
        "statuses": write_statuses(),
        "distances": bool(distances),
        "numbers": [(name, table.shape, _encode(table)) for form in forms for name, table in form.tables.items()],
        "indices": [
            (name, textwrap.wrap("".join(f"{row}, " for row in rows), _WIDTH))
            for form in forms
            for name, rows in form.indices.items()
        ],
    }
    return render("module.py", values)


def _write_form(form: Form) -> str:
    """The functions of a form as text."""
    return f"{render(f'{form.template}.py', form.values)}\n\n{form.functions}".strip("\n")


def _build_law(law: Impedance | PDPlus) -> Form:
    """The function `command`, and the functions that it calls in addition to those of phi and of the inverse.

    Raises:
        InvalidValueError: if the law takes inputs at run time, such as a payload or a given mass matrix.
    """
    model, n, m = law.model, law.chart.n, law.chart.m
    if model.gains(law.problem, law.feed_forward):
        raise InvalidValueError(
            "model of the law",
            ", ".join(model.gains(law.problem, law.feed_forward)),
            "a law without inputs at run time",
        )
    # Numbers of the law as columns; full turns of endless joints are counted.
    bound, domain = law.problem.domain.reach, law.problem.domain
    stiffness = law.stiffness if law.damping_stiffness is None else law.damping_stiffness
    turn = np.zeros(law.problem.n)
    turn[list(law.problem.turning)] = 2 * np.pi
    columns = {
        "turn": turn,
        "stiffness": law.stiffness,
        "damping_stiffness": stiffness,
        "damping_ratio": law.damping_ratio,
        "compliance": law.compliance,
        "limit": law.limit,
    }
    tables = {name: value[:, None] for name, value in columns.items()}
    tables["reach"] = np.array([domain.centre - bound, domain.centre + bound])[:, :, None]
    # Options of the law.
    values = {
        "formula": law.formula,
        "feed_forward": law.feed_forward,
        "damping": law.damping,
        "fastest": law.fastest if law.is_limited else None,
        "blocks": f"((0, {n}),)" if law.coupling == "coupled" else f"((0, {m}), ({m}, {n}))",
        "statuses": ", ".join(_LAW_STATUSES),
        "numbers": ", ".join(str(int(ControlStatus[name])) for name in _LAW_STATUSES),
        "largest": LARGEST,
        "smallest_volume": SMALLEST_VOLUME**2 * law.median_volume,
        "softest": SOFTEST,
        "rounds": ROUNDS,
    }
    return Form("law", values, "\n\n".join(_write_law_functions(law)), tables, {})


def _write_law_functions(law: Impedance | PDPlus) -> list[str]:
    """Code for the errors, and for the robot's matrices and torques."""
    # Symbols of the state, of a joint velocity, and of the task targets.
    chart, n, m = law.chart, law.chart.n, law.chart.m
    q, dq, w = (ca.MX.sym(name, n) for name in ("q", "dq", "w"))
    x_d, dx_d, ddx_d = (ca.MX.sym(name, m) for name in ("x_d", "dx_d", "ddx_d"))
    inputs, robot = {"q": q, "dq": dq}, law.problem.robot
    error, slope = chart.parts.relative.error(q, x_d)
    e = ca.SX.sym("e", n)
    result = [
        _write_graph("_task_errors", "e, then de/dq row by row, of q, x_d.", [q, x_d], [error, ca.vec(slope.T)]),
        write_function(
            "_shortest",
            "Errors by the shorter way around for coordinates that are angles, (n, N).",
            dense_function("f", [e], [wrap_shortest(e, chart.parts.turns)]),
        ),
        _write_graph(
            "_mass_matrix", "Entries of M row by row, (n n, N).", [q], [ca.vec(law.model.mass_matrix(robot, inputs))]
        ),
        _write_graph("_gravity", "Gravity torque, (n, N).", [q], [law.model.gravity_torque(robot, inputs)]),
    ]
    # Feed-forward also needs the rates of targets and errors.
    if law.feed_forward:
        drift = chart.parts.relative.compute_drift(q, x_d, dx_d)
        bias = chart.parts.relative.compute_bias(q, dq, w, (x_d, dx_d, ddx_d))
        coriolis = law.model.coriolis_torque(robot, inputs, w)
        states = [q, dq, w, x_d, dx_d, ddx_d]
        result += [
            _write_graph(
                "_task_drift",
                "Rate of the errors of a robot at rest, less its sign, of q, x_d, dx_d.",
                [q, x_d, dx_d],
                [drift],
            ),
            _write_graph(
                "_task_bend",
                "How the rates of the errors change, of q, dq, w, x_d and its derivatives.",
                states,
                [bias],
            ),
            _write_graph("_coriolis_torque", "C(q, dq) w, of q, dq, w.", [q, dq, w], [coriolis]),
            _BEND,
        ]
    return result


_BEND = '''def _bend(q, dq, w, wanted):
    """d/dt (J w - drift) for a constant w, (n, N)."""
    m, n = len(UNITS), len(JOINTS)
    targets = [wanted[k * n : k * n + m] for k in range(3)]
    change = (_along(_xi_jacobian, q, dq) * w).sum(1) - wanted[2 * n + m :]
    return np.concatenate([_task_bend(np.concatenate([q, dq, w, *targets])), change])
'''


def _write_graph(name: str, summary: str, inputs: list[ca.MX], outputs: list[ca.MX]) -> str:
    """A Python function whose argument holds the columns of all inputs, one below the other."""
    graph = ca.Function("graph", inputs, [ca.densify(ca.vertcat(*outputs))])
    symbols = [ca.SX.sym("s", part.numel()) for part in inputs]
    return write_function(name, summary, dense_function("f", [ca.vertcat(*symbols)], [graph(*symbols)]))


def _encode(table: Array) -> list[str]:
    """The numbers of a table as lines of base64."""
    # Adding 0.0 turns -0.0 into 0.0.
    text = b64encode((np.asarray(table, dtype="<f8") + 0.0).tobytes()).decode()
    return [text[k : k + _WIDTH] for k in range(0, max(len(text), 1), _WIDTH)]


@dataclass(frozen=True)
class Library:
    """A library with NumPy's functions under its own name; `templates/NAME.py.jinja` has the other code it needs."""

    title: str
    prefix: str  #: prefix of its functions in code
    imports: tuple[str, ...]  #: imports of the standard library, an empty line, other imports
    erf: tuple[str, str]  #: name of its error function, and the import for it
    constants: str
    note: str
    tables: str = ""  #: code that prepares the tables when the module is imported
    names: Mapping[str, str] = field(default_factory=dict)  #: functions with another name than in NumPy
    #: whether its compiler may recompute shared values for each use, so that this must be prevented
    fuses: bool = False

    def translate(self, text: str) -> str:
        """Translate code for NumPy to this library."""
        text = text if self.fuses else _SHARED.sub(r"\1", text)
        for name, own in self.names.items():
            text = text.replace(f"np.{name}(", f"{self.prefix}.{own}(")
        return re.sub(r"\bnp\.", f"{self.prefix}.", text).replace("_erf(", f"{self.erf[0]}(")

    def imports_for(self, code: str) -> str:
        """The imports that a module needs, from its code for NumPy."""
        lines = list(self.imports)
        if "_erf(" in code and self.erf[1] not in lines:
            lines.insert(0 if self.erf[1] == "import math" else lines.index("") + 1, self.erf[1])
        return "\n".join(lines)


LIBRARIES = {
    "numpy": Library(
        title="NumPy",
        prefix="np",
        imports=(*_COMMON, "", "import numpy as np"),
        erf=("np.vectorize(math.erf)", "import math"),
        constants="ROWS = 1024  # joint positions at once, so that intermediate values stay in the cache\n"
        "LAST_ROUNDS = 1  # of the inverse, at a solution\n",
        note="Single precision if q is numpy.float32, double otherwise.",
    ),
    "torch": Library(
        title="PyTorch",
        prefix="torch",
        imports=("import struct", *_COMMON, "", "import torch"),
        erf=("torch.erf", "import torch"),
        constants="ROWS = 8192  # joint positions at once, so that memory stays bounded; raise it on a GPU\n" + _ROUNDS,
        note="q is a floating-point tensor. Results have its precision and device, and are differentiable.",
        # torch.func.vmap does not support moveaxis.
        names={"moveaxis": "movedim"},
        tables="""
with torch.inference_mode(False):  # what is made in that mode has no derivatives later
    _TABLES = {name: _numbers(*parts) for name, parts in _NUMBERS.items()}
    _TABLES |= {name: torch.tensor(values, dtype=torch.int64) for name, values in _INDICES.items()}
""",
    ),
    "jax": Library(
        title="JAX",
        prefix="jnp",
        imports=(*_COMMON, "", "import jax", "import jax.numpy as jnp", "import numpy"),
        erf=("jax.scipy.special.erf", "import jax"),
        constants=_ROUNDS,
        note="Results have the precision of q, and are differentiable; `jax_enable_x64` allows double precision.",
        fuses=True,
    ),
}
