"""The house keeps its shape: packages import in one order, files in no circle."""

import ast
import importlib
import re
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
FOLDERS = {"orthocas": "orthocas", "problems": "orthocas.problems", "solvers": "orthocas.solvers"}
SOURCES = {
    ".".join([package, *path.relative_to(ROOT / folder).with_suffix("").parts]): path
    for folder, package in FOLDERS.items()
    for path in sorted((ROOT / folder).rglob("*.py"))
}
MODULES = {name.removesuffix(".__init__"): path for name, path in SOURCES.items()}
FACES = ("orthocas.__main__", "orthocas.plotting")  # what nothing else may import
ORDER = (  # packages import what stands before them, and nothing else
    *("errors", "version", "tools", "solvers", "robots", "tasks", "bases", "exact", "charts", "certificates"),
    *("control", "learn", "codegen", "simulation", "fitting", "paths", "problems", "viewer", "cli"),
)


@cache
def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


def imports_of(path: Path, inside: bool = False, types: bool = False) -> set[str]:
    """Modules of this package that a file takes names from; names that a package hands on count where they are made.

    Args:
        path: the file.
        inside: also imports in functions, and modules that are named by strings.
        types: also imports that only types need.
    """
    found = set()
    for node in nodes(path, inside, types):
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            found |= {home(node.module or "", alias.name) for alias in node.names}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif inside and isinstance(node, ast.Constant) and isinstance(node.value, str):
            found.add(node.value.partition(":")[0])
    return {name for name in found if name in MODULES and MODULES[name] != path}


def nodes(path: Path, inside: bool, types: bool) -> Iterator[ast.AST]:
    for node in tree(path).body:
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            yield from node.body if types else ()
        elif inside:
            yield from ast.walk(node)
        else:
            yield node


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


def package(module: str) -> str:
    return module.removeprefix("orthocas.").partition(".")[0]


def circle() -> list[str]:
    """Modules that import each other, first = last; empty if there are none."""
    done: set[str] = set()

    def visit(name: str, way: tuple[str, ...]) -> list[str]:
        if name in way:
            return [*way[way.index(name) :], name]
        if name not in done:
            for below in sorted(imports_of(MODULES[name])):
                if found := visit(below, (*way, name)):
                    return found
            done.add(name)
        return []

    return next((found for name in MODULES if (found := visit(name, ()))), [])


def test_there_are_sources_to_check() -> None:
    assert len(SOURCES) > 100
    assert {"orthocas.problems.iiwa", "orthocas.solvers.gauss_newton", "orthocas.fitting.terms"} <= set(MODULES)
    assert "orthocas.tools.checks" in imports_of(MODULES["orthocas.charts.chart"])
    assert "orthocas.charts.figures" in imports_of(MODULES["orthocas.charts.chart"], inside=True)
    assert {package(name) for name in MODULES if name not in (*FACES, "orthocas")} == set(ORDER)


@pytest.mark.slow
def test_files_import_in_no_circle() -> None:
    assert circle() == []


@pytest.mark.slow
@pytest.mark.parametrize("types", [False, True])
def test_packages_import_in_one_order(types: bool) -> None:
    """Imports in functions and modules named by strings count, too, and with `types` those that only types need."""
    for name, path in MODULES.items():
        if name not in (*FACES, "orthocas"):
            below = {package(other) for other in imports_of(path, inside=True, types=types)} - {"orthocas"}
            up = [other for other in below if ORDER.index(other) > ORDER.index(package(name))]
            assert not up, f"{name} imports {up}, which stand above it"


@pytest.mark.slow
def test_picture_of_the_packages_is_the_code() -> None:
    """Drawn by tools/packages.py: its arrows lead just where imports do, and its files are all there are."""
    page = (ROOT / "CONTRIBUTING.md").read_text()
    arrows, sizes = re.findall(r"^    (\w+) --> (\w+)$", page, re.MULTILINE), re.findall(r"(\w+)/<br>(\d+) files", page)
    inside = [package(name) for name in SOURCES if name.count(".") > 1]
    assert {name: int(size) for name, size in sizes} == {name: inside.count(name) for name in inside}
    drawn, real = {(a, b) for a, b in arrows}, set[tuple[str, str]]()
    for name, path in MODULES.items():
        if package(name) in inside:
            real |= {(package(name), package(other)) for other in imports_of(path, inside=True)}
    assert closure(drawn) == closure({(a, b) for a, b in real if {a, b} <= set(inside) - {"tools"} and a != b})


def closure(arrows: set[tuple[str, str]]) -> set[tuple[str, str]]:
    longer = arrows | {(a, d) for a, b in arrows for c, d in arrows if b == c}
    return arrows if longer == arrows else closure(longer)


@pytest.mark.slow
def test_nothing_imports_the_faces() -> None:
    for name, path in MODULES.items():
        if name not in FACES:
            assert not imports_of(path, inside=True, types=True) & set(FACES), name


@pytest.mark.slow
def test_domains_answer_for_themselves() -> None:
    """Few files outside their package know a kind of domain by its name; boxes are the language of all."""
    kinds = {"ClearBox", "Corridor", "Torus"}
    known = {
        name
        for name, path in MODULES.items()
        if package(name) != "tasks" and any(isinstance(n, ast.Name) and n.id in kinds for n in ast.walk(tree(path)))
    }
    assert known - {"orthocas.charts.regular_part"} == {  # a kind that is defined above the coordinates that it needs
        "orthocas.fitting.fit",
        "orthocas.paths.chart_along",
        "orthocas.problems.planar",
    }


def test_modules_are_not_named_by_strings() -> None:
    """But for commands, which are imported when they are called."""
    named = {
        name for name, path in SOURCES.items() if re.search(r"""import_module\(f?["']orthocas""", path.read_text())
    }
    computed = {name for name, path in SOURCES.items() if "import_module(f" in path.read_text()}
    assert (named, computed) == (set(), {"orthocas.__init__", "orthocas.cli.commands"})


@pytest.mark.slow
def test_imports_in_functions_say_why() -> None:
    """They are for heavy libraries that few calls need: at the top of the function, the first with its reason."""
    for path in SOURCES.values():
        lines = path.read_text().splitlines()
        for node in ast.walk(tree(path)):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                inner = [n for n in ast.walk(node) if isinstance(n, ast.Import | ast.ImportFrom)]
                body = node.body[1:] if ast.get_docstring(node) else node.body
                assert inner == body[: len(inner)], f"{path}: import inside {node.name}"
                assert not inner or "#" in lines[inner[0].lineno - 1], f"{path}: {node.name} does not say why"


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
    listed = (ROOT / "docs" / "reference" / "references.md").read_text()
    used = {word for path in SOURCES.values() for word in re.findall(r"\[([A-Z][A-Za-z]*\d{4})\]", path.read_text())}
    assert "AS2023" in used
    for key in used:
        assert f"[{key}]" in listed
