"""A benchmark of redundancy resolution, made of what users report: 15 scenarios, all methods, eight arms (35 min).

Writes `benchmarks/redundancy/results/SCENARIO.json`; `redundancy_page.py` makes tables and pictures of them. How to add
a method: `benchmarks/redundancy/README.md`.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

from redundancy import tuning
from redundancy.arms import HELD_OUT, SOURCES
from redundancy.runner import measured, scenarios

QUICK = ("drift", "elbow", "base")


def main(
    names: Sequence[str] = (),
    arms: Sequence[str] = tuple(SOURCES),
    seeds: Sequence[int] = (0, 1),
    more: Sequence[Path] = (),
    quick: bool = False,
    methods: Sequence[str] = (),
) -> dict[str, dict[str, object]]:
    """Run, and keep the results unless it is quick; those of other methods, arms and seeds stay."""
    chosen = names or (QUICK if quick else tuple(scenarios()))
    return measured(chosen, arms[:1] if quick else arms, seeds[:1] if quick else seeds, more, quick, only=methods)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="SCENARIO", help=f"default: all of {', '.join(scenarios())}")
    parser.add_argument("--arms", nargs="+", default=list(SOURCES), choices=[*SOURCES, *HELD_OUT])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1])
    parser.add_argument("--method", type=Path, action="append", default=[], help="a file with METHODS of your own")
    parser.add_argument("--quick", action="store_true", help="one arm, short runs; prints, and keeps nothing")
    parser.add_argument("--tune", action="store_true", help="choose the settings first (8 min for all methods)")
    parser.add_argument("--methods", nargs="+", default=[], help="names of methods; others keep their results")
    options = parser.parse_args()
    if options.tune:
        tuning.main(options.methods)
    results = main(options.names, options.arms, options.seeds, options.method, options.quick, options.methods)
    for name, result in results.items():
        print(f"{name}: {result['number']}")
        for method, row in result["methods"].items():  # type: ignore[attr-defined]
            print(f"  {method:24}", [case.get("value", case.get("why")) for case in row["cases"]])
