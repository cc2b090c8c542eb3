"""Expressions as graphs, their values and their derivatives as Taylor models."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from orthocas.certificates.taylor import (
    BINARY,
    POWERS,
    UNARY,
    TaylorModel,
    cosine,
    power,
    reciprocal,
    reciprocal_square_root,
    sine,
    square,
)
from orthocas.errors import CertifyError
from orthocas.tools.expressions import to_tape

_LARGEST_POWER = 64
_LINEAR = ("assign", "neg", "twice")
_SUMS = ("add", "sub")


@dataclass(frozen=True, eq=False)
class TaylorGraph:
    """An SX function q (n, 1) -> values, dense, as a list of steps in Taylor arithmetic.

    Raises:
        CertifyError: if a step has no bounds.
    """

    steps: tuple[tuple[Any, ...], ...]
    outputs: int  #: number of values, column by column
    what: str  #: for errors

    @classmethod
    def of(cls, function: ca.Function, what: str) -> "TaylorGraph":
        """The steps of a function, checked."""
        tape = to_tape(function)
        graph = cls(tuple(map(tuple, tape["steps"])), tape["rows"] * tape["columns"], what)
        graph.require_bounds()
        return graph

    def require_bounds(self) -> None:
        """Refuse operations without bounds."""
        constants: dict[int, float] = {}
        for name, into, *of in self.steps:
            if name in POWERS and not is_whole(constants.get(of[1])):
                raise CertifyError(f"{self.what} has a power that is no whole number, so it cannot be certified")
            if name not in (*UNARY, *BINARY, *POWERS, "const", "input", "output"):
                raise CertifyError(f"{self.what} uses the operation {name}, which cannot be certified")
            constants.pop(into, None)
            if name == "const":
                constants[into] = of[0]

    def __call__(self, inputs: Sequence[TaylorModel]) -> list[TaylorModel]:
        """The values for models of q_1, ..., q_n."""
        work: dict[int, Any] = {}
        results: dict[int, TaylorModel] = {}
        for name, into, *of in self.steps:
            if name == "const":
                work[into] = TaylorModel.constant(np.array([float(of[0])]))
            elif name == "input":
                work[into] = inputs[of[0]]
            elif name == "output":
                results[into] = work[of[0]]
            elif name in UNARY:
                work[into] = UNARY[name](work[of[0]])
            elif name in POWERS:
                work[into] = power(work[of[0]], int(work[of[1]].centre.flat[0]))
            else:
                work[into] = BINARY[name](work[of[0]], work[of[1]])
        return [results[k] for k in range(self.outputs)]


def is_whole(value: float | None) -> bool:
    """Whether a constant, if there is one, is a whole number that powers may have as exponent."""
    return value is not None and abs(value) <= _LARGEST_POWER and value == round(value)


Slopes = dict[int, TaylorModel]  #: derivatives by the inputs; an input that is missing has the derivative 0
#: f' for f(a) with the value v; functions that are not among UNARY have a derivative with bounds, but no value
_DERIVATIVES: dict[str, Callable[[TaylorModel, Any], TaylorModel]] = {
    "sq": lambda a, v: a.times(2.0),
    "sqrt": lambda a, v: reciprocal_square_root(a).times(0.5),
    "inv": lambda a, v: -square(v),
    "sin": lambda a, v: cosine(a),
    "cos": lambda a, v: -sine(a),
    "tan": lambda a, v: square(reciprocal(cosine(a))),
    "exp": lambda a, v: v,
    "tanh": lambda a, v: _one() - square(v),
    "log": lambda a, v: reciprocal(a),
    "atan": lambda a, v: reciprocal(square(a) + _one()),
    "asin": lambda a, v: reciprocal_square_root(_one() - square(a)),
    "acos": lambda a, v: -reciprocal_square_root(_one() - square(a)),
}
_KNOWN = {*_LINEAR, *_SUMS, *_DERIVATIVES, *POWERS, "mul", "div", "atan2", "const", "input", "output"}


class _Jet(NamedTuple):
    """A value, None if it has no bounds, and its derivatives."""

    value: TaylorModel | None
    slopes: Slopes


@dataclass(frozen=True, eq=False)
class DerivativeGraph:
    """q -> dh/dq for some of the joints, column by column, of an SX function h of one column q (n, 1).

    Raises:
        CertifyError: if a step has no bounds.
    """

    steps: tuple[tuple[Any, ...], ...]  #: of h
    outputs: int  #: number of values of h
    joints: tuple[int, ...]  #: the columns

    @classmethod
    def of(cls, function: ca.Function, joints: Sequence[int], what: str) -> "DerivativeGraph":
        """The graph of a function, checked; `what` names it in errors."""
        tape = to_tape(function)
        _require_bounds(tape["steps"], what)
        return cls(tuple(map(tuple, tape["steps"])), tape["rows"] * tape["columns"], tuple(joints))

    def __call__(self, inputs: Sequence[TaylorModel]) -> list[TaylorModel]:
        """The entries dh_i/dq_j, the rows i of the first column first, for models of q_1, ..., q_n."""
        work: dict[int, _Jet] = {}
        results: dict[int, Slopes] = {}
        for name, into, *of in self.steps:
            if name == "const":
                work[into] = _Jet(TaylorModel.constant(np.array([float(of[0])])), {})
            elif name == "input":
                work[into] = _Jet(inputs[of[0]], {of[0]: _one()} if of[0] in self.joints else {})
            elif name == "output":
                results[into] = work[of[0]].slopes
            else:
                work[into] = _jet(name, [work[k] for k in of])
        none = TaylorModel.constant(np.zeros(1))
        return [results[i].get(joint, none) for joint in self.joints for i in range(self.outputs)]


def _one() -> TaylorModel:
    return TaylorModel.constant(np.ones(1))


def _jet(name: str, of: list[_Jet]) -> _Jet:
    """A step of any kind."""
    if name in POWERS:
        assert of[1].value is not None
        return _power(of[0], int(of[1].value.centre.flat[0]))
    if len(of) == 1:
        return _unary(name, *of)
    return {"add": _sum, "sub": _difference, "mul": _product, "div": _quotient, "atan2": _angle}[name](*of)


def _unary(name: str, a: _Jet) -> _Jet:
    value = UNARY[name](a.value) if name in UNARY and a.value is not None else None
    if name in _LINEAR:
        return _Jet(value, {j: UNARY[name](slope) for j, slope in a.slopes.items()})
    return _Jet(value, _scaled(_DERIVATIVES[name](_known(a), value), a.slopes) if a.slopes else {})


def _power(a: _Jet, exponent: int) -> _Jet:
    value = _known(a)
    slopes = _scaled(power(value, exponent - 1).times(float(exponent)), a.slopes) if exponent and a.slopes else {}
    return _Jet(power(value, exponent), slopes)


def _sum(a: _Jet, b: _Jet) -> _Jet:
    return _Jet(_both("add", a, b), _added(a.slopes, b.slopes))


def _difference(a: _Jet, b: _Jet) -> _Jet:
    return _Jet(_both("sub", a, b), _added(a.slopes, {j: -slope for j, slope in b.slopes.items()}))


def _product(a: _Jet, b: _Jet) -> _Jet:
    parts = [_scaled(_known(other), part.slopes) for part, other in ((a, b), (b, a)) if part.slopes]
    return _Jet(_both("mul", a, b), _added(*parts))


def _quotient(a: _Jet, b: _Jet) -> _Jet:
    """a / b with the derivative (a' - (a / b) b') / b."""
    inverse = reciprocal(_known(b))
    value = None if a.value is None else a.value * inverse
    slopes = _scaled(inverse, a.slopes)
    if b.slopes:
        assert value is not None
        slopes = _added(slopes, _scaled(-(value * inverse), b.slopes))
    return _Jet(value, slopes)


def _angle(y: _Jet, x: _Jet) -> _Jet:
    """atan2(y, x), without a value, with the derivative (x y' - y x') / (x^2 + y^2)."""
    a, b = _known(y), _known(x)
    inverse = reciprocal(square(b) + square(a))
    return _Jet(None, _added(_scaled(b * inverse, y.slopes), _scaled(-(a * inverse), x.slopes)))


def _known(jet: _Jet) -> TaylorModel:
    assert jet.value is not None  # `_require_bounds` has refused others
    return jet.value


def _both(name: str, a: _Jet, b: _Jet) -> TaylorModel | None:
    return None if a.value is None or b.value is None else BINARY[name](a.value, b.value)


def _scaled(factor: TaylorModel, slopes: Slopes) -> Slopes:
    return {j: factor * slope for j, slope in slopes.items()}


def _added(*parts: Slopes) -> Slopes:
    total: Slopes = {}
    for part in parts:
        for j, slope in part.items():
            total[j] = total[j] + slope if j in total else slope
    return total


def _require_bounds(steps: Sequence[Sequence[Any]], what: str) -> None:
    """Refuse operations whose derivative has no bounds, or needs a value that has none."""
    constants: dict[int, float] = {}
    moving: dict[int, bool] = {}  # whether a place has derivatives
    known: dict[int, bool] = {}  # whether its value has bounds
    for name, into, *of in steps:
        if name not in _KNOWN:
            raise CertifyError(f"{what} uses the operation {name}, which cannot be certified")
        if name in POWERS and not is_whole(constants.get(of[1])):
            raise CertifyError(f"{what} has a power that is no whole number, so it cannot be certified")
        if name == "output":
            continue
        constants.pop(into, None)
        if name == "const":
            constants[into] = of[0]
        if name in ("const", "input"):
            moving[into], known[into] = name == "input", True
            continue
        if any(not known[k] for k in _needed(name, of, moving)):
            raise CertifyError(f"{what} uses the value of log, atan, asin, acos or atan2, which cannot be certified")
        bounded = name in UNARY or name in BINARY or name in POWERS
        known[into], moving[into] = bounded and all(known[k] for k in of), any(moving[k] for k in of)


def _needed(name: str, of: Sequence[int], moving: dict[int, bool]) -> list[int]:
    """The operands whose values a derivative needs."""
    if name in _LINEAR or name in _SUMS:
        return []
    if name == "mul":
        return [one for one, other in (of, of[::-1]) if moving[other]]
    if name == "div":
        return [*of] if moving[of[1]] else [of[1]]
    return [*of]
