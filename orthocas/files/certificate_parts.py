"""The certificate in a chart file: a part of the header, and arrays whose names begin with certificate_."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from orthocas.certificates import Certificate, Subdivision
from orthocas.checks import require_count
from orthocas.errors import InvalidValueError
from orthocas.files.json import part
from orthocas.files.npy import Stored

_TREES = ("regular", "injective")
_CORNERS = ("low", "high", "codes")


def certificate_to_data(certificate: Certificate) -> tuple[dict[str, Any], dict[str, Stored]]:
    """A certificate as plain data and arrays."""
    arrays: dict[str, Stored] = {}
    for name in _TREES:
        tree: Subdivision | None = getattr(certificate, name)
        if tree is not None:
            arrays |= {f"certificate_{name}_{corner}": getattr(tree, corner) for corner in _CORNERS}
    header = {
        "fingerprint": certificate.fingerprint,
        "method": certificate.method,
        "bound": certificate.bound,
        "conditioning": certificate.conditioning,
        "fold": [list(point) for point in certificate.fold],
        "boxes": certificate.boxes,
        "seconds": certificate.seconds,
        **({"least_singular_value": certificate.least_singular_value} if certificate.least_singular_value else {}),
        **({"dead": certificate.dead} if certificate.dead else {}),
        **({"digest": certificate.digest} if certificate.digest else {}),
    }
    return header, arrays


def certificate_from_data(data: Mapping[str, Any], arrays: Mapping[str, Stored], n: int) -> Certificate:
    """The certificate of a chart of n joints.

    Raises:
        InvalidValueError: if something is missing or makes no sense. The message names it.
    """
    regular = _tree(arrays, "regular", n)
    injective = _tree(arrays, "injective", n) if "certificate_injective_codes" in arrays else None
    fold = part(data, "fold", list)
    if len(fold) not in (0, 2) or any(not isinstance(point, list) or len(point) != n for point in fold):
        raise InvalidValueError("fold of a certificate", repr(fold)[:80], f"no or two joint positions of {n} numbers")
    return Certificate(
        part(data, "fingerprint", str),
        part(data, "method", str),
        _number(data, "bound"),
        regular,
        _number(data, "conditioning"),
        injective,
        tuple(tuple(float(value) for value in point) for point in fold),
        require_count("boxes of a certificate", int(_number(data, "boxes")), least=0),
        _number(data, "seconds"),
        _number(data, "least_singular_value") if "least_singular_value" in data else 0.0,
        require_count("dead boxes of a certificate", int(_number(data, "dead")), least=0) if "dead" in data else 0,
        part(data, "digest", str) if "digest" in data else "",  # missing in older files
    )


def _tree(arrays: Mapping[str, Stored], name: str, n: int) -> Subdivision:
    low, high, codes = (part(arrays, f"certificate_{name}_{corner}", np.ndarray) for corner in _CORNERS)
    tree = Subdivision(low, high, codes)
    if tree.n != n:
        raise InvalidValueError(f"box of '{name}' in a certificate", f"one of {tree.n} joints", f"{n} joints")
    return tree


def _number(data: Mapping[str, Any], name: str) -> float:
    value = data.get(name)
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value < 1e300:
        raise InvalidValueError(f"field '{name}' of a certificate", repr(value)[:80], "a number that is not negative")
    return float(value)
