"""What a controller says about its own output, and the guard that keeps that output finite and bounded."""

from enum import IntEnum

import casadi as ca

from orthocas.domains import Domain, Torus, reach

LARGEST = 1e100  #: numbers beyond are treated as not finite: their squares may overflow
_SMALLEST_VOLUME = 1e-3  # of the parallelepiped of the gradients, relative to its median over the domain


class ControlStatus(IntEnum):
    """Whether a command comes from the control law, or is the fallback, and why.

    The fallback is the gravity torque for torque controllers and zero for velocity controllers, within the limit.
    """

    OK = 0
    OUTSIDE_DOMAIN = 1
    SINGULAR = 2
    NOT_FINITE = 3


def guard(domain: Domain | None, n: int, numbers: int) -> ca.Function:
    """The command if all is well, otherwise the fallback, both cut to +- limit; and the status.

    Args:
        domain: where the law is good; None for everywhere.
        n: number of joints.
        numbers: how many numbers the law got as input.

    Returns:
        A function of the command of the law (n, 1), which may be NaN; the fallback (n, 1), whose entries become zero
        where they are not finite; the limit (n, 1) of each entry, which may be infinite; q (n, 1); all numbers the law
        got; and det(J A^-1 J^T) relative to its median over the domain. It gives command (n, 1) and status (1, 1).
    """
    command, fallback, limit, q = (ca.SX.sym(name, n) for name in ("command", "fallback", "limit", "q"))
    inputs, volume = ca.SX.sym("inputs", numbers), ca.SX.sym("volume")
    regular = ca.logic_and(volume > _SMALLEST_VOLUME**2, _all_finite(command))
    status = ca.if_else(regular, float(ControlStatus.OK), float(ControlStatus.SINGULAR))
    status = ca.if_else(_is_inside(domain, q), status, float(ControlStatus.OUTSIDE_DOMAIN))
    meant = ca.logic_and(_all_finite(inputs), ca.logic_all(limit > 0))
    status = ca.if_else(meant, status, float(ControlStatus.NOT_FINITE))
    rows = []
    for i in range(n):
        safe = ca.if_else(_is_finite(fallback[i]), fallback[i], 0)
        chosen = ca.if_else(status == float(ControlStatus.OK), command[i], safe)
        bound = ca.if_else(limit[i] > 0, limit[i], 0)  # also where it is NaN
        rows.append(ca.fmin(ca.fmax(chosen, -bound), bound))
    return ca.Function("guard", [command, fallback, limit, q, inputs, volume], [ca.vertcat(*rows), status])


def _is_inside(domain: Domain | None, q: ca.SX) -> ca.SX:
    """Whether q (n, 1) lies in the domain; angles of a torus always do."""
    if domain is None or isinstance(domain, Torus):
        return ca.SX(1)
    return ca.logic_all(ca.fabs(q - ca.DM(domain.centre)) <= ca.DM(reach(domain)))


def _is_finite(value: ca.SX) -> ca.SX:
    """False for NaN too, since comparisons with NaN are."""
    return ca.fabs(value) <= LARGEST


def _all_finite(values: ca.SX) -> ca.SX:
    return ca.logic_all(_is_finite(values))
