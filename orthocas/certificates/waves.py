"""Trigonometric polynomials of joint positions: entries of task Jacobians, and their cofactors, in closed form.

Rows of arms are sums of products of sines and cosines of single joints. Multiplied out, each is a short sum of waves
c_k exp(i k . q) with whole k, and so are its derivatives and the minors of a matrix of such rows. The numbers c_k are
known up to rounding only, and each sum carries a bound of it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthocas.certificates.taylor import TINY, UNIT, UP, above, sum_error
from orthocas.errors import CertifyError
from orthocas.tools.checks import Array
from orthocas.tools.expressions import Tape, evaluate_tape

_MOST_TERMS = 1_000_000  # of a product before equal frequencies are joined
_WIDEST, _MOST_JOINTS = 100, 8  # frequency of a joint; numbers of so many joints are whole numbers of 64 bits
_COMPLEX = 8  # roundings of a complex product, with room to spare
_NEGLIGIBLE = 1e-16, 1e-6  # of the sum of all sizes, and of the error: smaller waves become a part of the error


@dataclass(frozen=True, eq=False)
class Waves:
    """q (n,) -> sum_k c_k exp(i k . q), which is real, up to an error of that size at any real q."""

    frequencies: NDArray[np.int64]  #: k, (terms, n), each once
    coefficients: NDArray[np.complex128]  #: c_k, (terms,)
    error: float

    @classmethod
    def constant(cls, value: float, n: int, error: float = 0.0) -> "Waves":
        """A number."""
        return cls(np.zeros((1, n), dtype=np.int64), np.array([complex(value)]), error)

    @classmethod
    def sine(cls, joint: int, n: int) -> "Waves":
        """The sine of a joint's position."""
        return cls(_both_ways(joint, n), np.array([-0.5j, 0.5j]), 0.0)

    @classmethod
    def cosine(cls, joint: int, n: int) -> "Waves":
        """The cosine of a joint's position."""
        return cls(_both_ways(joint, n), np.array([0.5 + 0j, 0.5 + 0j]), 0.0)

    @property
    def size(self) -> float:
        """A bound of the absolute values, without the error."""
        return float(np.abs(self.coefficients).sum()) * above(len(self.coefficients))

    def __neg__(self) -> "Waves":
        return replace(self, coefficients=-self.coefficients)

    def __add__(self, other: "Waves") -> "Waves":
        return _joined(
            np.concatenate([self.frequencies, other.frequencies]),
            np.concatenate([self.coefficients, other.coefficients]),
            self.error + other.error,
        )

    def __sub__(self, other: "Waves") -> "Waves":
        return self + (-other)

    def __mul__(self, other: "Waves") -> "Waves":
        if len(self.coefficients) * len(other.coefficients) > _MOST_TERMS:
            raise CertifyError("the task Jacobian has too many waves")
        frequencies = (self.frequencies[:, None] + other.frequencies[None]).reshape(-1, self.frequencies.shape[1])
        coefficients = (self.coefficients[:, None] * other.coefficients[None]).ravel()
        carried = self.error * (other.size + other.error) + self.size * other.error
        rounding = sum_error(_COMPLEX) * self.size * other.size
        return _joined(frequencies, coefficients, (carried + rounding) * UP)

    def derivative(self, joint: int) -> "Waves":
        """By one joint. The error must be rounding of these coefficients, no error from elsewhere."""
        k = self.frequencies[:, joint]
        highest = int(np.abs(k).max(initial=0))
        error = (highest * self.error + _COMPLEX * UNIT * highest * self.size) * UP
        return replace(self, coefficients=1j * k * self.coefficients, error=error)

    def trimmed(self) -> "Waves":
        """Without negligible waves."""
        sizes = np.abs(self.coefficients)
        kept = sizes > max(_NEGLIGIBLE[0] * float(sizes.sum()), _NEGLIGIBLE[1] * self.error)
        left_out = float(sizes[~kept].sum()) * above(len(sizes))
        return Waves(self.frequencies[kept], self.coefficients[kept], (self.error + left_out) * UP)

    def __call__(self, q: Array) -> Array:
        """Values at points (N, n), rounded, (N,)."""
        values: Array = (np.exp(1j * (q @ self.frequencies.T)) @ self.coefficients).real
        return values


def _both_ways(joint: int, n: int) -> NDArray[np.int64]:
    unit = np.eye(n, dtype=np.int64)[joint]
    return np.stack([unit, -unit])


def _joined(frequencies: NDArray[np.int64], coefficients: NDArray[np.complex128], error: float) -> Waves:
    """The sum of waves, some of the same frequency."""
    if frequencies.shape[1] > _MOST_JOINTS or np.abs(frequencies).max(initial=0) > _WIDEST:
        raise CertifyError("the task Jacobian has too many joints, or too short waves")
    keys = (frequencies + _WIDEST) @ (2 * _WIDEST + 1) ** np.arange(frequencies.shape[1], dtype=np.int64)
    _, first, place = np.unique(keys, return_index=True, return_inverse=True)
    total = np.zeros(len(first), dtype=complex)
    np.add.at(total, place.ravel(), coefficients)
    rounding = sum_error(len(coefficients)) * float(np.abs(coefficients).sum())
    return Waves(frequencies[first], total, (error + rounding) * UP + TINY)


def waves_of(tape: Tape, n: int) -> list[Waves]:
    """The values of an expression of q (n, 1), column by column.

    Raises:
        CertifyError: if it is no sum of products of numbers and of sines and cosines of single joints.
    """

    def leaf(name: str, of: Any) -> Waves | int:
        return Waves.constant(float(of), n) if name == "const" else int(of)

    def step(name: str, of: Sequence[Waves | int]) -> Waves | int:
        if name in ("sin", "cos"):
            if isinstance(joint := of[0], Waves):
                raise CertifyError("the task uses a sine of more than the position of a joint")
            return Waves.sine(joint, n) if name == "sin" else Waves.cosine(joint, n)
        if name not in _STEPS:
            raise CertifyError(f"the task uses the operation {name}, which makes no waves")
        return _STEPS[name](*map(_known, of))

    return [_known(value) for value in evaluate_tape(tape, leaf, step)]


def _known(value: Waves | int) -> Waves:
    if isinstance(value, Waves):
        return value
    raise CertifyError("the task uses the position of a joint other than by sine and cosine")


_STEPS: dict[str, Callable[..., Waves]] = {
    "assign": lambda a: a,
    "neg": lambda a: -a,
    "twice": lambda a: a + a,
    "sq": lambda a: a * a,
    "add": lambda a, b: a + b,
    "sub": lambda a, b: a - b,
    "mul": lambda a, b: a * b,
}


def cofactors(rows: Sequence[Sequence[Waves]]) -> list[Waves]:
    """z with det [rows; g] = sum_j g_j z_j for all g, from rows (m, m + 1)."""
    columns = range(len(rows) + 1)
    minors: dict[tuple[int, ...], Waves] = {(j,): rows[0][j].trimmed() for j in columns}
    for k, row in enumerate(rows[1:], 1):
        entries = [entry.trimmed() for entry in row]
        minors = {chosen: _minor(entries, minors, chosen) for chosen in combinations(columns, k + 1)}
    return [_signed(minors[tuple(i for i in columns if i != j)], len(rows) + j) for j in columns]


def _minor(row: list[Waves], minors: dict[tuple[int, ...], Waves], columns: tuple[int, ...]) -> Waves:
    """Of some columns, by expansion along the last row."""
    parts = (
        _signed(row[j] * minors[columns[:place] + columns[place + 1 :]], len(columns) - 1 + place)
        for place, j in enumerate(columns)
    )
    return reduce(Waves.__add__, parts).trimmed()


def _signed(value: Waves, places: int) -> Waves:
    return -value if places % 2 else value
