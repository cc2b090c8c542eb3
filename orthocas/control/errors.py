"""Errors of phi for laws, with orientations relative to their targets."""

import casadi as ca

from orthocas.charts.chart import Chart
from orthocas.tools.expressions import wrap_shortest


def errors(chart: Chart, q: ca.MX, reference: ca.MX) -> tuple[ca.MX, ca.MX]:
    """phi relative to phi_d, e (n, 1), and de/dq (n, n) for a reference at rest.

    For most tasks e = phi - phi_d and de/dq = J. A whole orientation counts from its target, see `Relative`.
    Coordinates that are angles take the shorter way around. No other error is taken modulo anything: whole turns of
    joints are resolved in q, before phi is evaluated (`orthocas.tasks.problem.Problem.unwrap`).
    """
    m, own = chart.m, chart.coordinates.functions
    e, slope = chart.relative.error(q, reference[:m])
    rest = wrap_shortest(own["xi"](q) - reference[m:], chart.turns[m:])
    return ca.vertcat(e, rest), ca.vertcat(slope, own["jacobian"](q))


def drift(chart: Chart, q: ca.MX, reference: ca.MX, velocity: ca.MX) -> ca.MX:
    """The rate de/dq dq at which q stays with a reference that moves, (n, 1): d_phi_d for most tasks."""
    m = chart.m
    return ca.vertcat(chart.relative.compute_drift(q, reference[:m], velocity[:m]), velocity[m:])


def bend(chart: Chart, q: ca.MX, dq: ca.MX, w: ca.MX, wanted: tuple[ca.MX, ca.MX, ca.MX]) -> ca.MX:
    """(d/dt) (de/dq w - drift), (n, 1), with phi_d and its two derivatives: dJ/dt w - dd_phi_d for most tasks."""
    m = chart.m
    x, dx, ddx = (part[:m] for part in wanted)
    rest = chart.coordinates.functions["second_derivative"](q, dq, w) - wanted[2][m:]
    return ca.vertcat(chart.relative.compute_bias(q, dq, w, (x, dx, ddx)), rest)
