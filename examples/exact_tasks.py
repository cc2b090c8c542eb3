"""Tasks with m >= 2 that have exact coordinates: found by thinking, checked by brackets, grown, and fitted (2 min).

Exact coordinates for two or more task components are rare ([AS2023] Theorem 1). These are three kinds:

- *separable maps*: task components are sums of functions of single joints, h = B f(q) with one f_k for each joint, so
  the gradients commute: the propellers of `orthocas.problems.propellers`;
- *a metric*: the planar arm with four joints, in the absolute angles a of its links, with their lengths as weights.
  Per link, the gradients of x, of y and of the weighted sum of the angles are -sin a, cos a and 1: the fields of the
  projective motions of a circle, which are closed under brackets for any number of links. What such motions leave
  alone is the cross-ratio of the four link directions;
- *a mechanism*: two arms on one base, one task component for each, in the metric of their common mass matrix. The
  gradient of one arm does not feel the other.

Next to each stands a neighbour that is not exact.
"""

import argparse
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import casadi as ca
import numpy as np
from matplotlib.figure import Figure

import orthocas as oc
from orthocas import problems
from orthocas.problems.propellers import logarithms
from orthocas.robots import KinematicTree
from orthocas.tasks.metric import Metric
from orthocas.tools.checks import Array

LENGTHS = (1.0, 0.8, 0.7, 0.5)  # of the links [m]
TURNED = np.tril(np.ones((4, 4)))  # absolute angles of the links from joint angles
WEIGHTS = (1000.0, 30.0)
DEGREES = (1, 2, 3, 4, 5)


@dataclass(frozen=True)
class Case:
    """A problem, whether it is exact, and its exact coordinates if they have a formula."""

    name: str
    problem: oc.Problem
    exact: bool
    formula: Callable[[ca.SX], ca.SX] | None = None


def cases() -> list[Case]:
    """All problems."""
    hexarotor, arm, pair = problems.get("hexarotor"), planar_4r(True), two_arms()
    tilted = Metric.custom(hexarotor.robot, "of the neighbours", lambda w: ca.diag(1 + w[[1, 2, 3, 4, 5, 0]] ** 2))
    return [
        Case("hexarotor, A = I", hexarotor, True, logarithms),
        Case("hexarotor, metric of the neighbours", _with_metric(hexarotor, tilted), False),
        Case("planar 4R: x, y, sum of angles", arm, True, cross_ratio),
        Case("the same, A = I", _with_metric(arm, "euclidean"), False),
        Case("planar 4R: x, y", planar_4r(False), False),
        Case("two arms, A = M", pair, True),
        Case("one tip on both arms, A = M", two_arms(together=True), False),
    ]


def _with_metric(problem: oc.Problem, metric: "Metric | str") -> oc.Problem:
    return oc.Problem(problem.robot, problem.task, metric, problem.domain, problem.name)


def planar_4r(with_sum: bool) -> oc.Problem:
    """Task (x, y) of the tip, and with `with_sum` the sum of the links' angles weighted by their lengths.

    The metric is A = T^T diag(lengths) T, with the absolute angles a = T q. It is constant: that of rotors in the base
    which turn the links through belts, with inertias in proportion to the lengths.
    """
    robot = oc.Robot.planar(LENGTHS, [1.0] * 4)
    weights = ca.DM(LENGTHS)

    def task(q: ca.SX) -> ca.SX:
        a = ca.DM(TURNED) @ q
        tip = [ca.dot(weights, ca.cos(a)), ca.dot(weights, ca.sin(a))]
        return ca.vertcat(*tip, *([ca.dot(weights, a)] if with_sum else []))

    labels = ("x", "y", "angles") if with_sum else ("x", "y")
    box = oc.Box([0.2, 1.0, -1.8, 2.6], 0.25)
    metric = TURNED.T @ np.diag(LENGTHS) @ TURNED
    return oc.Problem(robot, oc.Task.custom(robot, "planar", task, labels), metric, box, "planar_4r")


def cross_ratio(q: ca.SX) -> ca.SX:
    """The logarithm of the cross-ratio of t_i = tan(a_i / 2), with the absolute angles a.

    It is (t_1 - t_2)(t_3 - t_4) / ((t_1 - t_4)(t_3 - t_2)), with t_i - t_j = sin((a_i - a_j) / 2) over common cosines.
    """
    a = ca.DM(TURNED) @ q

    def apart(i: int, j: int) -> ca.SX:
        return ca.log(ca.fabs(ca.sin((a[i] - a[j]) / 2)))

    return apart(0, 1) + apart(2, 3) - apart(0, 3) - apart(2, 1)


def two_arms(together: bool = False) -> oc.Problem:
    """Two planar arms on one base, A = M: the x of both tips, or with `together`, their mean in x and y."""
    left, right = (oc.Robot.planar([1.0, 0.8], [3.0, 2.0]).tree for _ in range(2))
    robot = oc.Robot(_side_by_side(left, right))

    def tips(q: ca.SX) -> list[ca.SX]:
        angles = [(q[k], q[k] + q[k + 1]) for k in (0, 2)]
        return [ca.vertcat(ca.cos(a) + 0.8 * ca.cos(b), ca.sin(a) + 0.8 * ca.sin(b)) for a, b in angles]

    def task(q: ca.SX) -> ca.SX:
        first, second = tips(q)
        return (first + second) / 2 if together else ca.vertcat(first[0], second[0])

    box = oc.Box([0.6, 0.8, 0.9, 0.7], 0.25)
    labels = ("x", "y") if together else ("x_left", "x_right")
    return oc.Problem(robot, oc.Task.custom(robot, "tips", task, labels), "inertia", box, "two_arms")


def _side_by_side(left: KinematicTree, right: KinematicTree) -> KinematicTree:
    """Both trees on one base; the tip is that of the left one."""
    n = left.n
    arrays = ("rotations", "translations", "masses", "centres", "inertias", "armatures")
    limits = ("lower", "upper", "effort_limits", "velocity_limits")
    both = {name: np.concatenate([getattr(left, name), getattr(right, name)]) for name in (*arrays, *limits)}
    return replace(
        left,
        joint_names=tuple(f"{side}{k + 1}" for side in ("left", "right") for k in range(n)),
        joint_kinds=left.joint_kinds + right.joint_kinds,
        parents=left.parents + tuple(p if p < 0 else p + n for p in right.parents),
        **both,
    )


def leak(chart: oc.Chart, samples: int) -> float:
    """Root mean square leak of a chart on held-out samples [deg]."""
    return float(oc.evaluate(chart, samples).leak.rms)


def row(case: Case, quick: bool) -> dict[str, float]:
    """Defect, and leaks of the formula, of grown coordinates by differences, and of fits."""
    samples = 2000 if quick else 10_000
    found = oc.involutivity(case.problem, 300 if quick else 2000)
    numbers = {"defect": found.mean, "exact": float(found.exact), "expected_leak_deg": found.expected_leak_deg}
    if case.formula is not None:
        given = oc.Given.from_function("formula", case.problem.n, case.formula)
        numbers["formula_leak_deg"] = leak(oc.fit(case.problem, given).chart, samples)
    if case.exact:
        numbers["grown_leak_by_differences_deg"] = grown_leak(case.problem)
    for degree in (2, 4) if quick else DEGREES:
        chart = oc.fit(case.problem, oc.Polynomial(degree), weights=WEIGHTS, samples=1500 if quick else None).chart
        numbers[f"degree_{degree}_leak_deg"] = leak(chart, samples)
    return numbers


def grown_leak(problem: oc.Problem, count: int = 20, step: float = 1e-4) -> float:
    """Largest leak of grown coordinates, whose gradients are taken by central differences of xi [deg].

    Their own Jacobian is orthogonal by construction, so it would prove nothing.
    """
    chart = oc.grow(problem, leaf="linear")
    centre, half = problem.domain.centre, problem.domain.half_width
    points = centre + 0.5 * half * np.random.default_rng(3).uniform(-1, 1, (count, problem.n))
    shifts = step * np.concatenate([np.eye(problem.n), -np.eye(problem.n)])
    xi = chart.xi((points[:, None] + shifts).reshape(-1, problem.n)).reshape(count, 2, problem.n, chart.r)
    gradients = ((xi[:, 0] - xi[:, 1]) / (2 * step)).transpose(0, 2, 1)  # (N, r, n)
    return float(np.degrees(np.arcsin(np.clip(sines(problem, points, gradients), 0, 1))).max())


def sines(problem: oc.Problem, points: Array, gradients: Array) -> Array:
    """Sines of the leak of given gradients (N, r, n), in the metric, (N, r)."""
    J = problem.task.batched_jacobian(points)[0].reshape(len(points), problem.m, problem.n)
    A = np.array([np.asarray(problem.metric.function(q), dtype=float) for q in points])
    raised = np.linalg.solve(A, gradients.transpose(0, 2, 1))  # grad_A xi, (N, n, r)
    across = J @ raised
    inside = np.linalg.solve(J @ np.linalg.solve(A, J.transpose(0, 2, 1)), across)
    shares = (across * inside).sum(axis=1) / np.einsum("srn,snr->sr", gradients, raised)
    return np.sqrt(np.maximum(shares, 0))


def draw(rows: dict[str, dict[str, float]], quick: bool) -> Figure:
    """Leak by degree: it falls without end where coordinates are exact, and settles elsewhere."""
    figure = Figure(figsize=(7.2, 4.2), layout="constrained")
    axes = figure.subplots()
    degrees = (2, 4) if quick else DEGREES
    for (name, numbers), colour in zip(rows.items(), ("C0", "C0", "C1", "C1", "C4", "C2", "C2"), strict=True):
        style = "-o" if numbers["exact"] else "--s"
        axes.plot(degrees, [numbers[f"degree_{d}_leak_deg"] for d in degrees], style, color=colour, ms=4, label=name)
    axes.set(yscale="log", xlabel="degree of the polynomials", ylabel="leak, rms over held-out samples [deg]")
    axes.set_xticks(degrees)
    axes.legend(fontsize=8)
    axes.grid(alpha=0.3)
    return figure


def main(out: Path, quick: bool = False) -> dict[str, dict[str, float]]:
    """Numbers of all cases, and the picture.

    Args:
        out: folder for the picture.
        quick: two degrees, fewer samples.
    """
    out.mkdir(parents=True, exist_ok=True)
    rows = {case.name: row(case, quick) for case in cases()}
    draw(rows, quick).savefig(out / "exact_tasks.png", dpi=150)
    return rows


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out"))
    parser.add_argument("--quick", action="store_true")
    arguments = parser.parse_args()
    for name, numbers in main(arguments.out, arguments.quick).items():
        print(name)
        for key, value in numbers.items():
            print(f"  {key:32} {value:.4g}")
