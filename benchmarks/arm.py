"""How many of an arm's postures `orthocas.Arm` finds for a pose, and how long that takes (12 min).

On four arms and three of random shape, at poses of random postures within the limits: the curves that the stored starts
lead to, against those of 20,000 random starts. Their lengths within the limits are compared, and each random posture is
looked for on the arcs of its pose, which does not know it. Plain damped Newton's methods in NumPy, from 1,000 random
starts at some of the poses, end within the limits at postures that are looked for as well. Times are of one thread.
`--quick` takes two arms and few poses.
"""

import time
from dataclasses import dataclass

import numpy as np
from benchmark import run

import orthocas as oc
from orthocas.arms.kernel import Curve, evaluate_cubic
from orthocas.arms.self_motion import SelfMotions, cut_curve, find_motions
from orthocas.robots.tree import KinematicTree
from orthocas.tools.checks import Array

READY = ("panda-wide", "iiwa7-wide", "xarm7-wide", "baxter-left-wide")
SEEDS = (1, 2, 3)  # of random arms
POSES, NEWTON_POSES, DENSE, STARTS = 100, 20, 20_000, 1000
NEAR = 0.015  # [rad] between points of curves: they are one
SAME = 1e-6  # [rad] from an arc: the posture is on it


def random_arm(seed: int, n: int = 7) -> oc.Robot:
    """n joints of limits -2.6 and 2.6, axes tilted by right angles and up to 12 degrees, links of 0.2 m."""
    rng = np.random.default_rng(seed)
    offsets = rng.uniform(-0.05, 0.05, (n, 3)) + np.array([0.0, 0.0, 0.2])
    right = np.where(np.arange(n) % 2, -np.pi / 2, np.pi / 2) * (np.arange(n) > 0)
    roll, pitch = right + rng.uniform(-0.2, 0.2, n), rng.uniform(-0.1, 0.1, n)
    turns = []
    for a, b in zip(roll, pitch, strict=True):
        about_x = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
        about_y = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
        turns.append(about_y @ about_x)
    return oc.Robot(
        KinematicTree(
            joint_names=tuple(f"j{k + 1}" for k in range(n)),
            joint_kinds=("revolute",) * n,
            parents=tuple(range(-1, n - 1)),
            rotations=np.array(turns),
            translations=offsets,
            masses=np.ones(n),
            centres=np.zeros((n, 3)),
            inertias=np.tile(np.eye(3) * 0.01, (n, 1, 1)),
            armatures=np.zeros(n),
            lower=np.full(n, -2.6),
            upper=np.full(n, 2.6),
            effort_limits=np.full(n, 50.0),
            velocity_limits=np.full(n, 2.0),
            tip_name="tip",
            tip_parent=n - 1,
            tip_rotation=np.eye(3),
            tip_translation=np.array([0.0, 0.0, 0.1]),
            gravity=np.array([0.0, 0.0, -9.81]),
        )
    )


@dataclass(frozen=True)
class Pose:
    """What was found at a pose."""

    seconds: float  #: of the curves
    call: float  #: of one call of `find_motions`
    curves: int
    share: float  #: of the length that the dense search finds
    gap: float  #: of the random posture from the arcs


def look(arm: oc.Arm, q: Array, pool: Array) -> Pose:
    """Both searches at the pose of a posture (n,); the dense one begins there, and at postures of a pool (S, n)."""
    maps = arm.maps
    target = maps.targets_of(q[None])[0]
    began = time.perf_counter()
    mine = maps.find_curves(target)
    middle = time.perf_counter()
    found = find_motions(maps, target)
    ended = time.perf_counter()
    dense = maps.kernel.find_curves(target, np.vstack([q, pool]), len(pool) + 1)
    lengths = np.array([sum(arc.length for arc in cut_curve(maps, target, curve)) for curve in dense])
    known = np.array([any(is_same(other, curve) for other in mine) for curve in dense])
    gap = found.nearest(q).value if found.components else np.inf
    return Pose(middle - began, ended - middle, found.curves, float(lengths[known].sum() / lengths.sum()), gap)


def is_same(curve: Curve, other: Curve) -> bool:
    """Whether points of another curve are on a curve, up to full turns: near points of it at most 0.02 rad apart."""
    parts = (curve.q[:-1], curve.q[1:], curve.tangent[:-1], curve.tangent[1:], curve.length[:-1, None])
    points, along = evaluate_cubic(*(part[:, None] for part in parts), np.linspace(0, 1, 21)[None, :, None])
    for row in (0, len(other.q) // 3, len(other.q) // 2):
        away = points - other.q[row]
        away = np.linalg.norm(away - 2 * np.pi * np.rint(away / (2 * np.pi)), axis=2)
        k = np.unravel_index(np.argmin(away), away.shape)
        if not (away[k] < NEAR and along[k] @ other.tangent[row] > 0):
            return False
    return True


def newton(arm: oc.Arm, target: Array, q: Array) -> Array:
    """Postures within the limits with the target to which damped least squares lead from starts (S, n), in NumPy."""
    lower, upper, targets, q = arm.robot.lower, arm.robot.upper, np.tile(target, (len(q), 1)), q.copy()
    for _ in range(40):
        e, J = arm.maps.evaluate(q, targets)
        error, gram = np.abs(e).max(axis=1), J @ J.transpose(0, 2, 1)
        damping = np.where(error > 0.1, 1e-2, np.where(error > 1e-3, 1e-6, 1e-14)) * np.trace(gram, axis1=1, axis2=2)
        y = np.linalg.solve(gram + damping[:, None, None] * np.eye(e.shape[1]), e[:, :, None])
        step = (J.transpose(0, 2, 1) @ y)[:, :, 0]
        q += step * np.minimum(1.0, 0.7 / np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1e-300))
    q = lower + (q - lower) % (2 * np.pi)
    return np.asarray(q[(np.abs(arm.maps.evaluate(q, targets)[0]).max(axis=1) < 1e-9) & (q <= upper).all(axis=1)])


def count_missed(motions: SelfMotions, q: Array) -> int:
    """Of postures (N, n), those that are on no arc."""
    return sum(not motions.components or motions.nearest(posture).value > SAME for posture in q)


def main(quick: bool = False) -> dict[str, float]:
    """Print a table, and return its numbers."""
    found: dict[str, float] = {}
    columns = ("arm", "curves a pose", "curves: median, 99 % [ms]", "one call: median [ms]", "length of the dense [%]")
    columns += ("worst pose [%]", "random postures found", "Newton's postures missed")
    print(f"| {' | '.join(columns)} |\n|{' --- |' * len(columns)}")
    names = [*READY[:1], *SEEDS[:1]] if quick else [*READY, *SEEDS]
    for name in names:
        robot = oc.load(name).problem.robot if isinstance(name, str) else random_arm(name)
        arm, rng = oc.Arm(oc.Task.pose(robot)), np.random.default_rng(7)
        find_motions(arm.maps, arm.maps.targets_of(np.zeros((1, robot.n)))[0])  # all is built before times are taken
        low, high = np.maximum(robot.lower, -np.pi), np.minimum(robot.upper, np.pi)
        pool = rng.uniform(low, high, (500 if quick else DENSE, robot.n))
        postures = rng.uniform(low, high, (5 if quick else POSES, robot.n))
        poses = [look(arm, q, pool) for q in postures]
        of = {key: np.array([getattr(pose, key) for pose in poses]) for key in Pose.__annotations__}
        missed = seen = 0
        for target in arm.maps.targets_of(postures[: 2 if quick else NEWTON_POSES]):
            ends = newton(arm, target, rng.uniform(low, high, (100 if quick else STARTS, robot.n)))
            missed, seen = missed + count_missed(find_motions(arm.maps, target), ends), seen + len(ends)
        ms, label = 1e3 * of["seconds"], name if isinstance(name, str) else f"random {name}"
        share, worst = (np.floor(1e5 * value) / 1e3 for value in (of["share"].mean(), of["share"].min()))
        there = int((of["gap"] < SAME).sum())
        print(
            f"| {label} | {of['curves'].mean():.1f} | {np.median(ms):.2f}, {np.quantile(ms, 0.99):.2f} "
            f"| {1e3 * np.median(of['call']):.2f} | {share:.3f} | {worst:.3f} | {there} of {len(poses)} "
            f"| {missed} of {seen} |",
            flush=True,
        )
        found |= {f"{label}, ms": float(np.median(ms)), f"{label}, share": float(share)}
        found |= {f"{label}, worst": float(worst), f"{label}, found": there / len(poses)}
        found |= {f"{label}, missed": float(missed)}
    return found


if __name__ == "__main__":
    run(main, __doc__)
