"""The status of a controller's output, and the guard that keeps the output finite and bounded."""

from enum import IntEnum

import casadi as ca
import numpy as np

from orthocas.domains import Conditioned, Domain, reach

LARGEST = 1e100  #: larger numbers count as not finite, because their squares may overflow
GUARD = "guard"  #: name of the guard's function
SMALLEST_VOLUME = 1e-3  #: of the parallelepiped of the gradients, relative to its median over the domain


class ControlStatus(IntEnum):
    """Tells whether a command comes from the control law, or why it is the fallback.

    The fallback is the gravity torque for torque controllers and zero for velocity controllers, within the limit. With
    SATURATED it still comes from the law, but the limit cuts it: torques one by one, velocities all by the same
    factor, which keeps the direction of the task.
    """

    OK = 0
    OUTSIDE_DOMAIN = 1
    SINGULAR = 2
    NOT_FINITE = 3
    SATURATED = 4
    NEAR_BORDER = 5  #: this and the following ones come from the supervised law in C
    CAUGHT = 6
    RETURNING = 7
    BAD_INPUT = 8
    TOO_FAST = 9  #: why the catcher took over: a joint was faster than its limit
    LATE = 10  #: why the catcher took over: a tick came too late

    @property
    def words(self) -> str:
        """For example 'near border'."""
        return self.name.lower().replace("_", " ")


#: statuses of commands that are not the fallback
FROM_THE_LAW = (ControlStatus.OK, ControlStatus.SATURATED, ControlStatus.NEAR_BORDER)


def guard(domain: Domain | None, n: int, numbers: int, keep_direction: bool) -> ca.Function:
    """Choose the command if all is well and the fallback otherwise, cut it to +- limit, and report the status.

    Args:
        domain: where the law is valid; None for everywhere.
        n: number of joints.
        numbers: count of input numbers of the law.
        keep_direction: whether the limit scales the whole command, instead of cutting entries one by one.

    Returns:
        A function with the outputs command (n, 1) and status (1, 1). Its inputs are: the command of the law (n, 1),
        which may be NaN; the fallback (n, 1), whose entries become zero where they are not finite; the limit (n, 1) of
        each entry, which may be infinite; q (n, 1); all input numbers of the law; and det(J A^-1 J^T) relative to its
        median over the domain, and the smallest regular value of that.
    """
    command, fallback, limit, q = (ca.SX.sym(name, n) for name in ("command", "fallback", "limit", "q"))
    inputs, volume, smallest = ca.SX.sym("inputs", numbers), ca.SX.sym("volume"), ca.SX.sym("smallest")
    regular = ca.logic_and(volume > smallest, _all_finite(command))
    status = ca.if_else(regular, float(ControlStatus.OK), float(ControlStatus.SINGULAR))
    status = ca.if_else(_is_inside(domain, q), status, float(ControlStatus.OUTSIDE_DOMAIN))
    meant = ca.logic_and(_all_finite(inputs), _all(limit > 0))
    status = ca.if_else(meant, status, float(ControlStatus.NOT_FINITE))
    from_law = status == float(ControlStatus.OK)
    chosen = _chosen(from_law, command, fallback)
    cut = _cut(chosen, limit, keep_direction)
    saturated = ca.logic_and(from_law, ca.logic_not(_all(ca.fabs(chosen) <= limit)))
    status = ca.if_else(saturated, float(ControlStatus.SATURATED), status)
    given = [command, fallback, limit, q, inputs, volume, smallest]
    names = ["command", "fallback", "limit", "q", "inputs", "volume", "smallest"]
    return ca.Function(GUARD, given, [cut, status], names, ["cut", "status"])


def _chosen(from_law: ca.SX, command: ca.SX, fallback: ca.SX) -> ca.SX:
    rows = range(command.shape[0])
    safe = [ca.if_else(_is_finite(fallback[i]), fallback[i], 0) for i in rows]
    return ca.vertcat(*(ca.if_else(from_law, command[i], safe[i]) for i in rows))


def _cut(command: ca.SX, limit: ca.SX, keep_direction: bool) -> ca.SX:
    """The command within +- limit; zero where the limit is NaN or not > 0."""
    rows = range(command.shape[0])
    bound = ca.vertcat(*(ca.if_else(limit[i] > 0, limit[i], 0) for i in rows))
    if keep_direction:
        excess = [ca.if_else(ca.fabs(command[i]) > bound[i], ca.fabs(command[i]) / bound[i], 1) for i in rows]
        command = command / ca.mmax(ca.vertcat(1, *excess))
    return ca.fmin(ca.fmax(command, -bound), bound)


def _is_inside(domain: Domain | None, q: ca.SX) -> ca.SX:
    """Whether q (n, 1) lies in the domain: between its borders, and where its condition holds, if it has one."""
    clear = _all(domain.pivots(q) > 0) if isinstance(domain, Conditioned) else ca.SX(1)
    return ca.logic_and(_is_between_borders(domain, q), clear)


def _is_between_borders(domain: Domain | None, q: ca.SX) -> ca.SX:
    """Whether q (n, 1) lies in the box; always true for joints without borders, such as the angles of a torus."""
    widths = np.full(q.shape[0], np.inf) if domain is None else reach(domain)
    bounded = np.flatnonzero(np.isfinite(widths)).tolist()
    if domain is None or not bounded:
        return ca.SX(1)
    return _all(ca.fabs(q[bounded] - ca.DM(domain.centre[bounded])) <= ca.DM(widths[bounded]))


def _is_finite(value: ca.SX) -> ca.SX:
    """Whether a number is finite; false also for NaN, since comparisons with NaN are false."""
    return ca.fabs(value) <= LARGEST


def _all_finite(values: ca.SX) -> ca.SX:
    return _all(_is_finite(values))


def _all(conditions: ca.SX) -> ca.SX:
    """Whether all conditions hold. Their sum needs no branches, and less code than `ca.logic_all`."""
    return ca.sum1(conditions) == conditions.shape[0]
