"""Fits beside other work, and with more threads than cores: seconds of the default loss at degree 4.

Every fit has a process of its own with OMP_NUM_THREADS set; beside it, so many processes run an empty loop. The table
gives medians of three.
"""

import argparse
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from statistics import median

FIT = """
import time
import orthocas as oc
arm = oc.problems.get("iiwa")
oc.fit(arm, oc.Polynomial(1))  # the first call loads libraries
start = time.perf_counter()
oc.fit(arm, oc.Polynomial({degree}))
print(time.perf_counter() - start)
"""
THREADS = (1, 2, 4, 8, 16)  # and one for each core
BUSY = (0, 2, 6)


def main(quick: bool = False) -> dict[tuple[int, int], float]:
    """Print a table in Markdown; return seconds by numbers of threads and of busy processes."""
    cores = os.cpu_count() or 1
    counts, loads = ((1, 2), (0, 1)) if quick else (sorted({*THREADS, cores}), BUSY)
    found: dict[tuple[int, int], float] = {}
    print("| threads | " + " | ".join(f"{load} busy processes [s]" for load in loads) + " |")
    print("|" + " --- |" * (len(loads) + 1))
    for threads in counts:
        for load in loads:
            with busy(load):
                found[threads, load] = median(seconds(2 if quick else 4, threads) for _ in range(1 if quick else 3))
        print(f"| {threads} | {' | '.join(f'{found[threads, load]:.2f}' for load in loads)} |", flush=True)
    return found


def seconds(degree: int, threads: int) -> float:
    """Of one fit in a new process."""
    environment = os.environ | {"OMP_NUM_THREADS": str(threads)}
    code = FIT.format(degree=degree)
    run = subprocess.run([sys.executable, "-c", code], env=environment, check=True, capture_output=True, text=True)
    return float(run.stdout)


@contextmanager
def busy(count: int) -> Iterator[None]:
    """So many processes that keep a core busy each."""
    others = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for other in others:
            other.kill()
            other.wait()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true")
    main(parser.parse_args().quick)
