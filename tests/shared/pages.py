"""Blocks of code of the pages, and a reader who runs them."""

import json
import re
import shutil
import subprocess
from importlib.util import find_spec
from pathlib import Path

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text()
HOW_TO = [f"how-to/{path.name}" for path in sorted((ROOT / "docs" / "how-to").glob("*.md"))]


def blocks(language: str, page: str = "") -> list[str]:
    """The blocks of code of a page of docs, or of README."""
    text = (ROOT / "docs" / page).read_text() if page else README
    return re.findall(rf"```{language}\n(.*?)```", text, flags=re.DOTALL)


#: run by a new Python in an empty folder, as a reader does who copies and pastes: the page's blocks, in order
READER = r"""
import json, linecache, os, subprocess, sys
from pathlib import Path

import matplotlib
matplotlib.use("agg")
os.environ["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
sys.path.insert(0, "")
names = {"__name__": "__main__"}
for number, (language, code) in enumerate(json.loads(sys.argv[1]), 1):
    title = f"block {number}"
    if language == "sh":
        done = subprocess.run(["bash", "-e", "-c", code], capture_output=True, text=True)
        if done.returncode != 0:
            sys.exit(f"{title} fails:\n{code}{done.stdout[-2000:]}{done.stderr[-2000:]}")
        continue
    linecache.cache[title] = (len(code), None, code.splitlines(True), title)
    exec(compile(code, title, "exec"), names)
"""

#: what is installed already is not installed again, and a viewer is closed with Ctrl-C after some seconds
SHELL = """
pip() { :; }
orthocas() {
  case "$1 $*" in
    view*--export*) command orthocas "$@" ;;
    view*) timeout --preserve-status --signal INT 8 orthocas "$@" --port 0 || [ $? = 130 ] ;;
    *) command orthocas "$@" ;;
  esac
}
"""
_BLOCK = re.compile(
    r"(?:^<!-- (needs|sketch) ?([^\n]*) -->\n)?^```(\{code-cell\} python|python|sh)\n(.*?)^```$",
    re.DOTALL | re.MULTILINE,
)


def read_page(page: str, python: str, folder: Path) -> None:
    """Run the blocks of Python and shell of a page, in order, in one process of a Python; raises if one fails.

    `<!-- needs A B -->` before a block names modules, programs and folders of the checkout that orthocas does not
    bring: the folders are copied, and the block is left out without the others. `<!-- sketch -->` marks what the reader
    completes.
    """
    blocks = []
    for mark, needs, language, code in _BLOCK.findall((ROOT / "docs" / page).read_text()):
        if mark == "sketch" or not all(_bring(name, folder) for name in needs.split()):
            continue
        blocks.append(("sh", SHELL + code) if language == "sh" else ("python", code))
    done = subprocess.run(
        [python, "-c", READER, json.dumps(blocks)], cwd=folder, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, f"{page}:\n{done.stdout[-2000:]}\n{done.stderr[-4000:]}"


def _bring(name: str, folder: Path) -> bool:
    """Whether a block has what it needs: a folder of the checkout, which is copied, a module or a program."""
    if "/" in name:
        shutil.copytree(ROOT / name, folder / name, dirs_exist_ok=True)
        return True
    return find_spec(name) is not None or shutil.which(name) is not None
