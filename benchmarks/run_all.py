"""Runs every benchmark in turn (about an hour on 2 cores), and sums up in a table which ones ran, and for how long.

The results are in docs/. Names on the command line choose some; `--quick` takes small cases, to see that all of them
run. A benchmark that fails does not stop the others. `browser_view.py` needs Chromium and is left out.
"""

import argparse
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from benchmark import table

SCRIPTS = (
    "dynamics",
    "start_up",
    "command",
    "batches",
    "fits",
    "folds",
    "quality_and_time",
    "threads",
    "clear_boxes",
    "clear_positions",
    "certificates",
    "wide_certificates",
    "one_to_one",
    "suggested_domains",
    "many_joints",
    "priorities",
    "wide_charts",
    "quantities",
    "choices",
    "elbow_angle",
    "scaling",
    "many_machines",
    "gradients",
    "compiled_loss",
    "ipopt_front",
    "starts",
    "gradient_flow",
    "mesh_chart",
    "growing_queries",
    "lengths",
    "angles",
    "leak_bound",
    "closed_loop",
    "control_tick",
    "supervised_tick",
    "small_processors",
    "inverse",
    "exported_inverse",
    "exported_nearest",
    "beyond_reach",
    "collisions",
    "collisions_in_mujoco",
    "arm",
    "all_solutions",
    "arm_batches",
    "default_gains",
    "safety",
    "faults",
    "held_loads",
    "following",
    "operational_space",
    "decoupling",
    "redundancy_benchmark",
    "xi_in_qp",
    "xi_in_solvers",
    "random_walk",
    "metric_loss",
    "against_torch",
    "paper_network",
    "figures_with_networks",
)
HEADER = "| benchmark | seconds | result |\n| --- | --- | --- |"


def ran(name: str, quick: bool) -> tuple[str, float, int]:
    """Run one benchmark: its name, seconds and exit code."""
    print(f"\n## {name}", flush=True)
    start = time.perf_counter()
    path = Path(__file__).parent / f"{name}.py"
    done = subprocess.run([sys.executable, str(path), *(["--quick"] if quick else [])], check=False)
    return name, time.perf_counter() - start, done.returncode


def main(names: Sequence[str], quick: bool = False) -> int:
    """Run benchmarks, and print the summary; 1 if one of them failed."""
    found = [ran(name, quick) for name in names]
    print("\n## Summary\n")
    results = ((name, seconds, "done" if code == 0 else f"FAILED, exit code {code}") for name, seconds, code in found)
    table(HEADER, (f"| {name} | {seconds:.0f} | {result} |" for name, seconds, result in results))
    return int(any(code for *_, code in found))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help="default: all", metavar="NAME")
    parser.add_argument("--quick", action="store_true", help="small cases")
    arguments = parser.parse_args()
    sys.exit(main(arguments.names or SCRIPTS, arguments.quick))
