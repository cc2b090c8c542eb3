"""An atlas in C: sizes, and times of the search for a chart, of its coordinates, and of the supervised law (3 min).

The charts along a tool path of the 7-DoF arm, A = M, PD+ with default gains, compiled with gcc -O2. Times are medians
of 15 rounds over 2,000 positions around the path; "slowest" is the best time of the slowest position. A tick with a
hand-over finds the posture that the reference asks for and takes value, velocity and acceleration to the next chart.
"""

import argparse
import subprocess
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

import orthocas as oc
from orthocas import problems
from orthocas.atlas.c_source import AtlasTables
from orthocas.codegen import compile_shared
from orthocas.codegen.library import compilers
from orthocas.control import PDPlus
from orthocas.tools.checks import Array

_POSITIONS = 2000
_PROGRAM = r"""
#define _POSIX_C_SOURCE 199309L
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include "arm.h"

#define N ARM_JOINTS
#define ROUNDS 15
#define LEAST 20

static double q[COUNT][N], best[COUNT];
static int chart[COUNT], before[COUNT];
static volatile double sink;

static double now(void) {
  struct timespec t;
  clock_gettime(CLOCK_MONOTONIC, &t);
  return (double)t.tv_sec * 1e6 + (double)t.tv_nsec * 1e-3;
}

static arm_state state;
static arm_reference reference;

static void call(int what, int k) {
  static const double dq[N];
  double out[N * N], phi[N];
  switch (what) {
    case 0: sink = arm_chart_at(q[k], ARM_NO_CHART); break;
    case 1: sink = arm_chart_at(q[k], chart[k]); break;
    case 2: arm_xi(chart[k], q[k], out); break;
    case 3: arm_jacobian(chart[k], q[k], out); break;
    case 4: arm_chart(chart[k], q[k], phi, out); break;
    case 5: arm_control(chart[k], q[k], dq, &reference, &arm_default_gains, out); break;
    default: /* a step, without or with a hand-over */
      memcpy(state.q, q[k], sizeof state.q);
      state.mode = ARM_LAW;
      state.weight = 1.0;
      state.chart = what == 6 ? chart[k] : before[k];
      arm_reference_at(state.chart, q[k], &reference);
      state.reference = reference;
      arm_step(&state, &arm_default_safety, q[k], dq, &reference, &arm_default_gains, 1e-3, out);
  }
  sink = out[0];
}

static int order(const void *a, const void *b) { return *(const double *)a > *(const double *)b ? 1 : -1; }

int main(void) {
  double times[ROUNDS];
  int what, k, round, i, kept = 0;
  FILE *file = fopen("positions", "rb");
  if (file == NULL || fread(q, sizeof q, 1, file) != 1) return 1;
  for (k = 0; k < COUNT; ++k) { /* positions with a chart, and a neighbour that does not hold them */
    double there[N];
    const int here = arm_chart_at(q[k], ARM_NO_CHART);
    int other = ARM_NO_CHART;
    for (i = 0; i < 2 * N && other == ARM_NO_CHART; ++i) {
      memcpy(there, q[k], sizeof there);
      there[i / 2] += i % 2 ? 0.4 : -0.4;
      other = arm_chart_at(there, ARM_NO_CHART);
      if (other != ARM_NO_CHART && arm_chart_at(q[k], other) == other) other = ARM_NO_CHART;
    }
    if (here == ARM_NO_CHART || other == ARM_NO_CHART) continue;
    memmove(q[kept], q[k], sizeof q[k]);
    chart[kept] = here;
    before[kept++] = other;
  }
  if (kept == 0) return 2;
  arm_start(&state, q[0], 0);
  for (what = 0; what < 8; ++what) {
    double slowest = 0.0;
    for (round = 0; round < ROUNDS; ++round) {
      const double start = now();
      for (k = 0; k < kept; ++k) call(what, k);
      times[round] = (now() - start) / kept;
    }
    qsort(times, ROUNDS, sizeof(double), order);
    for (k = 0; k < kept; ++k) best[k] = 1e300;
    for (round = 0; round < ROUNDS; ++round)
      for (k = 0; k < kept; ++k) {
        const double start = now();
        double time;
        for (i = 0; i < LEAST; ++i) call(what, k);
        time = (now() - start) / LEAST;
        if (time < best[k]) best[k] = time;
      }
    for (k = 0; k < kept; ++k) slowest = best[k] > slowest ? best[k] : slowest;
    printf("%.4f %.4f %.4f\n", times[ROUNDS / 2], times[0], slowest);
  }
  printf("%d %d %d\n", kept, (int)sizeof(arm_state), (int)sizeof(arm_safety));
  return 0;
}
"""
_ROWS = (
    *("search for the chart", "search, with the chart used last", "xi", "J_xi", "phi and J"),
    *("PD+", "supervised PD+ with its reference", "the same with a hand-over"),
)


def main(quick: bool = False, file: Path | None = None) -> dict[str, float]:
    """Print times; return sizes, and the times of the search and of a hand-over tick [us]."""
    with TemporaryDirectory() as place:
        folder = Path(place)
        atlas, path = _atlas(folder, quick, file)
        part = oc.AtlasPart.along(atlas, path, 0.0 if quick else 0.05)
        law = PDPlus.on_chart(atlas.chart(int(part.charts[0])))
        generated = oc.generate_c(part, folder / "c", law, "arm")
        library, tables = compile_shared(generated, folder), AtlasTables(part)
        rng = np.random.default_rng(0)
        q = path[rng.integers(len(path), size=_POSITIONS)] + rng.uniform(-0.1, 0.1, (_POSITIONS, path.shape[1]))
        q.tofile(folder / "positions")
        times, sizes = _run(folder)
        found = {"charts": len(atlas), "along the path": len(part), "positions": sizes[0]}
        found |= {"tables KiB": tables.bytes / 1024, "library KiB": library.stat().st_size / 1024}
    print("| call | median us | best us | slowest position us |\n| --- | --- | --- | --- |")
    for name, row in zip(_ROWS, times, strict=True):
        print(f"| {name} | " + " | ".join(f"{time:.3f}" for time in row) + " |")
    return found | {"search_us": times[0][0], "hand_over_us": times[-1][0]}


def _atlas(folder: Path, quick: bool, file: Path | None) -> tuple[oc.Atlas, Array]:
    """An atlas around a path, and the path: joint positions."""
    known = problems.get("planar_3r_x" if quick else "iiwa")
    problem = oc.Problem(known.robot, known.task, "inertia", known.domain)
    if quick:
        path = np.linspace([0.6, 2.6, 0.9], [0.6, 3.0, 0.2], 40)
        asked = oc.AtlasSettings(degree=2, leak_deg=14.0, half_width=0.4, splits=4)
        return oc.build_atlas(problem, folder / "a.orthocas-atlas", asked, region=path, radius=0.3, jobs=1), path
    path = _tool_path(problem)
    if file is not None:
        return oc.Atlas.load(file), path
    asked = oc.AtlasSettings(half_width=0.35, leak_deg=3.0)
    return oc.build_atlas(problem, folder / "a.orthocas-atlas", asked, region=path[::8], radius=0.12), path


def _tool_path(problem: oc.Problem) -> Array:
    """Half a metre down from the working posture, and half a metre sideways, with the joints moved by M^-1 J^T."""
    q = problem.domain.centre
    begin = problem.task.batched(q[None])[0][0]
    corner = begin + np.array([0.0, 0.0, -0.5])
    shares = np.linspace(0, 1, 401)[:, None]
    rows = []
    for x in np.vstack([begin + shares * (corner - begin), corner + shares * [-0.25, 0.45, 0.0]]):
        for _ in range(3):
            J = problem.task.batched_jacobian(q[None])[0][0].reshape(-1, problem.n)
            B = np.linalg.solve(problem.robot.mass_matrix(q), J.T)
            q = q + B @ np.linalg.solve(J @ B, x - problem.task.batched(q[None])[0][0])
        rows.append(q)
    return np.array(rows)


def _run(folder: Path) -> tuple[list[tuple[float, ...]], tuple[int, ...]]:
    """Compile the program and run it: times [us] of every kind of call, and sizes."""
    (folder / "times.c").write_text(_PROGRAM)
    flags = ("-std=c99", "-O2", f"-DCOUNT={_POSITIONS}", f"-I{folder / 'c'}")
    command = [compilers()[0], *flags, "times.c", str(folder / "c" / "arm.c"), "-o", "times", "-lm"]
    subprocess.run(command, cwd=folder, check=True)
    printed = subprocess.run([str(folder / "times")], cwd=folder, check=True, capture_output=True, text=True).stdout
    *rows, last = [line.split() for line in printed.splitlines()]
    return [tuple(map(float, row)) for row in rows], tuple(map(int, last))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a planar arm")
    parser.add_argument("--file", type=Path, help="an atlas of an earlier run")
    options = parser.parse_args()
    main(options.quick, options.file)
