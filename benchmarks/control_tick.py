"""Control ticks in generated C: median and worst of 100,000 calls, compile time, size; peers in one process (2 min).

Compiled with gcc -O2, as a user would. The peer is the projector controller, generated the same way.
"""

import argparse
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import orthocas as oc
from orthocas import problems
from orthocas.codegen import CompiledLibrary, compile_shared, time_ticks
from orthocas.control import Controller, Impedance, Kinematic, PDPlus, Projector


def laws(quick: bool) -> Iterator[tuple[str, oc.Chart, Controller]]:
    """Title, chart and controller."""
    known = problems.get("iiwa")
    inertial = oc.Problem(known.robot, known.task, "inertia", known.domain, "iiwa_M")
    for degree in (2,) if quick else (4, 5):
        chart = oc.fit(inertial, oc.Polynomial(degree), samples=3000, weights=(1000, 30, 150, 1)).chart
        title = f"polynomial:{degree}"
        yield f"PD+ decoupled, {title}", chart, PDPlus(chart, 50.0, coupling="decoupled")
        if degree <= 4:
            yield f"PD+ coupled, {title}", chart, PDPlus(chart, 50.0)
            yield f"impedance decoupled, {title}", chart, Impedance(chart, 50.0, coupling="decoupled")
            yield f"kinematic, {title}", chart, Kinematic(chart)
            yield "projector, A = M", chart, Projector(inertial, 50.0, 10.0)
    for widths in () if quick else ((64, 64), (1024, 512)):  # the last as in the paper; time does not ask for quality
        network = oc.fit(inertial, oc.MLP(widths), samples=300, solver=oc.solvers.LBFGS(max_iterations=3)).chart
        title = network.coordinates.label
        yield f"impedance decoupled, {title}", network, Impedance(network, 50.0, coupling="decoupled")
        yield f"PD+ decoupled, {title}", network, PDPlus(network, 50.0, coupling="decoupled")


def main(quick: bool = False) -> dict[str, dict[str, float]]:
    """Print a table; by title: microseconds (median, 99 %, worst), share of late ticks, seconds and KiB."""
    found: dict[str, dict[str, float]] = {}
    cases = []
    with tempfile.TemporaryDirectory() as folder:
        for number, (title, chart, law) in enumerate(laws(quick)):
            begin = time.perf_counter()
            generated = oc.generate_c(chart, folder, law, f"tick{number}")
            written = time.perf_counter()
            library = compile_shared(generated, Path(folder))
            done = time.perf_counter()
            size = library.stat().st_size / 1024
            found[title] = {"generate": written - begin, "compile": done - written, "KiB": size}
            cases.append((law, CompiledLibrary(library, generated.name, chart.n)))
        large = [title.endswith("1024x512") for title in found]
        ticks = time_ticks(cases[: large.count(False)], 10_000 if quick else 100_000)
        ticks += time_ticks(cases[large.count(False) :], 5_000) if any(large) else []
    print("| controller | median us | 99 % us | worst us | late ppm | generate s | compile s | KiB |\n|" + " --- |" * 8)
    for (title, row), times in zip(found.items(), ticks, strict=True):
        row |= {"median": times.median, "p99": times.p99, "worst": times.worst, "late": 1e6 * times.late}
        keys = ("median", "p99", "worst", "late", "generate", "compile", "KiB")
        print(f"| {title} | {' | '.join(f'{row[key]:.2f}' for key in keys)} |")
    return found


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true")
    main(parser.parse_args().quick)
