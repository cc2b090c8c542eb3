"""Gradients of the coordinates of a network, as Taylor models, by the chain rule from the outputs to the inputs."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from orthocas.certifying.functions import cosine, sine, square, tanh
from orthocas.certifying.monomials import Variables
from orthocas.certifying.rounding import TINY, UNIT, above
from orthocas.certifying.taylor import TaylorModel, stacked
from orthocas.checks import Array
from orthocas.parametrisations.mlp import MLPFamily


@dataclass(frozen=True, eq=False)
class NetworkRows:
    """J_xi of xi = W_out tanh(W_2 tanh(W_1 [sin q; cos q; q] + b_1) + b_2) on boxes."""

    layers: tuple[tuple[Array, Array], ...]  #: weights (out, in) and biases (out,)
    direct: tuple[bool, ...]  #: which joints enter as q itself

    @classmethod
    def of(cls, family: MLPFamily, theta: Array) -> "NetworkRows":
        """The layers of a family with its parameters."""
        layers, start = [], 0
        for width, out in pairwise(family.widths):
            end = start + out * width
            layers.append((theta[start:end].reshape(width, out).T.copy(), theta[end : end + out]))
            start = end + out
        return cls(tuple(layers), family.direct)

    def __call__(self, joints: list[TaylorModel], half_widths: Array, variables: Variables) -> TaylorModel:
        """J_xi, (r, n, boxes), for models of the joints."""
        turning = [q for q, slides in zip(joints, self.direct, strict=True) if not slides]
        sliding = [q for q, slides in zip(joints, self.direct, strict=True) if slides]
        sines, cosines = [sine(q) for q in turning], [cosine(q) for q in turning]
        layer, slopes = stacked([*sines, *cosines, *sliding]), []
        one = TaylorModel.constant(np.ones((1, 1)))
        for W, b in self.layers[:-1]:
            layer = tanh(_weighted(W, layer) + TaylorModel.constant(b[:, None]))
            slopes.append(one - square(layer))
        rows = []
        for weights in self.layers[-1][0]:
            gradient = TaylorModel.constant(weights[:, None])
            for (W, _), slope in zip(self.layers[-2::-1], slopes[::-1], strict=True):
                gradient = _weighted(W.T, gradient * slope)
            rows.append(self._by_joint(gradient, sines, cosines))
        return stacked(rows)

    def _by_joint(self, gradient: TaylorModel, sines: list[TaylorModel], cosines: list[TaylorModel]) -> TaylorModel:
        """Derivatives by the joints from those by the inputs [sin q; cos q; q]."""
        turning, columns = len(sines), []
        angle, slide = 0, 2 * turning
        for slides in self.direct:
            if slides:
                columns.append(gradient[slide])
                slide += 1
            else:
                by_sine, by_cosine = gradient[angle], gradient[turning + angle]
                columns.append(by_sine * cosines[angle] - by_cosine * sines[angle])
                angle += 1
        return stacked(columns)


def _weighted(W: Array, models: TaylorModel) -> TaylorModel:
    """W times a column of models, (out, boxes)."""
    size = np.abs(W)
    rounding = 4 * UNIT * (W.shape[1] + 8) * np.abs(models.coefficients).sum(axis=0)
    remainder = (size @ (models.remainder + rounding)) * above(W.shape[1]) + TINY
    return TaylorModel(models.variables, W @ models.coefficients, remainder)
