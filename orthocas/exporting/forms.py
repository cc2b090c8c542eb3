"""Coordinates as code: tables of products of one-joint functions, networks, or any expression line by line."""

import casadi as ca

from orthocas.casadi_tools.batch import dense_function
from orthocas.chart import Chart
from orthocas.coordinates.fitted import Coordinates
from orthocas.exporting.form import Form
from orthocas.exporting.networks import network_form
from orthocas.exporting.products import product_form
from orthocas.exporting.tapes import function_code

_SPECIAL = (product_form, network_form)  # what `expression_form` would write as many thousand lines


def form_of(chart: Chart) -> Form:
    """The coordinates of a chart in the first form that fits.

    Raises:
        NoExpressionError: if the chart is grown.
    """
    if isinstance(chart.coordinates, Coordinates):
        for form in _SPECIAL:
            if (found := form(chart.coordinates)) is not None:
                return found
    return expression_form(chart)


def expression_form(chart: Chart) -> Form:
    """xi and its Jacobian, operation by operation."""
    q = ca.SX.sym("q", chart.n)
    slopes = dense_function("J_xi", [q], [chart.function("jacobian")(q)[chart.m :, :]])
    code = [
        function_code("_xi", "Coordinates, (r, N), of columns q (n, N).", chart.function("xi")),
        function_code("_xi_slopes", "The entries of their Jacobian row by row, (r n, N).", slopes),
    ]
    return Form("expression", {}, "\n\n".join(code), {}, {})
