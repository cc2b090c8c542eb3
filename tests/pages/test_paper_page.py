"""The table of docs/paper.md is whole, and names only what exists."""

import ast
import re
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "paper.md").read_text()
TESTS = {path.name: path for path in (ROOT / "tests").rglob("test_*.py")}


@cache
def functions_of(path: Path) -> set[str]:
    return {node.name for node in ast.parse(path.read_text()).body if isinstance(node, ast.FunctionDef)}


def rows(section: str) -> list[list[str]]:
    """The cells of a table."""
    (text,) = re.findall(rf"## {section}\n(.*?)(?=\n## |\Z)", PAGE, flags=re.DOTALL)
    lines = [line for line in text.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split(" | ")] for line in lines[2:]]


def test_every_module_and_test_named_in_the_table_exists() -> None:
    modules = re.findall(r"`((?:orthocas|problems|solvers|examples|benchmarks)/[\w/]+\.py)`", PAGE)
    tests = re.findall(r"`(test_\w+\.py)::(\w+)`", PAGE)
    assert len(modules) > 100
    assert len(tests) > 100
    assert not [module for module in modules if not (ROOT / module).is_file()]
    assert not [pair for pair in tests if pair[1] not in functions_of(TESTS[pair[0]])]


def test_rows_name_a_module_a_test_and_a_verdict() -> None:
    for section in ("Equations", "Theorems and statements", "Quantitative claims", "Figures"):
        for cells in rows(section):
            assert re.fullmatch(r"`[\w/]+\.py`", cells[-3]), cells
            assert re.fullmatch(r"`test_\w+\.py::\w+`", cells[-2]), cells
            assert cells[-1], cells


def test_equations_and_figures_are_all_there() -> None:
    assert [cells[0] for cells in rows("Equations") if cells[0] != "-"] == [str(k) for k in range(1, 44)]
    assert [cells[0] for cells in rows("Figures")] == [str(k) for k in range(1, 31)]
