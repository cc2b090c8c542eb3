"""Wall time and peak memory of whole commands, median of five runs."""

import os
import subprocess
import sys
import tempfile
import time
from statistics import median

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


def main(runs: int = 5) -> list[str]:
    """Rows of a table."""
    rows = ["| command | wall [s] | peak memory [MiB] |", "| --- | --- | --- |"]
    with tempfile.TemporaryDirectory() as folder:
        for words in COMMANDS:
            seconds, memory = zip(*(measure(words, folder) for _ in range(runs)), strict=True)
            rows.append(f"| `orthocas {' '.join(words)}` | {median(seconds):.2f} | {median(memory):.0f} |")
    return rows


if __name__ == "__main__":
    print("\n".join(main()))
