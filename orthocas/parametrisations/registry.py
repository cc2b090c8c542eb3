"""Parametrisations by their short names, for the command line and chart files."""

from collections.abc import Callable

from orthocas.checks import require_known
from orthocas.errors import InvalidValueError
from orthocas.parametrisations.family import Parametrisation
from orthocas.parametrisations.fourier import Fourier
from orthocas.parametrisations.linear import Linear
from orthocas.parametrisations.mlp import MLP
from orthocas.parametrisations.polynomial import Polynomial


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


PARAMETRISATIONS: dict[str, Callable[[str, str], Parametrisation]] = {
    "linear": _linear,
    "polynomial": lambda label, text: Polynomial(_whole(label, text)),
    "fourier": lambda label, text: Fourier(_whole(label, text)),
    "mlp": lambda label, text: MLP(tuple(_whole(label, width) for width in text.split("x"))),
}


def parse_parametrisation(label: str) -> Parametrisation:
    """Read 'polynomial:4', 'fourier:2', 'mlp:64x64' or 'linear'.

    Raises:
        UnknownNameError: if there is no such parametrisation.
        InvalidValueError: if the part behind the colon does not fit.
    """
    name, _, text = label.partition(":")
    require_known("parametrisation", name, PARAMETRISATIONS)
    return PARAMETRISATIONS[name](label, text)
