"""Numbers with which a generated library checks itself on the machine it runs on."""

import numpy as np

from orthocas.chart import Chart
from orthocas.checks import Array
from orthocas.codegen.numbers import numbers
from orthocas.codegen.precision import Precision
from orthocas.control import Controller


def check_values(chart: Chart, controller: Controller | None, q: Array, precision: Precision) -> dict[str, str]:
    """Values of the placeholders: a state, and what every function gives there."""
    n, robot = chart.n, chart.problem.robot
    dq = precision.rounded(np.round(np.linspace(0.1, -0.2, n), 3))
    values = {
        "check_q": q,
        "check_dq": dq,
        "check_phi": chart.phi(q),
        "check_jacobian": chart.jacobian(q).ravel(),
        "check_curvature": chart.function("second_derivative")(q, dq, dq).full().ravel(),
        "check_mass_matrix": robot.mass_matrix(q).ravel(),
        "check_bias": robot.bias(q, dq),
    }
    if controller is not None:
        value = controller.measured(q).full().ravel() + 0.001
        reference = [precision.rounded(part) for part in (value, *np.full((2, len(value)), 0.01))]
        command, _ = controller.function(q, dq, *reference, *controller.gains.values())
        values["check_command"] = command.full().ravel()
    words = {name: numbers(value) for name, value in values.items()}
    if controller is not None:
        words["check_reference"] = ", ".join(f"{{{numbers(part)}}}" for part in reference)
    return words
