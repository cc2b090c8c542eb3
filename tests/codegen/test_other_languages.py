"""The call from Julia on docs/how-to/c_code.md: its types, through ctypes, and Julia itself where it is installed."""

import ctypes
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from pages import blocks
from programs import needs_c, output_of

import orthocas as oc

TYPES = {"Cint": ctypes.c_int, "Ptr{Cdouble}": ctypes.POINTER(ctypes.c_double)}
CALL = re.compile(r'ccall\(\(:(\w+), "\./(\w+\.so)"\), (\w+), \(([^)]+)\), q, phi, rows\)')


@pytest.fixture(scope="module")
def compiled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the library that the page's own line compiles."""
    folder = tmp_path_factory.mktemp("library")
    oc.generate_c(oc.load("panda-position"), folder / "generated", name="arm")
    page = (Path(__file__).parents[2] / "docs" / "how-to" / "c_code.md").read_text()
    (line,) = re.findall(r"^    (gcc -O3 -shared .*)$", page, flags=re.MULTILINE)
    output_of(*line.replace("-O3", "-O1").split(), folder=folder)
    return folder


@pytest.mark.slow
@needs_c
def test_call_of_the_page_gives_the_chart_through_ctypes(compiled: Path) -> None:
    (code,) = blocks("julia", "how-to/c_code.md")
    function, library, result, arguments = CALL.findall(code)[0]
    chart = oc.load("panda-position")
    arm_chart = ctypes.CDLL(str(compiled / library))[function]
    arm_chart.restype, arm_chart.argtypes = TYPES[result], [TYPES[name] for name in arguments.split(", ")]
    q, phi, rows = chart.domain.centre + 0.05, np.zeros(7), np.zeros((7, 7))
    status = arm_chart(*(array.ctypes.data_as(TYPES["Ptr{Cdouble}"]) for array in (q, phi, rows)))
    assert status == 0
    np.testing.assert_allclose(phi, chart.phi(q), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(rows, chart.jacobian(q), rtol=1e-10, atol=1e-10)


@pytest.mark.nightly
@pytest.mark.slow
@needs_c
@pytest.mark.skipif(shutil.which("julia") is None, reason="no Julia")
def test_julia_calls_the_library(compiled: Path) -> None:
    (code,) = blocks("julia", "how-to/c_code.md")
    chart = oc.load("panda-position")
    q = chart.domain.centre + 0.05
    filled = code.replace("status =", f"q .= {q.tolist()}\nstatus =") + "foreach(println, [phi; vec(J); status])\n"
    (compiled / "call.jl").write_text(filled)
    *numbers, status = map(float, output_of("julia", "call.jl", folder=compiled).split())
    assert status == 0
    np.testing.assert_allclose(numbers[:7], chart.phi(q), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(np.reshape(numbers[7:], (7, 7), order="F"), chart.jacobian(q), rtol=1e-10, atol=1e-10)
