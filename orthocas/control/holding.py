"""Whether the motors of an arm can hold it against gravity."""

import numpy as np

from orthocas.robots.robot import Robot
from orthocas.tasks.domains import Domain
from orthocas.tasks.samples import sample_uniform
from orthocas.tools.checks import Array
from orthocas.tools.display import percent

_SAMPLES = 512  # of the domain


def holding_doubts(robot: Robot, domain: Domain, limit: Array) -> list[str]:
    """What to know of an arm whose motors cannot hold it: one sentence, or none if they can at all samples.

    A joint is held at q if |g_i(q)| <= limit_i. The sentence names the joint that lacks most at the centre of the
    domain, or else at the worst sample, and the share of uniform samples at which some joint is not held, rounded up.

    Args:
        robot: the arm, with its payload.
        domain: where it is to be held.
        limit: largest torque or force of each joint, (n,) [N m] or [N], infinite where there is none.
    """
    points = np.vstack([domain.centre, sample_uniform(domain, _SAMPLES, 0)])
    needed = np.abs(robot.gravity(points))
    excess = needed / limit
    heavy = (excess > 1).any(axis=1)
    if not heavy.any():
        return []
    worst = 0 if heavy[0] else int(np.argmax(excess.max(axis=1)))
    joint = int(np.argmax(excess[worst]))
    unit = "N" if robot.tree.prismatic[joint] else "N m"
    where, most = ("at the centre of", "") if heavy[0] else ("everywhere in", "up to ")
    share = percent(heavy[1:].mean(), fault=True)
    return [
        f"the motors cannot hold the arm {where} the domain: gravity needs {most}{needed[worst, joint]:.4g} {unit} at "
        f"joint '{robot.joint_names[joint]}', the limit is {limit[joint]:.4g} {unit}, and at {share} of "
        f"{_SAMPLES} samples of the domain gravity alone exceeds a limit"
    ]
