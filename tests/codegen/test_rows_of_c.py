"""phi of many rows in generated C equals that of Python, also where sines are left to the library of C."""

import ctypes
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from programs import needs_c
from public_objects import cyclic, fitted, given, network, with_idle_joint

import orthocas as oc
from orthocas.codegen import GeneratedC
from orthocas.codegen.library import NO_DOUBLE, STRICT, find_compilers
from orthocas.errors import InvalidValueError
from orthocas.tasks.samples import sample_uniform
from orthocas.tools.checks import Array

pytestmark = needs_c
OK, NOT_FINITE = 0, 3


def fourier() -> oc.Chart:
    robot = oc.Robot.planar([1.0, 1.0, 1.0], [1.0, 1.0, 1.0])
    problem = oc.Problem(robot, oc.Task.position(robot, "x"), domain=oc.Torus(3))
    return oc.fit(problem, oc.Fourier(2), samples=500, weights=oc.Weights(folds=0)).chart


def phi_rows(generated: GeneratedC, q: Array, *flags: str) -> tuple[Array, int]:
    """phi of rows, compiled without warnings, and the status."""
    kind = np.float32 if generated.single_precision else np.float64
    sources = [str(generated.folder / f"{generated.name}{end}.c") for end in ("", "_rows")]
    library = str(generated.folder / "rows.so")
    strict = (*STRICT, *(NO_DOUBLE if generated.single_precision else ()))
    subprocess.run(
        [find_compilers()[0], *strict, *flags, "-fPIC", "-shared", "-o", library, *sources, "-lm"], check=True
    )
    points, phi = np.ascontiguousarray(q, dtype=kind), np.empty(q.shape, dtype=kind)
    pointers = [ctypes.c_void_p(array.ctypes.data) for array in (points, phi)]
    status = getattr(ctypes.CDLL(library), f"{generated.name}_phi_rows")(ctypes.c_long(len(q)), *pointers)
    return phi.astype(float), int(status)


@pytest.mark.slow
@pytest.mark.parametrize("build", [fitted, with_idle_joint, given, cyclic, network, fourier])
def test_rows_are_those_of_python(build: Callable[[], object], tmp_path: Path) -> None:
    made = build()
    chart = made if isinstance(made, oc.Chart) else made.chart  # type: ignore[attr-defined]
    q = sample_uniform(chart.problem.domain, 203, 4)  # not a multiple of the rows side by side
    q[7] += 40.0
    generated = oc.generate_c(chart, tmp_path, name="arm", rows=True)
    found, status = phi_rows(generated, q, "-O1")
    want = chart.phi(q)
    largest = np.abs(want).max(axis=1, keepdims=True)  # far outside, polynomials are large
    assert status == OK
    np.testing.assert_allclose(found / largest, want / largest, atol=2e-13)


@pytest.mark.slow
def test_rows_without_numbers_or_far_away_are_treated_as_single_ones(tmp_path: Path) -> None:
    chart = fitted().chart
    q = sample_uniform(chart.problem.domain, 20, 4)
    q[3, 1], q[9, 0], q[17, 2] = np.nan, 3e5, np.inf
    found, status = phi_rows(oc.generate_c(chart, tmp_path, name="arm", rows=True), q, "-O3")
    assert status == NOT_FINITE
    assert not found[[3, 17]].any()
    good = np.setdiff1d(np.arange(20), [3, 17])
    np.testing.assert_allclose(found[good], chart.phi(q[good]), rtol=1e-12, atol=1e-13)


@pytest.mark.slow
def test_rows_in_single_precision(tmp_path: Path) -> None:
    chart = fitted().chart
    q = sample_uniform(chart.problem.domain, 50, 4)
    found, status = phi_rows(oc.generate_c(chart, tmp_path, name="arm", rows=True, single_precision=True), q, "-O2")
    assert status == OK
    np.testing.assert_allclose(found, chart.phi(q), atol=3e-5)


@pytest.mark.slow
def test_large_networks_are_refused(tmp_path: Path) -> None:
    problem = fitted().chart.problem
    chart = oc.fit(problem, oc.MLP((96, 96)), oc.solvers.LBFGS(max_iterations=1), samples=50).chart
    with pytest.raises(InvalidValueError, match="operations of phi"):
        oc.generate_c(chart, tmp_path / "rows", rows=True)
    assert not (tmp_path / "rows").exists()
