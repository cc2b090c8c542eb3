"""`check_c`: compiles C with gcc and clang, and compares it with Python at random states."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from orthocas.charts.chart import Chart
from orthocas.codegen.generate import GeneratedC
from orthocas.codegen.library import CompiledLibrary, compile_shared, gain_numbers
from orthocas.codegen.rendering import DOUBLE, SINGLE, Precision, find_bounds_inside
from orthocas.control.controller import (
    FROM_THE_LAW,
    Controller,
    ControlStatus,
    count_turns_from_centre,
    find_squared_volume,
)
from orthocas.errors import AgreementError
from orthocas.native.libraries import find_compilers
from orthocas.tools.batch import Batched
from orthocas.tools.checks import Array, require_kind
from orthocas.tools.expressions import wrap_shortest
from orthocas.tools.files import open_draft_folder


@dataclass(frozen=True, slots=True)
class CheckRules:
    """Numbers of the comparison."""

    bad: tuple[float, ...] = (np.nan, np.inf, -np.inf, 1e200)  #: bad inputs
    spoil_every: int = 20  #: one in this many states gets a bad input
    reach: float = 1.2  #: random states lie in the domain, enlarged by this factor
    nearby: float = 0.01  #: [half-widths]; in single precision, a status may be that of a position this near
    start: float = 0.01  #: distance of starts of the inverse map from the solution [rad]
    far: float = 1e3  #: change of phi for targets without a solution
    solved: float = 0.9  #: least fraction of targets that the inverse map must solve from a near start
    regular: float = 1e6  #: largest condition number of J for these targets


RULES = CheckRules()


@dataclass(frozen=True)
class AgreementCheck:
    """Largest relative differences over all states and compilers, by function. All statuses agreed."""

    states: int
    compilers: tuple[str, ...]
    differences: dict[str, float]


def check_c(
    generated: GeneratedC, chart: Chart, controller: Controller | None = None, states: int = 1000, seed: int = 0
) -> AgreementCheck:
    """Compile with gcc and clang (C99, warnings as errors), where installed, and compare with Python.

    Args:
        generated: result of `generate_c`.
        chart: the chart from which it was generated.
        controller: the law of the library, if it has one.
        states: number of random states.
        seed: seed of the states.

    It compares numbers and statuses at random states inside and around the domain, some with NaN, infinite or huge
    numbers. It also compares them at rest at the centre of the domain, at its lowest and highest corners, and at the
    centres of its faces.

    Raises:
        CompileError: if there is no compiler, or compilation fails.
        AgreementError: if a status differs, or a result differs by more than the tolerance of its number type
            (`Precision`), relative to its largest entry. Near singularities, the tolerance of commands is larger if one
            rounding of q, or of one joint, changes them much. In single precision, it also grows with the inverse
            square of the volume of the gradients, and a status may be that of a nearby position.
    """
    require_kind("chart", chart, Chart)
    n, precision = chart.n, SINGLE if generated.single_precision else DOUBLE
    domain = chart.problem.domain

    # Random positions in and around the domain, then the corner cases, which lie in the domain.
    corners = np.clip(domain.centre + domain.half_width * list_corners(n), *find_bounds_inside(domain, precision))
    around = domain.half_width * RULES.reach * np.random.default_rng(seed).uniform(-1, 1, (states, n))
    q = precision.round(np.vstack([domain.centre + around, corners]))
    differences: dict[str, float] = {}
    for compiler in find_compilers():
        with open_draft_folder() as folder:
            path = compile_shared(generated, folder, compiler=compiler)
            library = CompiledLibrary(path, generated.name, n, generated.single_precision)
            results = _compare(library, chart, controller, q, seed)
        for name, value in results.items():
            if not value <= precision.tolerance:
                raise AgreementError(
                    f"C, compiled by {compiler}, differs from Python by {value:.3g} in {name}, "
                    f"expected at most {precision.tolerance:g} relative"
                )
            differences[name] = max(value, differences.get(name, 0.0))
    return AgreementCheck(len(q), tuple(Path(compiler).name for compiler in find_compilers()), differences)


def list_corners(n: int) -> Array:
    """Centre, two corners and centres of the faces of the box from -1 to 1, (3 + 2 n, n)."""
    return np.vstack([np.zeros(n), np.full(n, -1), np.full(n, 1), -np.eye(n), np.eye(n)])


def spoil(rng: np.random.Generator, *arrays: Array) -> list[Array]:
    """Copies with NaN, infinite or huge numbers in some rows, each in one array; corner cases stay unchanged."""
    copies = [array.copy() for array in arrays]
    for row in range(0, len(arrays[0]) - len(list_corners(arrays[0].shape[1])), RULES.spoil_every):
        array = copies[rng.integers(len(copies))]
        array[row, rng.integers(array.shape[1])] = RULES.bad[rng.integers(len(RULES.bad))]
    return copies


def _compare(
    library: CompiledLibrary, chart: Chart, controller: Controller | None, q: Array, seed: int
) -> dict[str, float]:
    """Largest relative differences by function. The last positions are corner cases, taken at rest."""
    rng = np.random.default_rng(seed)
    if not np.array_equal(library.domain, find_bounds_inside(chart.problem.domain, library.precision)):
        raise AgreementError("the domain in C differs from the domain of the chart")
    dq = library.precision.round(rng.normal(size=q.shape))
    dq[len(q) - len(list_corners(chart.n)) :] = 0
    differences = _compare_chart_and_dynamics(library, chart, *spoil(rng, q, dq))
    # dJ/dt v at random v, where it is defined.
    v = library.precision.round(rng.normal(size=q.shape))
    expected = Batched(chart.function("second_derivative"))(q, dq, v)[0]
    curvature = np.array([library.curvature(*row)[0] for row in zip(q, dq, v, strict=True)])
    good = np.asarray(np.isfinite(expected).all(axis=1))
    differences["curvature"] = _compute_largest(curvature, _blank(good, expected))
    differences["check"] = library.check()
    differences["inverse"] = _compare_inverse(library, chart, q)
    if controller is not None:
        differences["control"] = _compare_control(library, controller, q, dq, rng)
    return differences


def _compare_chart_and_dynamics(library: CompiledLibrary, chart: Chart, q: Array, dq: Array) -> dict[str, float]:
    domain, robot = chart.problem.domain, chart.problem.robot
    largest = library.precision.largest
    finite, moving = _are_numbers(largest, q), _are_numbers(largest, q, dq)
    somewhere, speed = np.where(finite[:, None], q, domain.home), np.where(moving[:, None], dq, 0)
    inside = np.where(domain.contains(somewhere), ControlStatus.OK, ControlStatus.OUTSIDE_DOMAIN)
    expected = {"phi": chart.phi(somewhere), "jacobian": chart.jacobian(somewhere)}
    has_value = finite & np.isfinite(expected["phi"]).all(axis=1) & np.isfinite(expected["jacobian"]).all(axis=(1, 2))
    status = np.select([~finite, ~has_value], [ControlStatus.NOT_FINITE, ControlStatus.SINGULAR], inside)
    # phi and J; C returns zeros where they are undefined.
    results = [library.chart(row) for row in q]
    _require_status("chart", [row[-1] for row in results], status, q)
    phi, J = (np.array([row[k] for row in results]) for k in range(2))
    expected = {name: _blank(has_value, value) for name, value in expected.items()}
    # pi and -pi are the same angle.
    phi = expected["phi"] + wrap_shortest(phi - expected["phi"], chart.parts.turns)
    differences = {"phi": _compute_largest(phi, expected["phi"]), "jacobian": _compute_largest(J, expected["jacobian"])}
    # Mass matrix, bias and gravity, in the same way.
    expected = {
        "mass_matrix": robot.mass_matrix(somewhere),
        "bias": robot.bias(somewhere, speed),
        "gravity": robot.gravity(somewhere),
    }
    pushed = [library.dynamics(*row) for row in zip(q, dq, strict=True)]
    _require_status("dynamics", [row[-1] for row in pushed], np.where(moving, inside, ControlStatus.NOT_FINITE), q)
    return differences | {
        name: _compute_largest(np.array([row[k] for row in pushed]), _blank(moving, value))
        for k, (name, value) in enumerate(expected.items())
    }


def _compare_inverse(library: CompiledLibrary, chart: Chart, q: Array) -> float:
    """Largest error in phi of the solutions. Most targets must be solved from near starts; far ones cannot."""
    # Targets with a defined phi, and J far from singular.
    inner = q[: len(q) // 10]
    J = chart.jacobian(inner)
    finite = np.asarray(np.isfinite(chart.phi(inner)).all(axis=1) & np.isfinite(J).all(axis=(1, 2)))
    inner = inner[finite & (np.linalg.cond(np.where(finite[:, None, None], J, np.eye(chart.n))) < RULES.regular)]
    targets, starts = chart.phi(inner), library.precision.round(inner + RULES.start)
    near = [_measure_inverse(library, chart, *pair) for pair in zip(targets, starts, strict=True)]
    far = [_measure_inverse(library, chart, *pair) for pair in zip(targets + RULES.far, inner, strict=True)]
    solved = np.isfinite(near).sum()
    if solved < RULES.solved * len(inner):
        raise AgreementError(
            f"the inverse map solved {solved} of {len(inner)} targets from {RULES.start:g} away, expected most of them"
        )
    # NaN must be refused as target and as start.
    nothing = np.full(chart.n, np.nan)
    for arguments in ((nothing, q[0]), (q[0], nothing)):
        solution, status = library.inverse(*arguments)
        if status != ControlStatus.NOT_FINITE or solution.any():
            raise AgreementError(
                f"inverse returns {solution.tolist()} and status {status} for NaN, expected zeros and 3"
            )
    return max((error for error in (*near, *far) if np.isfinite(error)), default=0.0)


def _measure_inverse(library: CompiledLibrary, chart: Chart, target: Array, start: Array) -> float:
    """Largest error in phi; infinite without a solution, for which status and output must be as documented."""
    solution, status = library.inverse(target, start)
    if status in (ControlStatus.OK, ControlStatus.OUTSIDE_DOMAIN):
        if (status == ControlStatus.OK) != chart.problem.domain.contains(solution.astype(float)):
            raise AgreementError(f"the status of inverse is {status} at q = {solution.tolist()}")
        return float(np.abs(wrap_shortest(chart.phi(solution.astype(float)) - target, chart.parts.turns)).max())
    if status == ControlStatus.STOPPED_EARLY:
        # Measure errors with the library's own phi and scale, because rounding is large far outside.
        phi = np.array([library.chart(q)[0] for q in (solution, start)], dtype=float)
        scale = chart.parts.phi_sizes + library.precision.coarse * np.abs(target)
        after, before = np.abs(chart.parts.phi_map.difference(np.tile(target, (2, 1)), phi) / scale).max(axis=1)
        if not after <= before * (1 + 1e-5):
            raise AgreementError(
                f"inverse returns {solution.tolist()}, with the error {after}, larger than {before} at its start"
            )
    elif status != ControlStatus.SINGULAR or not np.array_equal(solution, start):
        raise AgreementError(f"inverse returns {solution.tolist()} and status {status}, expected its start")
    return np.inf


def _compare_control(
    library: CompiledLibrary, controller: Controller, q: Array, dq: Array, rng: np.random.Generator
) -> float:
    numbers = library.precision.round(gain_numbers(controller))
    if not np.array_equal(library.default_gains(len(numbers)), numbers):
        raise AgreementError("the default gains in C differ from the gains of the controller")
    # References near the quantities, and random gains; some of these numbers are made bad.
    around = np.nan_to_num(Batched(controller.measured)(q)[0])
    reference = (around + 0.1 * rng.normal(size=around.shape), *rng.normal(size=(2, *around.shape)))
    state = spoil(rng, q, dq, *reference)
    inputs = [library.precision.round(values) for values in (*state, *sample_gains(controller, len(q), rng))]
    law = Batched(count_turns_from_centre(library.precision.graph(controller), controller.problem))
    command, status = law(*inputs)
    if not (status == ControlStatus.OK).any():
        raise AgreementError(
            f"{controller.name} is undefined at all {len(q)} states, expected at least one where it is defined"
        )
    rows = zip(*inputs[:2], np.hstack(inputs[2:5]), np.hstack(inputs[5:]), strict=True)
    results, statuses = zip(*(library.control(*row) for row in rows), strict=True)
    same = np.array(statuses) == status[:, 0]
    # In single precision, accept any status where the law changes its status at a neighbour of q along a joint.
    expected = status[:, 0]
    if library.single_precision:
        step = np.diag(RULES.nearby * controller.problem.domain.half_width)
        near = [law(inputs[0] + way, *inputs[1:])[1][:, 0] != expected for way in np.vstack([step, -step])]
        expected = np.where(np.any(near, axis=0), statuses, expected)
    _require_status("control", statuses, expected, inputs[0])
    amplification = _estimate_amplification(library.precision, controller, law, inputs)
    return float((_compute_differences(np.array(results), command) / amplification)[same].max())


def sample_gains(controller: Controller, rows: int, rng: np.random.Generator) -> list[Array]:
    """Random gains around those of the controller, (rows, length) each. Limits are finite or sometimes infinite."""
    gains = []
    for name, gain in controller.gains.items():
        if name == "payload":
            # Payloads up to 2 kg, within about 0.1 m of the tip, with positive definite inertias.
            mass, factors = rng.uniform(0, 2, (rows, 1)), 0.05 * rng.normal(size=(rows, 3, 3))
            inertia = factors @ factors.transpose(0, 2, 1)
            values = np.hstack([mass, 0.1 * rng.normal(size=(rows, 3)), inertia[:, *np.triu_indices(3)]])
        elif name == "mass_matrix":
            # One factor plus a diagonal keeps matrices symmetric positive definite.
            n = controller.problem.n
            diagonal = np.eye(n) * rng.uniform(0, 0.1, (rows, 1, n))
            values = (gain.reshape(n, n) * rng.uniform(0.5, 1.5, (rows, 1, 1)) + diagonal).reshape(rows, -1)
        elif name in ("wrench", "extra_torque", "coriolis_torque", "gravity_torque"):
            values = gain + rng.normal(size=(rows, len(gain)))
        else:
            values = np.where(np.isfinite(gain), gain, 50.0) * rng.uniform(0.5, 1.5, (rows, len(gain)))
        if name == "limit":
            # A weak arm may saturate in all states, which would not test the law, so a third has no limits.
            values[::3] = np.inf
            values[7::40, 0] = rng.choice([0.0, -1.0, np.nan, np.inf], size=len(values[7::40]))
        gains.append(values)
    return gains


def _estimate_amplification(precision: Precision, controller: Controller, law: Batched, inputs: list[Array]) -> Array:
    """Factor on the tolerance of the command at each state, (N,) >= 1."""
    q, others = inputs[0], inputs[1:]
    command, status = law(*inputs)
    change = np.zeros(len(q))
    # Effects of joints may cancel, so each joint is also moved alone.
    for joints in (np.ones(q.shape[1], dtype=bool), *np.eye(q.shape[1], dtype=bool)):
        moved, status_there = law(np.where(joints, precision.next_above(q), q), *others)
        same = (status_there == status)[:, 0]
        change = np.where(same, np.maximum(change, _compute_differences(moved, command)), change)
    results: Array = change.clip(precision.sensitive, 1) / precision.sensitive
    # The volume does not depend on full turns.
    volume = find_squared_volume(controller.graph)
    if precision is SINGLE and volume is not None:
        squares = np.where(np.isin(status, FROM_THE_LAW), Batched(volume)(*inputs)[0], 1.0)[:, 0]
        results /= squares.clip(precision.smallest_volume**2, 1)
    return results


def _are_numbers(largest: float, *arrays: Array) -> NDArray[np.bool_]:
    """Rows without NaN, infinities, or numbers that the C code rejects."""
    return np.asarray(np.all([(np.abs(array) <= largest).all(axis=1) for array in arrays], axis=0))


def _blank(good: NDArray[np.bool_], values: Array) -> Array:
    """Values at good states, zeros at the others."""
    return np.where(good.reshape(-1, *[1] * (values.ndim - 1)), values, 0.0)


def _require_status(function: str, results: Sequence[int], expected: Array, q: Array) -> None:
    unequal = np.flatnonzero(np.array(results) != expected)
    if unequal.size:
        row = int(unequal[0])
        raise AgreementError(
            f"the status of {function} is {results[row]} at q = {q[row].tolist()}, expected {expected[row]:.0f}"
        )


def _compute_largest(results: Array, expected: Array) -> float:
    """The largest of `_compute_differences`."""
    return float(_compute_differences(results, expected).max())


def _compute_differences(results: Array, expected: Array) -> Array:
    """Differences at each state relative to the largest entry, (N,); infinite where an entry is not finite."""
    flat = (len(results), -1)
    scale = np.abs(expected.reshape(flat)).max(axis=1).clip(1e-300)
    difference = np.abs(results - expected).reshape(flat).max(axis=1) / scale
    return np.where(np.isfinite(difference), difference, np.inf)
