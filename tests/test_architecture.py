"""The house keeps its shape: imports point one way, the flat level stays small, functions stay short."""

import ast
import importlib
import re
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from statistics import median

ROOT = Path(__file__).parent.parent
FOLDERS = {"orthocas": "orthocas", "problems": "orthocas.problems", "solvers": "orthocas.solvers"}
SOURCES = {
    ".".join([package, *path.relative_to(ROOT / folder).with_suffix("").parts]): path
    for folder, package in FOLDERS.items()
    for path in sorted((ROOT / folder).rglob("*.py"))
}
MODULES = {name.removesuffix(".__init__"): path for name, path in SOURCES.items()}
FACES = ("orthocas", "orthocas.__main__", "orthocas.cli", "paper")  # what nothing else may import
LONGEST_CHAIN = 25
FLAT_MODULES = 18


@cache
def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


def imports_of(path: Path) -> set[str]:
    """Modules of this package that a file takes names from; names that a package hands on count where they are made."""
    found = set()
    for node in tree(path).body:  # imports for types alone stand in a block of their own
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            found |= {home(node.module or "", alias.name) for alias in node.names}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
    return {name for name in found if name in MODULES}


@cache
def home(module: str, name: str) -> str:
    """The module that defines what `from module import name` brings."""
    if f"{module}.{name}" in MODULES:
        return f"{module}.{name}"
    if module in MODULES and MODULES[module].name == "__init__.py":
        for node in tree(MODULES[module]).body:
            if isinstance(node, ast.ImportFrom) and name in {alias.name for alias in node.names}:
                return home(node.module or "", name)
    return module


def functions() -> Iterator[tuple[str, int]]:
    """Every function with the lines of its body, docstring apart."""
    for name, path in SOURCES.items():
        for node in ast.walk(tree(path)):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                body = node.body[1:] if ast.get_docstring(node) else node.body
                yield f"{name}.{node.name}", (body[-1].end_lineno or 0) - body[0].lineno + 1 if body else 0


def longest_chains() -> dict[str, int]:
    """Modules on the longest way down from each module; raises if imports go in a circle."""
    depth: dict[str, int] = {}

    def visit(name: str, way: tuple[str, ...]) -> int:
        assert name not in way, "circle: " + " -> ".join((*way[way.index(name) :], name))
        if name not in depth:
            depth[name] = 1 + max((visit(below, (*way, name)) for below in imports_of(MODULES[name])), default=0)
        return depth[name]

    for name in MODULES:
        visit(name, ())
    return depth


def test_there_are_sources_to_check() -> None:
    assert len(SOURCES) > 100
    assert {"orthocas.problems.iiwa", "orthocas.solvers.gauss_newton", "orthocas.fitting.loss"} <= set(MODULES)
    assert "orthocas.checks" in imports_of(MODULES["orthocas.chart"])


def test_imports_go_in_no_circle_and_chains_stay_short() -> None:
    assert max(longest_chains().values()) <= LONGEST_CHAIN


def test_the_flat_level_stays_small() -> None:
    assert len(list((ROOT / "orthocas").glob("*.py"))) <= FLAT_MODULES


def test_nothing_imports_the_faces() -> None:
    for name, path in MODULES.items():
        imported = imports_of(path)
        if not name.startswith(FACES[1:]) and name not in FACES:
            assert not {below for below in imported if below in FACES or below.startswith(FACES[1:])}, name
            assert not {below for below in imported if below.startswith("orthocas.problems")} or "problems" in name, (
                name
            )


def test_solvers_know_objectives_only() -> None:
    allowed = ("orthocas.solvers", "orthocas.minimising", "orthocas.casadi_tools", "orthocas.checks", "orthocas.errors")
    for name, path in MODULES.items():
        if name.startswith("orthocas.solvers"):
            assert all(below.startswith(allowed) for below in imports_of(path)), name


def test_imports_stand_at_the_top_of_the_file() -> None:
    for path in SOURCES.values():
        for node in ast.walk(tree(path)):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                inner = [n for n in ast.walk(node) if isinstance(n, ast.Import | ast.ImportFrom)]
                assert not inner, f"{path}: import inside {node.name}"


def test_functions_are_short() -> None:
    lengths = dict(functions())
    assert len(lengths) > 1000
    assert not {name: lines for name, lines in lengths.items() if lines > 40}
    assert median(lengths.values()) <= 6


def test_public_names_exist() -> None:
    packages = {name.removesuffix(".__init__") for name in SOURCES if name.endswith(".__init__")}
    assert len(packages) >= 15
    for package in packages:
        module = importlib.import_module(package)
        assert hasattr(module, "__all__"), package
        for name in module.__all__:
            assert hasattr(module, name), f"{package}.{name}"


def test_every_package_is_installed() -> None:
    listed = set(tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"])
    assert listed == {name.removesuffix(".__init__") for name in SOURCES if name.endswith(".__init__")}


def test_references_used_in_docstrings_are_listed() -> None:
    listed = (ROOT / "docs" / "references.md").read_text()
    used = {word for path in SOURCES.values() for word in re.findall(r"\[([A-Z][A-Za-z]*\d{4})\]", path.read_text())}
    assert "AS2023" in used
    for key in used:
        assert f"[{key}]" in listed
