"""[AS2023] Fig. 16: the network with sines and cosines of the joints as inputs, and its number of parameters.

The paper states about 535e3 parameters for the network of Sec. 9, with 7 joints, layers of 1024 and 512, and 4 outputs.
With the joints themselves as inputs it has exactly 535,044; with sines and cosines it has 542,212.
"""

from typing import Any

import casadi as ca
import numpy as np

from orthocas.bases import MLP, JointSpace
from orthocas.bases.mlp import MLPFamily
from orthocas.tools.checks import Array

from .drawing import Drawing
from .style import EXTRA, GREY, INK, LABEL, TASK, THIRD, new_figure

_HIDDEN, _JOINTS, _OUTPUTS = (1024, 512), 7, 4  # of the paper's network
_COLUMNS = (0.0, 1.5, 3.2, 4.9, 6.5)  # places of joints, inputs, hidden layers and outputs
_Place = tuple[float, float] | None  # None: units that are left out


def draw(quick: bool) -> Drawing:
    """Draw the layers; the numbers count parameters, and compare the network with its formula in NumPy."""
    figure = new_figure(3.1, layout=None)
    axes = figure.add_axes((0.01, 0.02, 0.98, 0.96))
    axes.set(xlim=(-0.75, 7.4), ylim=(-0.55, 4.35), aspect="equal")
    axes.set_axis_off()
    joints = _column(axes, 0, (r"$q_1$", r"$q_2$", "", r"$q_n$"), GREY, 0.95)
    sines = _column(axes, 1, ("sin", "cos", "sin", "cos", "", "sin", "cos"), THIRD, 0.58)
    first = _column(axes, 2, ("tanh", "tanh", "tanh", "", "tanh"), TASK, 0.78)
    second = _column(axes, 3, ("tanh", "tanh", "tanh", "", "tanh"), TASK, 0.78)
    outputs = _column(axes, 4, (r"$\xi_1$", "", r"$\xi_r$"), EXTRA, 0.95)
    for k, place in enumerate((0, 1, 3)):
        own = [joints[place], joints[place]]
        _connect(axes, own[:1], [sines[p] for p in ((0, 1), (2, 3), (5, 6))[k]], 1.0)
    for left, right in ((sines, first), (first, second), (second, outputs)):
        _connect(axes, [p for p in left if p is not None], [p for p in right if p is not None], 0.45)
    for x, text in zip(
        ((_COLUMNS[1] + _COLUMNS[2]) / 2, (_COLUMNS[2] + _COLUMNS[3]) / 2, (_COLUMNS[3] + _COLUMNS[4]) / 2),
        ("$W_1, b_1$", "$W_2, b_2$", r"$W_\mathrm{out}, b_\mathrm{out}$"),
        strict=True,
    ):
        axes.text(x, -0.38, text, fontsize=LABEL, ha="center", va="center")
    for x, text in zip(_COLUMNS, ("joints", "inputs", "layer 1", "layer 2", "coordinates"), strict=True):
        axes.text(x, 4.2, text, fontsize=LABEL, ha="center", va="center")
    return Drawing({"": figure}, _numbers())


def _column(axes: Any, column: int, names: tuple[str, ...], colour: str, step: float) -> list[_Place]:
    """Draw the units of a layer; an empty name stands for those that are left out. Returns their places."""
    x, places = _COLUMNS[column], list[_Place]()
    heights = 1.95 + step * (np.arange(len(names))[::-1] - (len(names) - 1) / 2)
    for y, name in zip(heights, names, strict=True):
        if not name:
            axes.text(x, y, r"$\vdots$", fontsize=LABEL + 3, ha="center", va="center")
            places.append(None)
            continue
        axes.plot(
            x, y, "o", markersize=19, markerfacecolor="white", markeredgecolor=colour, markeredgewidth=1.5, zorder=3
        )
        axes.text(x, y, name, fontsize=LABEL - 2, ha="center", va="center", color=INK, zorder=4)
        places.append((x, float(y)))
    return places


def _connect(axes: Any, left: Any, right: Any, width: float) -> None:
    for a in left:
        for b in right:
            axes.plot(*np.array([a, b]).T, color=GREY, linewidth=width, zorder=1)


def _numbers() -> dict[str, float]:
    unit = JointSpace(np.zeros(_JOINTS), np.ones(_JOINTS), (False,) * _JOINTS, tuple(f"q{k}" for k in range(_JOINTS)))
    sizes = {raw: MLP(_HIDDEN, raw).family(unit, _OUTPUTS).size for raw in (False, True)}
    small = MLP((5, 4)).family(unit, _OUTPUTS)
    theta, q = small.initial(0), np.random.default_rng(1).normal(size=(_JOINTS, 1))
    found = np.asarray(ca.evalf(small.expression(ca.MX(ca.DM(q)), ca.MX(ca.DM(theta)))))
    return {
        "parameters_with_sines_and_cosines": float(sizes[False]),
        "parameters_with_raw_inputs": float(sizes[True]),
        "error_of_formula": float(np.abs(found - by_formula(small, theta, q)).max()),
    }


def by_formula(family: MLPFamily, theta: Array, q: Array) -> Array:
    """W_out tanh(W_2 tanh(W_1 [sin q; cos q] + b_1) + b_2) + b_out in NumPy ([AS2023] Sec. 6), (r, 1)."""
    layer, start = np.concatenate([np.sin(q), np.cos(q)]), 0
    for depth, out in enumerate((*family.hidden, family.outputs)):
        end = start + out * len(layer)
        layer = theta[start:end].reshape(-1, out).T @ layer + theta[end : end + out, None]
        start = end + out
        layer = np.tanh(layer) if depth < len(family.hidden) else layer
    return np.asarray(layer)
