"""The shoulder-elbow-wrist angle as the coordinate of a pose task: how far it leans into the task (20 s).

The 7-DoF arm with the pose of its flange on the paper's cube, A = I. The leak is the angle between d xi and the space
orthogonal to the task gradients (0 for exact coordinates, 90 degrees for a function of the task); the paper's cosines
compare d xi with one task gradient at a time, and are smaller. Fits have the weights of `compare_parametrisations.py`.
"""

import numpy as np
from benchmark import run

import orthocas as oc
from orthocas.tasks.samples import sample_uniform

COORDINATES = {
    "conventional SEW": oc.SEW("conventional"),
    "stereographic SEW": oc.SEW(),
    "linear": oc.Linear(),
    "fitted": oc.Polynomial(4),
}
WEIGHTS = oc.Weights(folds=0.0, angles="paper")


def leaks(chart: oc.Chart, points: np.ndarray) -> np.ndarray:
    """Leak at each point for r = 1 and A = I [deg], straight from the Jacobian."""
    rows = np.split(chart.jacobian(points), [chart.m], axis=1)
    task, gradient = np.linalg.qr(rows[0].transpose(0, 2, 1))[0], rows[1][:, 0]
    within = np.linalg.norm(np.einsum("kij,ki->kj", task, gradient), axis=1)
    return np.asarray(np.degrees(np.arcsin(np.minimum(1, within / np.linalg.norm(gradient, axis=1)))))


def main(quick: bool = False) -> dict[str, dict[str, float]]:
    """Print a table; return its figures by coordinate."""
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
    return found


if __name__ == "__main__":
    run(main, __doc__)
