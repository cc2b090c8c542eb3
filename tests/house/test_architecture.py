"""The house keeps its shape: packages import in one order, files in no circle."""

import ast
import importlib
import re
import tomllib
from collections.abc import Collection, Iterator, Mapping
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
FOLDERS = {"orthocas": "orthocas", "problems": "orthocas.problems", "solvers": "orthocas.solvers"}
SOURCES = {
    ".".join([package, *path.relative_to(ROOT / folder).with_suffix("").parts]): path
    for folder, package in FOLDERS.items()
    for path in sorted((ROOT / folder).rglob("*.py"))
}
MODULES = {name.removesuffix(".__init__"): path for name, path in SOURCES.items()}
FACES = ("orthocas.__main__",)  # what nothing else may import
ORDER = (  # packages import what stands before them, and nothing else
    *("errors", "version", "tools", "native", "solvers", "robots", "tasks", "bases", "exact", "charts", "certificates"),
    *("control", "learn", "codegen", "simulation", "fitting", "paths", "arms", "problems", "viewer", "cli"),
)


#: calls that import what a string names; of ours, only strings that are written out count as imports
LOADERS = {
    "import_module",
    "__import__",
    "import_extra",
    "resolve_name",
    "run_module",
    "run_path",
    "find_spec",
    "spec_from_file_location",
    "reload",
    "exec",
    "eval",
}
COMPUTED = {  # files that may compute the name of a module, and why
    "orthocas.__init__",  # the public names of __init__.pyi, which is above all packages
    "orthocas.cli.commands",  # commands of its own package, on demand
    "orthocas.cli.doctor",  # the libraries that the metadata name, to see whether they load
    "orthocas.robots.urdf",  # a description of the package robot_descriptions
    "orthocas.tools.checks",  # `import_extra`, whose callers write the name out
}


@cache
def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


@cache
def every(node: ast.AST) -> tuple[ast.AST, ...]:
    """All nodes below one, found once for all tests."""
    return tuple(ast.walk(node))


@cache
def naming(node: ast.AST) -> tuple[ast.AST, ...]:
    """Those of them that may name a module."""
    kinds = (ast.ImportFrom, ast.Import, ast.Constant)
    return tuple(part for part in every(node) if isinstance(part, kinds))


@cache
def imports_of(path: Path, inside: bool = False, types: bool = False) -> frozenset[str]:
    """Modules of this package that a file takes names from, itself excluded; see `imports_in`."""
    return frozenset(name for name in imports_in(tree(path), inside, types) if MODULES[name] != path)


def imports_in(source: ast.Module, inside: bool = False, types: bool = False) -> set[str]:
    """Modules of this package that a text takes names from; names that a package hands on count where they are made.

    Args:
        source: the text.
        inside: also imports in functions, and modules that are named by strings.
        types: also imports that only types need.
    """
    found = set()
    for node in nodes(source, inside, types):
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative import"
            found |= {home(node.module or "", alias.name) for alias in node.names}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif inside and isinstance(node, ast.Constant) and isinstance(node.value, str) and "." in node.value:
            found.add(node.value.partition(":")[0])
    return {name for name in found if name in MODULES}


def nodes(source: ast.Module, inside: bool, types: bool) -> Iterator[ast.AST]:
    for node in source.body:
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            yield from node.body if types else ()
            # What runs in place of the imports for types.
            yield from (part for other in node.orelse for part in (naming(other) if inside else (other,)))
        elif inside:
            yield from naming(node)
        else:
            yield node


def takes_from_the_face(source: ast.Module) -> bool:
    """Whether a text imports `orthocas` itself, through which it could reach every package, or a public name of it."""
    taken = False
    for node in every(source):
        if isinstance(node, ast.ImportFrom) and node.module == "orthocas":
            taken |= any(home("orthocas", alias.name) == "orthocas" for alias in node.names)
        elif isinstance(node, ast.Import):
            whole = [alias.name for alias in node.names if alias.asname is None or alias.name == "orthocas"]
            taken |= any(name.partition(".")[0] == "orthocas" for name in whole)
        # The same by a string: import_module("orthocas"), sys.modules["orthocas"], sys.modules.get(name).
        elif isinstance(node, ast.Subscript):
            taken |= last_name(node.value) == "modules"
        elif isinstance(node, ast.Call) and (
            last_name(node.func) in LOADERS or last_name(getattr(node.func, "value", node)) == "modules"
        ):
            taken |= any(isinstance(part, ast.Constant) and part.value == "orthocas" for part in node.args)
    return taken


def last_name(node: ast.AST) -> str:
    """`c` of a.b.c."""
    return node.id if isinstance(node, ast.Name) else node.attr if isinstance(node, ast.Attribute) else ""


def computes_names(source: ast.Module) -> bool:
    """Whether a text imports modules whose names are not written out, or hands a function on that does."""
    aliases = [alias for node in every(source) if isinstance(node, ast.ImportFrom) for alias in node.names]
    loaders = LOADERS | {alias.asname for alias in aliases if alias.name in LOADERS and alias.asname}
    written_out = {
        node.func
        for node in every(source)
        if isinstance(node, ast.Call)
        and node.args
        and isinstance(node.args[0], ast.Constant)
        and isinstance(node.args[0].value, str)
    }
    return any(last_name(node) in loaders and node not in written_out for node in every(source))


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


def circle(imports: Mapping[str, Collection[str]]) -> list[str]:
    """Modules that import each other, first = last; empty if there are none."""
    done: set[str] = set()

    def visit(name: str, way: tuple[str, ...]) -> list[str]:
        if name in way:
            return [*way[way.index(name) :], name]
        if name not in done:
            for below in sorted(imports[name]):
                if found := visit(below, (*way, name)):
                    return found
            done.add(name)
        return []

    return next((found for name in imports if (found := visit(name, ()))), [])


def test_there_are_sources_to_check() -> None:
    assert len(SOURCES) > 100
    assert {"orthocas.problems", "orthocas.solvers.minimisers", "orthocas.fitting.terms"} <= set(MODULES)
    assert "orthocas.tools.checks" in imports_of(MODULES["orthocas.charts.chart"])
    assert "orthocas.charts.figures" in imports_of(MODULES["orthocas.charts.chart"], inside=True)
    assert {package(name) for name in MODULES if name not in (*FACES, "orthocas")} == set(ORDER)


@pytest.mark.slow
def test_files_import_in_no_circle() -> None:
    """Imports in functions and by strings count, too; those that only types need do not."""
    assert circle({name: imports_of(path, inside=True) for name, path in MODULES.items()}) == []
    assert circle({"a": {"b"}, "b": {"c"}, "c": {"b"}}) == ["b", "c", "b"]


def test_no_file_takes_names_from_the_face() -> None:
    """`import orthocas as oc` would lead to every package, up and down."""
    assert [name for name, path in SOURCES.items() if takes_from_the_face(tree(path))] == []


@pytest.mark.parametrize(
    "text",
    [
        *("import orthocas as oc", "import orthocas.charts.chart", "from orthocas import fit"),
        *("import_module('orthocas')", "sys.modules['orthocas'].fit", "sys.modules.get('orthocas')"),
    ],
)
def test_names_from_the_face_are_found(text: str) -> None:
    assert takes_from_the_face(ast.parse(f"def late():\n    {text}"))
    assert not takes_from_the_face(ast.parse("from orthocas import problems\nimport orthocas.charts.chart as chart"))


@pytest.mark.parametrize("types", [False, True])
def test_packages_import_in_one_order(types: bool) -> None:
    """Imports in functions and modules named by strings count, too, and with `types` those that only types need."""
    for name, path in MODULES.items():
        if name not in (*FACES, "orthocas"):
            below = {package(other) for other in imports_of(path, inside=True, types=types)} - {"orthocas"}
            up = [other for other in below if ORDER.index(other) > ORDER.index(package(name))]
            assert not up, f"{name} imports {up}, which stand above it"


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


def test_nothing_imports_the_faces() -> None:
    for name, path in MODULES.items():
        if name not in FACES:
            assert not imports_of(path, inside=True, types=True) & set(FACES), name


def test_domains_answer_for_themselves() -> None:
    """Few files outside their package know a kind of domain by its name; boxes are the language of all."""
    kinds = {"ClearBox", "Corridor", "Torus"}
    known = {
        name
        for name, path in MODULES.items()
        if package(name) != "tasks" and any(isinstance(n, ast.Name) and n.id in kinds for n in every(tree(path)))
    }
    assert known - {"orthocas.charts.regular_part"} == {  # a kind that is defined above the coordinates that it needs
        "orthocas.fitting.fit",
        "orthocas.paths.chart_along",
        "orthocas.problems",
    }


def test_names_of_modules_are_written_out() -> None:
    """Then the order holds for them: a string that names a module of ours counts as an import."""
    assert {name for name, path in SOURCES.items() if computes_names(tree(path))} == COMPUTED


@pytest.mark.parametrize(
    "text",
    [
        "import_module(name)",
        "importlib.import_module(f'orthocas.{name}')",
        "from importlib import import_module as load\nload('orthocas.' + name)",
        "list(map(import_module, names))",
        "__import__(name)",
        "import_extra(package, 'view', 'view')",
        "exec(text)",
    ],
)
def test_computed_names_of_modules_are_found(text: str) -> None:
    assert computes_names(ast.parse(text))
    written_out = ast.parse("def late():\n    return import_module('orthocas.cli.fit')")
    assert not computes_names(written_out)
    assert imports_in(written_out, inside=True) == {"orthocas.cli.fit"}


def test_what_runs_in_place_of_imports_for_types_counts() -> None:
    text = ast.parse("if TYPE_CHECKING:\n    import orthocas.cli.fit\nelse:\n    from orthocas.charts import chart")
    assert imports_in(text) == imports_in(text, inside=True) == {"orthocas.charts.chart"}
    assert imports_in(text, inside=True, types=True) == {"orthocas.cli.fit", "orthocas.charts.chart"}


def test_entry_points_lead_to_the_top() -> None:
    """Commands start in `cli`. Plug-ins, which lower packages load, lie in a package that nothing imports."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert {package(target.partition(":")[0]) for target in project["scripts"].values()} == {"cli"}
    groups = project.get("entry-points", {}).values()
    plugged = {package(target.partition(":")[0]) for group in groups for target in group.values()}
    for name, path in MODULES.items():
        others = {package(other) for other in imports_of(path, inside=True, types=True)} - {package(name)}
        assert not others & plugged, f"{name} imports a plug-in"
    readers = {name for name, path in SOURCES.items() if "entry_points" in path.read_text()}
    assert readers <= {"orthocas.tools.plugins"}


def test_imports_in_functions_say_why() -> None:
    """They are for heavy libraries that few calls need: at the top of the function, the first with its reason."""
    for path in SOURCES.values():
        lines = path.read_text().splitlines()
        for node in every(tree(path)):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                inner = [n for n in every(node) if isinstance(n, ast.Import | ast.ImportFrom)]
                body = node.body[1:] if ast.get_docstring(node) else node.body
                assert inner == body[: len(inner)], f"{path}: import inside {node.name}"
                said = not inner or any("#" in line for line in lines[inner[0].lineno - 2 : inner[0].lineno])
                assert said, f"{path}: {node.name} does not say why"


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
