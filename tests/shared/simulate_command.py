"""What tests of `orthocas simulate` share."""

import json
from pathlib import Path
from typing import Any

from programs import Run

from orthocas.tools.files import LIST

SHORT = {"duration": 1, "steps": [{"time": 0.1, "move": {"x": 0.1}}, {"time": 0.6, "to": {"xi1": 0.05}}]}


FILES = {"trajectory.npz", "coordinates.png", "report.json"}


def written() -> set[str]:
    """What is in the folder, apart from the list of it."""
    return {path.name for path in Path("out").iterdir()} - {LIST}


def report_of(run: Run, *words: str, **more: str) -> dict[str, Any]:
    code, out, err = run(*words, "--animation", "none", "--json", **more)
    assert (code, err) == (0, "")
    report: dict[str, Any] = json.loads(out)
    return report
