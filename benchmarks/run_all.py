"""Runs every benchmark in turn (about an hour on 2 cores). The results are in docs/performance.md."""

import subprocess
import sys
from pathlib import Path

SCRIPTS = (
    "dynamics",
    "start_up",
    "command",
    "batches",
    "fits",
    "folds",
    "quality_and_time",
    "clear_boxes",
    "certificates",
    "suggested_domains",
    "choices",
    "scaling",
    "gradients",
    "compiled_loss",
    "ipopt_front",
    "starts",
    "mesh_chart",
    "growing_queries",
    "lengths",
    "closed_loop",
    "control_tick",
    "supervised_tick",
    "inverse",
    "default_gains",
    "safety",
    "following",
    "operational_space",
    "redundancy_peers",
    "metric_loss",
    "against_torch",
    "paper_network",
    "figures_with_networks",
)

if __name__ == "__main__":
    for name in SCRIPTS:
        print(f"\n## {name}", flush=True)
        subprocess.run([sys.executable, str(Path(__file__).parent / f"{name}.py")], check=True)
