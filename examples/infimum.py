"""How far fits are from the best possible orthogonality: a spline solution of the variational problem (10 min).

Cubic splines on grids of the box, solved by Gauss-Newton from two starts, bound the infimum of the loss from above;
where refinement changes the loss geometrically, its limit is that of even coordinates near the start. Six families are
judged by the same loss with the same quadrature. Staircases show that the infimum itself is 0: the loss sees directions
of gradients, not their lengths. For the arm with seven joints no grid is fine enough; there the loss is extrapolated
over the degree of polynomials.
"""

import argparse
import json
from dataclasses import dataclass
from itertools import product
from math import ceil
from pathlib import Path

import casadi as ca
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter
from scipy import sparse
from scipy.interpolate import BSpline
from scipy.sparse.linalg import spsolve

import orthocas as oc
from orthocas import problems, solvers
from orthocas.fitting.sample_loss import Loss
from orthocas.fitting.terms import Sizes
from orthocas.tasks.samples import Samples, evaluate_samples
from orthocas.tools.batch import Batched
from orthocas.tools.checks import Array

WEIGHTS = oc.Weights(folds=0.0)  # the search for folds is no part of the integral
FAMILIES = (oc.Linear(), oc.Polynomial(4), oc.Polynomial(8), oc.Fourier(3), oc.MLP((32, 32)), oc.MLP((64, 64)))
GRIDS = (2, 4, 8)  # cells along each axis; halves, so that the last three losses have a limit
POINTS = 24  # of the quadrature along each axis, at least
DEGREES = (2, 3, 4, 5, 6)  # of the arm with seven joints
STEPS = (2, 4, 8)  # of staircases along each axis
WIDTH = 1e-7  # of the layers between them, in steps


def cases() -> dict[str, oc.Problem]:
    """Problems with three joints: m = 1 and 2, A = M and I."""
    x, xy = problems.get("planar_3r_x"), problems.get("planar_3r_xy")
    flat = oc.Problem(xy.robot, xy.task, "euclidean", xy.domain, "planar_3r_xy")
    return {"planar_3r_x, A = M": x, "planar_3r_xy, A = M": xy, "planar_3r_xy, A = I": flat}


@dataclass(frozen=True, eq=False)
class Integrand:
    """Residuals of the loss at points, as functions of J_xi there, and the mean with the weights of a quadrature."""

    loss: Loss
    samples: Samples
    shares: Array  #: weights of the points, (N,), which add up to 1
    data: Array  #: what the loss needs to know at the points, (N, entries)
    function: Batched  #: rows of J_xi and data -> residuals and their derivatives

    @classmethod
    def of(cls, problem: oc.Problem, points: Array, shares: Array, orient: Array) -> "Integrand":
        """The default loss of a problem at points, oriented like the gradients `orient` (N, r, n)."""
        weights, samples = WEIGHTS.for_problem(problem), evaluate_samples(problem, points)
        loss = Loss.of(Sizes(problem.n, problem.m, problem.r, problem.metric.is_identity), weights.by_name)
        described = samples.collect_data(loss.data, samples.orientation(orient))
        flat = [part.reshape(len(points), -1) for part in described]
        rows, symbols = ca.SX.sym("J", problem.n, problem.r), loss.arguments()[1]
        turned = [ca.SX.sym("part", s.shape[1], s.shape[0]) for s in symbols]  # NumPy has rows first
        stacked = ca.vertcat(ca.vec(rows), *(ca.vec(part) for part in turned))
        rho = loss.residuals(rows.T, [part.T for part in turned])
        derivative = ca.densify(ca.jacobian(rho, ca.vec(rows)))
        function = ca.Function("rho", [stacked], [ca.densify(rho), ca.vec(derivative.T)])
        return cls(
            loss, samples, shares, np.concatenate([np.empty((len(points), 0)), *flat], axis=1), Batched(function)
        )

    def __call__(self, J: Array) -> tuple[float, Array, Array]:
        """Mean loss, residuals (N, rows) and derivatives (N, rows, r, n) for gradients J (N, r, n)."""
        rho, slopes = self.function(np.concatenate([J.reshape(len(J), -1), self.data], axis=1))
        rho = rho.reshape(len(J), -1)
        value = float(self.shares @ (rho**2).sum(axis=1)) / 2
        return value, rho, slopes.reshape(len(J), rho.shape[1], *J.shape[1:])


class Splines:
    """Cubic splines in three variables on a box, at the points of a Gauss quadrature."""

    def __init__(self, box: oc.Box, cells: int) -> None:
        at, weights = np.polynomial.legendre.leggauss(ceil(POINTS / cells))
        ends = np.linspace(-1.0, 1.0, cells + 1)
        line = (ends[:-1, None] + (at + 1) / cells).ravel()
        knots = np.concatenate([[-1.0] * 3, ends, [1.0] * 3])
        self.count = cells + 3
        value = sparse.csr_matrix(BSpline.design_matrix(line, knots, 3))
        slope = sparse.csr_matrix(BSpline(knots, np.eye(self.count), 3).derivative()(line))
        half, centre = box.half_width, box.centre
        self.points = centre + half * np.array(list(product(line, repeat=3)))
        share = np.tile(weights, cells) / (2 * cells)
        self.shares = np.einsum("i,j,k->ijk", share, share, share).ravel()
        self.value = sparse.kron(sparse.kron(value, value), value).tocsr()
        self.slopes = []
        for joint in range(3):
            first, second, third = (slope / half[joint] if k == joint else value for k in range(3))
            self.slopes.append(sparse.kron(sparse.kron(first, second), third).tocsr())

    def interpolated(self, xi: Array) -> Array:
        """Coefficients (r, K) of the splines nearest to values xi (N, r) at the points."""
        V = self.value
        return np.array([spsolve((V.T @ V).tocsc(), V.T @ column) for column in xi.T])


class SplineLoss:
    """The loss over coefficients of splines, for `solvers.GaussNewton`."""

    def __init__(self, splines: Splines, problem: oc.Problem, start: Array) -> None:
        self.splines, self.r = splines, problem.r
        self.integrand = Integrand.of(problem, splines.points, splines.shares, self.gradients(start.ravel()))

    def gradients(self, theta: Array) -> Array:
        """J_xi at the points, (N, r, 3)."""
        C = theta.reshape(self.r, -1)
        return np.stack([(slope @ C.T) for slope in self.splines.slopes], axis=2)

    def value(self, theta: Array) -> float:
        """The mean loss."""
        return self.integrand(self.gradients(theta))[0]

    def value_and_gradient(self, theta: Array) -> tuple[float, Array]:
        """The mean loss and its gradient."""
        value, rho, slopes = self.integrand(self.gradients(theta))
        by_entry = np.einsum("s,sa,sajk->jks", self.splines.shares, rho, slopes)
        parts = [sum(G.T @ by_entry[j, k] for k, G in enumerate(self.splines.slopes)) for j in range(self.r)]
        return value, np.concatenate(parts)

    def normal_equations(self, theta: Array) -> tuple[float, Array, Array]:
        """The mean loss, its gradient and the Gauss-Newton matrix, assembled cell by cell as a sparse product."""
        _, rho, slopes = self.integrand(self.gradients(theta))
        H = np.zeros((theta.size, theta.size))
        for a in range(rho.shape[1]):
            weighted = self.splines.shares[:, None, None] ** 0.5 * slopes[:, a]
            row = [
                sum(sparse.diags(weighted[:, j, k]) @ G for k, G in enumerate(self.splines.slopes))
                for j in range(self.r)
            ]
            D = sparse.hstack(row).tocsr()
            H += (D.T @ D).toarray()
        return *self.value_and_gradient(theta), H


def refined(problem: oc.Problem, start: oc.Chart, grids: tuple[int, ...]) -> list[float]:
    """Least loss of splines on each grid, each started from the chart."""
    assert isinstance(problem.domain, oc.Box)
    losses = []
    for cells in grids:
        splines = Splines(problem.domain, cells)
        theta = splines.interpolated(start.xi(splines.points))
        objective = SplineLoss(splines, problem, theta)
        found = solvers.GaussNewton(60, 1e-5).minimise(objective, theta.ravel())
        losses.append(found.value)
    return losses


def extrapolated(values: list[float]) -> tuple[float, float]:
    """Limit of a sequence that falls geometrically, from its last three values (Aitken), and its distance from them."""
    first, second, third = values[-3:]
    before, after = first - second, second - third
    limit = third - after**2 / (before - after) if 0 < after < before else third
    return limit, max(third - limit, abs(after))


def staircase(problem: oc.Problem, steps: int, width: float = WIDTH) -> oc.Chart:
    """One coordinate for three joints and two task components, with any leak that one likes, and no fold.

    xi = e(s(q))^T (q - s(q)) + 2 sum_i sign(z_i) s_i(q_i), where s_i is a smooth staircase from the centre of a cell to
    that of the next one, z(q) spans ker J_x, and e = A z / |A z| is the direction of an orthogonal gradient. Within a
    cell the gradient is e at its centre. In the thin layers between cells it is steep. It leaks there, but what they
    add to the mean goes to 0 with their width. If no component of z changes its sign on the box, det J has none.
    """
    domain = problem.domain
    low, cell = domain.centre - domain.half_width, 2 * domain.half_width / steps

    def across(q: ca.SX) -> ca.SX:
        J = problem.task.jacobian_function(q)
        return ca.cross(J[0, :].T, J[1, :].T)

    signs = np.sign(np.asarray(ca.DM(ca.evalf(across(ca.SX(domain.centre)))))).ravel()

    def xi(q: ca.SX) -> ca.SX:
        at = (q - low) / cell
        stairs = 0.5 + sum((1 + ca.tanh((at - j) / width)) / 2 for j in range(1, steps))
        s = low + cell * stairs
        e = problem.metric.function(s) @ across(s)
        return ca.dot(e / ca.norm_2(e), q - s) + 2 * ca.dot(ca.DM(signs), s)

    return oc.fit(problem, oc.Given.from_function(f"staircase {steps}", problem.n, xi), weights=WEIGHTS).chart


def judged(problem: oc.Problem, chart: oc.Chart, splines: Splines) -> float:
    """Loss of a chart by the quadrature."""
    J = chart.jacobian(splines.points)[:, problem.m :]
    return Integrand.of(problem, splines.points, splines.shares, J)(J)[0]


def as_angle(loss: float) -> float:
    """The angle [deg] whose sine, at all samples and all pairs, would give this loss."""
    return float(np.degrees((2 * loss / WEIGHTS.task) ** 0.5))


def row(problem: oc.Problem, quick: bool) -> dict[str, float]:
    """Infimum of a problem with its error bar, from two starts, and the losses of the families."""
    assert isinstance(problem.domain, oc.Box)
    samples = 600 if quick else None
    charts = {
        family.label: oc.fit(problem, family, weights=WEIGHTS, samples=samples).chart
        for family in (FAMILIES[:2] if quick else FAMILIES)
    }
    grids = (1, 2, 4) if quick else GRIDS
    losses = refined(problem, charts["polynomial:4"], grids)
    infimum, error = extrapolated(losses)
    numbers = {"infimum": infimum, "error": error, "other_start": refined(problem, charts["linear"], grids[-2:-1])[0]}
    numbers |= {f"splines, {cells} cells": loss for cells, loss in zip(grids, losses, strict=True)}
    splines = Splines(problem.domain, grids[-1])
    if problem.r == 1:
        for steps in STEPS[:1] if quick else STEPS:
            numbers[f"staircase, {steps} steps"] = sampled(problem, staircase(problem, steps))
    return numbers | {label: judged(problem, chart, splines) for label, chart in charts.items()}


def sampled(problem: oc.Problem, chart: oc.Chart) -> float:
    """Loss of a chart on 100,000 random points."""
    points = problem.domain.centre + problem.domain.half_width * np.random.default_rng(5).uniform(-1, 1, (100_000, 3))
    J = chart.jacobian(points)[:, problem.m :]
    return Integrand.of(problem, points, np.full(len(points), 1 / len(points)), J)(J)[0]


def seven_joints(quick: bool) -> dict[str, float]:
    """Losses of polynomials on held-out samples of the iiwa, and their limit over the degree."""
    problem, numbers = problems.get("iiwa"), {}
    points = problem.domain.centre + problem.domain.half_width * np.random.default_rng(5).uniform(-1, 1, (20_000, 7))
    shares = np.full(len(points), 1 / len(points))
    for degree in DEGREES[:2] if quick else DEGREES:
        chart = oc.fit(problem, oc.Polynomial(degree), weights=WEIGHTS).chart
        J = chart.jacobian(points)[:, problem.m :]
        numbers[f"polynomial:{degree}"] = Integrand.of(problem, points, shares, J)(J)[0]
    if not quick:
        infimum, error = limit_over_degree(np.array(DEGREES, dtype=float), np.array(list(numbers.values())))
        numbers |= {"infimum": infimum, "error": error}
    return numbers


def limit_over_degree(degrees: Array, losses: Array) -> tuple[float, float]:
    """Limit a of the least squares fit a + b rho^degree, and how far it moves if one degree is left out."""

    def limit(kept: list[int]) -> float:
        best = (np.inf, 0.0)
        for rho in np.linspace(0.05, 0.95, 91):
            columns = np.column_stack([np.ones(len(kept)), rho ** degrees[kept]])
            found = np.linalg.lstsq(columns, losses[kept], rcond=None)[0]
            error = float(((columns @ found - losses[kept]) ** 2).sum())
            best = min(best, (error, max(float(found[0]), 0.0)))
        return best[1]

    everything = list(range(len(degrees)))
    infimum = limit(everything)
    return infimum, max(abs(limit([j for j in everything if j != k]) - infimum) for k in everything)


def table(rows: dict[str, dict[str, float]]) -> list[str]:
    """Losses, and their angles in brackets: a line for each spline grid, family and staircase, a column a problem."""
    every = dict.fromkeys(label for numbers in rows.values() for label in numbers)
    kinds = [label.split(",")[0] for label in every]
    labels = [label for label, kind in zip(every, kinds, strict=True) if kind == "splines"] + ["limit of splines"]
    labels += [label for label in every if ":" in label or label == "linear"]
    labels += [label for label, kind in zip(every, kinds, strict=True) if kind == "staircase"]
    lines = [f"| | {' | '.join(rows)} |", f"| --- |{' --- |' * len(rows)}"]
    return lines + [
        f"| {label} | {' | '.join(cell(numbers, label) for numbers in rows.values())} |" for label in labels
    ]


def cell(numbers: dict[str, float], label: str) -> str:
    """A loss with four digits and its angle; the limit of splines with its error, where refinement shows one."""
    if label != "limit of splines":
        return f"{numbers[label]:.4g} ({as_angle(numbers[label]):.3g}°)" if label in numbers else ""
    infimum, error = max(numbers["infimum"], 0.0), numbers["error"]
    grids = [value for name, value in numbers.items() if name.startswith("splines")]
    if infimum == grids[-1]:
        return f"below {infimum:.4g} ({as_angle(infimum):.3g}°), no limit found"
    if error > infimum:
        return f"below {infimum + error:.2g} ({as_angle(infimum + error):.2g}°)"
    return f"{infimum:.4g} ± {error:.1g} ({as_angle(infimum):.3g}°)"


def draw(rows: dict[str, dict[str, float]]) -> Figure:
    """The families beside the infimum, as angles."""
    figure = Figure(figsize=(10.5, 3.6), layout="constrained")
    panels = figure.subplots(1, len(rows), sharey=True, squeeze=False)[0]
    for axes, (name, numbers) in zip(panels, rows.items(), strict=True):
        labels = [label for label in numbers if ":" in label or label == "linear"]
        angles = [as_angle(numbers[label]) for label in labels]
        axes.plot(angles, labels, "o", color="C0", label="fitted")
        finest = [value for label, value in numbers.items() if label.startswith("splines")][-1]
        axes.axvline(as_angle(finest), color="C3", label="splines on the finest grid")
        axes.set(title=name, xlabel="angle, root mean square [deg]", xscale="log")
        subs = (1,) if max(angles) > 50 * min(angles) else (1, 2, 3, 5)  # of labelled ticks
        axes.xaxis.set(major_locator=LogLocator(subs=subs), major_formatter="{x:g}", minor_formatter=NullFormatter())
        axes.grid(alpha=0.3)
    panels[0].invert_yaxis()
    handles, words = panels[-1].get_legend_handles_labels()
    figure.legend(handles, words, loc="outside lower center", ncols=2, frameon=False)
    return figure


def main(out: Path, quick: bool = False) -> dict[str, dict[str, float]]:
    """Infima and losses of all problems, in `infimum.json`, and the picture.

    Args:
        out: folder for both.
        quick: coarse grids, two families, small fits.
    """
    out.mkdir(parents=True, exist_ok=True)
    rows: dict[str, dict[str, float]] = {}
    for name, problem in list(cases().items())[1 if quick else 0 :]:
        rows[name] = row(problem, quick)
        draw(rows).savefig(out / "infimum.png", dpi=150)
        (out / "infimum.json").write_text(json.dumps(rows, indent=1))
    print("\n".join(table(rows)), flush=True)
    rows["iiwa"] = seven_joints(quick)
    (out / "infimum.json").write_text(json.dumps(rows, indent=1))
    return rows


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out"))
    parser.add_argument("--quick", action="store_true")
    arguments = parser.parse_args()
    for key, value in main(arguments.out, arguments.quick)["iiwa"].items():
        print(f"iiwa  {key:14} {value:10.5g}" + ("" if key == "error" else f" {as_angle(max(value, 0.0)):8.3f} deg"))
