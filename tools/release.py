"""The checklist of a release: `python tools/release.py --dry-run` looks and builds, but tags nothing.

Without `--dry-run`, a checklist without faults ends with a tag in this clone. Uploading is left to people. Needs the
extra `release`, and a package index for the fresh environment.
"""

import argparse
import re
import shlex
import subprocess
import sys
import tarfile
import tomllib
import venv
import zipfile
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

ROOT = Path(__file__).parent.parent
PROJECT: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
VERSION = re.findall(r'VERSION = "(.+)"', (ROOT / "orthocas" / "version.py").read_text())[0]
CONDA_NAMES = {"pin": "pinocchio", "matplotlib": "matplotlib-base"}

IN_WHEEL = (
    "orthocas/py.typed",
    "orthocas/problems/data/iiwa7_r800.urdf",
    "orthocas/viewer/page.js",
    "solvers/minimisers.py",
    "licenses/LICENSE",
)
NOT_IN_WHEEL = ("tests/", "docs/", "benchmarks/", "examples/", "tools/")
IN_SOURCES = ("LICENSE", "README.md", "CHANGELOG.md", "CITATION.cff", "SECURITY.md", "Makefile", "tests/conftest.py")
NOT_IN_SOURCES = ("/build/", "/out/", "__pycache__", ".venv")


def texts() -> Iterator[str]:
    """Faults of the texts: versions that differ, and a changelog without the version."""
    for name in ("CITATION.cff", "tools/recipe.yaml"):
        found = re.findall(r"^\s*version: ([\d.]+)$", (ROOT / name).read_text(), flags=re.MULTILINE)
        if found != [VERSION]:
            yield f"{name} has version {', '.join(found) or 'none'}, expected {VERSION}"
    if f"## [{VERSION}]" not in (ROOT / "CHANGELOG.md").read_text():
        yield f"CHANGELOG.md has no section [{VERSION}]; rename [Unreleased] and add the date"
    if not {"Source", "Documentation"} <= set(PROJECT.get("urls", {})):
        yield "pyproject.toml names no Source and Documentation in [project.urls]; add them once there are addresses"
    yield from dependencies()


def dependencies() -> Iterator[str]:
    """Differences between the dependencies of the conda recipe and those of pyproject.toml."""
    recipe = (ROOT / "tools" / "recipe.yaml").read_text().partition("  run:\n")[2].partition("\n\n")[0]
    listed = {line.split("#")[0].strip(" -") for line in recipe.splitlines()}
    wanted = {f"python {PROJECT['requires-python']}"}
    for text in PROJECT["dependencies"]:
        name, least = text.split(">=")
        wanted.add(f"{CONDA_NAMES.get(name, name)} >={least}")
    for text in sorted(wanted ^ listed):
        yield f"tools/recipe.yaml {'lacks' if text in wanted else 'has'} {text!r}, unlike pyproject.toml"


def recipe() -> Iterator[str]:
    """Render the conda recipe; differences of its name, version, licence and commands from those of pyproject.toml."""
    (variant,) = import_module("rattler_build").Stage0Recipe.from_file(ROOT / "tools" / "recipe.yaml").render()
    rendered = variant.recipe.to_dict()
    commands = [f"{name} = {target}" for name, target in PROJECT["scripts"].items()]
    for what, found, wanted in (
        ("name", rendered["package"]["name"], PROJECT["name"]),
        ("version", rendered["package"]["version"], VERSION),
        ("licence", rendered["about"]["license"], PROJECT["license"]),
        ("commands", rendered["build"]["python"]["entry_points"], commands),
    ):
        if found != wanted:
            yield f"tools/recipe.yaml has the {what} {found}, expected {wanted}"


def state_of_the_clone() -> Iterator[str]:
    """Faults of the clone: changes that are not committed, or a tag of this version."""
    if run("git", "status", "--porcelain"):
        yield "there are changes that are not committed"
    if run("git", "tag", "--list", f"v{VERSION}"):
        yield f"the tag v{VERSION} exists already"


def packages(dist: Path) -> Iterator[str]:
    """Build both distributions; faults of their metadata and contents."""
    run(sys.executable, "-m", "build", "--outdir", str(dist), str(ROOT))
    files = sorted(dist.iterdir())
    run(sys.executable, "-m", "twine", "check", "--strict", *map(str, files))
    (sources,), (wheel,) = dist.glob("*.tar.gz"), dist.glob("*.whl")
    with tarfile.open(sources) as archive:
        yield from contents(sources.name, archive.getnames(), IN_SOURCES, NOT_IN_SOURCES)
    with zipfile.ZipFile(wheel) as archive:
        yield from contents(wheel.name, archive.namelist(), IN_WHEEL, NOT_IN_WHEEL)
        metadata = archive.read(f"orthocas-{VERSION}.dist-info/METADATA").decode()
    for line in (f"Version: {VERSION}", f"License-Expression: {PROJECT['license']}"):
        if line not in metadata.splitlines():
            yield f"{wheel.name} lacks the line {line!r} in its metadata"


def contents(name: str, found: list[str], wanted: tuple[str, ...], unwanted: tuple[str, ...]) -> Iterator[str]:
    """What an archive lacks, and what it should not hold."""
    for ending in wanted:
        if not any(entry.endswith(ending) for entry in found):
            yield f"{name} lacks {ending}"
    for part in unwanted:
        if any(entry.startswith(part) or (part[0] == "/" and part in entry) for entry in found):
            yield f"{name} holds {part}"


def installed_sources(dist: Path, folder: Path, tests: str) -> Iterator[str]:
    """Install the source distribution in a fresh environment and run its own tests there; what fails."""
    (sources,) = dist.glob("*.tar.gz")
    with tarfile.open(sources) as archive:
        archive.extractall(folder, filter="data")
    venv.create(folder / "venv", with_pip=True)
    python = str(folder / "venv" / "bin" / "python")
    run(python, "-m", "pip", "install", "--quiet", f"{sources}[test]")
    words = (python, "-m", "pytest", "-q", "-n", "2", *shlex.split(tests))
    done = subprocess.run(words, cwd=folder / f"orthocas-{VERSION}", capture_output=True, text=True, check=False)
    print(done.stdout.strip().splitlines()[-1] if done.stdout.strip() else done.stderr)
    if done.returncode != 0:
        yield f"tests of the source distribution fail:\n{done.stdout[-3000:]}"


def run(*words: str) -> str:
    """Output of a command; raises if it fails."""
    return subprocess.run(words, cwd=ROOT, check=True, capture_output=True, text=True).stdout.strip()


def report(title: str, check: Callable[[], Iterator[str]]) -> int:
    """Run one check, print its faults, and return how many there are."""
    try:
        faults = list(check())
    except subprocess.CalledProcessError as error:
        faults = [f"{' '.join(error.cmd[:4])} fails:\n{error.stdout}{error.stderr}"]
    print(f"[{'x' if not faults else ' '}] {title}")
    for fault in faults:
        print(f"    - {fault}")
    return len(faults)


def main() -> int:
    """Run the checklist; the exit code is 1 if there are faults."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--dry-run", action="store_true", help="make no tag")
    parser.add_argument("--tests", default="-m 'not slow'", help="arguments of pytest for the source distribution")
    options = parser.parse_args()
    print(f"orthocas {VERSION}")
    with TemporaryDirectory() as name:
        folder = Path(name)
        dist = folder / "dist"
        faults = report("versions, changelog, links, recipe", texts)
        faults += report("the conda recipe renders, and agrees with pyproject.toml", recipe)
        faults += report("the clone is clean", state_of_the_clone)
        faults += report("source distribution and wheel: build, twine check, contents, licence", lambda: packages(dist))
        faults += report(
            "tests of the installed source distribution", lambda: installed_sources(dist, folder, options.tests)
        )
    if not options.dry_run and not faults:
        run("git", "tag", "--annotate", f"v{VERSION}", "--message", f"orthocas {VERSION}")
        print(f"tagged v{VERSION}; now: git push origin v{VERSION}; python -m build; python -m twine upload dist/*")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
