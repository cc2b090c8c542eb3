"""`orthocas` imports in every situation a person gets into; the wheel itself is checked by check_wheel.py."""

from pathlib import Path

import pytest
from programs import python

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
USE = (
    "import orthocas as oc; from orthocas import problems, solvers; "
    "print(problems.get('planar_2r').n, solvers.get('lbfgs').name)"
)


def strictly(code: str, folder: Path) -> str:
    """What it prints in a new Python, where a warning is an error."""
    return python(code, folder, "-W", "error").strip()


def test_works_anywhere(tmp_path: Path) -> None:
    assert strictly(USE, tmp_path) == "2 lbfgs"


def test_works_in_the_checkout_root() -> None:
    assert strictly(USE, ROOT) == "2 lbfgs"


def test_users_own_modules_of_the_same_names_are_left_alone(tmp_path: Path) -> None:
    (tmp_path / "solvers.py").write_text("mine = 'solvers'")
    (tmp_path / "problems.py").write_text("mine = 'problems'")
    assert (
        strictly(USE + "; import solvers, problems; print(solvers.mine, problems.mine)", tmp_path)
        == "2 lbfgs\nsolvers problems"
    )


def test_import_is_silent_and_leaves_random_state_alone(tmp_path: Path) -> None:
    code = (
        "import numpy as np, casadi as ca; a = np.random.get_state()[1].copy(); m = ca.GlobalOptions.getNumpyMode();"
        "import orthocas; assert (np.random.get_state()[1] == a).all(); assert ca.GlobalOptions.getNumpyMode() == m"
    )
    assert strictly(code, tmp_path) == ""
