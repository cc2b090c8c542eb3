"""The supervised law in double and in single precision: ticks, sizes, proof, and the difference in MuJoCo (2 min).

The 7-DoF arm, A = M, PD+ with default gains on coordinates of degree 4, compiled with gcc -O2. The supervised law runs
all of its parts in every tick: the program puts the law back in command after each one. For the difference, the flange
follows a circle of 5 cm in 4 s, three times, in MuJoCo at 1 kHz, under the compiled law of either type.
"""

import ctypes
import subprocess
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from benchmark import run

import orthocas as oc
from orthocas import problems
from orthocas.codegen import CompiledLibrary, Supervisor, check_c, compile_shared, time_ticks
from orthocas.control import PDPlus
from orthocas.native.libraries import find_compilers
from orthocas.simulation import MuJoCoPlant

TICK = 1e-3
_SUPERVISED = """
#include <string.h>
#include "arm.h"

const int supervised_sizes[2] = {sizeof(arm_state), sizeof(arm_safety)};

int supervised_control(const NUMBER *q, const NUMBER *dq, const NUMBER *reference, const NUMBER *gains,
                       NUMBER *command) {
  static arm_state state;
  memcpy(state.q, q, sizeof state.q); /* no jump */
  state.mode = ARM_LAW;
  state.weight = 1;
  return (int)arm_step(&state, &arm_default_safety, q, dq, (const arm_reference *)reference, (const arm_gains *)gains,
                       (NUMBER)1e-3, command);
}
"""


def main(quick: bool = False) -> dict[str, float]:
    """Print two tables; return the largest differences of the flange [m] and of the proof."""
    known = problems.get("iiwa")
    problem = oc.Problem(known.robot, known.task, "inertia", known.domain, "iiwa_M")
    chart = oc.fit(problem, oc.Polynomial(2 if quick else 4), samples=3000, weights=(1000, 30, 150, 1)).chart
    paths, proofs = [], []
    print("| PD+ | numbers | law us | supervised us | KiB | stack bytes | state bytes | settings bytes | proof |")
    print("|" + " --- |" * 9)
    for coupling, single in product(("coupled",) if quick else ("decoupled", "coupled"), (False, True)):
        law = PDPlus.on_chart(chart, coupling=coupling)
        with TemporaryDirectory() as folder:
            generated = oc.generate_c(chart, folder, law, "arm", single_precision=single)
            library = CompiledLibrary(compile_shared(generated, Path(folder)), "arm", chart.n, single)
            supervised, sizes = _supervised(Path(folder), library)
            ticks = [time.median for time in time_ticks([(law, library), (law, supervised)], 2000 if quick else 50_000)]
            proofs.append(max(check_c(generated, chart, law, 100 if quick else 1000).differences.values()))
            if coupling == "coupled":
                paths.append(flange(chart, Supervisor(library, law), 1.0 if quick else 12.0))
            print(
                f"| {coupling} | {library.precision.c_name} | {ticks[0]:.2f} | {ticks[1]:.2f} "
                f"| {library.path.stat().st_size / 1024:.0f} | {generated.stack_bytes} | {sizes[0]} | {sizes[1]} "
                f"| {proofs[-1]:.1e} |",
                flush=True,
            )
    apart = float(np.linalg.norm(paths[0] - paths[1], axis=1).max())
    print(f"\nflange, double against float: at most {1e6 * apart:.2f} um apart on the circle")
    return {"flange": apart, "proof": proofs[-1]}


def _supervised(folder: Path, library: CompiledLibrary) -> tuple[CompiledLibrary, list[int]]:
    """A library whose control function is a tick of the supervised law, and the sizes of state and settings [bytes]."""
    source, target = folder / "supervised.c", folder / "libsupervised.so"
    source.write_text(_SUPERVISED)
    words = ["-O2", "-fPIC", "-shared", f"-DNUMBER={library.precision.c_name}", str(source), str(library.path)]
    subprocess.run([find_compilers()[0], *words, f"-Wl,-rpath,{folder}", "-o", str(target), "-lm"], check=True)
    supervised = CompiledLibrary(target, "supervised", library.n, library.single_precision)
    return supervised, list((ctypes.c_int * 2).from_address(supervised.address("sizes")))


def flange(chart: oc.Chart, supervisor: Supervisor, seconds: float) -> np.ndarray:
    """Positions of the flange on a circle of 4 s in MuJoCo, (ticks, 3)."""
    plant, q = MuJoCoPlant(chart.problem.robot), chart.problem.domain.centre
    plant.reset(q)
    supervisor.start(q)
    home, path = chart.phi(q), []
    for k in range(round(seconds / TICK)):
        angle, rate = 2 * np.pi * k * TICK / 4, 2 * np.pi / 4
        reference = np.concatenate([home, np.zeros(2 * chart.n)])
        reference[[1, 2]] += 0.05 * np.array([1 - np.cos(angle), np.sin(angle)])
        reference[chart.n + np.array([1, 2])] = 0.05 * rate * np.array([np.sin(angle), np.cos(angle)])
        reference[2 * chart.n + np.array([1, 2])] = 0.05 * rate**2 * np.array([np.cos(angle), -np.sin(angle)])
        command, _ = supervisor.step(plant.q, plant.dq, reference, TICK)
        plant.step(command, TICK)
        path.append(plant.q)
    return chart.phi(np.array(path))[:, : chart.m]


if __name__ == "__main__":
    run(main, __doc__)
