"""What a proof on the half-widths of unbounded joints says about all their positions (ours)."""

from collections.abc import Collection

import casadi as ca
import numpy as np

from orthocas.casadi_tools.batch import dense_function
from orthocas.casadi_tools.structure import gradient_dependences, periodic_joints
from orthocas.casadi_tools.tape import Tape, to_tape
from orthocas.chart import Chart
from orthocas.coordinates.fitted import Coordinates
from orthocas.domains import borders
from orthocas.errors import CertifyError
from orthocas.parametrisations.family import Family, LinearFamily
from orthocas.parametrisations.mlp import MLPFamily


def require_all_positions(chart: Chart, variables: Collection[int]) -> None:
    """Raise CertifyError unless a proof for the half-widths of unbounded joints is one for all their positions.

    It is one for a joint that is not among the variables of the proof, and for a revolute joint whose half-width is at
    least half a turn, if J is the same after a full turn of it. No word of the file is taken for that: the steps of h
    and of xi are read. The joints of a torus are unbounded.
    """
    problem = chart.problem
    endless = np.flatnonzero(np.isinf(borders(problem.domain)[1])).tolist()
    asked = [joint for joint in endless if joint in variables]
    if not asked:
        return
    alike = _same_after_turns(chart)
    for joint in asked:
        name = problem.robot.joint_names[joint]
        if problem.robot.tree.prismatic[joint] or problem.domain.half_width[joint] < np.pi:
            raise CertifyError(f"joint '{name}' is unbounded and J depends on it, expected bounds, or a full turn")
        if joint not in alike:
            raise CertifyError(
                f"joint '{name}' is unbounded and J is not periodic in it, expected bounds, or a task and coordinates "
                "that are (Fourier, networks of sines and cosines, or a linear term only)"
            )


def _same_after_turns(chart: Chart) -> set[int]:
    """The joints whose full turns change neither J_x nor J_xi."""
    coordinates = chart.coordinates
    assert isinstance(coordinates, Coordinates)  # `chart_rows` has refused others
    task = _alike(to_tape(chart.problem.task.function), chart.n)
    if not len(coordinates.offset):
        return task
    own = _family_alike(coordinates.family, len(coordinates.active), coordinates)
    return task & {*coordinates.idle, *(coordinates.active[i] for i in own)}


def _family_alike(family: Family, n: int, coordinates: Coordinates) -> set[int]:
    """The same for the coordinates of a family of n joints."""
    if isinstance(family, MLPFamily):
        return {i for i, direct in enumerate(family.direct) if not direct}
    q = ca.SX.sym("q", n)
    if isinstance(family, LinearFamily):
        values = family.basis(q)
    else:
        values = family.expression(q, ca.SX(ca.DM(coordinates.theta)))
    return _alike(to_tape(dense_function("values", [q], [values])), n)


def _alike(tape: Tape, n: int) -> set[int]:
    """The joints whose full turns do not change a gradient."""
    needed = {k for row in gradient_dependences(tape) for joints in row.values() for k in joints}
    return {k for k in range(n) if k not in needed} | periodic_joints(tape, n)
