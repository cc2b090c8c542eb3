"""Fitted coordinates and their Jacobian on blocks of joint positions: one table of the basis times coefficients."""

from collections.abc import Callable
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from orthocas.casadi_tools.blocks import BlockFunction
from orthocas.casadi_tools.columns import COLUMNS, ColumnFunction
from orthocas.checks import Array
from orthocas.parametrisations.family import SelfDerivativeFamily

if TYPE_CHECKING:
    from orthocas.coordinates.fitted import Coordinates

Maker = Callable[[], BlockFunction]


def block_function(coordinates: "Coordinates", name: str) -> Maker:
    """What makes xi or the Jacobian of a self-derivative family on blocks, once for each thread.

    They are functions of q (n, c) that return (r, c), or J_xi row by row, (r n, c).
    """
    family = coordinates.family
    assert isinstance(family, SelfDerivativeFamily)
    return (_values if name == "xi" else _slopes)(coordinates, family)


def _values(coordinates: "Coordinates", family: SelfDerivativeFamily) -> Maker:
    """xi = scale (C psi - offset), and the idle joints."""
    r, active, idle = family.outputs, coordinates.active, list(coordinates.idle)
    C = coordinates.scale[:, None] * coordinates.theta.reshape(r, -1)
    shift, centre = (coordinates.scale * coordinates.offset)[:, None], coordinates.space.centre[idle, None]
    q = ca.SX.sym("q", len(active))
    basis = ColumnFunction(ca.Function("basis", [q], [ca.densify(family.basis(q))]))

    def make() -> BlockFunction:
        psi, xi = basis.on_one_block(), np.empty((coordinates.r, COLUMNS))

        def on_one_block(columns: Array) -> Array:
            np.matmul(C, psi(columns[active])[0], out=xi[:r])
            xi[:r] -= shift
            xi[r:] = columns[idle] - centre
            return xi

        return on_one_block

    return make


def _slopes(coordinates: "Coordinates", family: SelfDerivativeFamily) -> Maker:
    """J_xi = scale C_i psi', where psi' holds the basis functions that occur in derivatives, and 1 for idle joints."""
    n, r, active = coordinates.space.n, family.outputs, coordinates.active
    by_joint = family.derivative_tables(coordinates.theta)  # (active, r, 1 + K)
    places = np.flatnonzero(by_joint.any(axis=(0, 1)))
    table = np.zeros((r, n, len(places)))
    table[:, active] = coordinates.scale[:, None, None] * by_joint[:, :, places].transpose(1, 0, 2)
    flat = table.reshape(r * n, len(places))
    of_idle = np.eye(n)[list(coordinates.idle)].reshape(-1, 1)
    q = ca.SX.sym("q", len(active))
    smaller = ca.vertcat(1, family.basis(q))[places.tolist()]
    basis = ColumnFunction(ca.Function("smaller_basis", [q], [ca.densify(smaller)]))

    def make() -> BlockFunction:
        psi, J = basis.on_one_block(), np.empty((coordinates.r * n, COLUMNS))
        J[r * n :] = of_idle

        def on_one_block(columns: Array) -> Array:
            np.matmul(flat, psi(columns[active])[0], out=J[: r * n])
            return J

        return on_one_block

    return make
