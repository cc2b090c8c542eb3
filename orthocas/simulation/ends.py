"""Whether a law kept its arm in a run."""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from orthocas.control.controller import Controller, ControlStatus
from orthocas.simulation.disturbances import Push
from orthocas.simulation.trajectory import Trajectory

_BEYOND = 1e-3  # [rad] or [m] beyond a joint limit: stops give way a little
_LASTING = 0.1  # [s] at the limit, from which on the storage must not rise


def why_lost(run: Trajectory, controller: Controller, pushes: Sequence[Push], supervised: bool) -> str:
    """Why a law lost its arm in a run, in words; empty if it kept it.

    It lost the arm where the arm left the domain of the law's chart, in which alone the law commands; with a law
    without a chart, where it left the joint limits. A supervised law may leave them and come back, and its catcher may
    hold the arm outside.

    It also lost the arm where motors were at their limit for more than 0.1 s, and the storage V, the energy of springs
    and motion, was larger after that time than before. This counts at the end of the run, and where the catcher of a
    supervised law had to take over meanwhile, without a push.

    Args:
        run: the run, in the quantities of the law.
        controller: the law.
        pushes: that acted on the arm.
        supervised: whether its supervised form ran.
    """
    away, what = _away(run, controller)
    held = supervised and run.status[-1] in (ControlStatus.CAUGHT, ControlStatus.RETURNING)
    if (away[-1] and not held) or (away.any() and not supervised):
        first, _ = next(_stretches(away))
        left = "was outside" if first == 0 else "left"
        return f"the arm {left} {what} at t = {run.times[first]:.4g} s"
    at_limit = np.abs(run.command) >= controller.gains["limit"]
    for first, last in _stretches(np.asarray(at_limit.any(axis=1))):
        since, until = run.times[[first, last]]
        pushed = any(push.start < until and push.end > since for push in pushes)
        caught = (run.status[first : last + 1] == ControlStatus.CAUGHT).any() and not pushed
        grows = run.storage[last] > run.storage[first]
        if (caught or last == len(run.times) - 1) and until - since > _LASTING and grows:
            joint = run.joint_names[int(np.argmax(at_limit[first : last + 1].sum(axis=0)))]
            return f"from t = {since:.4g} s to {until:.4g} s joint '{joint}' was at its limit, and errors grew"
    return ""


def _away(run: Trajectory, controller: Controller) -> tuple[NDArray[np.bool_], str]:
    """At which instants the arm is outside what the law respects, (N,), and what that is."""
    if controller.chart is not None:
        return np.asarray(~controller.problem.domain.contains(run.q)), "the domain of the chart"
    robot = controller.problem.robot
    beyond = (run.q < robot.lower - _BEYOND) | (run.q > robot.upper + _BEYOND)
    return np.asarray(beyond.any(axis=1)), "the joint limits"


def _stretches(true: NDArray[np.bool_]) -> Iterator[tuple[int, int]]:
    """First and last index of every run of true entries."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], true, [False]]).astype(int)))
    for first, end in edges.reshape(-1, 2).tolist():
        yield first, end - 1
