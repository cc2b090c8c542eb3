"""What type checkers say to users: pyright on the tutorials, and on calls with misspelt words."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
TUTORIALS = sorted((ROOT / "docs" / "tutorials").glob("*.md"))
MISSPELT = """
import orthocas as oc

robot = oc.Robot.planar([1.0, 1.0, 1.0], [3.0, 3.0, 3.0])
problem = oc.Problem(robot, oc.Task.position(robot, "x"))
fit = oc.fit(problem, oc.Polynomial(3), precision="singel")
law = oc.control.PDPlus.on_chart(fit.chart, coupling="decoupld", damping="square_rot")
oc.Weights(angles="metrics")
oc.grow(problem, leaf="cirle")
oc.generate_c(fit.chart, "folder", "pd_plus")
"""
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def errors(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Messages of errors in all programs, with file and line, checked as `basic`, against this package."""
    folder = tmp_path_factory.mktemp("programs")
    (folder / "misspelt.py").write_text(MISSPELT)
    for page in TUTORIALS:
        blocks = re.findall(r"```\{code-cell\} python\n(.*?)```", page.read_text(), flags=re.DOTALL)
        assert len(blocks) > 5
        (folder / f"{page.stem}.py").write_text(re.sub("^:tags:.*$", "", "\n".join(blocks), flags=re.MULTILINE))
    settings = {"include": ["*.py"], "typeCheckingMode": "basic", "extraPaths": [str(ROOT)], "venvPath": "/"}
    (folder / "pyrightconfig.json").write_text(json.dumps(settings))
    words = ("-m", "basedpyright", "--outputjson", "--pythonpath", sys.executable, "-p", str(folder))
    done = subprocess.run([sys.executable, *words], capture_output=True, text=True, check=False)
    found = json.loads(done.stdout)["generalDiagnostics"]
    return [
        f"{Path(each['file']).stem}:{each['range']['start']['line'] + 1}: {each['message']}"
        for each in found
        if each["severity"] == "error"
    ]


def test_tutorials_have_no_type_errors(errors: list[str]) -> None:
    assert len(TUTORIALS) == 3
    assert [found for found in errors if not found.startswith("misspelt:")] == []


def test_misspelt_words_are_type_errors(errors: list[str]) -> None:
    lines = {int(found.split(":")[1]) for found in errors if found.startswith("misspelt:")}
    assert lines == {6, 7, 8, 9, 10}
