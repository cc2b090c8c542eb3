"""What benchmarks share as programs: tables whose rows appear as they come, times of calls, the option --quick."""

import argparse
import time
from collections.abc import Callable, Iterable
from typing import TypeVar

T = TypeVar("T")


def table(header: str, rows: Iterable[str]) -> list[str]:
    """Print a table row by row; return its rows."""
    print(header)
    found = []
    for row in rows:
        print(row, flush=True)
        found.append(row)
    return found


def timed(work: Callable[[], T], calls: int) -> tuple[list[float], T]:
    """Seconds of each call, and the last result."""
    seconds = []
    for _ in range(calls):
        start = time.perf_counter()
        result = work()
        seconds.append(time.perf_counter() - start)
    return seconds, result


def run(main: Callable[[bool], object], about: str | None) -> None:
    """Call `main(quick)` from a command line; `about` is the text of --help."""
    parser = argparse.ArgumentParser(description=about)
    parser.add_argument("--quick", action="store_true", help="a small case, to see that it works")
    main(parser.parse_args().quick)
