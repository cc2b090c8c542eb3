"""[AS2023] Fig. 21: the closed loop of the simulations as a block diagram, and its low-pass step response.

The numbers check the diagram against the code. The torque of `PDPlus` is J^T (f_FF + f_FB) + g with both forces from
their formulas, and the low-pass filter has the overshoot exp(-pi zeta / sqrt(1 - zeta^2)) of its differential equation.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.patches import Circle, FancyBboxPatch

from orthocas import problems
from orthocas.bases import Polynomial
from orthocas.charts.chart import Chart
from orthocas.control import PDPlus, Reference
from orthocas.control.reference import DAMPING_RATIO, NATURAL_FREQUENCY
from orthocas.fitting.fit import fit
from orthocas.tasks.samples import sample_uniform
from orthocas.tools.batch import Batched
from orthocas.tools.checks import Array

from .drawing import Drawing
from .paper_loss import PAPER_LOSS
from .style import EXTRA, INK, LABEL, TASK, THIRD, TICK, new_figure

_STEP_AT, _DURATION = 0.5, 3.0  # [s]
_STIFFNESS = (400.0, 40.0, 40.0)
_STATES = 50
_WANTED = r"$\varphi_d$" "\n" r"$\dot\varphi_d$" "\n" r"$\ddot\varphi_d$"
_BOXES = {  # text: middle, width, height [cm]
    "low pass\n2nd order": (2.9, 2.2, 1.9, 1.5),
    "feed-forward": (6.6, 3.3, 2.3, 0.9),
    "feedback": (6.6, 1.5, 2.3, 0.9),
    r"$J^T$": (10.2, 2.2, 1.0, 0.9),
    "robot": (13.5, 2.2, 1.7, 1.1),
    "$g(q)$": (11.9, 3.85, 1.2, 0.7),
}
_SUMS = ((8.8, 2.2), (11.9, 2.2))
_RADIUS = 0.2  # of a summing point [cm]


def draw(quick: bool) -> Drawing:
    """Draw the diagram and, below it, a unit step through the low-pass filter.

    `quick` has no effect, because the figure takes less than a second.
    """
    figure = new_figure(4.0, layout=None)
    diagram = figure.add_axes((0.0, 0.44, 1.0, 0.56))
    _draw_diagram(diagram)
    response = Reference.steps(["step"], [0.0], [(_STEP_AT, {"step": 1.0})], _DURATION)
    _draw_response(figure, response)
    return Drawing({"": figure}, _low_pass_numbers(response) | _loop_numbers())


def _draw_diagram(axes: Any) -> None:
    axes.set_xlim(0, 16)
    axes.set_ylim(0, 4.8)
    axes.set_aspect("equal")
    axes.set_axis_off()
    for text, (x, y, width, height) in _BOXES.items():
        corner = (x - width / 2, y - height / 2)
        style = "round,pad=0,rounding_size=0.12"
        axes.add_patch(FancyBboxPatch(corner, width, height, style, facecolor="#eef2f7", edgecolor=INK, linewidth=1))
        axes.text(x, y, text, fontsize=LABEL, ha="center", va="center")
    for centre in _SUMS:
        axes.add_patch(Circle(centre, _RADIUS, facecolor="white", edgecolor=INK, linewidth=1))
        axes.text(*centre, "+", fontsize=LABEL, ha="center", va="center_baseline")
    _draw_wires(axes)
    for x, y, text in (
        (0.95, 2.5, r"$\hat\varphi_d$"),
        (4.4, 3.1, _WANTED),
        (8.25, 3.68, r"$f_{\mathrm{FF}}$"),
        (8.25, 1.1, r"$f_{\mathrm{FB}}$"),
        (12.37, 2.45, r"$\tau$"),
        (15.2, 2.5, r"$q, \dot q$"),
    ):
        axes.text(x, y, text, fontsize=LABEL, ha="center", va="center")


def _draw_wires(axes: Any) -> None:
    """Draw signals, with arrow heads where they enter a block and dots where they branch."""
    wires: Sequence[Sequence[tuple[float, float]]] = (
        ((0.4, 2.2), (1.95, 2.2)),
        ((3.85, 2.2), (4.9, 2.2), (4.9, 3.3), (5.45, 3.3)),
        ((4.9, 2.2), (4.9, 1.5), (5.45, 1.5)),
        ((7.75, 3.3), (8.8, 3.3), (8.8, 2.4)),
        ((7.75, 1.5), (8.8, 1.5), (8.8, 2.0)),
        ((9.0, 2.2), (9.7, 2.2)),
        ((10.7, 2.2), (11.7, 2.2)),
        ((11.9, 3.5), (11.9, 2.4)),
        ((12.1, 2.2), (12.65, 2.2)),
        ((14.35, 2.2), (15.7, 2.2)),
        ((14.75, 2.2), (14.75, 0.45), (6.6, 0.45), (6.6, 1.05)),
    )
    for wire in wires:
        axes.plot(*np.array(wire[:-1]).T, color=INK, linewidth=1, solid_capstyle="butt")
        arrow = {"arrowstyle": "-|>", "color": INK, "linewidth": 1, "shrinkA": 0, "shrinkB": 0, "mutation_scale": 9}
        axes.annotate("", wire[-1], wire[-2], arrowprops=arrow)
    axes.plot(*np.array([(4.9, 2.2), (14.75, 2.2)]).T, "o", color=INK, markersize=3)


def _draw_response(figure: Any, response: Reference) -> None:
    """Draw value, velocity and acceleration of a unit step side by side."""
    times = np.linspace(0, _DURATION, 1501)
    panels = zip(
        response.sample(times),
        (r"$\varphi_d$ [1]", r"$\dot\varphi_d$ [1/s]", r"$\ddot\varphi_d$ [1/s$^2$]"),
        (TASK, EXTRA, THIRD),
        strict=True,
    )
    for k, (values, title, colour) in enumerate(panels):
        axes = figure.add_axes((0.06 + 0.325 * k, 0.12, 0.27, 0.27))
        if k == 0:
            axes.step([0, _STEP_AT, _DURATION], [0, 1, 1], where="post", color=INK, linewidth=1, linestyle=":")
        axes.plot(times, values[:, 0], color=colour)
        axes.set_title(title + (r", dotted: $\hat\varphi_d$" if k == 0 else ""), fontsize=LABEL)
        axes.set_xlabel("time [s]", fontsize=LABEL, labelpad=1)
        axes.tick_params(labelsize=TICK)
        axes.grid(alpha=0.3)


def _low_pass_numbers(response: Reference) -> dict[str, float]:
    times = np.linspace(_STEP_AT, _DURATION, 100_001)
    value, velocity, acceleration = (array[:, 0] for array in response.sample(times))
    equation = acceleration - NATURAL_FREQUENCY**2 * (1 - value) + 2 * DAMPING_RATIO * NATURAL_FREQUENCY * velocity
    outside = times[np.abs(value - 1) > 0.02]
    return {
        "overshoot": float(value.max() - 1),
        "overshoot_by_formula": float(np.exp(-np.pi * DAMPING_RATIO / np.sqrt(1 - DAMPING_RATIO**2))),
        "time_to_stay_within_2_percent_s": float(outside.max() - _STEP_AT),
        "largest_velocity_per_step_1_s": float(velocity.max()),
        "acceleration_after_a_step_1_s2": float(acceleration[0]),
        "differential_equation_error": float(np.abs(equation).max()),
    }


def _loop_numbers() -> dict[str, float]:
    """The torque of the controller compared with the sum in the diagram, at random states and references."""
    chart = fit(problems.get("planar_3r_x"), Polynomial(4), weights=PAPER_LOSS, samples=1500).chart
    controller = PDPlus(chart, _STIFFNESS)
    q = sample_uniform(chart.problem.domain, _STATES, 0)
    dq, *wanted = np.random.default_rng(1).normal(size=(4, _STATES, chart.n))
    gains = [np.tile(gain, (_STATES, 1)) for gain in controller.gains.values()]
    torque = Batched(controller.function)(q, dq, *wanted, *gains)[0]
    summed = np.array([_torque(chart, controller, *row) for row in zip(q, dq, *wanted, strict=True)])
    return {"torque_error_Nm": float(np.abs(torque - summed).max()), "largest_torque_Nm": float(np.abs(torque).max())}


def _torque(
    chart: Chart, controller: PDPlus, q: Array, dq: Array, value: Array, velocity: Array, acceleration: Array
) -> Array:
    """J^T (f_FF + f_FB) + g in NumPy, with the matrices of [AS2023] eqs. (28) to (35)."""
    robot, J = chart.problem.robot, chart.jacobian(q)
    M, D = (
        robot.mass_matrix(q),
        np.asarray(controller.damping_matrix(q, controller.stiffness, controller.damping_ratio)),
    )
    inertia = np.linalg.inv(J @ np.linalg.solve(M, J.T))
    wanted = np.linalg.solve(J, velocity)
    turning = J @ np.linalg.solve(M, np.asarray(robot.coriolis_product(q, dq, wanted)).ravel())
    bending = np.asarray(chart.function("second_derivative")(q, dq, wanted)).ravel()
    feed_forward = inertia @ (acceleration + turning - bending) + D @ velocity
    feedback = -controller.stiffness * (chart.phi(q) - value) - D @ J @ dq
    return np.asarray(J.T @ (feed_forward + feedback) + np.asarray(robot.gravity(q)).ravel())
