"""Control ticks in generated C: median and worst of 100,000 calls, compile time, size; peers in one process (2 min).

The code is compiled with gcc -O2, as a user would do. The peer is the projector controller, generated the same way. The
plain loop only multiplies for some microseconds, so its worst time shows the effect of the machine on any program.
"""

import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from baselines import Projector
from benchmark import run

import orthocas as oc
from orthocas import problems
from orthocas.codegen import CompiledLibrary, compile_shared, time_ticks
from orthocas.control import Controller, Impedance, Kinematic, PDPlus
from orthocas.native.libraries import find_compilers

_PLAIN = """
int plain_control(const double *q, const double *dq, const double *reference, const double *gains, double *command) {
  volatile double x = 1.0;
  int i;
  (void)q, (void)dq, (void)reference, (void)gains, (void)command;
  for (i = 0; i < 1500; ++i) x = x * 1.0000001;
  return 0;
}
"""


def laws(quick: bool) -> Iterator[tuple[str, oc.Chart, Controller]]:
    """Title, chart and controller."""
    known = problems.get("planar_3r_xy" if quick else "iiwa")
    inertial = oc.Problem(known.robot, known.task, "inertia", known.domain, f"{known.name}_M")
    for degree in (2,) if quick else (4, 5, 6):
        chart = oc.fit(inertial, oc.Polynomial(degree), samples=3000, weights=(1000, 30, 150, 1)).chart
        title = f"polynomial:{degree}"
        yield f"PD+ decoupled, {title}", chart, PDPlus(chart, 50.0, coupling="decoupled")
        if degree <= 4:
            yield f"PD+ coupled, {title}", chart, PDPlus(chart, 50.0)
            yield f"impedance decoupled, {title}", chart, Impedance(chart, 50.0, coupling="decoupled")
            yield f"kinematic, {title}", chart, Kinematic(chart)
            yield "projector, A = M", chart, Projector(inertial, 50.0, 10.0)
    for widths in (
        () if quick else ((64, 64), (1024, 512))
    ):  # the last as in the paper; the time does not depend on the quality
        network = oc.fit(inertial, oc.MLP(widths), samples=300, solver=oc.solvers.LBFGS(max_iterations=3)).chart
        title = network.coordinates.label
        yield f"impedance decoupled, {title}", network, Impedance(network, 50.0, coupling="decoupled")
        yield f"PD+ decoupled, {title}", network, PDPlus(network, 50.0, coupling="decoupled")


def main(quick: bool = False) -> dict[str, dict[str, float]]:
    """Print a table; return microseconds (median, 99 %, worst, best of the slowest state), seconds and KiB by title."""
    found: dict[str, dict[str, float]] = {}
    cases = []
    with tempfile.TemporaryDirectory() as folder:
        for number, (title, chart, law) in enumerate(laws(quick)):
            begin = time.perf_counter()
            generated = oc.generate_c(chart, Path(folder) / str(number), law, f"tick{number}")
            written = time.perf_counter()
            library = compile_shared(generated, Path(folder))
            done = time.perf_counter()
            size = library.stat().st_size / 1024
            found[title] = {"generate": written - begin, "compile": done - written, "KiB": size}
            cases.append((law, CompiledLibrary(library, generated.name, chart.n)))
        cases.insert(0, (cases[0][0], _plain_loop(Path(folder), chart.n)))
        found = {"plain loop": {}} | found
        large = [title.endswith("1024x512") for title in found]
        ticks = time_ticks(cases[: large.count(False)], 10_000 if quick else 100_000)
        ticks += time_ticks(cases[large.count(False) :], 5_000) if any(large) else []
    print(
        "| controller | median us | 99 % us | worst us | slowest state us | generate s | compile s | KiB |\n|"
        + " --- |" * 8
    )
    for (title, row), times in zip(found.items(), ticks, strict=True):
        row |= {"median": times.median, "p99": times.p99, "worst": times.worst, "steady": times.slowest_state}
        keys = ("median", "p99", "worst", "steady", "generate", "compile", "KiB")
        print(f"| {title} | {' | '.join(f'{row[key]:.2f}' if key in row else '-' for key in keys)} |")
    return found


def _plain_loop(folder: Path, n: int) -> CompiledLibrary:
    source, library = folder / "plain.c", folder / "libplain.so"
    source.write_text(_PLAIN)
    subprocess.run([find_compilers()[0], "-O2", "-fPIC", "-shared", str(source), "-o", str(library)], check=True)
    return CompiledLibrary(library, "plain", n)


if __name__ == "__main__":
    run(main, __doc__)
