"""Draw the packages and their imports in CONTRIBUTING.md: each package above those that it uses.

An arrow is left out where others lead the same way. Imports that only types need do not count.
"""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parent.parent
PAGE = ROOT / "CONTRIBUTING.md"
PICTURE = re.compile(r"(?<=```mermaid\n).*?(?=```)", flags=re.DOTALL)
APART = ("tools",)  # used by all, and drawn without arrows


def folders() -> dict[str, Path]:
    """The folder of every package, by its name in `orthocas`."""
    inside = {path.parent.name: path.parent for path in (ROOT / "orthocas").glob("*/__init__.py")}
    return inside | {name: ROOT / name for name in ("problems", "solvers")}


def uses() -> dict[str, set[str]]:
    """The packages that each one imports."""
    known = folders()
    return {
        name: {used for path in folder.rglob("*.py") for used in _imported(path)} & set(known) - {name, *APART}
        for name, folder in known.items()
    }


def _imported(path: Path) -> set[str]:
    found = set()
    for node in ast.parse(path.read_text()).body:
        for part in ast.walk(node) if not _for_types(node) else ():
            if isinstance(part, ast.ImportFrom):
                names = (part.module or "").split(".")
                found |= {alias.name for alias in part.names} if names == ["orthocas"] else set(names[1:2])
    return found


def _for_types(node: ast.stmt) -> bool:
    return isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"


def direct(graph: dict[str, set[str]]) -> list[tuple[str, str]]:
    """The arrows that no longer way replaces."""

    def below(name: str) -> set[str]:
        return graph[name].union(*(below(used) for used in graph[name]))

    return [
        (name, used)
        for name in sorted(graph)
        for used in sorted(graph[name])
        if not any(used in below(other) for other in graph[name])
    ]


def picture() -> str:
    """The drawing, in Mermaid's language, with the number of files in each package."""
    sizes = {name: len(list(folder.rglob("*.py"))) for name, folder in sorted(folders().items())}
    boxes = [f'    {name}["{name}/<br>{size} files"]' for name, size in sizes.items()]
    arrows = [f"    {name} --> {used}" for name, used in direct(uses())]
    return "\n".join(["flowchart TB", *boxes, *arrows, ""])


def main() -> None:
    """Write the picture into CONTRIBUTING.md."""
    PAGE.write_text(PICTURE.sub(lambda _: picture(), PAGE.read_text(), count=1))


if __name__ == "__main__":
    main()
