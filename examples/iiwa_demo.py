"""The numbers and pictures of `orthocas demo`: four extra coordinates for the 7-DoF arm (10 s).

Reproduces [AS2023] Sec. 9 and Fig. 27 with polynomials instead of a network.
"""

import argparse
from pathlib import Path

from orthocas.cli.compare import fit_demo


def main(out: Path, quick: bool = False) -> dict[str, float]:
    """Fit, evaluate and save; standard deviations [deg], conditioning, seconds, and how far the coordinates reach.

    Args:
        out: folder for chart and pictures.
        quick: degree 3 and few samples.
    """
    fit, found = fit_demo(out, quick)
    reach = fit.chart.xi_range(fit.chart.problem.domain.centre)
    return found | {f"{one.label} {end}": getattr(one, end) for one in reach for end in ("low", "high")}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out"))
    parser.add_argument("--quick", action="store_true")
    arguments = parser.parse_args()
    for name, value in main(arguments.out, arguments.quick).items():
        print(f"{name:<18} {value:.4g}")
