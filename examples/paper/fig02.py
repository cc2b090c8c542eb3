"""[AS2023] Fig. 2: a spring along the self-motion manifold, and a projected spring that is stuck, with real numbers.

The arm and both springs are those of `hidden_spring.py`. Each joint axis is scaled by the square root
of the joint's stiffness. So the energy of the posture spring is proportional to the square of its drawn length, its
torque points along the spring, and a torque that the projector hides is orthogonal to the curve.
"""

from typing import Any

import numpy as np

from orthocas.tools.checks import Array

from .drawing import Drawing
from .hidden_spring import POSTURE_STIFFNESS, RADIUS, HiddenSpring
from .scene import Scene
from .style import EXTRA, GREY, INK, LABEL, TASK, THIRD, TICK, add_3d, line_legend, new_figure

_NEARER = 0.5  # distance of the tip from the base at which the spring comes free [m]
_SCALE = np.sqrt(np.asarray(POSTURE_STIFFNESS) / max(POSTURE_STIFFNESS))
_LOW, _HIGH = np.array([-3.8, 1.2, 1.2]), np.array([2.7, 2.85, 2.85])  # corners of the picture [rad]
_TICKS = ((-3.0, 0.0), (1.5, 2.0, 2.5), (1.5, 2.0, 2.5))  # [rad]
_VIEW = (20, -20)
_COIL, _DISK = 0.06, 0.2  # radii in the picture
_RINGS = 0.25  # step of xi between two marks


def draw(quick: bool) -> Drawing:
    """Draw both springs and their energy along the curve; the numbers show what is hidden.

    `quick` has no effect, because the figure takes only a second.
    """
    spring = HiddenSpring()
    figure = new_figure(5.4, layout=None)
    panels = (("(a) geodetic spring", True), (r"(b) projected spring: $\tau \neq 0$, but $P^T\tau = 0$", False))
    for k, (title, geodetic) in enumerate(panels):
        axes = add_3d(figure, 0.5 * k - 0.01, 0.42, 0.49, 0.53)
        _scene(spring, geodetic).draw(axes, _VIEW, _LOW * _SCALE, _HIGH * _SCALE, 0.98)
        _label(axes, spring, geodetic)
        axes.text2D(0.5, 1.03, title, fontsize=LABEL, ha="center", transform=axes.transAxes)
        _draw_energy(figure.add_axes((0.09 + 0.5 * k, 0.135, 0.39, 0.24)), spring, geodetic)
    wires = {"geodetic spring": THIRD, "projected spring": EXTRA}
    line_legend(figure, {"self-motion curve": TASK, rf"steps of {_RINGS:g} in $\xi$; $\tau$": INK} | wires)
    return Drawing({"": figure}, _numbers(spring))


def _scene(spring: HiddenSpring, geodetic: bool) -> Scene:
    """The curve, the spring as a coil, start and goal, with marks of xi on the left and the torque on the right."""
    scene = Scene()
    scene.add_cube(_LOW * _SCALE, _HIGH * _SCALE, 0.006)
    scene.add_tube(spring.curve * _SCALE, 0.016, TASK)
    if geodetic:
        path = _way(spring)
        for q in _marks(spring, path):
            scene.add_ball(q * _SCALE, 0.032, INK)
        scene.add_tube(_coil(path * _SCALE, 22, 0.0), 0.009, THIRD)
    else:
        straight = np.linspace(spring.stuck, spring.goal, 200)
        scene.add_tube(_coil(straight * _SCALE, 11, 0.35), 0.009, EXTRA)
        scene.add_arrow(spring.stuck * _SCALE, _arrow(spring), 0.012, INK)
        scene.add_surface(*_disk(spring), TASK, 0.25)
    scene.add_ball(spring.stuck * _SCALE, 0.05, EXTRA)
    scene.add_ball(spring.goal * _SCALE, 0.05, THIRD)
    return scene


def _label(axes: Any, spring: HiddenSpring, geodetic: bool) -> None:
    """Add names of points and axes; ticks show joint angles, whatever the scale."""
    for q, text in ((spring.stuck, "$q$"), (spring.goal, "$q_d$")):
        axes.text(*(q * _SCALE + np.array([0, 0, 0.12])), text, fontsize=LABEL, ha="center")
    if not geodetic:
        tip = spring.stuck * _SCALE + _arrow(spring)
        axes.text(*(tip + np.array([0, 0, -0.1])), r"$\tau$", fontsize=LABEL, ha="center", va="center")
    for k, letter in enumerate("xyz"):
        axis = getattr(axes, f"{letter}axis")
        axis.set_ticks(np.asarray(_TICKS[k]) * _SCALE[k], [f"{tick:g}" for tick in _TICKS[k]], fontsize=TICK)
        getattr(axes, f"set_{letter}label")(f"$q_{k + 1}$ [rad]", fontsize=LABEL)
        axis.set_pane_color((1.0, 1.0, 1.0, 0.0))
        axis.line.set_visible(False)
        axis.labelpad = -3
        axis.set_tick_params(pad=0)
    axes.grid(False)


def _draw_energy(axes: Any, spring: HiddenSpring, geodetic: bool) -> None:
    """Draw the energy along the self-motion curve against the first joint, which grows monotonically."""
    curve = _charted(spring)
    places = np.array([spring.stuck, spring.goal])
    if geodetic:
        axes.plot(curve[:, 0], spring.geodetic_energy(curve), color=THIRD)
        energies = spring.geodetic_energy(places)
        axes.set_ylabel("energy [J]", fontsize=LABEL)
    else:
        nearer = _charted(HiddenSpring(_NEARER))
        axes.plot(curve[:, 0], spring.posture_energy(curve), color=EXTRA, label=f"tip at {RADIUS:g} m")
        axes.plot(nearer[:, 0], spring.posture_energy(nearer), "--", color=GREY, label=f"tip at {_NEARER:g} m")
        axes.legend(fontsize=TICK, frameon=False, loc="upper right")
        energies = spring.posture_energy(places)
    axes.scatter(places[:, 0], energies, s=26, color=(EXTRA, THIRD), zorder=3)
    for q, energy, text in zip(places, energies, ("$q$", "$q_d$"), strict=True):
        axes.annotate(text, (q[0], energy), xytext=(0, 6), textcoords="offset points", fontsize=LABEL, ha="center")
    axes.set_xlabel("along the curve: $q_1$ [rad]", fontsize=LABEL)
    axes.set_ylim(-4, 92)
    axes.tick_params(labelsize=TICK)
    axes.grid(alpha=0.3)


def _charted(spring: HiddenSpring) -> Array:
    """The part of the curve on which the chart was fitted."""
    return np.asarray(spring.curve[spring.problem.domain.contains(spring.curve)])


def _way(spring: HiddenSpring) -> Array:
    """The curve from the stuck point to the goal, (P, 3)."""
    q1 = spring.curve[:, 0]
    inside = spring.curve[(q1 > spring.stuck[0]) & (q1 < spring.goal[0])]
    return np.concatenate([spring.stuck[None], inside, spring.goal[None]])


def _marks(spring: HiddenSpring, path: Array) -> Array:
    """Points of a path at equal steps of xi."""
    xi = spring.chart.xi(path)[:, 0]
    steps = np.arange(np.ceil(xi.min() / _RINGS), np.floor(xi.max() / _RINGS) + 1) * _RINGS
    order = np.argsort(xi)
    return np.stack([np.interp(steps, xi[order], joint[order]) for joint in path.T], axis=1)


def _arrow(spring: HiddenSpring) -> Array:
    """The torque of the posture spring at the stuck point, in drawing scale, (3,)."""
    torque = spring.posture_torque(spring.stuck) / _SCALE
    return np.asarray(0.4 * torque / np.linalg.norm(torque))


def _disk(spring: HiddenSpring) -> tuple[Array, Array]:
    """A disk at the stuck point, orthogonal to the drawn curve: vertices and faces."""
    near = np.argsort(np.abs(spring.curve[:, 0] - spring.stuck[0]))[:2]
    normal = (spring.curve[near[1]] - spring.curve[near[0]]) * _SCALE
    first = np.cross(normal, _arrow(spring))
    second = np.cross(normal, first)
    axes = np.stack([first / np.linalg.norm(first), second / np.linalg.norm(second)])
    angle = np.linspace(0, 2 * np.pi, 41)
    rim = spring.stuck * _SCALE + _DISK * np.stack([np.cos(angle), np.sin(angle)], axis=1) @ axes
    here = np.arange(1, len(angle))
    return np.vstack([spring.stuck * _SCALE, rim]), np.stack([np.zeros_like(here), here, here + 1], axis=1)


def _coil(path: Array, turns: int, lead: float) -> Array:
    """A coil around a path (P, 3), straight in the first share `lead` of it."""
    share = np.linspace(0, 1, 32 * turns)
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    middle = np.stack([np.interp(share * length[-1], length, axis) for axis in path.T], axis=1)
    tangent = np.gradient(middle, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    side = np.cross(tangent, [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    angle = 2 * np.pi * turns * np.clip((share - lead) / (1 - lead), 0, 1)
    width = _COIL * np.clip(10 * np.minimum(share - lead, 1 - share), 0, 1)
    across = np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * np.cross(tangent, side)
    return np.asarray(middle + width[:, None] * across)


def _numbers(spring: HiddenSpring) -> dict[str, float]:
    way = _way(spring)
    nearer = HiddenSpring(_NEARER).curve
    wide = nearer[(nearer[:, 0] >= spring.start[0]) & (nearer[:, 0] <= spring.goal[0])]
    return {
        "hidden_energy_J": float(spring.posture_energy(spring.stuck[None])[0]),
        "hidden_torque_Nm": float(np.linalg.norm(spring.posture_torque(spring.stuck))),
        "projected_torque_Nm": abs(spring.projected_torque(spring.stuck)),
        "barrier_J": float(np.ptp(spring.posture_energy(way)) - spring.posture_energy(way[:1])[0]),
        "minima_of_projected_spring_before_the_goal": _minima(spring.posture_energy(way)),
        "minima_of_geodetic_spring_before_the_goal": _minima(spring.geodetic_energy(way)),
        "minima_with_tip_nearer": _minima(spring.posture_energy(wide)),
        "geodetic_energy_at_q_J": float(spring.geodetic_energy(spring.stuck[None])[0]),
        "task_error_of_curve_m": float(np.ptp(spring.problem.task.batched(spring.curve)[0], axis=0).max()),
    }


def _minima(energy: Array) -> float:
    """Number of times an energy stops falling before the last point; the first point counts if it is a minimum."""
    rising = np.diff(energy) > 0
    return float(rising[0]) + float(np.count_nonzero(~rising[:-1] & rising[1:]))
