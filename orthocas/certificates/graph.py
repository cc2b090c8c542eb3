"""Values and derivatives of expressions as Taylor models."""

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
from orthocas.tools.expressions import Tape, evaluate_tape, write_tape

_LARGEST_POWER = 64
_LINEAR = ("assign", "neg", "twice")
_SUMS = ("add", "sub")


Slopes = dict[int, TaylorModel]  #: derivatives by inputs; a missing input has the derivative 0
#: derivatives f' of functions f(a) with the value v; functions outside UNARY have bounds for derivatives only
_DERIVATIVES: dict[str, Callable[[TaylorModel, Any], TaylorModel]] = {
    "sq": lambda a, v: a.multiply_by(2.0),
    "sqrt": lambda a, v: reciprocal_square_root(a).multiply_by(0.5),
    "inv": lambda a, v: -square(v),
    "sin": lambda a, v: cosine(a),
    "cos": lambda a, v: -sine(a),
    "tan": lambda a, v: square(reciprocal(cosine(a))),
    "exp": lambda a, v: v,
    "tanh": lambda a, v: _build_one() - square(v),
    "log": lambda a, v: reciprocal(a),
    "atan": lambda a, v: reciprocal(square(a) + _build_one()),
    "asin": lambda a, v: reciprocal_square_root(_build_one() - square(a)),
    "acos": lambda a, v: -reciprocal_square_root(_build_one() - square(a)),
}
_KNOWN = {*_LINEAR, *_SUMS, *_DERIVATIVES, *POWERS, "mul", "div", "atan2"}


class _Jet(NamedTuple):
    """A value (None if it has no bounds), and its derivatives."""

    value: TaylorModel | None
    slopes: Slopes


@dataclass(frozen=True, eq=False, repr=False)
class TaylorGraph:
    """An SX function h of q (n, 1), dense, or its derivatives by some joints, in Taylor arithmetic.

    Raises:
        CertifyError: if an operation has no bounds.
    """

    tape: Tape
    joints: tuple[int, ...] | None  #: joints for dh/dq, column by column; None: h itself

    @classmethod
    def build(cls, function: ca.Function, what: str, joints: Sequence[int] | None = None) -> "TaylorGraph":
        """Check and record the operations of a function; `what` names it in errors."""
        tape = write_tape(function)
        _require_bounds(tape, what, joints is None)
        return cls(tape, None if joints is None else tuple(joints))

    def __call__(self, inputs: Sequence[TaylorModel]) -> list[TaylorModel]:
        """h, or the entries dh_i/dq_j column by column, for models of q_1, ..., q_n."""
        moving = self.joints or ()

        # The derivative of an input by itself is 1.
        def leaf(name: str, of: Any) -> _Jet:
            if name == "const":
                return _Jet(TaylorModel.constant(np.array([float(of)])), {})
            return _Jet(inputs[of], {of: _build_one()} if of in moving else {})

        jets = evaluate_tape(self.tape, leaf, _apply_step)
        if self.joints is None:
            return [_get_value(jet) for jet in jets]
        # A missing entry has the derivative 0.
        none = TaylorModel.constant(np.zeros(1))
        return [jet.slopes.get(joint, none) for joint in self.joints for jet in jets]


def _build_one() -> TaylorModel:
    return TaylorModel.constant(np.ones(1))


def _apply_step(name: str, of: Sequence[_Jet]) -> _Jet:
    """Apply one operation of a tape to jets."""
    a, slopes = of[0], Slopes()
    # f^k has the derivative k f^(k - 1) f'.
    if name in POWERS:
        assert of[1].value is not None
        value, exponent = _get_value(a), int(of[1].value.centre.flat[0])
        if exponent and a.slopes:
            slopes = _scale_slopes(power(value, exponent - 1).multiply_by(float(exponent)), a.slopes)
        return _Jet(power(value, exponent), slopes)
    if len(of) > 1:
        return {"add": _add, "sub": _subtract, "mul": _multiply, "div": _divide, "atan2": _take_angle}[name](*of)
    # Linear functions of one operand act on derivatives as on values.
    result = UNARY[name](a.value) if name in UNARY and a.value is not None else None
    if name in _LINEAR:
        slopes = {j: UNARY[name](slope) for j, slope in a.slopes.items()}
    elif a.slopes:
        slopes = _scale_slopes(_DERIVATIVES[name](_get_value(a), result), a.slopes)
    return _Jet(result, slopes)


def _add(a: _Jet, b: _Jet) -> _Jet:
    return _Jet(_combine_values("add", a, b), _add_slopes(a.slopes, b.slopes))


def _subtract(a: _Jet, b: _Jet) -> _Jet:
    return _Jet(_combine_values("sub", a, b), _add_slopes(a.slopes, {j: -slope for j, slope in b.slopes.items()}))


def _multiply(a: _Jet, b: _Jet) -> _Jet:
    parts = [_scale_slopes(_get_value(other), part.slopes) for part, other in ((a, b), (b, a)) if part.slopes]
    return _Jet(_combine_values("mul", a, b), _add_slopes(*parts))


def _divide(a: _Jet, b: _Jet) -> _Jet:
    """a / b with the derivative (a' - (a / b) b') / b."""
    inverse = reciprocal(_get_value(b))
    value = None if a.value is None else a.value * inverse
    slopes = _scale_slopes(inverse, a.slopes)
    if b.slopes:
        assert value is not None
        slopes = _add_slopes(slopes, _scale_slopes(-(value * inverse), b.slopes))
    return _Jet(value, slopes)


def _take_angle(y: _Jet, x: _Jet) -> _Jet:
    """atan2(y, x) without a value; its derivative is (x y' - y x') / (x^2 + y^2)."""
    a, b = _get_value(y), _get_value(x)
    inverse = reciprocal(square(b) + square(a))
    return _Jet(None, _add_slopes(_scale_slopes(b * inverse, y.slopes), _scale_slopes(-(a * inverse), x.slopes)))


def _get_value(jet: _Jet) -> TaylorModel:
    # `_require_bounds` has excluded None.
    assert jet.value is not None
    return jet.value


def _combine_values(name: str, a: _Jet, b: _Jet) -> TaylorModel | None:
    return None if a.value is None or b.value is None else BINARY[name](a.value, b.value)


def _scale_slopes(factor: TaylorModel, slopes: Slopes) -> Slopes:
    return {j: factor * slope for j, slope in slopes.items()}


def _add_slopes(*parts: Slopes) -> Slopes:
    total: Slopes = {}
    for part in parts:
        for j, slope in part.items():
            total[j] = total[j] + slope if j in total else slope
    return total


class _Step(NamedTuple):
    """What is known about an entry of a tape before it is evaluated."""

    bounded: bool  #: whether its value has bounds
    moving: bool  #: whether it has derivatives
    constant: float | None = None


def _require_bounds(tape: Tape, what: str, values: bool) -> None:
    """Refuse operations whose derivative has no bounds or needs an unbounded value, and outputs without bounds."""
    unbounded = f"{what} uses the value of log, atan, asin, acos or atan2, which cannot be certified"

    # Propagate this knowledge along the tape.
    def step(name: str, of: Sequence[_Step]) -> _Step:
        if name not in _KNOWN:
            raise CertifyError(f"{what} uses the operation {name}, which cannot be certified")
        # Exponents must be integer constants of moderate size.
        exponent = of[1].constant if name in POWERS else 0.0
        if exponent is None or abs(exponent) > _LARGEST_POWER or exponent != round(exponent):
            raise CertifyError(
                f"{what} has an exponent that is not a small integer constant, so it cannot be certified"
            )
        if not all(operand.bounded for operand in _find_needed(name, of)):
            raise CertifyError(unbounded)
        bounded = (name in UNARY or name in BINARY or name in POWERS) and all(operand.bounded for operand in of)
        return _Step(bounded, any(operand.moving for operand in of))

    outputs = evaluate_tape(tape, lambda name, of: _Step(True, name == "input", of if name == "const" else None), step)
    if values and not all(output.bounded for output in outputs):
        raise CertifyError(unbounded)


def _find_needed(name: str, of: Sequence[_Step]) -> Sequence[_Step]:
    """The operands whose values the derivative needs."""
    if name in _LINEAR or name in _SUMS:
        return ()
    if name == "mul":
        return [one for one, other in (of, of[::-1]) if other.moving]
    if name == "div":
        return of if of[1].moving else of[1:]
    return of
