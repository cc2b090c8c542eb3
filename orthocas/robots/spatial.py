"""Small pieces of rigid-body algebra on CasADi SX columns."""

import casadi as ca

from orthocas.checks import Array


def skew(v: ca.SX) -> ca.SX:
    """[v]x with [v]x w = v x w, (3, 3)."""
    x, y, z = ca.vertsplit(v)
    return ca.vertcat(ca.horzcat(0, -z, y), ca.horzcat(z, 0, -x), ca.horzcat(-y, x, 0))


def turn(q: ca.SX) -> ca.SX:
    """Rz(q), (3, 3)."""
    c, s = ca.cos(q), ca.sin(q)
    return ca.vertcat(ca.horzcat(c, -s, 0), ca.horzcat(s, c, 0), ca.horzcat(0, 0, 1))


def constant(values: Array) -> ca.SX:
    """A constant with its zeros dropped from the structure, so that products with them vanish."""
    return ca.SX(ca.sparsify(ca.DM(values)))
