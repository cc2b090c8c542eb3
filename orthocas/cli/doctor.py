"""`orthocas doctor`: lists installed and missing packages, with their uses, and checks that orthocas works."""

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

# Modules of orthocas that need a library are imported only after that library is found.

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
}  #: extra -> what needs it
PROGRAMS = {
    "cmake": "building generated C in projects",
    "ffmpeg": "animations as MP4",
}  #: program -> what needs it
#: module names that differ from the name of the distribution
_MODULES = {"pin": "pinocchio", "scikit-image": "skimage", "pillow": "PIL", "libigl": "igl"}
_REQUIREMENT = re.compile(r"""([\w.-]+)(?:\[[^]]*\])?(?:>=([\w.]+))?[^;]*(?:;.*extra == ["']([\w-]+)["'].*)?""")
# Exit code.
_FAULTY = 1
# Width of lines.
_WIDTH = 80


@dataclass(frozen=True, slots=True)
class Part:
    """A distribution that orthocas uses, and its state."""

    name: str
    extra: str  #: the extra that requires it; empty for the core
    version: str  #: empty if it is missing
    fault: str  #: why it cannot be used; empty if it can be used


def doctor(
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object on standard output.")] = False,
) -> None:
    """Show installed and missing packages and their uses, and test a first chart. Exit code 1 on failure."""
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
    """The distributions that the metadata of orthocas requires; nothing if orthocas is only on the path."""
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
    """Version of a distribution (empty if missing), and why it cannot be used (empty if it can)."""
    module = _MODULES.get(name, name.replace("-", "_"))
    try:
        version = metadata.version(name)
    except metadata.PackageNotFoundError:
        # Conda's pinocchio and igl have no metadata under their PyPI names.
        if find_spec(module) is None:
            return "", f"{name} is missing: pip install {name}"
        version = str(getattr(import_module(module), "__version__", "of unknown version"))
    if load:
        try:
            import_module(module)
        except Exception as error:
            # Report any error, such as a missing shared library, in its own words.
            return version, f"{name} {version} cannot be imported: {type(error).__name__}: {error}"
    return version, ""


def _leading_numbers(version: str) -> list[int]:
    """Up to three numbers of a version; a version without numbers counts as new enough."""
    return [int(digits) for digits in re.findall(r"\d+", version.partition("+")[0])[:3]] or [sys.maxsize]


def find_compiler_versions() -> list[str]:
    """First lines of --version of the C compilers on the PATH."""
    found = [path for name in ("gcc", "clang") if (path := shutil.which(name)) is not None]
    # On other systems the compiler is called cc.
    found = found or [path for path in (shutil.which("cc"),) if path is not None]
    said = [subprocess.run([path, "--version"], capture_output=True, text=True, check=False).stdout for path in found]
    return [text.splitlines()[0].strip() for text in said if text]


def find_linear_algebra() -> list[str]:
    """The libraries of BLAS and OpenMP in this process, with their threads."""
    # Imported only after it is found.
    from threadpoolctl import threadpool_info

    found = {(each["internal_api"], each["version"] or "", each["num_threads"]) for each in threadpool_info()}
    return [f"{f'{name} {version}'.strip()}, {threads} threads" for name, version, threads in sorted(found)]


def run_checks(compiler: bool) -> Iterator[tuple[str, str]]:
    """Fit and invert a chart of a planar arm, and compare its C with Python; yields results or errors."""
    # These modules are imported only after they are found.
    import numpy as np

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
    """The report as text: a name and a value per line, with long values on several lines."""
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
