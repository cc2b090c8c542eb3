"""Campaign of chart files: what is loaded can be evaluated, or the error names the file."""

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
from fuzz.child import Finding, run
from fuzz.mutants import Rng, entries_of, npy, packed, pick, sealed
from fuzz.sealed_files import bomb, judged, mutant
from orthocas.charts.chart import GrownChart
from orthocas.errors import OrthocasError
from orthocas.paths import corridor_problem
from orthocas.tasks.samples import sample_uniform


def _torus() -> oc.Chart:
    robot = oc.Robot.planar([1.0, 0.8], [1.0, 1.0])
    return oc.fit(oc.Problem(robot, oc.Task.position(robot, "x"), domain=oc.Torus(2)), oc.Fourier(2), samples=100).chart


def _custom(spec: Any, task: Callable[[oc.Robot], oc.Task]) -> oc.Chart:
    robot = oc.Robot.planar([1.0, 0.9, 0.8], [3.0, 2.0, 1.0])
    problem = oc.Problem(robot, task(robot), spec, oc.Box([0.6, 0.8, 0.8], 0.3), "mine")
    return oc.fit(problem, oc.Polynomial(2), samples=60).chart


def _iiwa() -> oc.Chart:
    arm = oc.problems.get("iiwa")
    task = oc.Task.named(arm.robot, "position+axis:z")
    return oc.fit(oc.Problem(arm.robot, task, domain=arm.domain), oc.Polynomial(1), samples=100).chart


def _corridor() -> oc.Chart:
    path = np.linspace([0.0, 0.6, 0.8], [0.8, 1.4, 0.8], 9)
    problem = corridor_problem(oc.problems.get("planar_3r_xy"), path)
    return oc.fit(problem, oc.Polynomial(2), samples=100).chart


CHARTS: dict[str, Callable[[], oc.Chart]] = {
    **public_objects.CHARTS,
    "torus": _torus,
    "custom metric": lambda: _custom(lambda q: ca.diag(2 + ca.cos(q)), lambda r: oc.Task.position(r, "xy")),
    "constant metric": lambda: _custom(np.diag([1.0, 2.0, 3.0]), oc.Task.polar),
    "custom task": lambda: _custom(
        "inertia",
        lambda r: oc.Task.custom(
            r, "mine", lambda q: ca.vertcat(ca.atan2(q[0], 1 + q[1] ** 2), ca.if_else(q[2] > 0, q[2], 0) + q[0])
        ),
    ),
    "real robot": _iiwa,
    "corridor": _corridor,
    "certified": lambda: replace(public_objects.fitted().chart, certificate=public_objects.certificate()),
}


def write_originals(folder: Path) -> None:
    """One chart file of each kind."""
    for k, build in enumerate(CHARTS.values()):
        build().save(folder / f"{k}.chart")


def charts(count: int) -> list[Finding]:
    """Judge so many mutants."""
    with TemporaryDirectory() as folder:
        write_originals(Path(folder))
        return run("charts", partial(judge, Path(folder)), range(count))


def judge(originals: Path, seed: int) -> str | None:
    """What is wrong with the treatment of a mutant."""
    return judged(partial(_mutant, originals), use, seed)


def use(path: Path) -> None:
    """Load a chart and evaluate all it is made for."""
    chart = oc.load(path)
    assert chart.n == chart.m + chart.r
    assert len(f"{chart!r} {chart.facts()}") < 10**5
    try:
        _evaluate(chart)
    except OrthocasError as error:  # no file is to blame
        raise OrthocasError(f"mutant: {error}") from None


def _evaluate(chart: oc.Chart) -> None:
    q = np.vstack([chart.problem.domain.centre, sample_uniform(chart.problem.domain, 8, 0)])
    phi, J = chart.phi(q[0]), chart.jacobian(q[0])
    assert phi.shape == (chart.n,)
    assert J.shape == (chart.n, chart.n)
    if isinstance(chart, GrownChart):  # NaN where the flow does not reach the leaf
        return
    if not (np.isfinite(phi).all() and np.isfinite(J).all()):  # a singular point?
        assert np.isfinite(chart.phi(q)).all(axis=1).any(), "phi is not finite"
        assert np.isfinite(chart.coordinates.jacobian(q)).all(axis=(1, 2)).any(), "the Jacobian is not finite"


def _mutant(originals: Path, rng: Rng) -> bytes:
    original = pick(rng, _files(originals))
    act = rng.integers(100)
    if act == 0:
        return bomb(original, bool(rng.integers(2)), int(pick(rng, (2**22, 2**28))))
    return _of_many_joints(original, rng) if act < 3 else mutant(original, rng)


@cache
def _files(folder: Path) -> list[Path]:
    return sorted(folder.iterdir(), key=lambda path: int(path.stem))


def _of_many_joints(original: Path, rng: Rng) -> bytes:
    """A chart whose robot has many more joints, or whose settings are enormous."""
    entries = entries_of(original)
    header = json.loads(entries["header.json"])
    arrays = {name: content for name, content in entries.items() if name.endswith(".npy")}
    if "settings" in header["coordinates"] and rng.integers(2):
        huge = pick(rng, (50, 10**4, 10**9, 10**300, -1, 2**31, 2**63))
        header["coordinates"]["settings"] = pick(
            rng, ({"degree": huge}, {"hidden": [huge, huge]}, {"hidden": [2] * 10**5})
        )
        header["coordinates"]["parametrisation"] = pick(rng, ("Polynomial", "Fourier", "MLP", "Circle", "Mobile"))
        return packed(sealed(header, arrays))
    n = int(pick(rng, (20, 150, 1000, 10**5)))
    robot = oc.Robot.planar([1.0] * min(n, 150), [1.0] * min(n, 150)).tree
    header["robot"] |= {"joint_names": [f"j{k}" for k in range(n)], "joint_kinds": ["revolute"] * n}
    header["robot"] |= {"parents": list(range(-1, n - 1)), "tip_parent": n - 1}
    for name in [name for name in arrays if name.startswith("robot_")]:
        value = np.asarray(getattr(robot, name[len("robot_") : -len(".npy")]))
        if value.shape[:1] == (robot.n,):
            value = np.concatenate([value, np.repeat(value[-1:], n - robot.n, axis=0)])
        arrays[name] = npy(value)
    arrays |= {"domain_centre.npy": npy(np.full(n, 0.1)), "domain_half_width.npy": npy(np.full(n, 0.2))}
    if "parametrisation" in header["coordinates"]:
        r = n - len(np.atleast_1d(header["problem"]["task"].get("labels", [0])))
        header["coordinates"] = {"parametrisation": "Polynomial", "settings": {"degree": 1}, "idle": []}
        ones = {
            "theta.npy": npy(np.ones(min(n, 200) * r)),
            "offset.npy": npy(np.zeros(r)),
            "scale.npy": npy(np.ones(r)),
        }
        arrays |= ones
    return packed(sealed(header, arrays))
