"""Parametrisations xi_theta(q): linear, polynomial, Fourier, MLP, closed forms, and your own."""

from typing import cast

from orthocas.bases.composed import Circle, Mobile
from orthocas.bases.cyclic import cyclic_joints
from orthocas.bases.family import (
    BasisFamily,
    ClosedForm,
    CombinableFamily,
    Cyclic,
    Family,
    JointSpace,
    LinearFamily,
    Parametrisation,
    component_gradients,
    parametrisation_from_data,
    parametrisation_names,
    parametrisation_to_data,
    parse_parametrisation,
    parse_suffix,
    register_parametrisation,
)
from orthocas.bases.given import SEW, Given, SEWKind
from orthocas.bases.mlp import ACTIVATIONS, MLP
from orthocas.bases.products import JOINTS, Fourier, Linear, Polynomial, ProductFamily
from orthocas.errors import InvalidValueError

__all__ = [
    "MLP",
    "SEW",
    "BasisFamily",
    "Circle",
    "ClosedForm",
    "CombinableFamily",
    "Family",
    "Fourier",
    "Given",
    "JointSpace",
    "Linear",
    "LinearFamily",
    "Mobile",
    "Parametrisation",
    "Polynomial",
    "ProductFamily",
    "component_gradients",
    "cyclic_joints",
    "parametrisation_from_data",
    "parametrisation_names",
    "parametrisation_to_data",
    "parse_parametrisation",
    "register_parametrisation",
]


def _parse_whole(text: str) -> int:
    try:
        return int(text)
    except ValueError:
        raise InvalidValueError(
            "parametrisation", repr(text), "whole numbers, as in polynomial:4 or mlp:64x64"
        ) from None


def _parse_products(text: str) -> tuple[int, Cyclic, int | None, tuple[str, ...]]:
    # The text is DEGREE, then joints=MOST, then the cyclic joints and those that are left out.
    degree, _, rest = text.partition(":")
    most = None
    if rest.startswith(f"{JOINTS}="):
        number, _, rest = rest.removeprefix(f"{JOINTS}=").partition(":")
        most = _parse_whole(number)
    cyclic, without = parse_suffix(rest, "after the degree 'joints=2'")
    return _parse_whole(degree), cyclic, most, without


def _parse_mlp(text: str) -> MLP:
    widths, _, rest = text.partition(":")
    raw, _, joints = rest.partition(":") if rest.partition(":")[0] == "raw" else ("", "", rest)
    activation, _, others = joints.partition(":")
    activation, joints = (activation, others) if activation in ACTIVATIONS else ("tanh", joints)
    cyclic, without = parse_suffix(joints, "after the widths 'raw', then 'isru'")
    return MLP(tuple(_parse_whole(width) for width in widths.split("x")), bool(raw), cyclic, without, activation)


def _parse_linear(text: str) -> Linear:
    if text:
        raise InvalidValueError("parametrisation", repr(f"linear:{text}"), "'linear' without a number")
    return Linear()


register_parametrisation("linear", Linear, _parse_linear)
register_parametrisation("polynomial", Polynomial, lambda text: Polynomial(*_parse_products(text)))
register_parametrisation("fourier", Fourier, lambda text: Fourier(*_parse_products(text)))
register_parametrisation("mlp", MLP, _parse_mlp)
register_parametrisation("sew", SEW, lambda text: SEW(cast(SEWKind, text or "stereographic")))
register_parametrisation("circle", Circle, lambda text: Circle(parse_parametrisation(text)))
register_parametrisation("mobile", Mobile, lambda text: Mobile(parse_parametrisation(text)))
register_parametrisation("given", Given)
