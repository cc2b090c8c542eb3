"""Calls of the public functions, classes and methods with arguments of wrong classes, shapes and sizes."""

import os
import warnings
from fractions import Fraction
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import casadi as ca
import numpy as np
from public_objects import (
    circle,
    fitted,
    impedance,
    planar,
    steps,
    trajectory,
)

import orthocas as oc
from fuzz.child import Finding, run, verdict
from fuzz.good_calls import good_calls
from fuzz.words import NAMES, NUMBERS, Rng, pick
from orthocas import problems, simulation, solvers


def calls(count: int) -> list[Finding]:
    """The campaign."""
    return run("calls", judge, range(count))


def judge(seed: int) -> str | None:
    """Call something with one or two arguments replaced, in an empty folder."""
    rng = np.random.default_rng(seed)
    table = good_calls()
    name = pick(rng, sorted(table))
    function, arguments = table[name]
    with TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # numbers that overflow
        os.chdir(folder)
        changed = dict(arguments)
        shown = []
        for _ in range(int(rng.integers(1, 3))):
            argument = pick(rng, sorted(arguments))
            changed[argument] = hostile(rng, arguments[argument])
            shown.append(f"{argument}={changed[argument]!r:.60}")
        found = verdict(partial(function, **changed))
        os.chdir("/")
    return None if found is None else f"{name}({', '.join(shown)}): {found}"


def hostile(rng: Rng, good: Any) -> Any:
    """A value that a careless user, or a careless program, may pass in place of a good one."""
    kind = rng.random()
    if kind < 0.25 and isinstance(good, np.ndarray | list | tuple):
        return _bent(rng, np.array(good, dtype=object))
    if kind < 0.35:
        return pick(rng, tuple(_objects().values()))
    if kind < 0.45:
        return pick(rng, (*NAMES, *NUMBERS, "x", "xyz", "position", "inertia", "phi", "decoupled"))
    return pick(rng, _values())


def _bent(rng: Rng, good: np.ndarray) -> Any:
    """A good array with a wrong entry, shape or size."""
    flat = good.ravel()
    bend = int(rng.integers(8))
    if bend == 0 and flat.size:
        flat[int(rng.integers(flat.size))] = pick(
            rng, (np.nan, np.inf, None, "x", 1j, 1e300, -1, ca.SX.sym("q"), [1], True)
        )
        return flat.reshape(good.shape).tolist()
    if bend == 1:
        return pick(rng, (tuple, set, iter, str, repr))(map(str, flat))
    shapes = (
        good[:-1] if good.ndim else good,
        np.append(flat, 0.0),
        good[None, None],
        good.T[::-1] if good.ndim else [good],
    )
    return pick(rng, (*shapes, good.tolist() * 2 if good.ndim else [], dict(enumerate(flat))))


class Like:
    """What NumPy turns into an array, as it does tensors of PyTorch, but neither an array nor a number itself."""

    def __init__(self, content: Any) -> None:
        self.content = content

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return np.array(self.content, dtype=dtype)


@cache
def _values() -> tuple[Any, ...]:
    numbers = (0, 1, 2, -1, 10**5, 10**9, 10**18, 10**400, 1.5, -0.0, 1e-320, 1e9, 1e300, np.nan, np.inf, -np.inf, 1j)
    numpies = (
        np.float32(1),
        np.int8(3),
        np.array(2.0),
        np.ones(1),
        np.ones((1, 1)),
        np.zeros(0),
        np.zeros(3),
        np.ones((3, 3)),
        np.zeros((2, 0)),
    )
    more = (
        np.full(3, np.nan),
        np.array(["1", "2", "3"]),
        np.array([None]),
        np.ma.array(np.ones(3), mask=[True, False, False]),
        np.ones((4, 3), dtype=complex),
        np.eye(3) > 0,
    )
    ones = ([0.5], (1.0,), [np.array(1.0)], np.ones(1), np.ones((1, 1)), ca.DM(0.5), Like(0.5), Like([0.1, 0.2, 0.3]))
    plain = (None, True, False, b"bytes", [], (), {}, set(), object(), type, len, print, range(3), Fraction(1, 3), ...)
    nested = (
        [[1], [1, 2]],
        [[[]]],
        [1, "a"],
        {"x": 1},
        {1: 2},
        {"x": None},
        [None],
        [[]],
        ["x"] * 3,
        [(0.1, {"x": 1})],
    )
    symbols = (ca.SX.sym("q", 3), ca.MX.sym("q", 3), ca.DM([1, 2, 3]), ca.SX(3, 3), ca.Function("f", [], []))
    functions = (
        lambda q: q,
        lambda q: None,
        lambda q: 1 / 0,
        lambda: 1,
        lambda q: q[7],
        lambda q: ca.if_else(q[0] > 0, 1, 2),
    )
    paths = (Path("nowhere/x"), Path("/dev/full"), Path("/proc/x"), Path("/dev/null/x"), Path(), Path(".."))
    return (*numbers, *numpies, *more, *ones, *plain, *nested, *symbols, *functions, *paths)


@cache
def _objects() -> dict[str, Any]:
    """Public objects, to be passed where others are wanted."""
    robot = planar().robot
    return {
        "chart": fitted().chart,
        "fit": fitted(),
        "grown": circle(),
        "problem": planar(),
        "robot": robot,
        "task": planar().task,
        "metric": planar().metric,
        "box": planar().domain,
        "torus": oc.Torus(3),
        "law": impedance(),
        "steps": steps(),
        "run": trajectory(),
        "polynomial": oc.Polynomial(2),
        "cyclic": oc.Polynomial(2, cyclic="auto"),
        "mlp": oc.MLP((3,)),
        "solver": solvers.GaussNewton(),
        "lbfgs": solvers.LBFGS(3),
        "class": oc.Chart,
        "module": oc,
        "sew": oc.SEW(),
        "other robot": problems.get("iiwa").robot,
        "weights": oc.Weights(),
        "push": simulation.Push(0.1, 0.1),
        "push at a link": simulation.Push(0.1, 0.1, [1.0, 0, 0], link="q3", point=[1.0, 0, 0]),
        "MuJoCo": simulation.MuJoCo(robot),
        "stops": simulation.Stops(),
    }
