"""What benchmarks share as programs: tables whose rows appear as they come, and the option --quick."""

import argparse
from collections.abc import Callable, Iterable


def table(header: str, rows: Iterable[str]) -> list[str]:
    """Print a table row by row; return its rows."""
    print(header)
    found = []
    for row in rows:
        print(row, flush=True)
        found.append(row)
    return found


def run(main: Callable[[bool], object], about: str | None) -> None:
    """Call `main(quick)` from a command line; `about` is the text of --help."""
    parser = argparse.ArgumentParser(description=about)
    parser.add_argument("--quick", action="store_true", help="a small case, to see that it works")
    main(parser.parse_args().quick)
