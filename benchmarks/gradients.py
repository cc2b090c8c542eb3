"""Loss and gradient against PyTorch (CPU) with the same mathematics, in one run: networks and bases of the 7-DoF arm.

n = 7, m = 3, r = 4, no joint split off, lambda = (1000, 30). Ours run with one BLAS thread and threads of their own, as
in fits. The implementations alternate, and the results are medians of several rounds. Values and gradients are checked
to agree before the clock starts.
"""

import time
from contextlib import nullcontext
from itertools import chain
from statistics import median

import numpy as np
import torch
from benchmark import run, table
from torch_loss import WEIGHTS, Step, basis_step, network_step

import orthocas as oc
from orthocas import problems
from orthocas.bases import JointSpace, LinearFamily
from orthocas.fitting.basis_objective import BasisObjective, build_gradients
from orthocas.fitting.network_objective import ArrayObjective
from orthocas.fitting.terms import Weights
from orthocas.tasks.samples import sample_problem
from orthocas.tools.batch import one_blas_thread

HEADER = (
    "| what | samples | orthocas double / single [ms] | PyTorch float64, forward / reverse | float32, forward / "
    "reverse | ratio to the best: double, single |\n| --- | --- | --- | --- | --- | --- |"
)
CASES = (((64, 64), 2000), ((1024, 512), 200))
BASES = ((oc.Polynomial(3), 4000), (oc.Polynomial(4), 8000), (oc.Fourier(2), 4000))


def main(quick: bool = False) -> list[str]:
    """All rows; `quick` uses small sizes and one round."""
    rounds = 1 if quick else 9
    networks = (network_row(*case, rounds) for case in ((((8, 8), 100),) if quick else CASES))
    bases = (basis_row(*case, rounds) for case in (((oc.Polynomial(2), 100),) if quick else BASES))
    return table(HEADER, chain(networks, bases))


def network_row(hidden: tuple[int, ...], samples: int, rounds: int) -> str:
    """The row of one network."""
    problem = problems.get("iiwa")
    family = oc.MLP(hidden).family(JointSpace.of(problem), problem.r)
    drawn, theta = sample_problem(problem, samples, 0), family.initial(0)
    weights = Weights.of(WEIGHTS)
    double, single = (ArrayObjective(family, drawn, weights, theta, lambda *_: drawn, kind) for kind in (False, True))
    ours = {
        "ours": lambda: double.value_and_gradient(theta),
        "ours in 32 bits": lambda: single.value_and_gradient(theta),
    }
    peers = {
        f"{mode} {dtype}": network_step(hidden, theta, drawn.points, drawn.unit_task_gradients, problem.r, dtype, mode)
        for dtype in (torch.float64, torch.float32)
        for mode in ("forward", "reverse")
    }
    times = _times({**ours, **peers}, rounds)
    f64, f32 = ([times[f"{mode} torch.{kind}"] for mode in ("forward", "reverse")] for kind in ("float64", "float32"))
    return _row(f"mlp {'x'.join(map(str, hidden))}", samples, times, f64, f32)


def basis_row(parametrisation: oc.Polynomial | oc.Fourier, samples: int, rounds: int) -> str:
    """The row of one basis, with its gradients sampled before the clock starts for both."""
    problem = problems.get("iiwa")
    family = parametrisation.family(JointSpace.of(problem), problem.r)
    assert isinstance(family, LinearFamily)
    drawn, theta = sample_problem(problem, samples, 0), family.initial(0)
    weights, kinds = Weights.of(WEIGHTS), (np.float64, np.float32)
    double, single = (
        BasisObjective(family, drawn, weights, theta, lambda *_: drawn, gradients=build_gradients(family, 7, kind))
        for kind in kinds
    )
    ours = {
        "ours": lambda: double.value_and_gradient(theta),
        "ours in 32 bits": lambda: single.value_and_gradient(theta),
    }
    C, G = theta.reshape(problem.r, -1), build_gradients(family, 7).dense(double.X, samples)
    peers = {str(dtype): basis_step(C, G, drawn.unit_task_gradients, dtype) for dtype in (torch.float64, torch.float32)}
    times = _times({**ours, **peers}, rounds)
    what = f"{parametrisation.label}, {family.width} functions"
    return _row(what, samples, times, [times["torch.float64"]], [times["torch.float32"]])


def _row(what: str, samples: int, times: dict[str, float], f64: list[float], f32: list[float]) -> str:
    """A row from milliseconds of ours and of PyTorch in both precisions."""
    double, single = times["ours"], times["ours in 32 bits"]
    listed = (" / ".join(f"{time:.1f}" for time in part) for part in (f64, f32))
    return (
        f"| {what} | {samples} | {double:.1f} / {single:.1f} | {' | '.join(listed)} "
        f"| {double / min(f64):.2f}, {single / min(f32):.2f} |"
    )


def _times(steps: dict[str, Step], rounds: int) -> dict[str, float]:
    """Median milliseconds of each step, after a check that all agree."""
    value, gradient = steps["ours"]()
    for name, step in steps.items():
        tolerance = 1e-3 if "32" in name else 1e-9
        peer_value, peer_gradient = step()
        np.testing.assert_allclose(peer_value, value, rtol=tolerance)
        np.testing.assert_allclose(peer_gradient, gradient, atol=tolerance * np.abs(gradient).max())
    seconds: dict[str, list[float]] = {name: [] for name in steps}
    for _ in range(rounds):
        for name, step in steps.items():
            with one_blas_thread() if "ours" in name else nullcontext():
                step()  # warms up its threads and caches again
                start = time.perf_counter()
                for _ in range(3):
                    step()
                seconds[name].append((time.perf_counter() - start) / 3)
    return {name: 1e3 * median(values) for name, values in seconds.items()}


if __name__ == "__main__":
    run(main, __doc__)
