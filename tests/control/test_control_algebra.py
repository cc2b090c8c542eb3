"""Smooth matrix functions of control laws, and damping designs, against NumPy, SciPy and closed forms."""

import ctypes
import shutil
import subprocess
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from scipy.linalg import eigh, sqrtm

from orthocas.control.linear_algebra import DAMPING_DESIGNS, DampingDesign, apply_damping, invert_spd, multiply_by_root
from orthocas.native.kernels import generate_kernels
from orthocas.native.libraries import find_compilers
from orthocas.tools.checks import Array
from orthocas.tools.processes import run_program

RNG = np.random.default_rng(11)


def spd(size: int, condition: float) -> Array:
    """A random matrix with eigenvalues from 1 to the condition number."""
    Q = np.linalg.qr(RNG.normal(size=(size, size)))[0]
    values = np.exp(np.linspace(0, np.log(condition), size))
    return np.asarray(Q @ np.diag(values) @ Q.T)


def square_root(A: Any) -> Any:
    return multiply_by_root(A, type(A).eye(A.shape[0]))


def damping_matrix(design: DampingDesign, M: Any, K: Any, Z: Any) -> Any:
    return apply_damping(design, M, K, Z, type(M).eye(M.shape[0]))


def function_of(expression: object, symbol: ca.SX) -> ca.Function:
    return ca.Function("f", [symbol], [expression])


@pytest.mark.parametrize("size", [1, 2, 3, 4, 7])
@pytest.mark.parametrize("condition", [1.0, 1e3, 1e6])
def test_square_root_squares_to_the_matrix(size: int, condition: float) -> None:
    A = ca.SX.sym("A", size, size)
    root = function_of(square_root(A), A)
    for _ in range(20):
        given = spd(size, condition)
        found = root(given).full()
        np.testing.assert_allclose(found @ found, given, atol=1e-15 * condition**1.5 + 1e-14)
        np.testing.assert_allclose(found, sqrtm(given).real, atol=1e-11 * np.sqrt(condition))
        assert np.linalg.eigvalsh(found)[0] > 0


@pytest.mark.parametrize("scale", [1e-9, 1e9])
def test_square_root_does_not_depend_on_units(scale: float) -> None:
    A = ca.SX.sym("A", 3, 3)
    given = spd(3, 100.0)
    found = function_of(square_root(A), A)(given * scale).full()
    np.testing.assert_allclose(found, sqrtm(given).real * np.sqrt(scale), rtol=1e-12)


def test_square_root_is_differentiable_where_eigenvalues_meet() -> None:
    """At a multiple of the identity: d sqrt(A) = dA / (2 sqrt(a)); eigenvectors would jump there."""
    A = ca.SX.sym("A", 3, 3)
    direction = np.diag([1.0, 2.0, 3.0]) + 0.5
    slope = ca.Function("g", [A], [ca.reshape(ca.jtimes(square_root(A), A, ca.DM(direction)), 3, 3)])
    np.testing.assert_allclose(slope(4 * np.eye(3)).full(), direction / 4, atol=1e-12)


def test_inverse_and_determinant_agree_with_numpy() -> None:
    A = ca.SX.sym("A", 5, 5)
    inverse, determinant = ca.Function("f", [A], list(invert_spd(A)))(given := spd(5, 1e4))
    np.testing.assert_allclose(inverse.full() @ given, np.eye(5), atol=1e-10)
    assert float(determinant) == pytest.approx(np.linalg.det(given), rel=1e-10)


@pytest.mark.parametrize("size", [2, 11, 30])
def test_matrices_in_loops_are_those_written_out(size: int) -> None:
    """What graphs compute by sweeps, as for robots with many joints."""
    A = ca.MX.sym("A", size, size)
    inverse, determinant, root = ca.Function("f", [A], [*invert_spd(A), square_root(A)])(given := spd(size, 1e4))
    np.testing.assert_allclose(inverse.full() @ given, np.eye(size), atol=1e-10)
    assert float(determinant) == pytest.approx(np.linalg.det(given), rel=1e-10)
    np.testing.assert_allclose(root.full() @ root.full(), given, atol=1e-8)


def damping(design: str, inertia: Array, K: Array, Z: Array) -> Array:
    M = ca.SX.sym("M", *inertia.shape)
    return np.asarray(ca.Function("D", [M], [damping_matrix(design, M, ca.SX(K), ca.SX(Z))])(inertia).full())  # type: ignore[arg-type]


def test_square_root_design_is_equation_29() -> None:
    M, K, Z = spd(4, 50.0), np.array([1.0, 20.0, 5.0, 300.0]), np.array([0.5, 0.7, 1.0, 0.2])
    half = sqrtm(M).real @ np.diag(Z) @ np.diag(np.sqrt(K))
    np.testing.assert_allclose(damping("square_root", M, K, Z), half + half.T, rtol=1e-10)


@pytest.mark.parametrize("design", ["square_root", "double_diagonal"])
def test_diagonal_case_is_two_zeta_root_of_m_k(design: str) -> None:
    m, K, Z = np.array([2.0, 0.1, 30.0]), np.array([1.0, 20.0, 5.0]), np.array([0.5, 0.7, 1.0])
    np.testing.assert_allclose(damping(design, np.diag(m), K, Z), np.diag(2 * Z * np.sqrt(m * K)), atol=1e-12)


def test_double_diagonal_gives_every_mode_the_damping_ratio() -> None:
    """In the generalised eigenvectors of (K, M): W^T M W = I, W^T K W = diag(omega^2), W^T D W = diag(2 zeta omega)."""
    M, K = spd(5, 1e3), np.array([1.0, 20.0, 5.0, 300.0, 0.3])
    values, W = eigh(np.diag(K), M)
    D = damping("double_diagonal", M, K, np.full(5, 0.6))
    np.testing.assert_allclose(W.T @ D @ W, np.diag(2 * 0.6 * np.sqrt(values)), atol=1e-9 * np.sqrt(values[-1]))


def test_equation_29_can_be_indefinite_where_double_diagonal_is_not() -> None:
    """M with a large off-diagonal part and stiffnesses far apart: B Z S + S Z B of positive factors, yet negative."""
    M, K, Z = np.array([[1.0, 0.99], [0.99, 1.0]]), np.array([1.0, 1e4]), np.full(2, 0.7)
    least, largest = np.linalg.eigvalsh(damping("square_root", M, K, Z))
    assert least == pytest.approx(-16.5024, abs=1e-3)  # as in docs/explanation/derivations_control.md
    assert least / largest == pytest.approx(-0.1338, abs=1e-4)
    for ratios in (Z, np.array([0.1, 2.0]), np.array([0.0, 1.0])):
        assert np.linalg.eigvalsh(damping("double_diagonal", M, K, ratios))[0] > -1e-12


@pytest.mark.slow
def test_damping_generates_to_c_that_agrees(tmp_path: Path) -> None:
    """Compiled with warnings as errors, on 100 inertias; both designs share the square root."""
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler")
    M, K, Z = ca.SX.sym("M", 4, 4), ca.SX.sym("K", 4), ca.SX.sym("Z", 4)
    designs = [ca.densify(damping_matrix(design, M, K, Z)) for design in DAMPING_DESIGNS]
    function = ca.Function("damping", [M, K, Z], designs)
    generator = ca.CodeGenerator("damping.c")
    generator.add(function)
    generator.generate(f"{tmp_path}/")
    library = tmp_path / "damping.so"
    warnings = ["-Wall", "-Wextra", "-Werror", "-Wno-unused-parameter", "-Wno-unknown-pragmas"]
    command = [compiler, "-std=c99", "-O1", *warnings, "-fPIC", "-shared", "-o", str(library)]
    subprocess.run([*command, str(tmp_path / "damping.c"), "-lm"], check=True)
    compiled = ca.external("damping", str(library))
    for _ in range(100):
        given = (spd(4, 10.0 ** RNG.uniform(0, 5)), RNG.uniform(1, 1000, 4), RNG.uniform(0, 1, 4))
        for want, found in zip(function(*given), compiled(*given), strict=True):
            np.testing.assert_allclose(found.full(), want.full(), rtol=1e-12, atol=1e-10)


@pytest.mark.parametrize("size", [2, 3, 7, 12])
def test_roots_in_generated_c_stop_when_they_are_exact(tmp_path: Path, size: int) -> None:
    """On eigenvalues up to 1e6 apart, in any units, and no further in arrays than they are long."""
    A, V = ca.MX.sym("A", size, size), ca.MX.sym("V", size, 2)
    kernels = generate_kernels([ca.Function("root", [A, V], [multiply_by_root(A, V)])], "own")
    source, library = tmp_path / "root.c", tmp_path / "root.so"
    source.write_text(f"#include <math.h>\n{kernels.code.replace('static int own_root', 'int own_root')}\n")
    strict = ["-std=c99", "-O2", "-Warray-bounds", "-Werror"]
    run_program([find_compilers()[0], *strict, "-fPIC", "-shared", "-o", str(library), str(source), "-lm"])
    given_places, found_places, _, length = kernels.work["root"]
    run = ctypes.CDLL(str(library)).own_root
    for condition in (1.0, 1e2, 1e4, 1e6):
        for scale in (1e-9, 1.0, 1e9):
            given, columns, found = scale * spd(size, condition), RNG.normal(size=(2, size)), np.zeros((2, size))
            places = [array.ctypes.data for array in (given, columns, found)]
            arg, res = (
                (ctypes.c_void_p * (given_places + 4))(*places[:2]),
                (ctypes.c_void_p * (found_places + 4))(places[2]),
            )
            work = np.full(length + 64, 7.0)
            assert run(arg, res, (ctypes.c_int * 8)(), ctypes.c_void_p(work.ctypes.data), 0) == 0
            want = sqrtm(given).real @ columns.T
            np.testing.assert_allclose(
                found.T, want, atol=1e-14 * np.sqrt(condition) * np.sqrt(scale * condition) * size
            )
            assert (work[length:] == 7.0).all()
            assert not any((*arg[given_places:], *res[found_places:]))
