"""Networks as code: their weights, layer by layer."""

from itertools import pairwise

import numpy as np

from orthocas.checks import Array
from orthocas.coordinates.fitted import Coordinates
from orthocas.exporting.form import Form, idle_part
from orthocas.parametrisations.mlp import MLPFamily


def network_form(coordinates: Coordinates) -> Form | None:
    """xi = W_out tanh(... tanh(W_0 u + b_0) ...) + A q + c; None if the coordinates are no network."""
    family = coordinates.family if len(coordinates.offset) else None
    if not isinstance(family, MLPFamily):
        return None
    scale, fitted, depth = coordinates.scale[:, None], len(coordinates.offset), len(family.hidden)
    layers = _layers(family, coordinates.theta)
    A, c = idle_part(coordinates)
    W_out = np.zeros((coordinates.r, family.hidden[-1]))
    W_out[:fitted] = scale * layers[depth][0]
    c[:fitted] = scale * (layers[depth][1] - coordinates.offset[:, None])
    active, slides = np.array(coordinates.active, dtype=int), np.array(family.direct, dtype=bool)
    turning, sliding, idle = active[~slides], active[slides], np.array(coordinates.idle, dtype=int)
    indices = {"turning": turning, "sliding": sliding, "idle": idle}
    indices["order"] = np.argsort(np.concatenate(list(indices.values())))
    tables = {"W_out": W_out, "A": A, "c": c}
    for k, (W, b) in enumerate(layers[:depth]):
        tables |= {f"W_{k}": W, f"b_{k}": b}
    plain = {name: [int(k) for k in of] for name, of in indices.items()}
    return Form("network", {"depth": str(depth)}, "", tables, plain)


def _layers(family: MLPFamily, theta: Array) -> list[tuple[Array, Array]]:
    """Weights (out, width) and biases (out, 1) of all layers."""
    layers, start = [], 0
    for width, out in pairwise(family.widths):
        middle, end = start + out * width, start + out * (width + 1)
        layers.append((theta[start:middle].reshape(width, out).T, theta[middle:end, None]))
        start = end
    return layers
