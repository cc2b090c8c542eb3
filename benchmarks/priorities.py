"""Two tasks, x1 above x2: PD+ with coordinates that follow x2, against springs of x2 behind a projector.

The 7-DoF arm holds its flange and turns its axis; Talos holds both hands and shifts its centre of mass. Coordinates xi
are orthogonal to x1, and the first of them follow x2 as far as x1 leaves it free (`like=x2`). Around a rectangle, x2
goes to another value, then x1, then both back one after the other, each in 2 s. Both laws get the same postures at the
corners: PD+ as phi of them, the hierarchy as x1 and x2. The hierarchy is the dynamically consistent one of [Kha1987];
what neither task holds, only the friction of the joints damps there. `--quick` takes the arm and degree 1.
"""

import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from baselines import Projector
from benchmark import run, table
from many_joints import TALOS, TALOS_MIRRORED, posture, robot

import orthocas as oc
from orthocas.control import PDPlus, Reference, matched_stiffness
from orthocas.simulation import Friction
from orthocas.tools.checks import Array

CORNERS, DURATION = (0.5, 2.5, 4.5, 6.5), 10.0  # [s]
SMOOTH = 8.0  # natural frequency of the filter of both references [rad/s]
VISCOUS = 0.2  # friction of each joint [N m s/rad]


@dataclass(frozen=True)
class Case:
    """Two tasks of a robot, and how far the coordinates of the second move."""

    name: str
    problem: oc.Problem
    second: oc.Task
    shift: tuple[float, ...]  #: of x2, as its coordinates count
    step: tuple[float, ...]  #: of x1


def cases(quick: bool) -> Iterator[Case]:
    """The arm, and the upper body of a humanoid."""
    arm = oc.problems.get("iiwa")
    box = oc.Box(arm.domain.centre, 0.4)
    problem = oc.Problem(arm.robot, oc.Task.position(arm.robot), "inertia", box)
    second = oc.Task.axis(arm.robot).with_reference_at(box.centre)
    yield Case("iiwa: flange above its axis", problem, second, (0.1, -0.1), (0.03, 0.03, 0.0))
    if quick:
        return
    body = robot("talos_reduced.urdf", "gripper_left_base_link", "gripper_right_base_link")
    centre = np.clip(posture(body, TALOS, TALOS_MIRRORED, "left"), body.lower + 0.3, body.upper - 0.3)
    hands = oc.Task.stack(oc.Task.position(body), oc.Task.position(body, frame=body.tips[1]))
    problem = oc.Problem(body, hands, "inertia", oc.Box(centre, 0.3))
    yield Case(
        "talos: hands above centre of mass",
        problem,
        oc.Task.centre_of_mass(body, "xy"),
        (0.005, -0.005),
        (0.0, 0.0, 0.02) * 2,
    )


def value(task: oc.Task, q: Array) -> Array:
    """x at one joint position, (m,)."""
    return np.array(task.function(q)).ravel()


def rows(quick: bool) -> Iterator[str]:
    """Both laws in each case."""
    for case in cases(quick):
        problem, k, home = case.problem, case.second.m, case.problem.domain.centre
        chart = oc.fit(problem, oc.Polynomial(1 if quick else 2), like=case.second).chart
        shift, step = np.zeros(chart.n), np.zeros(chart.n)
        shift[problem.m : problem.m + k], step[: problem.m] = case.shift, case.step
        corners = [home]
        for change in (shift, shift + step, step):
            corners.append(chart.inverse(chart.phi(home) + change, corners[-1]))
        stiffness = matched_stiffness(chart)
        springs = stiffness[: problem.m], stiffness[problem.m : problem.m + k]
        both = [np.concatenate([chart.x(q), value(case.second, q)]) for q in corners]
        laws: list[tuple[str, PDPlus | Projector, list[Array]]] = [
            ("PD+ in (x1, y2, xi)", PDPlus(chart, stiffness), [chart.phi(q) for q in corners]),
            ("hierarchy with projector", Projector(problem, *springs, second=case.second), both),
        ]
        for name, law, goals in laws:
            yield f"| {case.name} | {name} | {' | '.join(simulated(law, goals, case, both))} |"


def simulated(law: PDPlus | Projector, goals: list[Array], case: Case, both: list[Array]) -> list[str]:
    """x1 off while x2 moves, x2 off before x1 moves, joints off at the end, and the time of a core."""
    home, m = case.problem.domain.centre, case.problem.m
    changes = [
        (at, dict(zip(law.labels, goal.tolist(), strict=True)))
        for at, goal in zip(CORNERS, [*goals[1:], goals[0]], strict=True)
    ]
    reference = Reference.steps(law.labels, goals[0], changes, duration=DURATION, natural_frequency=SMOOTH)
    began = time.process_time()
    motion = oc.simulate(law, reference, home, friction=Friction(viscous=VISCOUS), compiled=True)
    tasks = (case.problem.task, case.second)
    x1, x2 = (np.array(task.batched(motion.q)[0]).reshape(len(motion.q), -1) for task in tasks)
    turned = np.searchsorted(motion.times, CORNERS[1]) - 1
    return [
        f"{1e3 * np.abs(x1[:turned] - x1[0]).max():.2f}",
        f"{100 * np.linalg.norm(x2[turned] - both[1][m:]) / np.linalg.norm(both[1][m:] - both[0][m:]):.1f}",
        f"{np.abs(motion.q[-1] - home).max():.0e}",
        f"{time.process_time() - began:.0f}",
    ]


def main(quick: bool = False) -> list[str]:
    """Print the table."""
    header = "| x1 above x2 | law | x1 off [mm] | x2 off after 2 s [%] | joints off at the end [rad] | time [s] |\n"
    return table(header + "|" + " --- |" * 6, rows(quick))


if __name__ == "__main__":
    run(main, __doc__)
