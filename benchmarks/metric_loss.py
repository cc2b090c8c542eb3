"""Which loss gives the better controller for A = M: the paper's cosines, or angles in the metric (about 40 min).

Every arm is charted around several places with both losses. From the middle of each box, the posture then moves to
goals on the same self-motion manifold and back, while the task should stay where it is. Both charts get the same goals,
so both controllers do the same work. With exact coordinates the task would not move, so what counts is how far it does.
Ratios are metric over paper: below 1, the loss in the metric is better. They are geometric means over places, fit seeds
and goals, with the standard error over places and seeds.

Robots other than the built-in ones come from example-robot-data (extra `[test]`).
"""

import argparse
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

import numpy as np

import orthocas as oc
from orthocas import problems
from orthocas.control import Controller, Impedance, PDPlus, Reference, matched_stiffness
from orthocas.errors import OrthocasError
from orthocas.fitting.terms import ANGLES
from orthocas.simulation import Outcome, coupling_index
from orthocas.tasks.problem import relative_singular_values
from orthocas.tasks.regular_box import regular_box
from orthocas.tools.checks import Array
from orthocas.tools.display import percent

HALF_WIDTH = 0.5  # [rad] of boxes around places
REGULAR = 0.05  # least relative singular value of the task at samples of a place
FREQUENCY = 2 * np.pi  # [rad/s] of the low pass that turns steps into motions
STEP = 0.3  # largest motion of a joint when one coordinate makes a step, as a share of the half-width
LAWS = {
    "PD+ decoupled": lambda chart, K: PDPlus(chart, K, coupling="decoupled", damping="double_diagonal"),
    "impedance decoupled": lambda chart, K: Impedance(chart, K, coupling="decoupled", damping="double_diagonal"),
    "impedance coupled": lambda chart, K: Impedance(chart, K, coupling="coupled", damping="double_diagonal"),
    "PD+ coupled": lambda chart, K: PDPlus(chart, K, coupling="coupled", damping="double_diagonal"),
}
URDFS = {
    "panda": ("panda_description/urdf/panda.urdf", "panda_hand"),
    "ur10": ("ur_description/urdf/ur10_robot.urdf", "tool0"),
    "baxter": ("baxter_description/urdf/baxter.urdf", "left_gripper"),
}
ARMS = {"planar_3r_xy": 6, "iiwa": 3, "panda": 3, "baxter": 3, "ur10": 3}  # with degrees


@dataclass(frozen=True)
class Measured:
    """One law on one chart and one goal, or the coupling index of the chart."""

    arm: str
    place: int
    seed: int
    angles: str
    what: str
    value: float


def problem_of(arm: str) -> oc.Problem:
    """The position task of an arm, with A = M, on its default box."""
    if arm in problems.names():
        known = problems.get(arm)
        return oc.Problem(known.robot, known.task, "inertia", known.domain, arm)
    file, tip = URDFS[arm]
    path = next(Path(str(entry.locate())) for entry in metadata.files("example-robot-data") or [] if file in str(entry))
    robot = oc.Robot.from_urdf(path, tip=tip)
    task = oc.Task.position(robot)
    return oc.Problem(robot, task, "inertia", regular_box(robot, task), arm)


def places(problem: oc.Problem, count: int) -> list[oc.Problem]:
    """The problem itself, and boxes around random postures where the task is regular."""
    found, robot, rng = [problem], problem.robot, np.random.default_rng(7)
    room = HALF_WIDTH if problem.n > 3 else float(problem.domain.half_width[0])
    lower, upper = np.maximum(robot.lower, -np.pi) + room, np.minimum(robot.upper, np.pi) - room
    while len(found) < count:
        box = oc.Box(rng.uniform(lower, upper), room)
        other = oc.Problem(robot, problem.task, "inertia", box, problem.name)
        if relative_singular_values(other, sampled(box, 300)).min() > REGULAR:
            found.append(other)
    return found


def sampled(box: oc.Box, count: int, seed: int = 0) -> Array:
    """Uniform samples of a box."""
    unit = np.random.default_rng(seed).uniform(-1, 1, (count, len(box.centre)))
    return np.asarray(box.centre + box.half_width * unit)


def goals(problem: oc.Problem, count: int, seed: int) -> Array:
    """Postures with the task of the centre, in the inner half of the box, (count, n)."""
    centre, half = problem.domain.centre, problem.domain.half_width
    q = centre + 0.5 * half * np.random.default_rng(seed).uniform(-1, 1, (50 * count, problem.n))
    wanted = problem.task.batched(centre[None])[0]
    for _ in range(20):
        error = wanted - problem.task.batched(q)[0]
        q = q + (np.linalg.pinv(problem.task.evaluate_jacobian(q)) @ error[:, :, None])[:, :, 0]
    solved = np.abs(wanted - problem.task.batched(q)[0]).max(axis=1) < 1e-10
    inside = (np.abs(q - centre) < 0.6 * half).all(axis=1)
    far = (np.abs(q - centre) > 0.3 * half).any(axis=1)
    return np.asarray(q[solved & inside & far][:count])


def task_error(law: Controller, chart: oc.Chart, goal: Array) -> float:
    """Root mean square distance of the task from its place while the posture moves to the goal and back [mm]."""
    start, end = chart.phi(chart.problem.domain.centre), chart.xi(goal)
    names = chart.labels[chart.m :]
    forth, back = (dict(zip(names, map(float, xi), strict=True)) for xi in (end, start[chart.m :]))
    reference = Reference.steps(chart.labels, start, [(0.05, forth), (1.3, back)], 2.5, FREQUENCY)
    run = oc.simulate(law, reference, chart.problem.domain.centre, step=0.02)
    if run.outcome is not Outcome.COMPLETE or run.status.any():
        raise OrthocasError(f"{law.name} did not finish")
    moved = chart.x(run.q) - start[: chart.m]
    return float(1000 * np.sqrt((moved**2).sum(axis=1).mean()))


def largest_index(law: Controller, chart: oc.Chart) -> float:
    """Largest deviation of the task while one coordinate makes a step, over the step [m per unit]."""
    centre, half = chart.problem.domain.centre, chart.problem.domain.half_width
    start = chart.phi(centre)
    moved = np.linalg.inv(chart.jacobian(centre))[:, chart.m :]  # joints for unit steps
    steps = STEP / np.abs(moved / half[:, None]).max(axis=0)
    changes = [
        (0.05 + 2.5 * j + 1.25 * k, {label: float(start[chart.m + j] + (0 if k else steps[j]))})
        for j, label in enumerate(chart.labels[chart.m :])
        for k in range(2)
    ]
    reference = Reference.steps(chart.labels, start, changes, 2.5 * chart.r, FREQUENCY)
    run = oc.simulate(law, reference, centre, step=0.02)
    return float(np.nanmax(coupling_index(chart, reference, run).index[: chart.m, chart.m :]))


def measured(
    arm: str, degree: int, regularity: float, count: int, seeds: int, quick: bool = False
) -> Iterator[Measured]:
    """Everything about one arm."""
    for place, problem in enumerate(places(problem_of(arm), 1 if quick else count)):
        for seed in range(1 if quick else seeds):
            targets = goals(problem, 1 if quick else 2, 100 * place + seed)
            for angles in ANGLES:
                weights = oc.Weights(regularity=regularity, folds=0.0, angles=angles)
                chart = oc.fit(problem, oc.Polynomial(degree), weights=weights, seed=seed).chart
                for what, value in of_chart(chart, targets, tuple(LAWS)[: 1 if quick else None]):
                    yield Measured(arm, place, seed, angles, what, value)


def of_chart(chart: oc.Chart, targets: Array, laws: tuple[str, ...]) -> Iterator[tuple[str, float]]:
    """Names and values of what is measured on a chart; NaN where a motion leaves the domain."""
    report = oc.evaluate(chart, 5_000)
    yield "paper's task angle, std [deg]", report.task_angle.std
    yield "leak, rms [deg]", report.leak.rms
    yield "conditioning, 1 %", report.conditioning.p01
    stiffness = matched_stiffness(chart)
    for name in laws:
        law = LAWS[name](chart, stiffness)
        for goal in targets:
            yield f"{name}: task error, rms [mm]", unless_refused(task_error, law, chart, goal)
    yield "coupling index [m]", unless_refused(largest_index, LAWS["PD+ decoupled"](chart, stiffness), chart)


def unless_refused(measure: Callable[..., float], *arguments: object) -> float:
    """The value, or NaN after an error of the package."""
    try:
        return measure(*arguments)
    except OrthocasError:
        return np.nan


def summary(rows: list[Measured]) -> dict[str, tuple[float, float, float, float, float]]:
    """Geometric means with both losses, their ratio, its relative standard error, and the share of ratios below 1."""
    found = {}
    for what in dict.fromkeys(row.what for row in rows):
        paper, metric = (
            np.array([row.value for row in rows if row.what == what and row.angles == angles]) for angles in ANGLES
        )
        cases = np.array([1000 * row.place + row.seed for row in rows if row.what == what and row.angles == "paper"])
        known = np.isfinite(paper) & np.isfinite(metric)
        if not known.any():
            continue
        logs = np.log(metric[known] / paper[known])
        means = np.array([logs[cases[known] == case].mean() for case in np.unique(cases[known])])
        error = means.std(ddof=1) / np.sqrt(len(means)) if len(means) > 1 else np.nan
        levels = [float(np.exp(np.log(part[known]).mean())) for part in (paper, metric)]
        found[what] = (*levels, float(np.exp(means.mean())), float(error), float((logs < 0).mean()))
    return found


def main(
    quick: bool = False, arms: tuple[str, ...] = tuple(ARMS), regularity: float = 150.0, count: int = 4, seeds: int = 2
) -> dict[str, float]:
    """Print a table row by row; return the ratios by arm and figure."""
    print("| arm | figure | paper's loss | loss in the metric | ratio | better in |")
    print("| --- | --- | --- | --- | --- | --- |")
    found, everything = {}, []
    for arm in arms[:1] if quick else arms:
        rows = list(measured(arm, 3 if quick else ARMS[arm], regularity, count, seeds, quick))
        everything += [
            Measured(r.arm, 10_000 * arms.index(arm) + r.place, r.seed, r.angles, r.what, r.value) for r in rows
        ]
        for what, numbers in summary(rows).items():
            found[f"{arm}: {what}"] = numbers[2]
            print(_row(arm, what, *numbers), flush=True)
    for what, numbers in summary(everything).items():
        print(_row("all", what, *numbers), flush=True)
    return found


def _row(arm: str, what: str, paper: float, metric: float, ratio: float, error: float, share: float) -> str:
    spread = f"{ratio:.2f} ± {ratio * error:.2f}" if np.isfinite(error) else f"{ratio:.2f}"
    return f"| {arm} | {what} | {paper:.3g} | {metric:.3g} | {spread} | {percent(share, 0)} |"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--arms", default=",".join(ARMS), help="Comma-separated, out of those built in.")
    parser.add_argument("--regularity", type=float, default=150.0, help="Weight lambda3 of both losses.")
    parser.add_argument("--places", type=int, default=4, help="Boxes of each arm.")
    parser.add_argument("--seeds", type=int, default=2, help="Fits with each loss in each box.")
    choice = parser.parse_args()
    main(choice.quick, tuple(choice.arms.split(",")), choice.regularity, choice.places, choice.seeds)
