"""Series of calls that threads share."""

import copy
from collections.abc import Callable
from typing import Any

import numpy as np
from public_objects import (
    BENT_POSTURE,
    HAS_COMPILER,
    arm,
    circle,
    collisions,
    compiled,
    disk,
    fitted,
    impedance,
    network,
    numbers,
    points_of,
    states_of,
)

import orthocas as oc
from orthocas.charts.chart import GrownChart
from orthocas.control import Controller, Kinematic, Remembering
from orthocas.tools.batch import Batched
from orthocas.tools.checks import Array

Call = Callable[[int], Any]  #: the k-th call of a series


def calls_of_chart(chart: oc.Chart) -> list[Call]:
    """Methods of a chart at points that change from call to call."""
    q = points_of(chart)
    phi = chart.phi(q)
    fitted_calls: list[Call] = [
        lambda k: np.asarray(chart.function("phi")(q[k % 6])),
        lambda k: np.asarray(chart.function("jacobian")(q[k % 6])),
        lambda k: np.hstack([*chart.quality(q[k % 6]).as_dict().values()]),
    ]
    return [
        lambda k: chart.phi(q[k % 6]),
        lambda k: chart.jacobian(q[: 1 + k % 6]),
        lambda k: chart.inverse(phi[k % 6], q[k % 6] + 0.02),
        lambda k: chart.solve(phi[k % 6 :]).q,
        lambda k: chart.problem.robot.mass_matrix(q[k % 6]),
        *([] if isinstance(chart, GrownChart) else fitted_calls),
    ]


def calls_of_collisions() -> list[Call]:
    """Distances, which every thread measures with memory of its own."""
    found, q = collisions(), points_of(fitted().chart)
    return [
        lambda k: np.hstack([found.distance(q[k % 6 :]).distance, found.pair_distances(q[k % 6])]),
        lambda k: found.check_free(q[: 1 + k % 6]),
    ]


def calls_of_law(law: Controller) -> list[Call]:
    """A law at states that change from call to call."""
    states = states_of(law)
    batched = Batched(law.function)

    def command(k: int) -> Array:
        return np.hstack(batched(*(part[k % 4 :][:1] for part in states)))

    return [command]


def calls_of_arm() -> list[Call]:
    """Searches for postures of task values that change from call to call."""
    whole = copy.deepcopy(arm())
    x = whole.x(BENT_POSTURE) + np.linspace(0.0, 0.1, 4)[:, None]
    return [
        lambda k: whole.solve(x[k % 4], start=BENT_POSTURE).q,
        lambda k: whole.solve(x[k % 4], 0.1).q,
        lambda k: np.atleast_1d(whole.self_motion(x[k % 4]).length),
    ]


def calls_of_ticks() -> list[Call]:
    """A law without a memory in ticks, copied for each call."""
    ticks = Remembering(Kinematic(copy.deepcopy(fitted().chart), 1.0))
    return [lambda k: np.hstack(numbers(ticks))]


def calls_of_compiled() -> list[Call]:
    """Both searches of a compiled inverse: near starts, and along self-motion curves."""
    inverse = copy.deepcopy(compiled())
    q = points_of(inverse.chart)
    phi, x = inverse.chart.phi(q), inverse.chart.x(q)
    return [lambda k: inverse.solve(phi[k % 6 :]).q, lambda k: inverse.nearest_xi(q[::-1] + 2.0, x[k % 6]).q]


SERIES: dict[str, tuple[Callable[[], list[Call]], int]] = {  #: of 5,000 calls
    "polynomial": (lambda: calls_of_chart(copy.deepcopy(fitted().chart)), 2400),
    "network": (lambda: calls_of_chart(copy.deepcopy(network())), 1200),
    "circle": (lambda: calls_of_chart(copy.deepcopy(circle())), 60),
    "disk": (lambda: calls_of_chart(copy.deepcopy(disk())), 40),
    **({"compiled inverse": (calls_of_compiled, 200)} if HAS_COMPILER else {}),
    "law in ticks": (calls_of_ticks, 200),
    "collisions": (calls_of_collisions, 300),
    "arm": (calls_of_arm, 120),
    "law": (lambda: calls_of_law(copy.deepcopy(impedance())), 1300),
}
