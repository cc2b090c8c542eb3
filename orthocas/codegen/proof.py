"""`--check`: compiled C against the Python it came from."""

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from orthocas.batch import Batched
from orthocas.chart import Chart
from orthocas.checks import Array
from orthocas.codegen.generate import GeneratedC
from orthocas.codegen.library import CompiledLibrary, compile_shared, compilers, gain_numbers
from orthocas.control import Controller
from orthocas.errors import ProofError

TOLERANCE = 1e-10  #: largest difference, relative to the largest entry of the result
_REACH = 1.2  # random states lie in the domain and this much around it
_BAD = (np.nan, np.inf, -np.inf, 1e200)


@dataclass(frozen=True)
class Proof:
    """Largest relative differences over all states and compilers, by function; statuses were equal everywhere."""

    states: int
    compilers: tuple[str, ...]
    differences: dict[str, float]


def check_c(
    generated: GeneratedC, chart: Chart, controller: Controller | None = None, states: int = 1000, seed: int = 0
) -> Proof:
    """Compile (C99, warnings are errors) with gcc and clang, those that are there, and compare with Python.

    Random states inside and around the domain, some of them with NaN, infinities and huge numbers; and at rest, the
    centre of the domain, its lowest and highest corner, and the centres of its faces.

    Raises:
        CompileError: if there is no compiler, or one complains.
        ProofError: if a result differs by more than 1e-10 of its largest entry, or a status differs.
    """
    n, domain, places = chart.n, chart.problem.domain, np.random.default_rng(seed).uniform(-1, 1, (states, chart.n))
    q = domain.centre + domain.half_width * np.vstack([_REACH * places, _corner_cases(n)])
    differences: dict[str, float] = {}
    for compiler in compilers():
        with tempfile.TemporaryDirectory() as folder:
            path = compile_shared(generated, Path(folder), compiler=compiler)
            found = _compared(CompiledLibrary(path, generated.name, n), chart, controller, q, seed)
        for name, value in found.items():
            if not value <= TOLERANCE:
                raise ProofError(
                    f"C, compiled by {compiler}, differs from Python by {value:.3g} in {name}, "
                    f"expected at most {TOLERANCE:g} relative"
                )
            differences[name] = max(value, differences.get(name, 0.0))
    return Proof(len(q), tuple(Path(compiler).name for compiler in compilers()), differences)


def _compared(
    library: CompiledLibrary, chart: Chart, controller: Controller | None, q: Array, seed: int
) -> dict[str, float]:
    """Largest relative differences by function; the last positions are corner cases, taken at rest."""
    rng = np.random.default_rng(seed)
    dq = rng.normal(size=q.shape)
    dq[len(q) - len(_corner_cases(chart.n)) :] = 0
    differences = _chart_and_dynamics(library, chart, q, dq)
    differences["inverse"] = _inverse(library, chart, q)
    if controller is not None:
        differences["control"] = _control(library, controller, q, dq, rng)
    return differences


def _corner_cases(n: int) -> Array:
    """Of the box from -1 to 1: centre, two corners, centres of the faces, (3 + 2 n, n)."""
    return np.vstack([np.zeros(n), np.full(n, -1), np.full(n, 1), -np.eye(n), np.eye(n)])


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
    for row in range(0, len(q) - len(_corner_cases(q.shape[1])), 20):  # some numbers that are none, in every argument
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
