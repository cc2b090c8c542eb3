"""A million joint positions: time per row of phi, xi and the Jacobian of a chart, and of the modules it exports.

Rows of PyTorch and JAX appear where they are installed. Every figure is the best of three runs. `--quick` takes 1,000
rows.
"""

import importlib.util
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from types import ModuleType
from typing import Any

import numpy as np
from benchmark import run, table

import orthocas as oc
from orthocas import problems
from orthocas.tasks.samples import sample_uniform
from orthocas.tools.checks import Array

NAMES = ("xi", "phi", "jacobian")
RUNS = 3


def best(call: Callable[[], object]) -> float:
    """Seconds of the quickest of some runs, after one that builds what is built once."""
    seconds = []
    for _ in range(RUNS + 1):
        start = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - start)
    return min(seconds[1:])


def exported(chart: oc.Chart, library: str, folder: Path) -> ModuleType:
    """The module of a library."""
    path = oc.export(chart, library, folder / f"arm_{library}.py")
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def functions(chart: oc.Chart, points: Array, folder: Path) -> dict[str, dict[str, Callable[[], Any]]]:
    """Calls by implementation and function."""
    found: dict[str, dict[str, Callable[[], Any]]] = {
        "orthocas": {name: lambda name=name: getattr(chart, name)(points) for name in NAMES}
    }
    arm = exported(chart, "numpy", folder)
    for kind in (np.float64, np.float32):
        q = points.astype(kind)
        found[f"NumPy, {kind.__name__}"] = {name: lambda name=name, q=q: getattr(arm, name)(q) for name in NAMES}
    if importlib.util.find_spec("torch"):
        found |= of_torch(exported(chart, "torch", folder), points)
    if importlib.util.find_spec("jax"):
        found["JAX, jit, float64"] = of_jax(exported(chart, "jax", folder), points)
    return found


def of_torch(arm: ModuleType, points: Array) -> dict[str, dict[str, Callable[[], Any]]]:
    """PyTorch without gradients, in both precisions."""
    torch: Any = importlib.import_module("torch")
    found = {}
    for kind in ("float64", "float32"):
        q = torch.as_tensor(points, dtype=getattr(torch, kind))
        found[f"PyTorch, {kind}"] = {name: lambda name=name, q=q: getattr(arm, name)(q) for name in NAMES}
    return found


def of_jax(arm: ModuleType, points: Array) -> dict[str, Callable[[], Any]]:
    """JAX, compiled."""
    jax: Any = importlib.import_module("jax")
    jax.config.update("jax_enable_x64", True)
    q = jax.numpy.asarray(points)
    compiled = {name: jax.jit(getattr(arm, name)) for name in NAMES}
    return {name: lambda name=name: compiled[name](q).block_until_ready() for name in NAMES}


def main(quick: bool = False) -> list[str]:
    """Print a table row by row."""
    rows = 1_000 if quick else 1_000_000
    chart = oc.fit(problems.get("iiwa"), oc.Polynomial(4)).chart
    points = sample_uniform(chart.problem.domain, rows, 3)

    def row(name: str, calls: dict[str, Callable[[], Any]]) -> str:
        figures = (f"{best(calls[one]) / rows * 1e6:.2f}" if one in calls else "-" for one in NAMES)
        return f"| {name} | {' | '.join(figures)} |"

    with TemporaryDirectory() as folder:
        header = f"| {rows} rows, degree 4, [us a row] | xi | phi | Jacobian |\n| --- | --- | --- | --- |"
        return table(header, (row(*one) for one in functions(chart, points, Path(folder)).items()))


if __name__ == "__main__":
    run(main, __doc__)
