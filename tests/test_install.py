"""`orthocas` imports in every situation a person gets into; the wheel itself is checked by check_wheel.py."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent
USE = (
    "import orthocas as oc; from orthocas import problems, solvers; "
    "print(problems.get('planar_2r').n, solvers.get('lbfgs').name)"
)


def python(code: str, folder: Path) -> str:
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code], cwd=folder, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_works_anywhere(tmp_path: Path) -> None:
    assert python(USE, tmp_path) == "2 lbfgs"


def test_works_in_the_checkout_root() -> None:
    assert python(USE, ROOT) == "2 lbfgs"


def test_users_own_modules_of_the_same_names_are_left_alone(tmp_path: Path) -> None:
    (tmp_path / "solvers.py").write_text("mine = 'solvers'")
    (tmp_path / "problems.py").write_text("mine = 'problems'")
    assert (
        python(USE + "; import solvers, problems; print(solvers.mine, problems.mine)", tmp_path)
        == "2 lbfgs\nsolvers problems"
    )


def test_import_is_silent_and_leaves_random_state_alone(tmp_path: Path) -> None:
    code = (
        "import numpy as np, casadi as ca; a = np.random.get_state()[1].copy(); m = ca.GlobalOptions.getNumpyMode();"
        "import orthocas; assert (np.random.get_state()[1] == a).all(); assert ca.GlobalOptions.getNumpyMode() == m"
    )
    assert python(code, tmp_path) == ""
