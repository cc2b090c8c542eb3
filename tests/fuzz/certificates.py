"""Campaign of certificates: no chart file with one number changed passes `certify --check` and says another thing.

Containers are sealed again, so their checksums fit. What is left is what the certificate itself covers and proves.
"""

import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import casadi as ca
import numpy as np
import public_objects

import orthocas as oc
from fuzz.child import Finding, run, verdict
from fuzz.mutants import Rng, entries_of, npy, packed, pick, sealed
from orthocas.certificates import check_certificate
from orthocas.tools.archive import read_npy

_ARM = "planar_3r_xy"
Way = tuple[Any, ...]  #: keys and indices down to a number of a header


def _certified(chart: oc.Chart, bound: float = 0.0, **options: Any) -> oc.Chart:
    return replace(chart, certificate=oc.certify(chart, bound, **options))


def _bounded() -> oc.Chart:
    return _certified(oc.fit(public_objects.planar("euclidean"), oc.Polynomial(2), samples=200).chart, 0.2)


def _torus() -> oc.Chart:
    robot = oc.Robot.planar([1.0, 1.0], [1.0, 1.0])
    task = oc.Task.custom(robot, "wave", lambda q: q[0] + 0.3 * ca.sin(q[1]))
    xi = oc.Given.from_function("wave", 2, lambda q: q[1] + 0.3 * ca.sin(q[0]))
    return _certified(oc.fit(oc.Problem(robot, task, domain=oc.Torus(2)), xi).chart)


def _clear() -> oc.Chart:
    known = oc.problems.get(_ARM)
    problem = oc.Problem(known.robot, known.task, domain=oc.Box([0.6, 0.8, 0.8], 0.3), least_singular_value=0.2)
    return _certified(oc.fit(problem, oc.Polynomial(2), samples=200).chart, time_limit=5)


def _unfinished() -> oc.Chart:
    return _certified(oc.fit(public_objects.planar("euclidean"), oc.Polynomial(2), samples=200).chart, time_limit=0)


CHARTS: dict[str, Callable[[], oc.Chart]] = {
    "bound": _bounded,
    "torus": _torus,
    "clear box": _clear,
    "fold": lambda: _certified(oc.fit(public_objects.planar(), oc.Linear()).chart),
    "unfinished": _unfinished,
    "cyclic": lambda: _certified(oc.fit(oc.problems.get(_ARM), oc.Polynomial(2, "auto"), samples=200).chart),
}


def write_originals(folder: Path) -> None:
    """One chart file of each kind, with its certificate."""
    for name, build in CHARTS.items():
        chart = build()
        assert check_certificate(chart), name
        chart.save(folder / f"{name}.chart")


def certificates(count: int) -> list[Finding]:
    """Judge so many changes of one number each."""
    with TemporaryDirectory() as folder:
        write_originals(Path(folder))
        return run("certificates", partial(judge, Path(folder)), range(count))


def judge(originals: Path, seed: int) -> str | None:
    """What is wrong with the treatment of a mutant."""
    rng = np.random.default_rng(seed)
    original = pick(rng, sorted(originals.iterdir()))
    content, where = mutant(original, rng)

    def call() -> None:
        path = Path(folder) / "mutant"
        path.write_bytes(content)
        chart = oc.load(path)
        if check_certificate(chart):
            assert said(chart) == _said_by(original), f"{original.stem}: {where} is changed, and the check holds"

    with TemporaryDirectory() as folder:
        return verdict(call)


def said(chart: oc.Chart) -> str:
    """All that a chart and its certificate say, and what defines them."""
    assert chart.certificate is not None
    return f"{chart.facts()} {chart.certificate.facts()} {chart.certificate.as_dict()} {chart.certificate.fingerprint}"


@cache
def _said_by(path: Path) -> str:
    return said(oc.load(path))


def mutant(original: Path, rng: Rng) -> tuple[bytes, str]:
    """A chart file with one number changed, half of them in the header, and where."""
    entries = entries_of(original)
    header = json.loads(entries["header.json"])
    arrays = {name: content for name, content in entries.items() if name.endswith(".npy")}
    if rng.integers(2):
        own = rng.integers(2) == 0  # half of those are numbers of the certificate
        ways = list(_numbers(header["certificate"], ("certificate",)) if own else _numbers(header))
        way = pick(rng, ways)
        _set(header, way, rng)
        return packed(sealed(header, arrays)), "/".join(map(str, way))
    name = pick(rng, [name for name in arrays if read_npy(arrays[name]).size])
    array = read_npy(arrays[name]).copy()
    place = int(rng.integers(array.size))
    array.flat[place] = _other(rng, array.flat[place], array.dtype.kind)
    return packed(sealed(header, {**arrays, name: npy(array)})), f"{name}[{place}]"


def _numbers(data: Any, way: Way = ()) -> list[Way]:
    """The ways to all numbers in plain data."""
    if isinstance(data, dict):
        return [found for key in data for found in _numbers(data[key], (*way, key))]
    if isinstance(data, list):
        return [found for k, part in enumerate(data) for found in _numbers(part, (*way, k))]
    return [way] if isinstance(data, int | float) and not isinstance(data, bool) else []


def _set(header: Any, way: Way, rng: Rng) -> None:
    for key in way[:-1]:
        header = header[key]
    value = header[way[-1]]
    header[way[-1]] = _other(rng, value, "i" if isinstance(value, int) else "f")


def _other(rng: Rng, value: Any, kind: str) -> Any:
    """A number that differs, often by little."""
    if kind in "iub":
        choices = [int(value) + step for step in (1, -1, 2, 7)] + [0, 1, 254, 255]
        choices = [other for other in choices if other != value and (kind == "i" or 0 <= other < 256)]
        return pick(rng, choices)
    near = [float(np.nextafter(value, side)) for side in (-np.inf, np.inf)]
    choices = [*near, value * (1 + 1e-9), value + 1e-6, value * 0.9, value * 1.1, -value, 0.0, 1.0, value + 2 * np.pi]
    return pick(rng, [float(other) for other in choices if other != value and np.isfinite(other)])
