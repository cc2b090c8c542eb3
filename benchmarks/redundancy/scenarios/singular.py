"""Through a singular posture: does the tool go on where the arm can?"""

import numpy as np
from scipy.optimize import minimize

from orthocas.tools.checks import Array
from redundancy.arms import Arm
from redundancy.paths import smooth
from redundancy.protocol import Run, Scenario, Score, Stream, Target

COUNT, TICKS, REST = 4, 150, 20
FAR, AROUND, MARGIN = 0.4, 1.0, 0.1  # of the motion to both sides; of a singular posture from home; from limits [rad]
SINGULAR, TRIES = 1e-4, 40  # least singular value of such a posture


def streams(arm: Arm, rng: np.random.Generator, quick: bool) -> list[Stream]:
    """Poses of straight joint motions through singular postures near home: joints can follow, and need not hurry."""
    found = []
    for _ in range(2 if quick else COUNT):
        q, way = find_singular(arm, rng), rng.normal(size=arm.n)
        way *= FAR / np.abs(way).max()
        begin = np.clip(q - way, arm.lower, arm.upper)
        end = np.clip(2 * q - begin, arm.lower, arm.upper)
        path = [Target(arm.placement(begin + s * (end - begin)), begin) for s in smooth(TICKS)]
        found.append(Stream(begin, path + [path[-1]] * REST, known=False))
    return found


def find_singular(arm: Arm, rng: np.random.Generator) -> Array:
    """A posture near home, away from the limits, whose Jacobian loses a rank (n,)."""
    low, high = np.maximum(arm.home - AROUND, arm.lower + MARGIN), np.minimum(arm.home + AROUND, arm.upper - MARGIN)
    low, high = np.minimum(low, high), np.maximum(low, high)

    def least(q: Array) -> float:
        return float(np.linalg.svd(arm.jacobian(q), compute_uv=False)[-1] ** 2)

    best = arm.home
    for _ in range(TRIES):
        end = minimize(least, rng.uniform(low, high), method="L-BFGS-B", bounds=list(zip(low, high, strict=True))).x
        best = min(best, end, key=least)
        if least(best) < SINGULAR**2:
            break
    return np.asarray(best)


def judge(arm: Arm, runs: list[Run]) -> Score:
    """Share of motions that are not followed."""
    return Score(100 * float(np.mean([not run.followed for run in runs])), True)


SCENARIO = Scenario(
    "singular",
    "Through a singular posture",
    "motions through singular postures not followed [%]",
    {
        "https://github.com/moveit/moveit/issues/3069": "the robot often halts at singularities. This is especially "
        "problematic when rotating.",
        "https://github.com/moveit/moveit2/issues/3411": 'every time it says "Very close to a singularity, emergency '
        'stop".',
    },
    streams,
    judge,
    percent=True,
    served="the method ran",
)
