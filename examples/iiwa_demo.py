"""The main use case: four extra coordinates for the 7-DoF arm, their quality, a chart file and two pictures (10 s).

Run by `make demo`. Reproduces [AS2023] Sec. 9 and Fig. 27 with polynomials instead of a network.
"""

import argparse
from pathlib import Path

import orthocas as oc
from orthocas import problems
from orthocas.cli.output import terminal_monitor
from orthocas.plotting import quality_figure, self_motion_figure

PAPER = {"task": 2.06, "mutual": 3.44, "minutes": 100.64}


def main(out: Path, quick: bool = False) -> dict[str, float]:
    """Fit, evaluate and save.

    Args:
        out: folder for chart and pictures.
        quick: degree 3 and few samples.

    Returns:
        Standard deviations [deg], conditioning and seconds.
    """
    out.mkdir(parents=True, exist_ok=True)
    with terminal_monitor() as monitor:
        fit = oc.fit(problems.get("iiwa"), oc.Polynomial(degree=3 if quick else 5), monitor=monitor)
    report = oc.evaluate(fit.chart, samples=5_000 if quick else 100_000)
    fit.chart.save(out / "iiwa.orthocas")
    quality_figure(report).savefig(out / "iiwa_quality.png", dpi=150)
    self_motion_figure(fit.chart, reach=None).savefig(out / "iiwa_self_motion.png", dpi=150)
    return {
        "task_std_deg": report.task_angle.std,
        "mutual_std_deg": report.mutual_angle.std,
        "conditioning_mean": report.conditioning.mean,
        "conditioning_p01": report.conditioning.p01,
        "conditioning_min": report.conditioning.min,
        "seconds": fit.seconds,
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out"))
    parser.add_argument("--quick", action="store_true")
    arguments = parser.parse_args()
    found = main(arguments.out, arguments.quick)
    print("KUKA iiwa, flange position, 4 extra coordinates on a cube of edge pi/2")
    print(f"  task angles    std {found['task_std_deg']:.2f} deg   (paper's network: {PAPER['task']})")
    print(f"  mutual angles  std {found['mutual_std_deg']:.2f} deg   (paper's network: {PAPER['mutual']})")
    print(f"  conditioning   mean {found['conditioning_mean']:.3f}, least found {found['conditioning_min']:.3f}")
    print(f"  fitted in      {found['seconds']:.1f} s       (paper: {PAPER['minutes']} min on a GPU)")
    print(f"  chart and pictures in {arguments.out}/")
