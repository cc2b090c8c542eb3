"""Wall time and peak memory of whole commands, median of five runs."""

import os
import subprocess
import sys
import tempfile
import time
from statistics import median

from benchmark import run, table

COMMANDS = (
    ["fit", "iiwa", "--out", "a.orthocas"],
    ["fit", "iiwa", "--param", "polynomial:5", "--out", "b.orthocas"],
    ["evaluate", "a.orthocas"],
    ["info", "iiwa"],
)


def measure(words: list[str], folder: str) -> tuple[float, float]:
    """Seconds and peak MiB of one run."""
    start = time.perf_counter()
    process = subprocess.Popen([sys.executable, "-m", "orthocas", *words], cwd=folder, stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    assert process.returncode == 0, words
    return time.perf_counter() - start, usage.ru_maxrss / 1024


def row(words: list[str], folder: str, runs: int) -> str:
    """Medians of one command."""
    seconds, memory = zip(*(measure(words, folder) for _ in range(runs)), strict=True)
    return f"| `orthocas {' '.join(words)}` | {median(seconds):.2f} | {median(memory):.0f} |"


def main(quick: bool = False) -> list[str]:
    """Print a table row by row; `quick` takes one run of each."""
    with tempfile.TemporaryDirectory() as folder:
        rows = (row(words, folder, 1 if quick else 5) for words in COMMANDS)
        return table("| command | wall [s] | peak memory [MiB] |\n| --- | --- | --- |", rows)


if __name__ == "__main__":
    run(main, __doc__)
