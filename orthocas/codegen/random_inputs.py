"""Random and special inputs with which generated C is compared with Python."""

from collections.abc import Callable, Mapping

import numpy as np

from orthocas.checks import Array
from orthocas.control import Controller

_BAD = (np.nan, np.inf, -np.inf, 1e200)


def corner_cases(n: int) -> Array:
    """Centre, two corners and centres of the faces of the box from -1 to 1, (3 + 2 n, n)."""
    return np.vstack([np.zeros(n), np.full(n, -1), np.full(n, 1), -np.eye(n), np.eye(n)])


def spoiled(rng: np.random.Generator, *arrays: Array) -> list[Array]:
    """Copies with a NaN, infinite or huge number in every twentieth row of one array; corner cases stay as they are."""
    copies = [array.copy() for array in arrays]
    for row in range(0, len(arrays[0]) - len(corner_cases(arrays[0].shape[1])), 20):
        array = copies[rng.integers(len(copies))]
        array[row, rng.integers(array.shape[1])] = _BAD[rng.integers(len(_BAD))]
    return copies


def random_gains(controller: Controller, rows: int, rng: np.random.Generator) -> list[Array]:
    """Random gains around those of the controller, (rows, length) each; limits are finite or, at times, infinite."""
    gains = []
    for name, gain in controller.gains.items():
        values = _RANDOM.get(name, _scaled)(gain, rows, rng)
        if name == "limit":
            values[::3] = np.inf  # states of a weak arm may all saturate, which would say little of the law
            values[7::40, 0] = rng.choice([0.0, -1.0, np.nan, np.inf], size=len(values[7::40]))
        gains.append(values)
    return gains


def _scaled(gain: Array, rows: int, rng: np.random.Generator) -> Array:
    return np.where(np.isfinite(gain), gain, 50.0) * rng.uniform(0.5, 1.5, (rows, len(gain)))


def _shifted(gain: Array, rows: int, rng: np.random.Generator) -> Array:
    return np.asarray(gain + rng.normal(size=(rows, len(gain))))


def _payloads(gain: Array, rows: int, rng: np.random.Generator) -> Array:
    """Payloads of up to 2 kg, within some 0.1 m of the tip, with positive definite inertias."""
    mass, factors = rng.uniform(0, 2, (rows, 1)), 0.05 * rng.normal(size=(rows, 3, 3))
    inertia = factors @ factors.transpose(0, 2, 1)
    return np.hstack([mass, 0.1 * rng.normal(size=(rows, 3)), inertia[:, *np.triu_indices(3)]])


def _symmetric(gain: Array, rows: int, rng: np.random.Generator) -> Array:
    """The matrix (n * n,) times one factor and plus a diagonal, so that it stays symmetric positive definite."""
    n = round(len(gain) ** 0.5)
    diagonal = np.eye(n) * rng.uniform(0, 0.1, (rows, 1, n))
    return np.asarray((gain.reshape(n, n) * rng.uniform(0.5, 1.5, (rows, 1, 1)) + diagonal).reshape(rows, -1))


_RANDOM: Mapping[str, Callable[[Array, int, np.random.Generator], Array]] = {  # inputs that are not just positive
    "payload": _payloads,
    "mass_matrix": _symmetric,
    **dict.fromkeys(("wrench", "extra_torque", "coriolis_torque", "gravity_torque"), _shifted),
}
