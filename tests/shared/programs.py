"""Programs that tests start, and which of them a machine has."""

import io
import shutil
import subprocess
import sys
from collections.abc import Callable
from contextlib import chdir, redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from orthocas.codegen import GeneratedC
from orthocas.native.libraries import find_compilers
from orthocas.tasks.corridor import Corridor

PROGRAMS = Path(__file__).parents[1] / "c"

Run = Callable[..., tuple[int, str, str]]  #: words of a command line to exit code, standard output, standard error

needs_c = pytest.mark.skipif(shutil.which("cc") is None and shutil.which("gcc") is None, reason="no C compiler")
needs_cmake = pytest.mark.skipif(shutil.which("cmake") is None, reason="no cmake")


def nightly(*values: Any) -> list[Any]:
    """Values of a parametrised test that only `make nightly` takes: other numbers on the same path."""
    return [
        pytest.param(*(value if isinstance(value, tuple) else (value,)), marks=pytest.mark.nightly) for value in values
    ]


def output_of(*words: str | Path, folder: Path | None = None) -> str:
    """What a program prints; it has to end well."""
    done = subprocess.run([str(word) for word in words], cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{words}: exit code {done.returncode}\n{done.stdout}{done.stderr}"
    return done.stdout


def python(code: str, folder: Path | None = None, *options: str) -> str:
    """What a new Python prints for some code."""
    return output_of(sys.executable, *options, "-c", code, folder=folder)


def printed_here(code: str, folder: Path) -> str:
    """What some code prints in this process, which knows the package already; not for code that registers things."""
    out = io.StringIO()
    with chdir(folder), redirect_stdout(out):
        exec(compile(code, "page", "exec"), {"__name__": "page"})
    return out.getvalue()


def path_flags(corridor: Corridor) -> tuple[str, str]:
    """What random_ticks.c is told about a corridor."""
    radius = ("INFINITY" if np.isinf(size) else repr(float(size)) for size in corridor.radius)
    return f"-DPATH={','.join(map(repr, corridor.postures.ravel().tolist()))}", f"-DRADIUS={','.join(radius)}"


def built(generated: GeneratedC, program: str, out: Path, *flags: str, compiler: str | None = None) -> Path:
    """A program of tests/c with the generated code."""
    target = out / Path(program).stem
    sources = [str(PROGRAMS / program), str(generated.folder / "arm.c")]
    command = [
        compiler or find_compilers()[0],
        "-std=c99",
        "-O1",
        "-g1",
        *flags,
        f"-I{generated.folder}",
        *sources,
        "-o",
        str(target),
    ]
    done = subprocess.run([*command, "-lm", "-pthread"], capture_output=True, text=True, check=False)
    if done.returncode != 0 and "cannot find" in done.stderr:
        pytest.skip("no sanitizer libraries")
    assert done.returncode == 0, done.stderr
    return target
