"""Families as CasADi functions of one joint position, in a form that gives small and fast C."""

from typing import Any

import casadi as ca
import numpy as np

from orthocas.casadi_tools.batch import dense_function
from orthocas.checks import Array
from orthocas.parametrisations.family import Family, LinearFamily, SelfDerivativeFamily


def point_functions(family: Family, theta: Array, n: int) -> dict[str, ca.Function]:
    """xi (r, 1) and jacobian (r, n) as functions of q (n, 1); second_derivative (r, 1) as a function of q, v, w.

    second_derivative is d^2 xi(q)[v, w]. A basis is evaluated once, and a loop multiplies it with a table of
    coefficients: written out, a polynomial of degree 4 on seven joints takes ten thousand operations.
    """
    if isinstance(family, SelfDerivativeFamily):
        return _from_tables(family, theta, n)
    if isinstance(family, LinearFamily):
        return _from_basis(family, theta, n)
    kind: Any = ca.MX if family.as_matrices else ca.SX
    q, v, w = (kind.sym(name, n) for name in ("q", "v", "w"))
    parameters: Any = ca.DM(theta)  # constants, so that weights are not sliced and transposed at every call
    xi = family.expression(q, parameters)
    jacobian = ca.horzcat(*family.jacobian(q, parameters)).T
    return _functions(xi, jacobian, second_derivative(xi, q, v, w), q, v, w)


def second_derivative(values: Any, q: Any, v: Any, w: Any) -> Any:
    """(d/ds) J(q + s v) w of an SX or MX expression."""
    return ca.jtimes(ca.jtimes(values, q, w), q, v)


def _from_basis(family: LinearFamily, theta: Array, n: int) -> dict[str, ca.Function]:
    """xi = C psi, J = C dpsi/dq and C d^2 psi[v, w], with the coefficients C and the basis psi."""
    x, a, b = (ca.SX.sym(name, n) for name in ("q", "v", "w"))
    psi = family.basis(x)
    basis = ca.Function("basis", [x], [psi])
    slopes = ca.Function("basis_slopes", [x], [ca.densify(ca.jacobian(psi, x))])
    bends = ca.Function("basis_bends", [x, a, b], [ca.densify(second_derivative(psi, x, a, b))])
    C = ca.MX(ca.DM(theta.reshape(family.outputs, family.width)))
    q, v, w = (ca.MX.sym(name, n) for name in ("q", "v", "w"))
    return _functions(C @ basis(q), C @ slopes(q), C @ bends(q, v, w), q, v, w)


def _from_tables(family: SelfDerivativeFamily, theta: Array, n: int) -> dict[str, ca.Function]:
    """Functions of a family whose basis is closed under differentiation: d xi / d q_i = C_i psi', psi' part of psi.

    For a polynomial of degree d, psi' holds the terms up to degree d - 1, and J is one table times psi'.
    """
    r = family.outputs
    tables = family.derivative_tables(theta)
    places = np.flatnonzero(tables.any(axis=(0, 1)))
    x, u = ca.SX.sym("q", n), ca.SX.sym("v", n)
    psi = family.basis(x)
    smaller = ca.vertcat(1, psi)[places.tolist()]
    basis = ca.Function("basis", [x], [psi])
    smaller_basis = ca.Function("smaller_basis", [x], [smaller])
    change = ca.Function("smaller_basis_change", [x, u], [ca.densify(ca.jtimes(smaller, x, u))])
    values = ca.MX(ca.DM(theta.reshape(r, family.width)))
    slopes = ca.MX(ca.DM(tables[:, :, places].reshape(n * r, len(places))))
    q, v, w = (ca.MX.sym(name, n) for name in ("q", "v", "w"))
    jacobian = ca.reshape(slopes @ smaller_basis(q), r, n)
    second = ca.reshape(slopes @ change(q, v), r, n) @ w
    return _functions(values @ basis(q), jacobian, second, q, v, w)


def _functions(xi: Any, jacobian: Any, second: Any, q: Any, v: Any, w: Any) -> dict[str, ca.Function]:
    return {
        "xi": dense_function("xi", [q], [xi]),
        "jacobian": dense_function("J_xi", [q], [jacobian]),
        "second_derivative": dense_function("d2xi", [q, v, w], [second], ["q", "v", "w"]),
    }
