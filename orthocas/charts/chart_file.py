"""Chart files: write a chart, its problem and its certificate as a header and arrays, and read them back."""

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
_GUARDED = ("least_volume", "clear_share")  # fields of certificates whose domain is a RegularPart
FREE = "free postures only"  #: note of charts fitted without postures in collision; says where the pairs come from
CHART = Kind("chart", 1, ChartFileError)
KINDS = (RegularPart,)  #: kinds of domains in files besides those of `orthocas.tasks`; importing registers them
_PROBES = 8  # points of the domain at which a chart is evaluated after reading
_MODERATE = 1e50  # products of a few numbers below this do not overflow
_BOUNDED = (Polynomial, Fourier, Linear, MLP)  # parametrisations that are finite if their parameters are
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
        InvalidValueError: if a field is missing or invalid. The message names it.
    """
    # the subdivisions of both proofs, and a fold if there is one
    regular = _tree(arrays, "regular", n)
    injective = _tree(arrays, "injective", n) if "certificate_injective_codes" in arrays else None
    fold = get_part(data, "fold", list)
    if len(fold) not in (0, 2) or any(not isinstance(point, list) or len(point) != n for point in fold):
        raise InvalidValueError("fold of a certificate", repr(fold)[:80], f"0 or 2 joint positions of {n} numbers")
    # Older files lack some numbers; they get the defaults.
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
    # Older files also count boxes that were given up.
    if "dead" not in data:
        return known
    return known.remove_given_up(require_count("dead boxes of a certificate", int(_number(data, "dead")), least=0))


def _tree(arrays: Mapping[str, Stored], name: str, n: int) -> Subdivision:
    """The subdivision of one proof of a certificate, for n joints."""
    low, high, codes = (get_part(arrays, f"certificate_{name}_{corner}", np.ndarray) for corner in _CORNERS)
    tree = Subdivision(low, high, codes)
    if tree.n != n:
        raise InvalidValueError(f"box of '{name}' in a certificate", f"a box of {tree.n} joints", f"{n} joints")
    return tree


def _number(data: Mapping[str, Any], name: str) -> float:
    """A finite field >= 0 of a certificate; raises InvalidValueError for anything else."""
    value = data.get(name)
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value < 1e300:
        raise InvalidValueError(f"field '{name}' of a certificate", repr(value)[:80], "a finite number >= 0")
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
    """Write a chart file with a collision model, if there is one.

    Default of `collisions`: the model of the chart file from which the robot was loaded, or the robot's own model for
    charts that were fitted without postures in collision. `orthocas.tools.archive` describes the container.

    Raises:
        ChartFileError: if the file cannot be written, or would replace something other than a chart without `force`.
    """
    header, arrays = _content(problem, coordinates)
    header["notes"] = _checked_notes(notes)
    # The certificate is stored with a digest of the notes, so that edited notes are noticed.
    if certificate is not None:
        data, proof = certificate_to_data(certificate)
        header["certificate"], arrays = {**data, "notes": _digest_of(header["notes"])}, {**arrays, **proof}
    # solids that were read from a chart file, or that shaped the fit, go into the new file
    if collisions is None and (isinstance(problem.robot.solids, KnownSolids) or FREE in notes):
        collisions = problem.robot.collisions
    if collisions is not None:
        header["collisions"], solids = collisions_to_data(collisions)
        arrays = {**arrays, **solids}
    write_archive(path, CHART, header, arrays, force)


def fingerprint(problem: Problem, coordinates: CoordinateMap) -> str:
    """SHA-256 of all that defines the chart: robot, task, metric, domain and coordinates, without notes."""
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
    """Read a chart file: problem, coordinates, notes, and certificate if there is one.

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
        # the parts of the file must be consistent
        if coordinates.r != problem.r:
            raise ChartFileError(f"{path} has {coordinates.r} coordinates, expected r = {problem.r}")
        _require_finite(problem, coordinates)
        if "collisions" in header:
            solids = collisions_from_data(problem.robot.tree, get_part(header, "collisions", dict), arrays)
            problem.robot.solids = KnownSolids(solids)
        # a certificate of another chart is refused
        certificate = None
        if "certificate" in header:
            proof = get_part(header, "certificate", dict)
            certificate = certificate_from_data(proof, arrays, problem.n)
            certificate.require_for(fingerprint(problem, coordinates))
            # certificates in older files have no digest of the notes
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
    """SHA-256 of notes. A proof does not cover notes, but a certified chart shows them, so changes must be noticed."""
    return hashlib.sha256(json.dumps(notes, sort_keys=True).encode()).hexdigest()


def _checked_notes(notes: Notes) -> dict[str, str | float]:
    """A copy of notes whose values are texts or finite numbers.

    Raises:
        InvalidValueError: if a note has another value.
    """
    for name, value in notes.items():
        require_text("name of a note", name)
        if isinstance(value, float) and not np.isfinite(value):
            raise InvalidValueError(f"note '{name}'", value, "a finite number")
        if not isinstance(value, str | int | float):
            raise InvalidValueError(f"note '{name}'", repr(value)[:80], "text or a number")
    return dict(notes)


def _require_finite(problem: Problem, coordinates: CoordinateMap) -> None:
    """Check that a chart is finite at some point of its domain, after reading.

    Singular points, even at the centre, are no reason to refuse a chart.

    Raises:
        InvalidValueError: if the task, the coordinates or one of their Jacobians is finite at none of a few points.
    """
    q = sample_uniform(problem.domain, _PROBES, 0)
    values = {"the task": problem.task.batched(q)[0], "the Jacobian of the task": problem.task.batched_jacobian(q)[0]}
    # Grown coordinates may be NaN anywhere, so they are not checked. Fitted ones are finite if all their numbers are
    # moderate and their family is bounded; otherwise they are evaluated.
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
    """Check that idle joints are different indices of n joints; return them."""
    idle = tuple(require_count("idle joint", k, least=0) for k in joints)
    if len(set(idle)) != len(idle) or any(k >= n for k in idle):
        raise InvalidValueError("idle joints", str(idle)[:80], f"different indices below {n}")
    return idle
