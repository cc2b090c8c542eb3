"""How long a control tick takes: calls of compiled controllers, timed in C in one process."""

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files

import numpy as np

from orthocas.charts.chart import Chart
from orthocas.codegen.generate import generate_c
from orthocas.codegen.library import CompiledLibrary, compile_shared, compilers, gain_numbers
from orthocas.control.controller import Controller
from orthocas.control.operational_space import PDPlus
from orthocas.tools.checks import Array
from orthocas.tools.files import open_draft_folder
from orthocas.tools.interrupts import deferred
from orthocas.tools.processes import run_program

_STATES = 64  # as in templates/ticks.c
_MICROSECONDS = 3e5  # to spend on one measurement


@dataclass(frozen=True)
class Ticks:
    """Computing times of one controller [us]."""

    median: float
    p99: float
    worst: float  #: includes interrupts and other activity of the machine
    slowest_state: float  #: best time of the slowest of 64 states, which excludes other activity of the machine


def control_tick(chart: Chart) -> float:
    """Time of one call of decoupled PD+ on a chart in generated C [us]: the best time of the slowest of 64 states.

    Raises:
        CompileError: if there is no C compiler.
    """
    with open_draft_folder() as folder:
        with deferred():  # CasADi may lose Ctrl-C while it builds functions
            law = PDPlus(chart, 50.0, coupling="decoupled")
            generated = generate_c(chart, folder, law, "tick")
        library = CompiledLibrary(compile_shared(generated, folder), "tick", chart.n)
        about = time_ticks([(law, library)], 200)[0].median
        calls = int(np.clip(_MICROSECONDS / about, 1_000, 100_000))
        return time_ticks([(law, library)], calls)[0].slowest_state


def time_ticks(cases: Sequence[tuple[Controller, CompiledLibrary]], calls: int = 100_000) -> list[Ticks]:
    """Measure compiled controllers of one robot and number type, with their own gains, on 64 states inside the domain.

    Raises:
        CompileError: if there is no C compiler, or the timing program cannot be built or run.
    """
    first = cases[0][1]
    with open_draft_folder() as folder:
        data, program = folder / "states", folder / "ticks"
        numbers = np.concatenate([part.ravel() for law, _ in cases for part in (_states(law), gain_numbers(law))])
        first.numbers(numbers).tofile(data)
        source = files(__package__) / "templates" / "ticks.c"
        (folder / "ticks.c").write_text(source.read_text())
        number = f"-DNUMBER={first.precision.c_name}"
        run_program([compilers()[0], "-O2", number, str(folder / "ticks.c"), "-o", str(program), "-ldl"])
        arguments = [str(program), str(data), str(calls), str(cases[0][0].problem.n)]
        for law, library in cases:
            sizes = (3 * len(law.labels), len(gain_numbers(law)))
            arguments += [str(library.path), f"{library.name}_control", *map(str, sizes)]
        lines = run_program(arguments).splitlines()
    return [Ticks(*map(float, line.split())) for line in lines]


def _states(law: Controller) -> Array:
    """States inside the domain with references nearby, (64, 2 n + 3 k)."""
    rng, domain, n, k = np.random.default_rng(0), law.problem.domain, law.problem.n, len(law.labels)
    q = domain.centre + 0.4 * domain.half_width * rng.uniform(-1, 1, (_STATES, n))
    q[~domain.contains(q)] = domain.centre
    reference = np.array([law.measured(point).full().ravel() for point in q]) + 0.01 * rng.normal(size=(_STATES, k))
    return np.hstack([q, rng.normal(size=(_STATES, n)), reference, rng.normal(size=(_STATES, 2 * k))])
