"""Multilayer perceptron with sine and cosine inputs ([AS2023] Sec. 6, Fig. 16)."""

from dataclasses import dataclass
from itertools import pairwise

import casadi as ca
import numpy as np

from orthocas.checks import Array, require_count
from orthocas.errors import InvalidValueError
from orthocas.parametrisations.family import Expression, JointSpace


@dataclass(frozen=True)
class MLP:
    """xi = W_out tanh(W_2 tanh(W_1 [sin q; cos q] + b_1) + b_2) + b_out; a prismatic joint enters as q itself.

    Args:
        hidden: widths of the hidden layers, each >= 1.
    """

    hidden: tuple[int, ...] = (64, 64)

    def __post_init__(self) -> None:
        if not isinstance(self.hidden, tuple | list) or not self.hidden:
            raise InvalidValueError("hidden", self.hidden, "the widths of at least one hidden layer, such as (64, 64)")
        object.__setattr__(self, "hidden", tuple(require_count("hidden", width) for width in self.hidden))

    @property
    def label(self) -> str:
        """'mlp:WIDTHxWIDTH'."""
        return "mlp:" + "x".join(map(str, self.hidden))

    def family(self, space: JointSpace, outputs: int) -> "MLPFamily":
        """The network on the given joints."""
        return MLPFamily(space, outputs, self.hidden)


@dataclass(frozen=True, eq=False)
class MLPFamily:
    """The network on given joints. theta holds W_1, b_1, W_2, b_2, ..., W_out, b_out, matrices column by column."""

    space: JointSpace
    outputs: int
    hidden: tuple[int, ...]
    as_matrices: bool = True

    @property
    def widths(self) -> tuple[int, ...]:
        """Widths of all layers, from the inputs to the outputs."""
        return (2 * self.space.n - sum(self.space.prismatic), *self.hidden, self.outputs)

    @property
    def size(self) -> int:
        """Number of weights and biases."""
        return sum(out * (width + 1) for width, out in pairwise(self.widths))

    def expression(self, q: Expression, theta: Expression) -> Expression:
        """xi_theta(q), (r, N), for q (n, N)."""
        turning = [i for i, slides in enumerate(self.space.prismatic) if not slides]
        sliding = [i for i, slides in enumerate(self.space.prismatic) if slides]
        layer = ca.vertcat(ca.sin(q[turning, :]), ca.cos(q[turning, :]), q[sliding, :])
        start = 0
        for depth, (width, out) in enumerate(pairwise(self.widths)):
            W = ca.reshape(theta[start : start + out * width], out, width)
            b = theta[start + out * width : start + out * (width + 1)]
            start += out * (width + 1)
            layer = W @ layer + ca.repmat(b, 1, q.shape[1])
            if depth < len(self.hidden):
                layer = ca.tanh(layer)
        return layer

    def initial(self, seed: int) -> Array:
        """Glorot-uniform weights and zero biases, (size,)."""
        rng = np.random.default_rng(seed)
        parts = []
        for width, out in pairwise(self.widths):
            bound = np.sqrt(6 / (width + out))
            parts += [rng.uniform(-bound, bound, out * width), np.zeros(out)]
        return np.concatenate(parts)
