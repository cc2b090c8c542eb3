"""Wall time and peak memory of whole commands, median of five runs."""

import subprocess
import sys
import tempfile
from statistics import median

from benchmark import run, table

COMMANDS = (
    ["fit", "iiwa", "--out", "a.orthocas"],
    ["fit", "iiwa", "--param", "polynomial:5", "--out", "b.orthocas"],
    ["evaluate", "a.orthocas"],
    ["info", "iiwa"],
)


WATCHED = """
import resource, subprocess, sys, time
start = time.perf_counter()
subprocess.run(sys.argv[1:], check=True, stdout=subprocess.DEVNULL)
print(time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024)
"""


def measure(words: list[str], folder: str) -> tuple[float, float]:
    """Seconds and peak MiB of one run; a small process starts it, because Linux counts the memory of that one."""
    watched = [sys.executable, "-c", WATCHED, sys.executable, "-m", "orthocas", *words]
    found = subprocess.run(watched, cwd=folder, capture_output=True, text=True, check=True)
    seconds, memory = map(float, found.stdout.split())
    return seconds, memory


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
