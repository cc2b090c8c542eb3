"""Named problems and their data."""

from collections.abc import Callable

from orthocas.problems import arms, propellers
from orthocas.tasks.problem import Problem
from orthocas.tools.checks import require_known

__all__ = ["get", "names"]

_PROBLEMS: dict[str, Callable[[], Problem]] = {
    "planar_2r": arms.planar_2r,
    "planar_3r_x": arms.planar_3r_x,
    "planar_3r_xy": arms.planar_3r_xy,
    "iiwa": arms.iiwa,
    "hexarotor": propellers.hexarotor,
}


def names() -> tuple[str, ...]:
    """Names of all named problems."""
    return tuple(_PROBLEMS)


def get(name: str) -> Problem:
    """Build a named problem.

    Raises:
        UnknownNameError: if there is no such problem.
    """
    require_known("problem", name, _PROBLEMS)
    return _PROBLEMS[name]()
