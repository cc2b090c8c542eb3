"""How long it takes until something happens: imports, help, short commands, and opening a chart; best of seven runs."""

import subprocess
import sys
import tempfile
import time
from itertools import chain
from pathlib import Path

from benchmark import run, table

import orthocas as oc
from orthocas import problems

STARTS = {
    "python (the floor)": ["-c", "pass"],
    "import casadi (the floor of a chart)": ["-c", "import casadi"],
    "import casadi, pinocchio (the floor of a robot file)": ["-c", "import casadi, pinocchio"],
    "import orthocas": ["-c", "import orthocas"],
    "import all of orthocas": ["-c", "import orthocas as oc; [getattr(oc, n) for n in oc.__all__]"],
    "orthocas --help": ["-m", "orthocas", "--help"],
    "orthocas info iiwa": ["-m", "orthocas", "info", "iiwa"],
    "orthocas fit iiwa": ["-m", "orthocas", "fit", "iiwa", "--out", "a.orthocas"],
}


def best_of_runs(words: list[str], folder: str, runs: int) -> float:
    """Seconds of the quickest run of a new interpreter."""
    seconds = []
    for _ in range(runs):
        start = time.perf_counter()
        subprocess.run([sys.executable, *words], cwd=folder, stdout=subprocess.DEVNULL, check=True)
        seconds.append(time.perf_counter() - start)
    return min(seconds)


def opening(folder: str, runs: int) -> float:
    """Seconds to open a chart of degree 4 in a program that runs already."""
    path = Path(folder) / "chart.orthocas"
    oc.fit(problems.get("iiwa"), oc.Polynomial(4), samples=3000).chart.save(path)
    seconds = []
    for _ in range(10 * runs):
        start = time.perf_counter()
        oc.load(path)
        seconds.append(time.perf_counter() - start)
    return min(seconds)


def main(quick: bool = False) -> list[str]:
    """Print a table row by row; `quick` takes one run of each."""
    runs = 1 if quick else 7
    with tempfile.TemporaryDirectory() as folder:
        rows = (f"| {name} | {best_of_runs(words, folder, runs):.3f} |" for name, words in STARTS.items())
        last = (f"| oc.load, degree 4 | {opening(folder, runs):.4f} |" for _ in range(1))
        return table("| start | [s] |\n| --- | --- |", chain(rows, last))


if __name__ == "__main__":
    run(main, __doc__)
