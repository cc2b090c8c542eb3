"""Errors of phi for laws: orientations relative to the wanted ones, and no whole turns."""

from typing import Any

import casadi as ca
import numpy as np

from orthocas.bases.family import CyclicParametrisation
from orthocas.charts.chart import Chart
from orthocas.charts.coordinates import Coordinates
from orthocas.charts.phi import shortest
from orthocas.tools.checks import Array


def without_turns(chart: Chart, difference: Any) -> Any:
    """A difference of two phi (n, 1) without whole turns of unbounded joints, and of circle-valued coordinates.

    A turn of joint k changes phi by the constant 2 pi dphi/dq_k, a column of T (n, u), if the coordinates are linear in
    q_k. The difference becomes e - T round(T^+ e). So sensors may report angles with or without whole turns, and the
    spring takes the shorter way.

    Args:
        chart: the chart.
        difference: phi - phi_d, an expression.
    """
    difference = shortest(difference, chart.turns)
    T = _turns(chart)
    if T.shape[1] == 0:
        return difference
    whole = ca.floor(ca.DM(np.linalg.pinv(T)) @ difference + 0.5)
    return difference - ca.DM(T) @ whole


def errors(chart: Chart, q: ca.MX, reference: ca.MX) -> tuple[ca.MX, ca.MX]:
    """phi relative to phi_d, e (n, 1), and de/dq (n, n) for a reference at rest.

    For most tasks e = phi - phi_d and de/dq = J. A whole orientation counts from the wanted one, see `Relative`.
    """
    m, own = chart.m, chart.coordinates.functions
    e, slope = chart.relative.error(q, reference[:m])
    e = without_turns(chart, ca.vertcat(e, own["xi"](q) - reference[m:]))
    return e, ca.vertcat(slope, own["jacobian"](q))


def drift(chart: Chart, q: ca.MX, reference: ca.MX, velocity: ca.MX) -> ca.MX:
    """The rate de/dq dq at which q stays with a reference that moves, (n, 1): d_phi_d for most tasks."""
    m = chart.m
    return ca.vertcat(chart.relative.drift(q, reference[:m], velocity[:m]), velocity[m:])


def bend(chart: Chart, q: ca.MX, dq: ca.MX, w: ca.MX, wanted: tuple[ca.MX, ca.MX, ca.MX]) -> ca.MX:
    """(d/dt) (de/dq w - drift), (n, 1), with phi_d and its two derivatives: dJ/dt w - dd_phi_d for most tasks."""
    m = chart.m
    x, dx, ddx = (part[:m] for part in wanted)
    rest = chart.coordinates.functions["second_derivative"](q, dq, w) - wanted[2][m:]
    return ca.vertcat(chart.relative.bend(q, dq, w, (x, dx, ddx)), rest)


def _turns(chart: Chart) -> Array:
    """What a turn of each unbounded joint adds to phi, (n, u)."""
    problem, coordinates = chart.problem, chart.coordinates
    if problem.domain.full_turns or not isinstance(coordinates, Coordinates):
        return np.zeros((chart.n, 0))
    chosen = coordinates.parametrisation
    cyclic = chosen.cyclic if isinstance(chosen, CyclicParametrisation) else ()
    joints = [
        k
        for k in problem.domain.unbounded
        if not problem.robot.tree.prismatic[k] and (k in coordinates.idle or problem.robot.joint_names[k] in cyclic)
    ]
    T = 2 * np.pi * chart.jacobian(problem.domain.centre)[:, joints]
    T[: chart.m] = 0.0
    return np.asarray(T)
