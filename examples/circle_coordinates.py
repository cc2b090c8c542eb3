"""Circle-valued coordinates of the planar arm with two joints, on its whole torus, for A = I and A = M (3 min).

The leaves of x are circles around its maximum and its minimum. Real-valued coordinates fold on each of them (Fig. 17
of [AS2023]). Angles need not, but two saddles at one level reorder the leaves: the grown coordinate jumps by pi there.
Twice that angle has no jump at all: it is continuous but at the four singular points, and exact. The pairs of a network
are fitted to its cosine and sine, then to the loss. Both parts are compared with the networks of Fig. 17.
"""

import argparse
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import orthocas as oc
from orthocas.coordinates.fitted import Coordinates
from orthocas.coordinates.turns import shortest
from orthocas.distil import _Distance, _Targets
from orthocas.domains import sample_evenly
from orthocas.fitting.graph_objective import GraphObjective
from orthocas.parametrisations import JointSpace
from orthocas.reproduce.chosen_fit import USUAL
from orthocas.reproduce.planar_fit import freely_fitted, with_other_seed
from orthocas.reproduce.planar_flow import (
    NAMES,
    cell_centres,
    corners,
    deviations,
    distance_to,
    grown_chart,
    mark_singular,
    planar_problem,
)
from orthocas.reproduce.style import joint_plane
from orthocas.samples import sample_problem, samples_at
from orthocas.singularities import singular_points
from orthocas.solvers import LBFGS

WEIGHTS = oc.Weights(1000.0, 0.0, 150.0, folds=0.0, angles="paper")  # the third forbids folds
NEAR, FAR = 0.7, 1.0  # from a singular point: samples that are left out, and beyond what angles are judged [rad]
STARTS = 3  # of real-valued networks


def fitted(metric: str, quick: bool) -> oc.Chart:
    """The circle-valued chart, from twice the grown angle."""
    problem = planar_problem(metric)
    parametrisation = oc.Circle(oc.MLP((8, 8) if quick else (40, 40)))
    family = parametrisation.family(JointSpace.of(problem), 1)
    points = sample_evenly(problem.domain, 800 if quick else 6000, 0)
    points = points[distance_to(points, singular_points(problem)) > NEAR]
    xi, x = grown_chart(problem).xi(points)[:, 0], problem.task.batched(points)[0][:, 0]
    known = np.isfinite(xi)
    size = 1 - x[known] ** 2 / 4  # pairs vanish at the maximum and the minimum, around which the angle turns
    pairs = size[:, None] * np.column_stack([np.cos(2 * xi[known]), np.sin(2 * xi[known])])
    targets = _Targets(points[known], pairs, np.zeros((int(known.sum()), 2, 2)), 0.0)
    steps = 40 if quick else 400
    start = LBFGS(steps, 1e-9).minimise(_Distance(family.pairs, targets), family.initial(0)).theta
    objective = GraphObjective(family, samples_at(problem, points), WEIGHTS, start, partial(sample_problem, problem))
    theta = LBFGS(steps if quick else 1500, 1e-8).minimise(objective, start).theta
    return oc.Chart(problem, Coordinates(parametrisation, JointSpace.of(problem), (), theta, np.zeros(1), np.ones(1)))


def real_valued(metric: str, quick: bool) -> oc.Chart:
    """The network of Fig. 17 with the least median deviation away from singular points."""
    charts = [freely_fitted(metric, quick, with_other_seed(USUAL, k)) for k in range(1 if quick else STARTS)]
    return min(charts, key=lambda chart: judged(chart)["median_deg"])


def judged(chart: oc.Chart, cells: int = 120) -> dict[str, float]:
    """Deviations from right angles more than 1 rad from singular points, and the share of them that is folded."""
    points = cell_centres(cells)
    points = points[distance_to(points, singular_points(chart.problem)) > FAR]
    J = chart.jacobian(points)
    angles, sides = deviations(chart.problem, points, J[:, 1]), np.sign(np.linalg.det(J))
    return {
        "median_deg": float(np.median(angles)),
        "rms_deg": float(np.sqrt((angles**2).mean())),
        "share_above_10_deg": float((angles > 10).mean()),
        "folded": float(min((sides > 0).mean(), (sides < 0).mean())),
    }


def jump_across_the_cut(chart: oc.Chart) -> float:
    """Largest change of xi over 0.01 rad across the cut of the grown chart, along its base leaf [rad]."""
    leaf = grown_chart(chart.problem).coordinates.leaf
    tangent = leaf.values(leaf.cut[None]).gradients[0, 0]
    near = leaf.cut + 0.005 * np.array([[-1.0], [1.0]]) * tangent / np.linalg.norm(tangent)
    return float(np.abs(shortest(np.diff(chart.xi(near), axis=0), np.array([2 * np.pi]))).max())


def draw(charts: dict[str, oc.Chart]) -> Figure:
    """The angle by colour, with leaves of the task."""
    figure = Figure(figsize=(8, 4.2), layout="constrained")
    panels = figure.subplots(1, 2)
    for axes, (metric, chart) in zip(panels, charts.items(), strict=True):
        q, points = corners(240)
        xi, h = (values.reshape(241, 241) for values in (chart.xi(points)[:, 0], chart.task(points)[:, 0]))
        shown = axes.imshow(xi, extent=2 * (-np.pi, np.pi), origin="lower", cmap="twilight", vmin=-np.pi, vmax=np.pi)
        axes.contour(q, q, h, levels=np.linspace(-1.75, 1.75, 8), colors="white", linewidths=0.8, linestyles="-")
        mark_singular(axes, singular_points(chart.problem))
        joint_plane(axes, parts=2)
        axes.set_title(f"${NAMES[metric]}$")
    figure.colorbar(shown, ax=panels, label=r"$\xi$ [rad]", shrink=0.8)
    return figure


def main(out: Path, quick: bool = False) -> dict[str, dict[str, float]]:
    """Fit and judge both kinds for both metrics, and draw the angles.

    Args:
        out: folder for the picture.
        quick: small networks, few samples.
    """
    out.mkdir(parents=True, exist_ok=True)
    charts = {metric: fitted(metric, quick) for metric in NAMES}
    rows = {}
    for metric, chart in charts.items():
        rows[f"{metric}, circle"] = judged(chart) | {"jump_across_the_old_cut_rad": jump_across_the_cut(chart)}
        rows[f"{metric}, real"] = judged(real_valued(metric, quick))
    draw(charts).savefig(out / "circle_coordinates.png", dpi=110)
    return rows


def _table(rows: dict[str, dict[str, float]]) -> list[str]:
    lines = []
    for name, row in rows.items():
        lines.append(f"{name:<20} " + "  ".join(f"{key} {value:.3g}" for key, value in row.items()))
    return lines


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out"))
    parser.add_argument("--quick", action="store_true")
    arguments = parser.parse_args()
    print("\n".join(_table(main(arguments.out, arguments.quick))))
