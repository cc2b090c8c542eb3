"""Parametrisations by name: short labels for the command line, plain data for chart files."""

from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import Any

from orthocas.checks import require_known
from orthocas.errors import InvalidValueError
from orthocas.parametrisations.family import Parametrisation
from orthocas.parametrisations.fourier import Fourier
from orthocas.parametrisations.given import Given
from orthocas.parametrisations.linear import Linear
from orthocas.parametrisations.mlp import MLP
from orthocas.parametrisations.polynomial import Polynomial
from orthocas.parametrisations.sew import SEW


def _whole(label: str, text: str) -> int:
    try:
        return int(text)
    except ValueError:
        raise InvalidValueError(
            "parametrisation", repr(label), "whole numbers, as in polynomial:4 or mlp:64x64"
        ) from None


def _linear(label: str, text: str) -> Linear:
    if text:
        raise InvalidValueError("parametrisation", repr(label), "'linear' without a number")
    return Linear()


PARAMETRISATIONS: dict[str, Callable[[str, str], Parametrisation | SEW]] = {
    "linear": _linear,
    "polynomial": lambda label, text: Polynomial(_whole(label, text)),
    "fourier": lambda label, text: Fourier(_whole(label, text)),
    "mlp": lambda label, text: MLP(tuple(_whole(label, width) for width in text.split("x"))),
    "sew": lambda label, text: SEW(text or "stereographic"),
}


_CLASSES: dict[str, type[Linear] | type[Polynomial] | type[Fourier] | type[MLP] | type[Given]] = {
    kind.__name__: kind for kind in (Linear, Polynomial, Fourier, MLP, Given)
}


def parametrisation_to_data(parametrisation: Parametrisation) -> dict[str, Any]:
    """Kind and settings as plain data.

    Raises:
        InvalidValueError: if it is not one of ours, so that it could not be read back.
    """
    if not isinstance(parametrisation, Linear | Polynomial | Fourier | MLP | Given):
        known = ", ".join(_CLASSES)
        raise InvalidValueError(
            "parametrisation", type(parametrisation).__name__, f"one that chart files know: {known}"
        )
    return {"parametrisation": type(parametrisation).__name__, "settings": asdict(parametrisation)}


def parametrisation_from_data(data: Mapping[str, Any]) -> Parametrisation:
    """Read `parametrisation_to_data` back.

    Raises:
        UnknownNameError: if there is no such parametrisation.
    """
    require_known("parametrisation", data["parametrisation"], _CLASSES)
    return _CLASSES[data["parametrisation"]](**data["settings"])


def parse_parametrisation(label: str) -> Parametrisation | SEW:
    """Read 'polynomial:4', 'fourier:2', 'mlp:64x64', 'linear' or 'sew:stereographic'.

    Raises:
        UnknownNameError: if there is no such parametrisation.
        InvalidValueError: if the part behind the colon does not fit.
    """
    name, _, text = label.partition(":")
    require_known("parametrisation", name, PARAMETRISATIONS)
    return PARAMETRISATIONS[name](label, text)
