"""`check_c` of an atlas: compares compiled C with the charts of the atlas in Python."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from orthocas.codegen.library import CompiledLibrary, GeneratedC, compile_shared, compilers, gain_numbers
from orthocas.codegen.precision import DOUBLE, SINGLE
from orthocas.codegen.proof import Proof
from orthocas.control.controller import Controller
from orthocas.errors import ProofError
from orthocas.tasks.domains import contains
from orthocas.tools.checks import Array, Indices
from orthocas.tools.files import draft_folder

if TYPE_CHECKING:
    from orthocas.atlas.atlas import AtlasPart

_REACH = 1.2  # random positions lie in boxes enlarged by this factor
_LAWS = 5  # charts whose laws are compared; building one takes half a second


def check_c_of_atlas(
    generated: GeneratedC, part: "AtlasPart", controller: Controller | None = None, states: int = 1000, seed: int = 0
) -> Proof:
    """Compile with gcc and clang (C99, warnings as errors), if installed, and compare with Python.

    Compares the chart found for random positions in and around the boxes, xi and J_xi there, and for some charts phi,
    J, and the law with random references.

    Raises:
        CompileError: if there is no compiler, or compilation fails.
        ProofError: if a result differs by more than 1e-10 of the largest entry (single precision: 1e-3), if C finds a
            chart whose box does not hold the position, or another one than Python.
    """
    precision = SINGLE if generated.single_precision else DOUBLE
    q = precision.rounded(_positions(part, states, seed))
    differences: dict[str, float] = {}
    for compiler in compilers():
        with draft_folder() as folder:
            path = compile_shared(generated, folder, compiler=compiler)
            single, r = generated.single_precision, part.atlas.problem.r
            library = CompiledLibrary(path, generated.name, q.shape[1], single, r)
            found = dict(_compared(library, part, controller, q, seed))
        for name, value in found.items():
            if not value <= precision.tolerance:
                raise ProofError(
                    f"C, compiled by {compiler}, differs from Python by {value:.3g} in {name}, "
                    f"expected at most {precision.tolerance:g} relative"
                )
            differences[name] = max(value, differences.get(name, 0.0))
    return Proof(len(q), tuple(Path(compiler).name for compiler in compilers()), differences)


def _positions(part: "AtlasPart", states: int, seed: int) -> Array:
    rng = np.random.default_rng(seed)
    boxes = [part.atlas.box(int(part.charts[k])) for k in rng.integers(len(part), size=min(states, 4 * len(part)))]
    rows = [boxes[k % len(boxes)] for k in range(states)]
    n = part.atlas.problem.n
    return np.array([box.centre + _REACH * box.half_width * rng.uniform(-1, 1, n) for box in rows])


def _compared(
    library: CompiledLibrary, part: "AtlasPart", controller: Controller | None, q: Array, seed: int
) -> Iterator[tuple[str, float]]:
    """Largest relative differences by function."""
    yield "check", library.check()
    charts = np.array([library.chart_at(row) for row in q])
    _require_right_charts(part, q, charts)
    q, charts = q[charts >= 0], charts[charts >= 0]
    numbers = part.charts[charts]
    found = [library.xi(*pair) for pair in zip(q, charts.tolist(), strict=True)]
    yield "xi", _difference(np.array([row[0] for row in found]), part.atlas.xi(q, numbers))
    yield "xi_jacobian", _difference(np.array([row[1] for row in found]), part.atlas.jacobian(q, numbers))
    rng = np.random.default_rng(seed)
    rows = np.unique(charts, return_index=True)[1]
    for row in rng.permutation(rows)[:_LAWS].tolist():
        yield from _of_one_chart(library, part, controller, q[row], int(charts[row]), rng)


def _of_one_chart(
    library: CompiledLibrary, part: "AtlasPart", controller: Controller | None, q: Array, number: int, rng: Any
) -> Iterator[tuple[str, float]]:
    chart = part.atlas.chart(int(part.charts[number]), near=q)
    phi, J, _ = library.chart(q, number)
    yield "phi", _difference(phi, chart.phi(q))
    yield "jacobian", _difference(J, chart.jacobian(q))
    if controller is None or not contains(chart.problem.domain, q):
        return
    law: Any = replace(controller, chart=chart)  # type: ignore[type-var]
    dq, velocity, acceleration = library.precision.rounded(rng.normal(size=(3, chart.n)))
    value = library.precision.rounded(chart.phi(q) + 0.01 * rng.normal(size=chart.n))
    wanted, _ = law.function(q, dq, value, velocity, acceleration, *law.gains.values())
    command, _ = library.control(q, dq, np.concatenate([value, velocity, acceleration]), gain_numbers(law), number)
    yield f"control of chart {number}", _difference(command, wanted.full()[:, 0])


def _require_right_charts(part: "AtlasPart", q: Array, charts: Indices) -> None:
    """Raise ProofError unless C finds the charts that Python finds, or others whose boxes hold the positions."""
    wanted = part.atlas.chart_at(q)
    known = np.isin(wanted, part.charts)
    found = np.where(charts >= 0, part.charts[charts], -1)
    different = np.flatnonzero(np.where(known, found != wanted, charts >= 0))
    held = np.zeros(len(q), dtype=bool)
    other = different[charts[different] >= 0]
    held[other] = part.index.in_boxes(q[other][:, list(part.plan.joints)], found[other])
    for row in different[~held[different]].tolist():
        raise ProofError(f"chart_at is {found[row]} at q = {q[row].tolist()}, expected {wanted[row]}")


def _difference(found: Array, wanted: Array) -> float:
    """Largest difference relative to the largest entry; infinite where an entry is not finite."""
    difference = float(np.abs(found - wanted).max() / max(float(np.abs(wanted).max()), 1e-300))
    return difference if np.isfinite(difference) else np.inf
