"""Circle-valued coordinates of the planar arm with two joints, on its whole torus, for A = I and A = M (5 min).

The leaves of x are circles around its maximum and its minimum. Real-valued coordinates fold on each of them (Fig. 17
of [AS2023]). Angles need not, but two saddles at one level reorder the leaves: an angle that winds once around the
maximum jumps by pi there. One that winds twice has no jump. The pairs of Fourier terms start at twice the angle that is
grown from a leaf, have the symmetries of the arm, and are fitted by Gauss-Newton, degree after
degree. They are compared with the networks of Fig. 17.
"""

import argparse
import json
from itertools import pairwise
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from paper.chosen_fit import USUAL
from paper.planar_fit import freely_fitted, with_other_seed
from paper.planar_flow import (
    NAMES,
    cell_centres,
    corners,
    deviations,
    distance_to,
    grown_chart,
    mark_singular,
    planar_problem,
)
from paper.singularities import singular_points
from paper.style import joint_plane

import orthocas as oc
from orthocas.bases import JointSpace
from orthocas.bases.composed import CircleFamily
from orthocas.bases.products import ProductFamily
from orthocas.charts.coordinates import Coordinates
from orthocas.solvers import GaussNewton
from orthocas.tasks.samples import evaluate_samples
from orthocas.tools.checks import Array
from orthocas.tools.expressions import wrap_shortest

DEGREES = (8, 16, 24, 32)  # total degree in both angles
LEVELS = {"euclidean": 1.0, "inertia": 0.05}  # of the leaves whose arc length labels flow lines at the start [m]
NEAR = 0.2  # from a singular point: samples that are left out [rad]
DISTANCES = (0.5, 0.7, 1.0)  # from singular points, beyond which angles are judged [rad]
STARTS = 3  # of real-valued networks


class SymmetricPairs:
    """Pairs (u, v) of Fourier terms with u(-q) = u(q), v(-q) = v(q), u(q1 + pi) = u(q), v(q1 + pi) = -v(q).

    Both maps take flow lines of x to flow lines. The first takes opposite lines at the maximum to each other, on which
    an angle with two windings is equal; the second exchanges maximum and minimum, and takes xi to -xi.
    """

    def __init__(self, problem: oc.Problem, degree: int) -> None:
        self.problem, self.degree = problem, degree
        self.parametrisation = oc.Circle(oc.Fourier(degree))
        family = self.parametrisation.family(JointSpace.of(problem), 1)
        assert isinstance(family, CircleFamily)
        assert isinstance(family.pairs, ProductFamily)
        self.size = family.size
        self.terms = np.array([(0, 0), *family.pairs.terms])  # 0: constant; 2 k - 1: cos k q; 2 k: sin k q
        sines = ((self.terms > 0) & (self.terms % 2 == 0)).sum(axis=1)
        harmonic = (self.terms[:, 0] + 1) // 2
        self.of_u, self.of_v = (np.flatnonzero((sines % 2 == 0) & (harmonic % 2 == part)) for part in (0, 1))

    @property
    def count(self) -> int:
        """Number of coefficients that the symmetries leave."""
        return len(self.of_u) + len(self.of_v)

    def columns(self, points: Array) -> tuple[Array, Array]:
        """Terms of u and of v at points (N, 2), with their derivatives, (3, N, terms) each."""
        waves, slopes = _waves(points, self.degree)
        first, second = self.terms.T
        found = [waves[0][:, first] * waves[1][:, second]]
        found += [slopes[0][:, first] * waves[1][:, second], waves[0][:, first] * slopes[1][:, second]]
        table = np.array(found)
        return table[:, :, self.of_u], table[:, :, self.of_v]

    def started(self, points: Array, level: float) -> Array:
        """Coefficients of the pairs nearest to those of twice the angle grown from a leaf; they vanish at extrema."""
        chart = oc.grow(self.problem, level)
        angle, mirrored = (2 * chart.xi(points + shift)[:, 0] for shift in ([0.0, 0.0], [np.pi, 0.0]))
        known = np.isfinite(angle) & np.isfinite(mirrored)
        middle = np.angle(np.exp(1j * (angle + mirrored))[known].mean()) / 2  # xi(q1 + pi) = -xi is then nearly true
        x = self.problem.task.batched(points)[0][known, 0]
        parts = (np.cos, np.sin)
        wanted = [(1 - x**2 / 4) * part(angle[known] - middle) for part in parts]
        found = [
            np.linalg.lstsq(C[0, known], w, rcond=1e-8)[0] for C, w in zip(self.columns(points), wanted, strict=True)
        ]
        return np.concatenate(found)

    def embedded(self, coefficients: Array, coarser: "SymmetricPairs") -> Array:
        """Coefficients of a lower degree as those of this one."""
        place = {tuple(term): k for k, term in enumerate(self.terms.tolist())}
        here = np.zeros((2, len(self.terms)))
        for row, part, values in zip(here, (coarser.of_u, coarser.of_v), coarser.split(coefficients), strict=True):
            row[[place[tuple(term)] for term in coarser.terms[part].tolist()]] = values
        return np.concatenate([here[0, self.of_u], here[1, self.of_v]])

    def split(self, coefficients: Array) -> tuple[Array, Array]:
        """Those of u and those of v."""
        return coefficients[: len(self.of_u)], coefficients[len(self.of_u) :]

    def chart(self, coefficients: Array) -> oc.Chart:
        """The chart with these pairs."""
        table = np.zeros((2, len(self.terms)))
        table[0, self.of_u], table[1, self.of_v] = self.split(coefficients)
        theta = np.concatenate([table[:, 1:].ravel(), table[:, 0]])
        space = JointSpace.of(self.problem)
        return oc.Chart(self.problem, Coordinates(self.parametrisation, space, (), theta, np.zeros(1), np.ones(1)))


def _waves(points: Array, degree: int) -> tuple[list[Array], list[Array]]:
    """1, sqrt(2) cos q, sqrt(2) sin q, ... of both angles, (N, 1 + 2 degree) each, and their derivatives."""
    k, root = np.arange(1, degree + 1), np.sqrt(2)
    values, slopes = [], []
    for q in points.T:
        c, s = root * np.cos(np.outer(q, k)), root * np.sin(np.outer(q, k))
        values.append(np.column_stack([np.ones(len(q)), np.stack([c, s], axis=2).reshape(len(q), -1)]))
        slopes.append(np.column_stack([np.zeros(len(q)), np.stack([-k * s, k * c], axis=2).reshape(len(q), -1)]))
    return values, slopes


class Leak:
    """Half of the mean squared sine of the angle between dxi and the leaves of an exact coordinate, at points."""

    def __init__(self, pairs: SymmetricPairs, points: Array) -> None:
        self.pairs, self.u, self.v = pairs, *pairs.columns(points)
        self.along = evaluate_samples(pairs.problem, points).unit_task_gradients[:, 0].T  # (2, N), unit

    def value(self, theta: Array) -> float:
        """The loss."""
        return float((self._sines(theta)[0] ** 2).mean()) / 2

    def value_and_gradient(self, theta: Array) -> tuple[float, Array]:
        """The loss and its gradient."""
        value, gradient, _ = self.normal_equations(theta)
        return value, gradient

    def normal_equations(self, theta: Array) -> tuple[float, Array, Array]:
        """The loss, its gradient and the Gauss-Newton matrix."""
        r, D, (u, v), W = self._sines(theta)
        w = (self.along - r * W / D) / D  # dr / dW, with W = u dv - v du
        by_u = (w * v[1:]).sum(axis=0)[:, None] * self.u[0] - _weighted(w * v[0], self.u[1:])
        by_v = _weighted(w * u[0], self.v[1:]) - (w * u[1:]).sum(axis=0)[:, None] * self.v[0]
        J = np.hstack([by_u, by_v])
        return float((r**2).mean()) / 2, J.T @ r / len(r), J.T @ J / len(r)

    def _sines(self, theta: Array) -> tuple[Array, Array, tuple[Array, Array], Array]:
        a, b = self.pairs.split(theta)
        u, v = self.u @ a, self.v @ b
        W = u[0] * v[1:] - v[0] * u[1:]
        D = np.sqrt((W**2).sum(axis=0)) + 1e-300
        return (self.along * W).sum(axis=0) / D, D, (u, v), W


def _weighted(w: Array, columns: Array) -> Array:
    """Sum over both angles of weights (2, N) times columns (2, N, terms)."""
    return np.asarray(w[0][:, None] * columns[0] + w[1][:, None] * columns[1])


def fitted(metric: str, degrees: tuple[int, ...], iterations: int) -> list[oc.Chart]:
    """Circle-valued charts of all degrees; each starts from the one before."""
    problem = planar_problem(metric)
    stages = [SymmetricPairs(problem, degree) for degree in degrees]
    theta = stages[0].started(half_of_torus(problem, 60, 0.0), LEVELS[metric])
    charts = []
    for before, pairs in pairwise([stages[0], *stages]):
        theta = pairs.embedded(theta, before)
        points = half_of_torus(problem, 4 * pairs.degree + 30, NEAR)
        theta = GaussNewton(iterations, 1e-5).minimise(Leak(pairs, points), theta).theta
        charts.append(pairs.chart(theta))
    return charts


def half_of_torus(problem: oc.Problem, cells: int, away: float) -> Array:
    """Centres of the cells of a grid with q2 > 0, farther than so much from singular points."""
    points = cell_centres(cells)
    return points[(points[:, 1] > 0) & (distance_to(points, singular_points(problem)) > away)]


def real_valued(metric: str, quick: bool) -> oc.Chart:
    """The network of Fig. 17 with the least median deviation away from singular points."""
    charts = [freely_fitted(metric, quick, with_other_seed(USUAL, k)) for k in range(1 if quick else STARTS)]
    return min(charts, key=lambda chart: judged(chart)["median_deg_beyond_1"])


def judged(chart: oc.Chart, cells: int = 140) -> dict[str, float]:
    """Deviations from right angles beyond some distances from singular points, and the share that is folded."""
    points = cell_centres(cells)
    distance = distance_to(points, singular_points(chart.problem))
    J = chart.jacobian(points)
    angles, sides = deviations(chart.problem, points, J[:, 1]), np.sign(np.linalg.det(J))
    numbers = {}
    for away in DISTANCES:
        part = angles[distance > away]
        numbers |= {
            f"median_deg_beyond_{away:g}": float(np.median(part)),
            f"rms_deg_beyond_{away:g}": float(np.sqrt((part**2).mean())),
            f"deviation_99_percent_deg_beyond_{away:g}": float(np.quantile(part, 0.99)),
            f"share_above_10_deg_beyond_{away:g}": float((part > 10).mean()),
            f"folded_beyond_{away:g}": float(min((sides[distance > away] == side).mean() for side in (-1, 1))),
        }
    return numbers


def jump_across_the_cut(chart: oc.Chart) -> float:
    """Largest change of xi over 0.01 rad across the cut of the grown chart of Fig. 13, along its base leaf [rad]."""
    leaf = grown_chart(chart.problem).coordinates.leaf
    tangent = leaf.values(leaf.cut[None]).gradients[0, 0]
    near = leaf.cut + 0.005 * np.array([[-1.0], [1.0]]) * tangent / np.linalg.norm(tangent)
    return float(np.abs(wrap_shortest(np.diff(chart.xi(near), axis=0), np.array([2 * np.pi]))).max())


def draw(charts: dict[str, oc.Chart]) -> Figure:
    """The angle by colour with leaves of the task, and its deviation from a right angle."""
    figure = Figure(figsize=(8, 7.4), layout="constrained")
    panels = figure.subplots(2, 2)
    for column, (metric, chart) in zip(panels.T, charts.items(), strict=True):
        q, points = corners(240)
        cells = cell_centres(240)
        angles = deviations(chart.problem, cells, chart.jacobian(cells)[:, 1]).reshape(240, 240)
        xi, h = (values.reshape(241, 241) for values in (chart.xi(points)[:, 0], chart.x(points)[:, 0]))
        frame = {"extent": 2 * (-np.pi, np.pi), "origin": "lower"}
        angle = column[0].imshow(xi, cmap="twilight", vmin=-np.pi, vmax=np.pi, **frame)
        column[0].contour(q, q, h, levels=np.linspace(-1.75, 1.75, 8), colors="white", linewidths=0.8, linestyles="-")
        off = column[1].imshow(angles, cmap="Greys", vmin=0, vmax=10, **frame)
        for axes in column:
            mark_singular(axes, singular_points(chart.problem))
            joint_plane(axes, parts=2)
        column[0].set_title(f"${NAMES[metric]}$")
    figure.colorbar(angle, ax=panels[0], label=r"$\xi$ [rad]")
    figure.colorbar(off, ax=panels[1], label=r"$|\angle(\mathrm{d}\xi, \nabla_A h) - 90°|$ [deg]", extend="max")
    return figure


def main(out: Path, quick: bool = False) -> dict[str, dict[str, float]]:
    """Fit and judge both kinds for both metrics, draw the angles, and write `circle_coordinates.json`.

    Args:
        out: folder for the files.
        quick: low degrees, small networks.
    """
    out.mkdir(parents=True, exist_ok=True)
    degrees, best, rows = (DEGREES[:1] if quick else DEGREES), {}, {}
    for metric in NAMES:
        charts = fitted(metric, degrees, 10 if quick else 60)
        for degree, chart in zip(degrees, charts, strict=True):
            rows[f"{metric}, degree {degree}"] = judged(chart)
        best[metric] = charts[-1]
        rows[f"{metric}, degree {degrees[-1]}"]["jump_across_the_old_cut_rad"] = jump_across_the_cut(charts[-1])
        rows[f"{metric}, real"] = judged(real_valued(metric, quick))
    draw(best).savefig(out / "circle_coordinates.png", dpi=110)
    (out / "circle_coordinates.json").write_text(json.dumps(rows, indent=1))
    return rows


def _table(rows: dict[str, dict[str, float]]) -> list[str]:
    lines = []
    for name, row in rows.items():
        lines.append(f"{name:<22} " + "  ".join(f"{key} {value:.3g}" for key, value in row.items()))
    return lines


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out"))
    parser.add_argument("--quick", action="store_true")
    arguments = parser.parse_args()
    print("\n".join(_table(main(arguments.out, arguments.quick))))
