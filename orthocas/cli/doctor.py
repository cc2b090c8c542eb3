"""`orthocas doctor`: what is installed, what is missing and for what, and whether it works."""

import json as json_text
import platform
import re
import shutil
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import import_module, metadata
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import typer

from orthocas.version import VERSION

# Nothing of orthocas that needs a library is imported before the libraries are known to be there.

EXTRAS = {
    "robots": "robots by name, such as panda",
    "xacro": "robots of xacro files",
    "view": "charts and motions in the browser",
    "mesh": "charts grown on closed surfaces of three joints",
    "mujoco": "MJCF files, and MuJoCo as plant of simulations",
    "jerk": "references within limits of jerk",
    "recordings": "joints in MCAP files of rosbag2",
    "learn": "environments of Gymnasium",
    "dask": "proofs and comparisons on many machines",
}  #: what is lost without each of the extras
PROGRAMS = {
    "cmake": "building generated C in projects",
    "ffmpeg": "animations as MP4",
}  #: what is lost without each program
#: modules of distributions that have other names
_MODULES = {"pin": "pinocchio", "scikit-image": "skimage", "pillow": "PIL", "libigl": "igl"}
_REQUIREMENT = re.compile(r"""([\w.-]+)(?:\[[^]]*\])?(?:>=([\w.]+))?[^;]*(?:;.*extra == ["']([\w-]+)["'].*)?""")
_FAULTY = 1  # exit code
_WIDTH = 80  # of lines


@dataclass(frozen=True, slots=True)
class Part:
    """A distribution that orthocas asks for, and what is there."""

    name: str
    extra: str  #: the extra that asks for it; empty for the core
    version: str  #: empty if it is missing
    fault: str  #: why it cannot be used; empty if it can


def doctor(
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object on standard output.")] = False,
) -> None:
    """Show what is installed, what is missing for what, and whether a first chart works. Exit code 1 if not."""
    parts = list(find_parts())
    core = {part.name: part.version for part in parts if not part.extra}
    faults = [part.fault for part in parts if part.fault and not part.extra]
    compilers = find_compiler_versions()
    checks = {} if faults else dict(run_checks(bool(compilers)))
    faults += [text for text in checks.values() if text.startswith("fails")]
    data = {
        "orthocas": VERSION,
        "folder": str(Path(__file__).parents[1]),
        "python": platform.python_version(),
        "platform": f"{platform.system()} {platform.machine()}",
        "core": core,
        "linear_algebra": [] if faults else find_linear_algebra(),
        "compilers": compilers,
        "extras": {extra: {part.fault for part in parts if part.extra == extra} == {""} for extra in EXTRAS},
        "programs": {name: shutil.which(name) is not None for name in PROGRAMS},
        "checks": checks,
        "faults": faults,
    }
    typer.echo(json_text.dumps(data, indent=2) if json else "\n".join(_format_lines(data)))
    if faults:
        raise typer.Exit(_FAULTY)


def find_parts() -> Iterator[Part]:
    """What orthocas asks for by its metadata, with what is there; nothing if it is only on the path."""
    try:
        requirements = metadata.requires("orthocas") or []
    except metadata.PackageNotFoundError:
        requirements = []
    for text in requirements:
        name, least, extra = _REQUIREMENT.fullmatch(text).groups(default="")  # type: ignore[union-attr]
        if extra and extra not in EXTRAS:
            continue
        version, fault = _find_version(name, load=not extra)
        if version and _leading_numbers(version) < _leading_numbers(least):
            fault = f"{name} is {version}, expected >= {least}"
        yield Part(name, extra, version, fault)


def _find_version(name: str, load: bool) -> tuple[str, str]:
    """The version of a distribution, empty if it is missing, and why it cannot be used."""
    module = _MODULES.get(name, name.replace("-", "_"))
    try:
        version = metadata.version(name)
    except metadata.PackageNotFoundError:
        # Conda's pinocchio and igl have no metadata of the names that they have on PyPI.
        if find_spec(module) is None:
            return "", f"{name} is missing: pip install {name}"
        version = str(getattr(import_module(module), "__version__", "of unknown version"))
    if load:
        try:
            import_module(module)
        except Exception as error:
            # Whatever stops it, such as a shared library that is not found: the user needs its words.
            return version, f"{name} {version} cannot be imported: {type(error).__name__}: {error}"
    return version, ""


def _leading_numbers(version: str) -> list[int]:
    """Up to three numbers of a version; one without numbers counts as new enough."""
    return [int(digits) for digits in re.findall(r"\d+", version.partition("+")[0])[:3]] or [sys.maxsize]


def find_compiler_versions() -> list[str]:
    """What the C compilers on the PATH say of themselves."""
    found = [path for name in ("gcc", "clang") if (path := shutil.which(name)) is not None]
    # Other systems call their compiler cc.
    found = found or [path for path in (shutil.which("cc"),) if path is not None]
    said = [subprocess.run([path, "--version"], capture_output=True, text=True, check=False).stdout for path in found]
    return [text.splitlines()[0].strip() for text in said if text]


def find_linear_algebra() -> list[str]:
    """The libraries of BLAS and OpenMP in this process, with their threads."""
    from threadpoolctl import threadpool_info  # after it is known to be there

    found = {(each["internal_api"], each["version"] or "", each["num_threads"]) for each in threadpool_info()}
    return [f"{f'{name} {version}'.strip()}, {threads} threads" for name, version, threads in sorted(found)]


def run_checks(compiler: bool) -> Iterator[tuple[str, str]]:
    """Fit and invert a chart of a planar arm, and compare its C with Python: what was done, or what failed."""
    import numpy as np  # this and the others after they are known to be there

    from orthocas import problems
    from orthocas.bases.products import Linear
    from orthocas.codegen.check import check_c
    from orthocas.codegen.generate import generate_c
    from orthocas.errors import OrthocasError
    from orthocas.fitting.fit import fit

    chart = fit(problems.get("planar_3r_xy"), Linear(), samples=100).chart
    q = chart.problem.domain.home
    error = float(np.abs(chart.inverse(chart.phi(q), q + 0.01) - q).max())
    yield "a chart", "fits and inverts" if error < 1e-9 else f"fails: the inverse is off by {error:.1e} rad"
    if compiler:
        with TemporaryDirectory() as folder:
            try:
                agreement = check_c(generate_c(chart, folder), chart)
            except OrthocasError as fault:
                yield "its C", f"fails: {fault}"
            else:
                yield "its C", f"agrees with Python at {agreement.states} states"


def _format_lines(data: dict[str, Any]) -> Iterator[str]:
    """The report for people: a name and a text on each line, long texts on several."""
    rows = [
        ("orthocas", f"{data['orthocas']} in {data['folder']}"),
        ("python", f"{data['python']}, {data['platform']}"),
        ("core", ", ".join(f"{name} {version or 'MISSING'}" for name, version in data["core"].items()) or "unknown"),
        ("linear algebra", "; ".join(data["linear_algebra"]) or "unknown"),
        ("C compiler", "; ".join(data["compilers"]) or "none: no compiled controllers, no orthocas codegen --check"),
    ]
    for name, purpose in EXTRAS.items():
        ready = data["extras"][name]
        rows.append((f"[{name}]", f"{purpose}: " + ("ready" if ready else f"pip install 'orthocas[{name}]'")))
    rows += [(name, f"{PROGRAMS[name]}: {'ready' if ready else 'missing'}") for name, ready in data["programs"].items()]
    rows += [(name, text) for name, text in data["checks"].items()]
    rows += [("FAULT", text) for text in data["faults"]]
    rows.append(("next", "mend the faults above" if data["faults"] else "orthocas demo, or orthocas fit ARM.urdf"))
    for name, text in rows:
        indent = " " * 16
        yield from textwrap.wrap(
            f"{name:<16}{text}", _WIDTH, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False
        )
