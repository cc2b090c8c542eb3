"""Chart files: a chart, its problem and its certificate as a header and arrays, and back."""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from orthocas.bases.cyclic import require_cyclic
from orthocas.bases.family import CyclicParametrisation, JointSpace, parametrisation_from_data, parametrisation_to_data
from orthocas.bases.mlp import MLP
from orthocas.bases.products import Fourier, Linear, Polynomial
from orthocas.charts.certificate import Certificate, Subdivision
from orthocas.charts.coordinates import CoordinateMap, Coordinates
from orthocas.charts.regular_part import RegularPart
from orthocas.errors import CertifyError, ChartFileError, InvalidValueError, OrthocasError
from orthocas.exact.flow import GrownCoordinates
from orthocas.exact.leaves import read_leaf
from orthocas.robots.collision_files import KnownSolids, collisions_from_data, collisions_to_data
from orthocas.robots.collisions import Collisions
from orthocas.tasks.problem import FOREIGN, Problem, read_problem, write_problem
from orthocas.tasks.samples import sample_uniform
from orthocas.tools.archive import Kind, Stored, read_archive, write_archive, write_npy
from orthocas.tools.checks import require_count, require_text
from orthocas.tools.json import get_part

_TREES = ("regular", "injective")
_CORNERS = ("low", "high", "codes")
_GUARDED = ("least_volume", "clear_share")  # in certificates of domains that keep folds out
FREE = "free postures only"  #: note of charts that were fitted without postures in collision: where pairs are from
CHART = Kind("chart", 1, ChartFileError)
KINDS = (RegularPart,)  #: of domains that files may have beside those of `orthocas.tasks`; the import registers them
_PROBES = 8  # points of the domain where a chart that is read is evaluated
_MODERATE = 1e50  # products of a few such numbers do not overflow
_BOUNDED = (Polynomial, Fourier, Linear, MLP)  # finite wherever their parameters are
_LEAF = "leaf_"  # prefix of the names of arrays that belong to a base leaf


def certificate_to_data(certificate: Certificate) -> tuple[dict[str, Any], dict[str, Stored]]:
    """A certificate as plain data and arrays."""
    arrays: dict[str, Stored] = {}
    for name in _TREES:
        tree: Subdivision | None = getattr(certificate, name)
        if tree is not None:
            arrays |= {f"certificate_{name}_{corner}": getattr(tree, corner) for corner in _CORNERS}
    names = ["fingerprint", "method", "bound", "conditioning", "fold", "boxes", "seconds"]
    names += ["least_singular_value"] if certificate.least_singular_value else []
    names += _GUARDED if certificate.least_volume else ()
    names += ["digest"] if certificate.digest else []
    header: dict[str, Any] = {name: getattr(certificate, name) for name in names}
    header["fold"] = [list(point) for point in certificate.fold]
    return header, arrays


def certificate_from_data(data: Mapping[str, Any], arrays: Mapping[str, Stored], n: int) -> Certificate:
    """The certificate of a chart of n joints.

    Raises:
        InvalidValueError: if something is missing or makes no sense. The message names it.
    """
    # the two trees of boxes, and a fold if there is one
    regular = _tree(arrays, "regular", n)
    injective = _tree(arrays, "injective", n) if "certificate_injective_codes" in arrays else None
    fold = get_part(data, "fold", list)
    if len(fold) not in (0, 2) or any(not isinstance(point, list) or len(point) != n for point in fold):
        raise InvalidValueError("fold of a certificate", repr(fold)[:80], f"no or two joint positions of {n} numbers")
    # numbers that came later are missing in older files
    known = Certificate(
        get_part(data, "fingerprint", str),
        get_part(data, "method", str),
        _number(data, "bound"),
        regular,
        _number(data, "conditioning"),
        injective,
        tuple(tuple(float(value) for value in point) for point in fold),
        require_count("boxes of a certificate", int(_number(data, "boxes")), least=0),
        _number(data, "seconds"),
        _number(data, "least_singular_value") if "least_singular_value" in data else 0.0,
        _number(data, "least_volume") if "least_volume" in data else 0.0,
        _number(data, "clear_share") if "clear_share" in data else 0.0,
        get_part(data, "digest", str) if "digest" in data else "",
    )
    # older files count boxes that were given up
    if "dead" not in data:
        return known
    return known.remove_given_up(require_count("dead boxes of a certificate", int(_number(data, "dead")), least=0))


def _tree(arrays: Mapping[str, Stored], name: str, n: int) -> Subdivision:
    low, high, codes = (get_part(arrays, f"certificate_{name}_{corner}", np.ndarray) for corner in _CORNERS)
    tree = Subdivision(low, high, codes)
    if tree.n != n:
        raise InvalidValueError(f"box of '{name}' in a certificate", f"one of {tree.n} joints", f"{n} joints")
    return tree


def _number(data: Mapping[str, Any], name: str) -> float:
    value = data.get(name)
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value < 1e300:
        raise InvalidValueError(f"field '{name}' of a certificate", repr(value)[:80], "a number that is not negative")
    return float(value)


Notes = Mapping[str, str | float]


def write_chart(
    path: str | Path,
    problem: Problem,
    coordinates: CoordinateMap,
    notes: Notes,
    certificate: Certificate | None = None,
    force: bool = False,
    collisions: Collisions | None = None,
) -> None:
    """Write a chart, with a collision model, or the one that the file had from which its robot came.

    `orthocas.tools.archive` describes the container.

    Raises:
        ChartFileError: if the file cannot be written, or would replace something other than a chart without `force`.
    """
    header, arrays = _content(problem, coordinates)
    header["notes"] = _checked_notes(notes)
    # the proof holds for these notes only
    if certificate is not None:
        data, proof = certificate_to_data(certificate)
        header["certificate"], arrays = {**data, "notes": _digest_of(header["notes"])}, {**arrays, **proof}
    # solids that came from a chart file go into the next one
    if collisions is None and (isinstance(problem.robot.solids, KnownSolids) or FREE in notes):
        collisions = problem.robot.collisions
    if collisions is not None:
        header["collisions"], solids = collisions_to_data(collisions)
        arrays = {**arrays, **solids}
    write_archive(path, CHART, header, arrays, force)


def fingerprint(problem: Problem, coordinates: CoordinateMap) -> str:
    """A digest of all that defines the chart: robot, task, metric, domain and coordinates, but no notes."""
    header, arrays = _content(problem, coordinates)
    digest = hashlib.sha256(json.dumps(header, sort_keys=True).encode())
    for name in sorted(arrays):
        digest.update(name.encode() + hashlib.sha256(write_npy(arrays[name])).digest())
    return digest.hexdigest()


def _content(problem: Problem, coordinates: CoordinateMap) -> tuple[dict[str, Any], dict[str, Stored]]:
    """Header and arrays of a chart, without notes."""
    header, arrays = write_problem(problem)
    description: dict[str, Any]
    if isinstance(coordinates, GrownCoordinates):
        description = {"leaf": coordinates.leaf.kind}
        numbers = {f"{_LEAF}{name}": array for name, array in coordinates.leaf.to_arrays().items()}
    else:
        assert isinstance(coordinates, Coordinates)
        description = {**parametrisation_to_data(coordinates.parametrisation), "idle": list(coordinates.idle)}
        numbers = {name: getattr(coordinates, name) for name in ("theta", "offset", "scale")}
    return {**header, "coordinates": description}, {**arrays, **numbers}


def read_chart(path: str | Path) -> tuple[Problem, CoordinateMap, Notes, Certificate | None]:
    """Read a chart back.

    Raises:
        ChartFileError: if the file is missing, truncated, edited, not a chart file, or from a newer version.
    """
    header, arrays = read_archive(path, CHART)
    try:
        problem = read_problem(header, arrays)
        # coordinates: grown from a leaf, or the parameters of a family
        data = get_part(header, "coordinates", dict)
        coordinates: CoordinateMap
        if "leaf" in data:
            own = {name.removeprefix(_LEAF): array for name, array in arrays.items() if name.startswith(_LEAF)}
            coordinates = GrownCoordinates(problem, read_leaf(problem, get_part(data, "leaf", str), own))
        else:
            parametrisation = parametrisation_from_data(data)
            coordinates = Coordinates(
                parametrisation,
                JointSpace.of(problem),
                _idle(get_part(data, "idle", list), problem.n),
                *(get_part(arrays, name, np.ndarray) for name in ("theta", "offset", "scale")),
            )
            if isinstance(parametrisation, CyclicParametrisation):
                require_cyclic(problem, parametrisation.cyclic)
        # what a file states must fit together
        if coordinates.r != problem.r:
            raise ChartFileError(f"{path} has {coordinates.r} coordinates, expected r = {problem.r}")
        _require_finite(problem, coordinates)
        if "collisions" in header:
            solids = collisions_from_data(problem.robot.tree, get_part(header, "collisions", dict), arrays)
            problem.robot.solids = KnownSolids(solids)
        # a proof of other coordinates is refused
        certificate = None
        if "certificate" in header:
            proof = get_part(header, "certificate", dict)
            certificate = certificate_from_data(proof, arrays, problem.n)
            certificate.require_for(fingerprint(problem, coordinates))
            # notes are missing in older files
            if "notes" in proof and proof["notes"] != _digest_of(header["notes"]):
                raise CertifyError("the notes have been changed since the file was written")
        return problem, coordinates, _checked_notes(get_part(header, "notes", dict)), certificate
    except ChartFileError:
        raise
    except OrthocasError as error:
        raise ChartFileError(f"{path} is inconsistent: {error}") from None
    except FOREIGN as error:
        raise ChartFileError(f"{path} is incomplete: {type(error).__name__} {error}") from None


def _digest_of(notes: Mapping[str, Any]) -> str:
    """SHA-256 of notes: they are no part of a proof, and a certified chart shows them beside it."""
    return hashlib.sha256(json.dumps(notes, sort_keys=True).encode()).hexdigest()


def _checked_notes(notes: Notes) -> dict[str, str | float]:
    """Notes of texts and finite numbers.

    Raises:
        InvalidValueError: for anything else.
    """
    for name, value in notes.items():
        require_text("name of a note", name)
        if isinstance(value, float) and not np.isfinite(value):
            raise InvalidValueError(f"note '{name}'", value, "a finite number")
        if not isinstance(value, str | int | float):
            raise InvalidValueError(f"note '{name}'", repr(value)[:80], "text or a number")
    return dict(notes)


def _require_finite(problem: Problem, coordinates: CoordinateMap) -> None:
    """Look once at what will be evaluated. Singular points, also at the centre, are no reason to refuse a chart.

    Raises:
        InvalidValueError: if task, coordinates or their Jacobians are finite at none of a few points of the domain.
    """
    q = sample_uniform(problem.domain, _PROBES, 0)
    values = {"the task": problem.task.batched(q)[0], "the Jacobian of the task": problem.task.batched_jacobian(q)[0]}
    # grown ones may be NaN; others are finite on their domain where all their numbers are moderate: a quick check
    if isinstance(coordinates, Coordinates):
        sizes = [np.abs(numbers) for numbers in (coordinates.theta, coordinates.offset, coordinates.scale)]
        widths = coordinates.space.half_width
        moderate = all((size < _MODERATE).all() for size in (*sizes, widths, 1 / widths))
        if not (moderate and isinstance(coordinates.parametrisation, _BOUNDED)):
            values |= {"xi": coordinates.xi(q), "the Jacobian of xi": coordinates.jacobian(q)}
    for what, numbers in values.items():
        if not np.isfinite(numbers.reshape(_PROBES, -1)).all(axis=1).any():
            raise InvalidValueError(what, f"not finite at any of {_PROBES} points of the domain", "finite numbers")


def _idle(joints: list[int], n: int) -> tuple[int, ...]:
    """The idle joints, checked against the number of joints."""
    idle = tuple(require_count("idle joint", k, least=0) for k in joints)
    if len(set(idle)) != len(idle) or any(k >= n for k in idle):
        raise InvalidValueError("idle joints", str(idle)[:80], f"different indices below {n}")
    return idle
