"""The shoulder-elbow-wrist angle as the coordinate of a pose task: how far it leans into the task (6 min).

First the 7-DoF arm with the pose of its flange on the paper's cube, A = I. The leak is the angle between d xi and the
space orthogonal to the task gradients (0 for exact coordinates, 90 degrees for a function of the task); the paper's
cosines compare d xi with one task gradient at a time, and are smaller. Fits have the weights of
`compare_parametrisations.py`. Then three arms on the domain of the wide chart of the home's branch, in both metrics:
leak, and the speed of the joints with xi held over the least one, for nine in ten velocities of the task. Then
networks on the same branches with A = I, where `fit_wide` by itself takes polynomials.
"""

import casadi as ca
import numpy as np
from benchmark import run, table
from wide_charts import robot_of

import orthocas as oc
from orthocas.bases.family import Parametrisation
from orthocas.bases.given import DIRECTIONS, SEW_KINDS, compute_elbow_angle
from orthocas.robots.kinematics import build_body_poses
from orthocas.tasks.samples import sample_uniform
from orthocas.tools.display import percent

COORDINATES = {
    "conventional SEW": oc.SEW("conventional"),
    "stereographic SEW": oc.SEW(),
    "linear": oc.Linear(),
    "fitted": oc.Polynomial(4),
}
METRICS = ("euclidean", "inertia")
ARMS = ("iiwa", "panda", "baxter, left")
WIDE = (
    "| arm, metric | regular share | fitted, leak rms [deg] | conventional SEW, leak rms [deg] "
    "| stereographic SEW, leak rms [deg] | fitted, speed | conventional SEW, speed | stereographic SEW, speed |\n|"
    + " --- |"
    * 8
)
NETWORKS = (
    "| arm, A = I | network of 24, without the last joint (default) | leak rms [deg] | polynomial without it "
    "| leak rms [deg] | network of 64, without it | leak rms [deg] | network of 64, all joints | leak rms [deg] |\n|"
    + " --- |"
    * 9
)
WEIGHTS = oc.Weights(folds=0.0, angles="paper")


def leaks(chart: oc.Chart, points: np.ndarray) -> np.ndarray:
    """Leak at each point for r = 1 and A = I [deg], straight from the Jacobian."""
    rows = np.split(chart.jacobian(points), [chart.m], axis=1)
    task, gradient = np.linalg.qr(rows[0].transpose(0, 2, 1))[0], rows[1][:, 0]
    within = np.linalg.norm(np.einsum("kij,ki->kj", task, gradient), axis=1)
    return np.asarray(np.degrees(np.arcsin(np.minimum(1, within / np.linalg.norm(gradient, axis=1)))))


def through_origins(robot: oc.Robot, kind: str) -> oc.Given:
    """The angle with S, E, W at the origins of joints 2, 4 and 6: baxter's axes do not meet, as `oc.SEW` requires."""

    def angle(q: ca.SX) -> ca.SX:
        S, E, W = (build_body_poses(robot.tree, q)[joint][1] for joint in (1, 3, 5))
        return compute_elbow_angle(E - S, W - S, *(ca.SX(ca.DM(axis)) for axis in DIRECTIONS[kind]))

    return oc.Given.from_function(f"{kind} SEW", robot.n, angle)


def whole_branch(name: str, metric: str, quick: bool) -> str:
    """One row: the wide chart of the home's branch with default settings, and both angles on its domain."""
    robot = robot_of(name)
    polynomial = oc.Polynomial(2) if quick else None
    fit = oc.fit_wide(robot, oc.Task.pose(robot), metric=metric, parametrisation=polynomial)
    wide = fit.chart
    own = [through_origins(robot, kind) if name == "baxter, left" else oc.SEW(kind) for kind in SEW_KINDS]
    angles = [oc.fit(wide.problem, angle).chart for angle in own]
    reports = [oc.evaluate(chart, 2_000 if quick else 20_000) for chart in (wide, *angles)]
    cells = [f"{report.leak.rms:.1f}" for report in reports] + [f"{report.held_speed:.2f}" for report in reports]
    names = f"{name}, {'A = I' if metric == 'euclidean' else 'A = M'}"
    return f"| {names} | {percent(fit.regular_share, 3)} | {' | '.join(cells)} |"


def networks(name: str, quick: bool) -> str:
    """One row: regular share and leak with A = I of the default, and of families with and without the last joint."""
    robot = robot_of(name)
    first, *_, last = robot.joint_names
    families: list[Parametrisation | None] = [None]
    if not quick:
        families += [oc.Polynomial(6, [first], without=[last])]
        families += [oc.MLP((64, 64, 64), True, without=names) for names in ([last], [])]
    fits = [oc.fit_wide(robot, oc.Task.pose(robot), parametrisation=family) for family in families]
    leaks_of = [oc.evaluate(fit.chart, 2_000 if quick else 20_000).leak.rms for fit in fits]
    cells = [f"{percent(fit.regular_share, 3)} | {leak:.1f}" for fit, leak in zip(fits, leaks_of, strict=True)]
    return f"| {name} | {' | '.join(cells)} |"


def main(quick: bool = False) -> dict[str, dict[str, float]]:
    """Print three tables; return the figures of the first one by coordinate."""
    arm, found = oc.problems.get("iiwa"), {}
    task = oc.Task.named(arm.robot, "pose", arm.domain.centre)
    problem = oc.Problem(arm.robot, task, "euclidean", arm.domain)
    points = sample_uniform(arm.domain, 2_000 if quick else 100_000, 1)
    print("| coordinate | leak rms [deg] | median [deg] | paper's cosines, std [deg] | folded [%] |\n|" + " --- |" * 5)
    for name, family in COORDINATES.items():
        chart = oc.fit(problem, oc.Polynomial(2) if quick and name == "fitted" else family, weights=WEIGHTS).chart
        report, angles = oc.evaluate(chart, len(points)), leaks(chart, points)
        found[name] = {
            "leak rms [deg]": float(np.sqrt((angles**2).mean())),
            "leak median [deg]": float(np.median(angles)),
            "paper's cosines, std [deg]": report.task_angle.std,
            "folded [%]": 100 * report.folded_samples / len(points),
        }
        print(f"| {name} | {' | '.join(f'{value:.1f}' for value in found[name].values())} |", flush=True)
    cases = [(name, metric) for name in ARMS for metric in METRICS]
    table(WIDE, (whole_branch(*case, quick) for case in (cases[1:2] if quick else cases)))
    table(NETWORKS, (networks(name, quick) for name in ARMS[: 1 if quick else None]))
    return found


if __name__ == "__main__":
    run(main, __doc__)
