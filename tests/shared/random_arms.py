"""Serial arms of random shape, for tests that no arm may pass by luck."""

import numpy as np
from scipy.spatial.transform import Rotation

import orthocas as oc
from orthocas.robots.tree import KinematicTree

SPATIAL_TASKS = ("position", "position:xy", "orientation", "axis", "axis:y", "pose", "pose:z", "position+axis")


def random_arm(rng: np.random.Generator, n: int, slides: float = 0.1) -> oc.Robot:
    """A chain of n joints: half of the twists are multiples of a right angle, as in arms that are built."""
    square = rng.uniform(size=n + 1) < 0.5
    turns = np.where(
        square[:, None], rng.integers(0, 4, (n + 1, 3)) * np.pi / 2, rng.uniform(-np.pi, np.pi, (n + 1, 3))
    )
    rotations = np.round(Rotation.from_euler("xyz", turns).as_matrix(), 12)
    rotations = np.linalg.svd(rotations)[0] @ np.linalg.svd(rotations)[2]
    return oc.Robot(
        KinematicTree(
            joint_names=tuple(f"j{k + 1}" for k in range(n)),
            joint_kinds=tuple("prismatic" if slide else "revolute" for slide in rng.uniform(size=n) < slides),
            parents=tuple(range(-1, n - 1)),
            rotations=rotations[:n],
            translations=rng.uniform(-0.4, 0.4, (n, 3)) * (rng.uniform(size=(n, 3)) < 0.6),
            masses=np.ones(n),
            centres=np.zeros((n, 3)),
            inertias=np.tile(np.eye(3) * 0.01, (n, 1, 1)),
            armatures=np.zeros(n),
            lower=np.full(n, -6.0),
            upper=np.full(n, 6.0),
            effort_limits=np.full(n, np.inf),
            velocity_limits=np.full(n, np.inf),
            tip_name="tip",
            tip_parent=n - 1,
            tip_rotation=rotations[n],
            tip_translation=rng.uniform(-0.3, 0.3, 3),
            gravity=np.array([0.0, 0.0, -9.81]),
        )
    )


def second_solutions(chart: oc.Chart, low: np.ndarray, high: np.ndarray, starts: int, seed: int) -> np.ndarray:
    """Pairs (q, p), (k, 2, n), of different points of a box with the same phi, by Newton's method from many starts."""
    rng = np.random.default_rng(seed)
    q, p = rng.uniform(low, high, (2, starts, chart.n))
    q[::2] = np.where(rng.uniform(size=(len(q[::2]), chart.n)) < 0.5, low, high)  # half of them in corners
    target = chart.phi(q)
    for _ in range(25):
        J, missing = np.nan_to_num(chart.jacobian(p)), np.nan_to_num(target - chart.phi(p))
        Jt = J.transpose(0, 2, 1)
        step = np.linalg.solve(Jt @ J + 1e-9 * np.eye(chart.n), Jt @ missing[:, :, None])
        p = np.clip(p + np.clip(step[:, :, 0], -0.5, 0.5), low, high)
    same = np.abs(chart.phi(p) - target).max(axis=1) < 1e-10
    apart = np.abs(p - q).max(axis=1) > 1e-4
    found: np.ndarray = np.stack([q, p], axis=1)[same & apart]
    return found
