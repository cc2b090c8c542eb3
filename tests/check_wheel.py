"""Build the wheel, install it in a fresh environment, and use it outside the repository and in its root.

Run by `make wheel-check`; not a test file, because it needs the package index.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

from shared.pages import HOW_TO, read_page

ROOT = Path(__file__).parent.parent
USE = """
import orthocas as oc
from orthocas import problems, solvers
problem = problems.get("iiwa")
fit = oc.fit(problem, oc.Polynomial(3), solvers.GaussNewton())
report = oc.evaluate(fit.chart, samples=2000)
assert report.task_angle.std < 3.5, report.task_angle
print(oc.__file__)
"""


def run(*words: str, cwd: Path) -> str:
    """Run a command, show it, and return what it printed."""
    sys.stdout.write(f"$ {' '.join(words)[:120]}\n")
    sys.stdout.flush()
    return subprocess.run(words, cwd=cwd, check=True, capture_output=True, text=True).stdout


def main() -> None:
    """Check that an installed copy is complete and independent of the checkout."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        run(sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", name, str(ROOT), cwd=folder)
        (wheel,) = folder.glob("*.whl")
        run(sys.executable, "-m", "venv", "venv", cwd=folder)
        python = str(folder / "venv" / "bin" / "python")
        run(python, "-m", "pip", "install", "--quiet", str(wheel), cwd=folder)
        used = run(python, "-c", USE, cwd=folder).strip()
        assert str(folder) in used, used
        used = run(python, "-c", USE, cwd=ROOT).strip()  # here the checkout's orthocas/ comes first on the path
        assert str(ROOT) in used, used
        command = str(folder / "venv" / "bin" / "orthocas")
        run(command, "fit", "iiwa", "--param", "polynomial:2", "--out", "a.orthocas", cwd=folder)
        sys.stdout.write(run(command, "evaluate", "a.orthocas", "--samples", "5000", cwd=folder))
        run(command, "charts", "panda-position", "--out", "panda.orthocas", cwd=folder)
        names = run(python, "-m", "zipfile", "-l", str(wheel), cwd=folder)
        for wanted in (
            "orthocas/problems/data/iiwa7_r800.urdf",
            "orthocas/py.typed",
            "solvers/minimisers.py",
            "charts/licences/MPL-2.0.txt",
            "charts/licences/NOTICE.txt",
        ):
            assert wanted in names, wanted
        run(python, "-m", "pip", "install", "--quiet", f"{wheel}[view,mujoco,learn,robots]", cwd=folder)
        for page in HOW_TO:
            sys.stdout.write(f"{page}\n")
            (folder / page).mkdir(parents=True)
            read_page(page, python, folder / page)
    sys.stdout.write("wheel check passed\n")


if __name__ == "__main__":
    main()
