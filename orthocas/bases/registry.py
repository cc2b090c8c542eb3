"""The registry of parametrisations: labels for the command line, plain data for chart files. Add your own here."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields, is_dataclass
from typing import Any, cast

from orthocas.bases.circle import Circle
from orthocas.bases.cyclic import Cyclic, Mobile, parse_suffix
from orthocas.bases.family import Parametrisation
from orthocas.bases.given import SEW, Given, SEWKind
from orthocas.bases.mlp import ACTIVATIONS, MLP
from orthocas.bases.products import JOINTS, Fourier, Linear, Polynomial
from orthocas.errors import InvalidValueError, NotSavableWarning, warn_caller
from orthocas.tools.checks import require_kind, require_known


@dataclass(frozen=True)
class Registration:
    """A parametrisation that chart files and the command line support."""

    kind: type[Parametrisation]
    parse: Callable[[str], Parametrisation] | None  #: parses the text after 'name:' on the command line


_REGISTERED: dict[str, Registration] = {}


def register_parametrisation(
    name: str, kind: type[Parametrisation], parse: Callable[[str], Parametrisation] | None = None
) -> None:
    """Register a parametrisation, so that its charts can be saved and loaded, and the command line accepts it.

    A program that loads such a chart file must register the same name first.

    Args:
        name: unique name. Labels begin with it.
        kind: a dataclass that is built from its fields. They are plain data: numbers, text, or tuples of them.
        parse: converts the text after the colon in 'name:text' to a parametrisation. Without it, the command line does
            not accept the name.

    Raises:
        InvalidValueError: if the name belongs to another class, or the class is not a dataclass.

    Example:
        >>> from dataclasses import dataclass
        >>> import orthocas as oc
        >>> from orthocas import bases
        >>> @dataclass(frozen=True)
        ... class Cubic(oc.Polynomial):
        ...     degree: int = 3
        >>> oc.register_parametrisation("cubic", Cubic, parse=lambda text: Cubic())
        >>> bases.parse_parametrisation("cubic")
        Cubic(degree=3, cyclic=(), joints=None, without=())
    """
    require_kind("name", name, str)
    before = _REGISTERED.get(name)
    if before is not None and before.kind is not kind:
        raise InvalidValueError("name", repr(name), f"a name that {before.kind.__name__} does not use")
    if not isinstance(kind, type) or not is_dataclass(kind):
        raise InvalidValueError("kind", repr(kind), "a dataclass: chart files store its fields")
    _REGISTERED[name] = Registration(kind, parse)


def parametrisation_names() -> tuple[str, ...]:
    """Names that the command line accepts."""
    return tuple(name for name, each in _REGISTERED.items() if each.parse is not None)


def warn_unless_savable(parametrisation: Parametrisation) -> None:
    """Issue a NotSavableWarning, before a fit, if its chart cannot be saved."""
    try:
        parametrisation_to_data(parametrisation)
    except InvalidValueError as error:
        warn_caller(f"charts of this fit cannot be saved: {error}", NotSavableWarning)


def parametrisation_to_data(parametrisation: Parametrisation) -> dict[str, Any]:
    """Convert a parametrisation to plain data: kind and settings.

    A setting that came later may have the metadata {"stored": "if given"}: data leave it out while it is None or empty,
    so that charts of before keep their fingerprints.

    Raises:
        InvalidValueError: if it is not registered, or its settings are not plain data.
    """
    kind = type(parametrisation)
    if kind not in {each.kind for each in _REGISTERED.values()} or not is_dataclass(parametrisation):
        raise InvalidValueError(
            "parametrisation",
            kind.__name__,
            f"a registered one, so that it can be saved: orthocas.register_parametrisation('...', {kind.__name__})",
        )
    # Settings that are parametrisations become data themselves.
    parts = {part.name: getattr(parametrisation, part.name) for part in fields(parametrisation)}
    inner = {name: parametrisation_to_data(part) for name, part in parts.items() if isinstance(part, Parametrisation)}
    settings = {**asdict(parametrisation), **inner}
    for part in fields(parametrisation):
        if part.metadata.get("stored") == "if given" and parts[part.name] in (None, ()):
            del settings[part.name]
    try:
        json.dumps(settings)
    except (TypeError, ValueError) as error:
        raise InvalidValueError(f"settings of {kind.__name__}", f"not plain data ({error})", "plain data") from None
    return {"parametrisation": kind.__name__, "settings": settings}


def parametrisation_from_data(data: Mapping[str, Any]) -> Parametrisation:
    """Convert the result of `parametrisation_to_data` back.

    Raises:
        UnknownNameError: if no such parametrisation is registered.
    """
    require_kind("data of a parametrisation", data, Mapping)
    kinds = {each.kind.__name__: each.kind for each in _REGISTERED.values()}
    name: str = data.get("parametrisation", "")
    settings: Any = data.get("settings")
    require_known("parametrisation", name, kinds)
    kind = kinds[name]
    require_kind("settings", settings, dict)
    names = {field.name for field in fields(kind)}  # type: ignore[arg-type]
    # Settings that are parametrisations themselves.
    inner = {name: part for name, part in settings.items() if isinstance(part, dict) and "parametrisation" in part}
    settings = settings | {name: parametrisation_from_data(part) for name, part in inner.items()}
    if not settings.keys() <= names:
        raise InvalidValueError(f"settings of {kind.__name__}", sorted(settings), f"some of {sorted(names)}")
    return kind(**settings)


def parse_parametrisation(label: str) -> Parametrisation:
    """Parse a label: 'polynomial:4:joints=2', 'fourier:2:cyclic', 'mlp:64x64:raw', 'circle:mlp:32x32', 'linear', yours.

    Raises:
        UnknownNameError: if there is no such parametrisation.
        InvalidValueError: if the text after the colon is invalid.
    """
    require_kind("parametrisation", label, str)
    name, _, text = label.partition(":")
    require_known("parametrisation", name, parametrisation_names())
    parse = _REGISTERED[name].parse
    assert parse is not None
    return parse(text)


def _parse_whole(text: str) -> int:
    try:
        return int(text)
    except ValueError:
        raise InvalidValueError(
            "parametrisation", repr(text), "whole numbers, as in polynomial:4 or mlp:64x64"
        ) from None


def _parse_products(text: str) -> tuple[int, Cyclic, int | None, tuple[str, ...]]:
    # DEGREE, then joints=MOST, then joints and what is left out.
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
