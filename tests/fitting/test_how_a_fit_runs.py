"""The page "How a fit runs" names the files that a fit enters, in the order in which it does."""

import re
import sys
import threading
from pathlib import Path
from types import FrameType
from typing import Any

import orthocas as oc
from orthocas.fitting.fit import fit

ROOT = Path(oc.__file__).parent.parent
PAGE = Path(__file__).parents[2] / "docs" / "explanation" / "how_a_fit_runs.md"
FILE = re.compile(r"`((?:orthocas|solvers)/[\w/]+\.py)`")


def entered() -> list[str]:
    """Files of the package whose functions a small fit calls, by their first calls."""
    problem, family, files = oc.problems.get("planar_3r_xy"), oc.Polynomial(3), dict[str, None]()

    def note(frame: FrameType, event: str, argument: Any) -> None:
        name = frame.f_code.co_filename
        # class bodies run while a module is imported
        if event == "call" and frame.f_code.co_name != "<module>" and name.startswith(str(ROOT)):
            files.setdefault(Path(name).relative_to(ROOT).as_posix())

    threading.setprofile(note)
    sys.setprofile(note)
    try:
        fit(problem, family, samples=300)
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
    return [name.removeprefix("orthocas/") if name.startswith("orthocas/solvers") else name for name in files]


def test_page_names_the_files_that_a_fit_enters() -> None:
    files = [name for name in entered() if ".venv" not in name]
    page = PAGE.read_text()
    assert set(FILE.findall(page)) == set(files)
    rows = re.findall(r"^\| " + FILE.pattern, page, re.MULTILINE)
    assert rows == [name for name in files if not name.startswith("orthocas/tools")]
    assert len(page.split()) <= 700
