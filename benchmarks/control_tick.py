"""Control ticks in generated C: median and worst of 100,000 calls, compile time, size; peers in one process (2 min).

Compiled with gcc -O2, as a user would. The peer is the projector controller, generated the same way.
"""

import argparse
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

import orthocas as oc
from orthocas import problems
from orthocas.codegen import compile_shared, gain_numbers
from orthocas.codegen.library import compilers
from orthocas.control import Controller, Impedance, Kinematic, PDPlus, Projector

_HARNESS = r"""
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>
#include <dlfcn.h>
typedef int (*control)(const double*, const double*, const double*, const double*, double*);
static int order(const void *a, const void *b) { double d = *(double*)a - *(double*)b; return (d > 0) - (d < 0); }
int main(int argc, char **argv) { /* states, ticks, n, k, gains, then library and function by pairs */
  FILE *file = fopen(argv[1], "rb");
  long ticks = atol(argv[2]); int n = atoi(argv[3]), c, j;
  for (c = 4; c + 3 < argc; c += 4) {
    int k = atoi(argv[c + 2]), g = atoi(argv[c + 3]), size = 2 * n + 3 * k;
    long t;
    double *states = malloc(sizeof(double) * size * 64), *gains = malloc(sizeof(double) * g), command[32];
    double *seconds = malloc(sizeof(double) * ticks);
    control run;
    *(void **)&run = dlsym(dlopen(argv[c], RTLD_NOW), argv[c + 1]);
    if (fread(states, sizeof(double), 64 * size, file) + fread(gains, sizeof(double), g, file) == 0) return 1;
    for (t = -1000; t < ticks; ++t) {
      const double *s = states + (t & 63) * size;
      struct timespec a, b;
      clock_gettime(CLOCK_MONOTONIC, &a);
      run(s, s + n, s + 2 * n, gains, command);
      clock_gettime(CLOCK_MONOTONIC, &b);
      if (t >= 0) seconds[t] = (b.tv_sec - a.tv_sec) * 1e6 + (b.tv_nsec - a.tv_nsec) * 1e-3;
    }
    qsort(seconds, ticks, sizeof(double), order);
    for (j = 0; j < 3; ++j) printf("%.3f ", seconds[j == 0 ? ticks / 2 : j == 1 ? ticks * 99 / 100 : ticks - 1]);
    printf("\n");
  }
  return 0;
}
"""


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
    if not quick:
        network = oc.fit(inertial, oc.MLP((64, 64)), samples=500, solver=oc.solvers.LBFGS(max_iterations=20)).chart
        yield "impedance decoupled, mlp:64x64", network, Impedance(network, 50.0, coupling="decoupled")
        yield "PD+ decoupled, mlp:64x64", network, PDPlus(network, 50.0, coupling="decoupled")


def main(quick: bool = False) -> dict[str, dict[str, float]]:
    """Print a table; by title: microseconds (median, 99 %, worst), seconds and KiB."""
    found: dict[str, dict[str, float]] = {}
    with tempfile.TemporaryDirectory() as folder:
        place, arguments, data = Path(folder), [], []
        (place / "harness.c").write_text(_HARNESS)
        harness = place / "harness"
        subprocess.run([compilers()[0], "-O2", str(place / "harness.c"), "-o", str(harness), "-ldl"], check=True)
        for number, (title, chart, law) in enumerate(laws(quick)):
            begin = time.perf_counter()
            generated = oc.generate_c(chart, place, law, f"tick{number}")
            written = time.perf_counter()
            library = compile_shared(generated, place)
            done = time.perf_counter()
            size = library.stat().st_size / 1024
            found[title] = {"generate": written - begin, "compile": done - written, "KiB": size}
            data += [states(chart, law), gain_numbers(law)]
            arguments += [str(library), f"tick{number}_control", str(len(law.labels)), str(len(data[-1]))]
        np.concatenate([part.ravel() for part in data]).tofile(place / "states")
        ticks = "10000" if quick else "100000"
        run = [str(harness), str(place / "states"), ticks, str(chart.n), *arguments]
        output = subprocess.run(run, capture_output=True, text=True, check=True).stdout
    print("| controller | median us | 99 % us | worst us | generate s | compile s | KiB |\n|" + " --- |" * 7)
    for (title, row), line in zip(found.items(), output.splitlines(), strict=True):
        row |= dict(zip(("median", "p99", "worst"), map(float, line.split()), strict=True))
        cells = [f"{row[key]:.2f}" for key in ("median", "p99", "worst", "generate", "compile", "KiB")]
        print(f"| {title} | {' | '.join(cells)} |")
    return found


def states(chart: oc.Chart, law: Controller) -> np.ndarray:
    """64 states inside the domain with references nearby, (64, 2 n + 3 k)."""
    rng, n, k = np.random.default_rng(0), chart.n, len(law.labels)
    q = chart.problem.domain.centre + 0.4 * chart.problem.domain.half_width * rng.uniform(-1, 1, (64, n))
    value = np.array([law.measured(point).full().ravel() for point in q])
    return np.hstack(
        [q, rng.normal(size=(64, n)), value + 0.01 * rng.normal(size=(64, k)), rng.normal(size=(64, 2 * k))]
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true")
    main(parser.parse_args().quick)
