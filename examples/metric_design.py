"""Choosing a metric for a task: a search that makes coordinates exact, and rotors that halve the leak (2 min).

The metric decides whether exact coordinates exist. The idea to choose it for that is that of Mussa-Ivaldi and Hogan,
for stiffness. Here the measure is the expected leak of `oc.involutivity`, an angle that needs no fit:

- *search*: diagonal metrics of the absolute link angles of a planar arm with four joints, task (x, y, weighted sum of
  angles). From equal weights the search finds the lengths of the links, where coordinates are exact (`exact_tasks.py`);
- *rotors*: A = M + b I, the mass matrix of the planar arm with three joints whose gears reflect the inertia b of their
  rotors to each joint. For a growing b, coordinates of the position of the tip come near to exact ones.
"""

import argparse
from pathlib import Path

import casadi as ca
import numpy as np
from exact_tasks import LENGTHS, TURNED, planar_4r
from matplotlib.figure import Figure
from scipy.optimize import minimize

import orthocas as oc
from orthocas import problems
from orthocas.tasks.metric import Metric
from orthocas.tools.checks import Array

ROTORS = (0.0, 0.3, 1.0, 3.0, 10.0)  # inertias b of the rotors, reflected to the joints [kg m^2]
DEGREES = (3, 5)


def with_metric(problem: oc.Problem, metric: Array | Metric) -> oc.Problem:
    """The same problem with another metric."""
    return oc.Problem(problem.robot, problem.task, metric, problem.domain, problem.name)


def of_links(problem: oc.Problem, weights: Array) -> oc.Problem:
    """With the metric T^T diag(weights) T: diagonal in the absolute angles T q of the links."""
    return with_metric(problem, TURNED.T @ np.diag(weights) @ TURNED)


def with_rotors(problem: oc.Problem, inertia: float) -> oc.Problem:
    """With the metric M + b I."""
    mass = problem.robot.function("mass_matrix")
    metric = Metric.custom(problem.robot, "with rotors", lambda q: mass(q) + inertia * ca.SX.eye(problem.n))
    return with_metric(problem, metric)


def expected(problem: oc.Problem, samples: int) -> float:
    """The expected leak [deg]."""
    return oc.involutivity(problem, samples).expected_leak_deg


def searched(problem: oc.Problem, samples: int, tolerance: float) -> tuple[Array, int]:
    """Weights of the links with the least expected leak, and the number of metrics tried. The first weight stays 1.

    The leak is a root of a sum of squares with a kink where it vanishes, so its square is minimised, by the simplex
    method of Nelder and Mead over logarithms.
    """

    def cost(logarithms: Array) -> float:
        return expected(of_links(problem, np.exp([0.0, *logarithms])), samples) ** 2

    options = {"xatol": tolerance, "fatol": tolerance**2, "maxfev": 400}
    found = minimize(cost, np.zeros(problem.n - 1), method="Nelder-Mead", options=options)
    return np.exp([0.0, *found.x]), int(found.nfev)


def leaks(problem: oc.Problem, quick: bool) -> dict[str, float]:
    """Expected leak, and leaks of fits, rms over held-out samples [deg]."""
    row = {"expected_leak_deg": expected(problem, 300 if quick else 2000)}
    for degree in DEGREES[:1] if quick else DEGREES:
        fit = oc.fit(problem, oc.Polynomial(degree), weights=oc.Weights(folds=0.0, angles="metric"))
        row[f"degree_{degree}_leak_deg"] = float(oc.evaluate(fit.chart, 5000).leak.rms)
    return row


def draw(rotors: dict[float, dict[str, float]]) -> Figure:
    """Leaks against the inertia of the rotors."""
    figure = Figure(figsize=(5.6, 3.6), layout="constrained")
    axes = figure.subplots()
    for key in next(iter(rotors.values())):
        label = key.removesuffix("_deg").replace("_", " ")
        axes.plot(list(rotors), [row[key] for row in rotors.values()], "-o", ms=4, label=label)
    axes.set_xscale("symlog", linthresh=0.3)
    axes.set(xlabel="reflected inertia of the rotors b [kg m²]", ylabel="leak [deg]", ylim=(0, None))
    axes.legend(fontsize=8)
    axes.grid(alpha=0.3)
    return figure


def main(out: Path, quick: bool = False) -> dict[str, dict[str, float]]:
    """Search, fits with equal, found and Euclidean metrics, and leaks with rotors; draws the latter.

    Args:
        out: folder for the picture.
        quick: a coarse search, fewer rotors and degrees.
    """
    out.mkdir(parents=True, exist_ok=True)
    arm, tip = planar_4r(True), problems.get("planar_3r_xy")
    weights, tried = searched(arm, 40 if quick else 100, 1e-3 if quick else 1e-6)
    ratio = weights / np.array(LENGTHS)
    rows = {
        "equal weights": leaks(of_links(arm, np.ones(4)), quick),
        "found weights": leaks(of_links(arm, weights), quick)
        | {"metrics_tried": float(tried), "distance_from_lengths": float(np.abs(ratio / ratio[0] - 1).max())},
    }
    rotors = {b: leaks(with_rotors(tip, b), quick) for b in (ROTORS[::3] if quick else ROTORS)}
    draw(rotors).savefig(out / "metric_design.png", dpi=150)
    heavy = oc.Problem(tip.robot, tip.task, "euclidean", tip.domain)  # M + b I is I but for its scale
    return (
        rows
        | {f"rotors of {b:g} kg m^2": row for b, row in rotors.items()}
        | {"rotors without end": leaks(heavy, quick)}
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out"))
    parser.add_argument("--quick", action="store_true")
    arguments = parser.parse_args()
    for name, numbers in main(arguments.out, arguments.quick).items():
        print(name)
        for key, value in numbers.items():
            print(f"  {key:24} {value:.4g}")
