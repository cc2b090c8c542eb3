"""The house keeps its shape: imports point one way, public names exist, packages are listed, nothing prints."""

import ast
import importlib
import re
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
SOURCES = {
    path: module
    for folder, package in (
        ("orthocas", "orthocas"),
        ("problems", "orthocas.problems"),
        ("solvers", "orthocas.solvers"),
    )
    for path in sorted((ROOT / folder).rglob("*.py"))
    for module in [".".join([package, *path.relative_to(ROOT / folder).with_suffix("").parts])]
}
TOP = (  # may see problems and solvers
    "orthocas.__init__",
    "orthocas.__main__",
    "orthocas.api",
    "orthocas.cli",
    "orthocas.reproduce",
)


def imports_of(path: Path) -> set[str]:
    """Modules of this package that a file imports."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            found |= {node.module or ""} | {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
    return {name for name in found if name.split(".")[0] == "orthocas"}


def test_there_are_sources_to_check() -> None:
    assert len(SOURCES) > 40
    assert {"orthocas.problems.iiwa", "orthocas.solvers.gauss_newton", "orthocas.loss"} <= set(SOURCES.values())


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: str(p.relative_to(ROOT)))
def test_imports_point_one_way(path: Path) -> None:
    module, imported = SOURCES[path], imports_of(path)
    is_top = module.startswith(TOP)
    outer = {name for name in imported if name.startswith(("orthocas.problems", "orthocas.solvers"))}
    if module.startswith("orthocas.problems"):
        assert not {name for name in outer if name.startswith("orthocas.solvers")}
    elif module.startswith("orthocas.solvers"):
        assert not {name for name in outer if name.startswith("orthocas.problems")}
    elif not is_top:
        assert not outer, f"{module} is core and imports {outer}"
    if not is_top:
        assert not {name for name in imported if name.startswith(("orthocas.cli", "orthocas.api"))}
        assert "orthocas" not in imported, f"{module} imports the facade"


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: str(p.relative_to(ROOT)))
def test_imports_stand_at_the_top_of_the_file(path: Path) -> None:
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            inner = [n for n in ast.walk(node) if isinstance(n, ast.Import | ast.ImportFrom)]
            assert not inner, f"{path}: import inside {node.name}"


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: str(p.relative_to(ROOT)))
def test_functions_are_short(path: Path) -> None:
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.FunctionDef):
            body = node.body[1:] if ast.get_docstring(node) else node.body
            lines = body[-1].end_lineno - body[0].lineno + 1 if body else 0
            assert lines <= 40, f"{path}: {node.name} has {lines} lines"


def test_public_names_exist() -> None:
    packages = {m.removesuffix(".__init__") for m in SOURCES.values() if m.endswith(".__init__")}
    assert len(packages) >= 5
    for package in packages:
        module = importlib.import_module(package)
        assert module.__all__, package
        for name in module.__all__:
            assert hasattr(module, name), f"{package}.{name}"


def test_every_package_is_installed() -> None:
    listed = set(tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"])
    assert listed == {m.removesuffix(".__init__") for m in SOURCES.values() if m.endswith(".__init__")}


def test_references_used_in_docstrings_are_listed() -> None:
    listed = (ROOT / "docs" / "references.md").read_text()
    used = {word for path in SOURCES for word in re.findall(r"\[([A-Z][A-Za-z]*\d{4})\]", path.read_text())}
    assert "AS2023" in used
    for key in used:
        assert f"[{key}]" in listed
