"""Laws in xi against the textbook's operational space controller, in MuJoCo at 1 kHz: four tables (15 min).

The arm is the 7-DoF arm with cubic coordinates, A = M and default gains; `--robot panda` takes another one. Circles and
steps of 0.1 m need A = I: with A = M, the light wrist would turn beyond its part of the box. The peer has 6 Hz and the
damping ratio 0.7 in all directions of task and posture. The laws in xi have modes around 6 Hz and the same damping
ratio. All laws hold the same postures: those of the peer come from the chart's inverse map. `--tables circles` prints
one table alone.
"""

import argparse
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from arm_in_mujoco import Loop, Run, followed
from compared_laws import Law, laws_on
from default_gains import problem_of, starts_of
from reference_motions import RADIUS, TICK, Motion, circles, held, step_of

import orthocas as oc
from orthocas.tools.checks import Array

WEIGHTS = (1000, 30, 150, 1, 1000)
STEP = 0.04  # in x [m]
PUSH = 20.0  # [N]
TABLES = ("textbook", "loops", "friction", "circles")
Moves = list[list[tuple[Array, Motion]]]


def flange_error(chart: oc.Chart, run: Run, motion: Motion) -> float:
    """Largest distance of the flange from its reference [mm]."""
    wanted = motion.phi[: len(run.q), 0, : chart.m]
    return float(1e3 * np.linalg.norm(chart.x(run.q) - wanted, axis=1).max())


def elbow_motion(chart: oc.Chart, run: Run) -> float:
    """Largest motion of a joint's origin [mm]."""
    points = chart.problem.robot.joint_points(run.q)
    return float(1e3 * np.linalg.norm(points - points[0], axis=2).max())


def pushed(law: Law, chart: oc.Chart, starts: Array) -> Array:
    """Motions of the flange along and across pushes, and across at rest, (starts, axes, 3) [mm]; NaN if it left."""
    found = np.full((len(starts), 3, 3), np.nan)
    for q, row in zip(starts, found, strict=True):
        for axis, push in enumerate(PUSH * np.eye(3)):
            run = followed(law, chart.problem.robot, q, held(chart, q, 2.0), Loop(push=tuple(push)))
            moved = 1e3 * (chart.x(run.q) - chart.x(q))
            across = np.linalg.norm(np.delete(moved, axis, axis=1), axis=1)
            if not run.status:
                row[axis] = np.abs(moved[:, axis]).max(), across.max(), across[-1]
    return found


def hidden_energy(law: Law, chart: oc.Chart, starts: Array) -> float:
    """Largest energy at rest after steps of 0.1 m in x, while xi or the posture stays where it was [J]."""
    found = []
    for q in starts:
        for label in chart.labels[: chart.m]:
            motion = step_of(chart, q, label, RADIUS)
            motion.posture[:] = [q, 0 * q]
            run = followed(law, chart.problem.robot, q, motion)
            found.append(law.hidden(run.q[-1], motion))
    return max(found)


def contradicted(law: Law, chart: oc.Chart, starts: Array) -> tuple[float, int]:
    """The same at the first start, when each of the others becomes the posture, or its xi; and how many runs left."""
    found, q = [], starts[0]
    for other in starts[1:]:
        motion = held(chart, q, 3.0)
        share = np.minimum(1, TICK * np.arange(len(motion.phi)))[:, None]
        motion.posture[:, 0] += share * (other - q)
        motion.phi[:, 0, chart.m :] += share * (chart.phi(other) - chart.phi(q))[chart.m :]
        run = followed(law, chart.problem.robot, q, motion)
        found += [] if run.status else [law.hidden(run.q[-1], motion)]
    return max(found, default=np.nan), len(starts) - 1 - len(found)


def against_textbook(chart: oc.Chart, laws: list[Law], starts: Array) -> list[str]:
    """The first table: what a law does to the flange. Pushes count if no law leaves the domain."""
    robot, xis = chart.problem.robot, chart.labels[chart.m :]
    rows = [
        "| | flange while xi moves | elbow | push: along | across | across at rest | left | noise |",
        "|" + " --- |" * 8,
    ]
    moves = [(q, step_of(chart, q, xi)) for q in starts for xi in xis]
    pushes = np.array([pushed(law, chart, starts) for law in laws])
    stayed = np.isfinite(pushes).all(axis=(0, 3))
    for law, push in zip(laws, pushes, strict=True):
        runs = [(motion, followed(law, robot, q, motion)) for q, motion in moves]
        noise = [followed(law, robot, q, motion, Loop(encoders=True)).noise for q, motion in moves[: len(xis)]]
        words = [
            f"{max(flange_error(chart, run, motion) for motion, run in runs):.3f} mm",
            f"{max(elbow_motion(chart, run) for _, run in runs):.0f} mm",
            *(f"{value:.1f} mm" for value in push[stayed].max(axis=0)),
            f"{np.isnan(push[..., 0]).sum()} of {stayed.size}",
            f"{np.sqrt(np.mean(np.square(noise))):.2f} N m",
        ]
        rows.append(f"| {law.name} | {' | '.join(words)} |")
    print("\n".join(rows), flush=True)
    return rows


def returning(chart: oc.Chart, laws: list[Law], starts: Array, cycles: int) -> list[str]:
    """The third table: drift after circles without stops, and energy in springs that the task does not feel."""
    rows = ["| | drift | largest flange error | hidden energy: steps | other posture |", "|" + " --- |" * 5]
    motion = circles(chart, starts[0], cycles)
    for law in laws:
        run = followed(law, chart.problem.robot, starts[0], motion, Loop(stops=False))
        drift = run.status or f"{np.linalg.norm(run.q[-1] - starts[0]):.1e} rad"
        energy, left = contradicted(law, chart, starts)
        words = [
            f"{drift}",
            f"{flange_error(chart, run, motion):.2f} mm",
            f"{hidden_energy(law, chart, starts):.2g} J",
            f"{energy:.2g} J{f', {left} left' if left else ''}",
        ]
        rows.append(f"| {law.name} | {' | '.join(words)} |")
        print("\n".join(rows[-1:] if law is not laws[0] else rows), flush=True)
    return rows


LOOPS = {
    "1 kHz": Loop(),
    "delay 1 ms": Loop(delay=1),
    "delay 2 ms": Loop(delay=2),
    "delay 5 ms": Loop(delay=5),
    "200 Hz": Loop(every=5),
    "100 Hz": Loop(every=10),
    "14-bit encoders": Loop(encoders=True),
    "Coulomb friction": Loop(coulomb=1.0),
    "all: 200 Hz, 2 ms, encoders, friction": Loop(delay=2, every=5, encoders=True, coulomb=1.0),
}


def imperfect(chart: oc.Chart, laws: list[Law], starts: Array, loops: dict[str, Loop]) -> list[str]:
    """The second table: largest errors of the flange while x moves and while xi moves, and how many runs went wrong."""
    rows = [f"| | {' | '.join(law.name for law in laws)} |", "| --- |" + " --- |" * len(laws)]
    groups = ((chart.labels[: chart.m], STEP), (chart.labels[chart.m :], None))
    moves = [[(q, step_of(chart, q, label, size)) for q in starts for label in labels] for labels, size in groups]
    for name, loop in loops.items():
        words = [name, *(outcome(law, chart, moves, loop) for law in laws)]
        rows.append(f"| {' | '.join(words)} |")
        print("\n".join(rows[-1:] if len(rows) > 3 else rows), flush=True)
    return rows


def against_friction(chart: oc.Chart, laws: list[Law], starts: Array) -> list[str]:
    """The fourth table: what integral action and compensation do against Coulomb friction."""
    rows = ["| Coulomb friction | x moves: largest, at the end | xi moves |", "| --- | --- | --- |"]
    groups = ((chart.labels[: chart.m], STEP), (chart.labels[chart.m :], None))
    moves = [[(q, step_of(chart, q, label, size)) for q in starts for label in labels] for labels, size in groups]
    for law in laws:
        words = []
        for part in moves:
            runs = [(motion, followed(law, chart.problem.robot, q, motion, Loop(coulomb=1.0))) for q, motion in part]
            ends = [flange_error(chart, replace(run, q=run.q[-1:]), motion.at_end()) for motion, run in runs]
            words.append(f"{max(flange_error(chart, run, motion) for motion, run in runs):.2f}, {max(ends):.2f}")
            words[-1] += ", left" * any(run.status for _, run in runs)
        rows.append(f"| {law.name} | {' | '.join(words)} |")
        print("\n".join(rows[-1:] if len(rows) > 3 else rows), flush=True)
    return rows


def outcome(law: Law, chart: oc.Chart, moves: Moves, loop: Loop) -> str:
    """Errors of the flange, and what went wrong how often."""
    errors, bad = [], []
    for part in moves:
        runs = [(motion, followed(law, chart.problem.robot, q, motion, loop)) for q, motion in part]
        good = [flange_error(chart, run, motion) for motion, run in runs if not run.status]
        errors.append(max(good, default=np.nan))
        bad += [run.status for _, run in runs if run.status]
    told = "".join(f", {bad.count(why)} {why}" for why in sorted(set(bad)))
    return f"{errors[0]:.2f}, {errors[1]:.2f}{told}"


def main(quick: bool = False, robot: str = "iiwa", tables: Sequence[str] = TABLES) -> list[str]:
    """Print the tables; `quick` takes two starts, three circles and two loops."""
    rows, loops = [], dict(list(LOOPS.items())[:2]) if quick else LOOPS
    for metric in ("inertia", "euclidean"):
        wanted = [name for name in tables if (name == "circles") == (metric == "euclidean")]
        if not wanted:
            continue
        chart = oc.fit(problem_of(robot, "position", metric), oc.Polynomial(3), weights=WEIGHTS).chart
        starts = starts_of(chart.problem, 2 if quick else 5)
        with laws_on(chart) as laws:
            if "textbook" in wanted:
                rows += against_textbook(chart, laws[:4], starts)
            if "loops" in wanted:
                rows += imperfect(chart, laws[:4], starts[:3], loops)
            if "friction" in wanted:
                rows += against_friction(chart, [laws[0], *laws[5:], laws[3]], starts[:1] if quick else starts[:3])
            if "circles" in wanted:
                rows += returning(chart, laws[:5], starts, 3 if quick else 50)
    return rows


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--robot", default="iiwa", choices=("iiwa", "panda", "xarm7"))
    parser.add_argument("--tables", nargs="+", default=TABLES, choices=TABLES)
    arguments = parser.parse_args()
    main(arguments.quick, arguments.robot, arguments.tables)
