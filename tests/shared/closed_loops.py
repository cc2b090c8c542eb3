"""What tests of closed loops share."""

import numpy as np

import orthocas as oc
from orthocas.control import Reference
from orthocas.control.controller import Controller
from orthocas.tools.checks import Array

K = 60.0


def resting(chart: oc.Chart, q: Array, duration: float) -> Reference:
    return Reference.steps(chart.labels, chart.phi(q), [], duration)


def torque_at(controller: Controller, reference: Reference, t: float, q: Array, dq: Array) -> Array:
    values = [part[0] for part in reference.sample([t])]
    return np.asarray(controller.function(q, dq, *values, *controller.gains.values())[0].full().ravel())
