"""All postures of an arm with x and xi, against Newton's method from 20,000 random starts (20 min).

On four arms with charts of all branches, and one of random shape that is fitted here: x and xi are those of random
postures in the charts' domains. `Arm.solve(..., all=True)` is asked for all postures in that chart. Newton's method on
(x, xi), from random starts within the limits, is NumPy of this file: kinematics come from the numbers of the robot, and
only xi and its gradient from the chart. Ends within the limits and the domain count, up to full turns of joints without
limits. `--quick` takes one arm, two targets and 500 starts.
"""

import time

import numpy as np
from arm import random_arm
from benchmark import run, table

import orthocas as oc
from orthocas.tools.checks import Array
from orthocas.tools.expressions import wrap_shortest

READY = ("panda", "iiwa7", "xarm7", "baxter-left")
RANDOM = 1  # seed of the fifth arm
TARGETS, STARTS = 100, 20_000
ROUNDS, LONGEST, LOST = 30, 0.7, 0.5  # of Newton's method; rows with such an error after a third of them end
MET, SAME = 1e-9, 1e-6  # errors of x and xi; distance of postures that are the same [rad]


def find_pose(robot: oc.Robot, q: Array) -> tuple[Array, Array, Array]:
    """Position (N, 3), rotation (N, 3, 3) and Jacobian (N, 6, n) of the tip at postures (N, n), in the world's axes."""
    tree, N = robot.tree, len(q)
    R, p = np.tile(np.eye(3), (N, 1, 1)), np.zeros((N, 3))
    axes, places = np.empty((N, 3, robot.n)), np.empty((N, 3, robot.n))
    for k in range(robot.n):
        p = p + R @ tree.translations[k]
        c, s = np.cos(q[:, k]), np.sin(q[:, k])
        turn = np.zeros((N, 3, 3))
        turn[:, 0, 0], turn[:, 0, 1], turn[:, 1, 0], turn[:, 1, 1], turn[:, 2, 2] = c, -s, s, c, 1.0
        R = R @ tree.rotations[k] @ turn
        axes[:, :, k], places[:, :, k] = R[:, :, 2], p
    p = p + R @ tree.tip_translation
    J = np.concatenate([np.cross(axes, p[:, :, None] - places, axis=1), axes], axis=1)
    return p, R @ tree.tip_rotation, J


def newton(chart: oc.Chart, posture: Array, q: Array) -> Array:
    """Postures with the pose and xi of a posture (n,) to which starts (S, n) lead, those in the domain, once each."""
    robot, period = chart.robot, chart.parts.turns[chart.m :]
    (position,), (rotation,), _ = find_pose(robot, posture[None])
    xi, done = chart.xi(posture), np.zeros((0, robot.n))
    for k in range(ROUNDS):
        if not len(q):
            break
        p, R, J = find_pose(robot, q)
        across = rotation @ R.transpose(0, 2, 1)
        axis = np.stack([across[:, i, j] - across[:, j, i] for i, j in ((2, 1), (0, 2), (1, 0))], axis=1) / 2
        sine = np.linalg.norm(axis, axis=1)
        angle = np.arctan2(sine, (np.trace(across, axis1=1, axis2=2) - 1) / 2)
        turn = axis * (angle / np.maximum(sine, 1e-300))[:, None]
        e = np.hstack([position - p, turn, wrap_shortest(xi - chart.xi(q), period)])
        error = np.abs(e).max(axis=1)
        done = np.vstack([done, q[error < MET / 10]])
        left = np.isfinite(error) & (error >= MET / 10) & ((error < LOST) | (k < ROUNDS // 3))
        q, e, error = q[left], e[left], error[left]
        rows = np.concatenate([J[left], chart.coordinates.jacobian(q)], axis=1)
        gram = rows @ rows.transpose(0, 2, 1)
        damping = np.where(error > 0.1, 1e-3, np.where(error > 1e-3, 1e-6, 1e-14)) * np.trace(gram, axis1=1, axis2=2)
        y = np.linalg.solve(gram + damping[:, None, None] * np.eye(robot.n), e[:, :, None])
        step = (rows.transpose(0, 2, 1) @ y)[:, :, 0]
        q = q + step * np.minimum(1.0, LONGEST / np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1e-300))
    done = np.array(list_different(robot, wrap_shortest(done, np.full(robot.n, 2 * np.pi)))).reshape(-1, robot.n)
    # Full turns within the limits do not change the pose; what they do to xi is looked at again.
    for k in np.flatnonzero(np.isfinite(robot.lower)):
        done = np.vstack([done + turns * 2 * np.pi * np.eye(robot.n)[k] for turns in (-1, 0, 1)])
        done = done[(done[:, k] >= robot.lower[k]) & (done[:, k] <= robot.upper[k])]
    done = done[(np.abs(wrap_shortest(xi - chart.xi(done), period)) < MET).all(axis=1)] if len(done) else done
    done = done[np.asarray(chart.domain.contains(done))] if len(done) else done
    return np.array(list_different(robot, done)).reshape(-1, robot.n)


def list_different(robot: oc.Robot, q: Array) -> list[Array]:
    """Postures (N, n), each once."""
    kept: list[Array] = []
    for posture in q:
        if not is_among(robot, posture, np.array(kept)):
            kept.append(posture)
    return kept


def is_among(robot: oc.Robot, posture: Array, q: Array) -> bool:
    """Whether a posture (n,) is one of several (N, n), up to full turns of joints without limits."""
    turns = np.where(np.isinf(robot.lower), 2 * np.pi, 0.0)
    return bool(len(q)) and bool((np.abs(wrap_shortest(q - posture, turns)).max(axis=1) < SAME).any())


def main(quick: bool = False) -> dict[str, float]:
    """Print a table, and return its numbers."""
    result: dict[str, float] = {}

    def measure(name: str | int) -> str:
        arm = oc.Arm.load(name) if isinstance(name, str) else oc.Arm.fit(random_arm(name))
        rng, robot, label = np.random.default_rng(11), arm.robot, name if isinstance(name, str) else f"random {name}"
        low, high = np.maximum(robot.lower, -np.pi), np.minimum(robot.upper, np.pi)
        # All is built before times are taken.
        arm.solve(arm.x(arm.charts[0].domain.home), 0.0, all=True)
        own = theirs = missed = 0
        seconds = []
        for k in range(2 if quick else TARGETS):
            number = int(rng.integers(len(arm.charts)))
            chart = arm.charts[number]
            posture = np.asarray(chart.domain.sample(1, k))[0]
            x, xi, branch = arm.x(posture), float(chart.xi(posture)[0]), arm.branch_names[number]
            began = time.perf_counter()
            found = arm.solve(x, xi, branch=branch, all=True).q
            seconds.append(time.perf_counter() - began)
            ends = newton(chart, posture, rng.uniform(low, high, (500 if quick else STARTS, robot.n)))
            own, theirs = own + len(found), theirs + len(ends)
            missed += sum(not is_among(robot, q, found) for q in ends)
        ms = 1e3 * float(np.median(seconds))
        result.update(
            {f"{label}, missed": missed, f"{label}, Newton": theirs, f"{label}, arm": own, f"{label}, ms": ms}
        )
        return f"| {label} | {len(arm.charts)} | {len(seconds)} | {own} | {theirs} | {missed} | {ms:.2f} |"

    columns = (
        "arm",
        "charts",
        "targets",
        "postures of the arm",
        "Newton's postures",
        "of these missed",
        "one call [ms]",
    )
    names = READY[:1] if quick else (*READY, RANDOM)
    table(f"| {' | '.join(columns)} |\n|{' --- |' * len(columns)}", map(measure, names))
    return result


if __name__ == "__main__":
    run(main, __doc__)
