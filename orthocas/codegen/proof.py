"""`--check`: compiled C against the Python it came from."""

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from orthocas.batch import Batched
from orthocas.chart import Chart
from orthocas.checks import Array
from orthocas.codegen.generate import GeneratedC
from orthocas.codegen.library import CompiledLibrary, compile_shared, gain_numbers
from orthocas.control import Controller
from orthocas.errors import ProofError

TOLERANCE = 1e-10  #: largest difference, relative to the largest entry of the result
_REACH = 1.2  # random states lie in the domain and this much around it
_BAD = (np.nan, np.inf, -np.inf, 1e200)


@dataclass(frozen=True)
class Proof:
    """Largest relative differences over all states, by function; statuses were equal everywhere."""

    states: int
    differences: dict[str, float]


def check_c(
    generated: GeneratedC, chart: Chart, controller: Controller | None = None, states: int = 1000, seed: int = 0
) -> Proof:
    """Compile (C99, warnings are errors) and compare with Python.

    Random states inside and around the domain, among them some with NaN, infinities and huge numbers.

    Raises:
        CompileError: if there is no compiler, or it complains.
        ProofError: if a result differs by more than 1e-10 of its largest entry, or a status differs.
    """
    rng, n = np.random.default_rng(seed), chart.n
    domain = chart.problem.domain
    q = domain.centre + _REACH * domain.half_width * rng.uniform(-1, 1, (states, n))
    dq = rng.normal(size=(states, n))
    differences: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as folder:
        library = CompiledLibrary(compile_shared(generated, Path(folder)), generated.name, n)
        differences |= _chart_and_dynamics(library, chart, q, dq)
        differences["inverse"] = _inverse(library, chart, q)
        if controller is not None:
            differences["control"] = _control(library, controller, q, dq, rng)
    bad = {name: value for name, value in differences.items() if not value <= TOLERANCE}
    if bad:
        text = ", ".join(f"{name} {value:.3g}" for name, value in bad.items())
        raise ProofError(f"C differs from Python by {text}, expected at most {TOLERANCE:g} relative")
    return Proof(states, differences)


def _chart_and_dynamics(library: CompiledLibrary, chart: Chart, q: Array, dq: Array) -> dict[str, float]:
    found = [(*library.chart(a)[:2], *library.dynamics(a, b)[:3]) for a, b in zip(q, dq, strict=True)]
    robot = chart.problem.robot
    wanted = (chart.phi(q), chart.jacobian(q), robot.mass_matrix(q), robot.bias(q, dq), robot.gravity(q))
    names = ("phi", "jacobian", "mass_matrix", "bias", "gravity")
    return {name: _difference(np.array([row[k] for row in found]), wanted[k]) for k, name in enumerate(names)}


def _inverse(library: CompiledLibrary, chart: Chart, q: Array) -> float:
    """Largest remaining error in phi, of the solutions that are found; most must be, from nearby."""
    inner = q[: len(q) // 10]
    targets, solved, worst = chart.phi(inner), 0, 0.0
    for target, start in zip(targets, inner, strict=True):
        solution, status = library.inverse(target, start + 0.01)
        if status in (0, 1):
            solved += 1
            worst = max(worst, float(np.abs(chart.phi(solution) - target).max()))
    if solved < 0.9 * len(inner):
        raise ProofError(f"the inverse map found {solved} of {len(inner)} positions 0.01 away, expected most")
    return worst


def _control(library: CompiledLibrary, controller: Controller, q: Array, dq: Array, rng: np.random.Generator) -> float:
    k = len(controller.labels)
    around = Batched(controller.measured)(q)[0]
    parts = [around + 0.1 * rng.normal(size=around.shape), *rng.normal(size=(2, len(q), k))]
    q, dq = q.copy(), dq.copy()
    for row in range(0, len(q), 20):  # some numbers that are none, in every argument
        arrays = (q, dq, *parts)
        array = arrays[rng.integers(len(arrays))]
        array[row, rng.integers(array.shape[1])] = _BAD[rng.integers(len(_BAD))]
    gains = [np.tile(gain, (len(q), 1)) for gain in controller.gains.values()]
    command, status = Batched(controller.function)(q, dq, *parts, *gains)
    numbers = gain_numbers(controller)
    if not np.array_equal(library.default_gains(len(numbers)), numbers):
        raise ProofError("the default gains in C are not those of the controller")
    found = [library.control(a, b, np.concatenate(c), numbers) for a, b, *c in zip(q, dq, *parts, strict=True)]
    unequal = np.flatnonzero(np.array([row[1] for row in found]) != status[:, 0])
    if unequal.size:
        row = int(unequal[0])
        raise ProofError(
            f"the status of control is {found[row][1]} at q = {q[row].tolist()}, expected {status[row, 0]:.0f}"
        )
    return _difference(np.array([row[0] for row in found]), command)


def _difference(found: Array, wanted: Array) -> float:
    """Largest difference, each state relative to its largest entry; infinite if anything is not finite."""
    flat = (len(found), -1)
    scale = np.abs(wanted.reshape(flat)).max(axis=1).clip(1e-300)
    difference = np.abs(found - wanted).reshape(flat).max(axis=1) / scale
    return float(difference.max()) if np.isfinite(difference).all() else np.inf
