"""Coordinate gradients of a network on NumPy arrays, in any precision, with their derivative by hand (ours)."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from orthocas.checks import Array


class NetworkArrays:
    """The gradients of a network with tanh layers at samples, and the derivative of a loss of these gradients.

    With a_l = tanh(V_l^T a_(l-1) + b_l) and s_l = 1 - a_l^2, the gradient of an output passes from the last layer to
    the inputs as g_(l-1) = V_l h_l, h_l = s_l g_l. The derivative of a loss goes back: first from the inputs to the
    outputs along the g_l, then from the outputs to the inputs along the a_l.

    Args:
        theta: V_1, b_1, ..., V_out, b_out, with V_l (width, next width) row by row. All products have its type.
        widths: widths of all layers, from the inputs to the outputs.
        inputs: a_0, (N, inputs).
    """

    def __init__(self, theta: Array, widths: Sequence[int], inputs: Array) -> None:
        self._V, self._b = _layers(theta, widths)
        self._a, self._s = [inputs], []
        for V, b in zip(self._V[:-1], self._b, strict=False):
            a = self._a[-1] @ V
            a += b
            np.tanh(a, out=a)
            self._a.append(a)
            self._s.append(1 - a * a)
        self._g: list[Array] = []  # at hidden layers, (r, N, width)
        self._h: list[Array] = []

    def gradients(self) -> Array:
        """Gradients of the outputs with respect to the inputs, (r, N, inputs)."""
        r, N = self._V[-1].shape[1], len(self._a[0])
        g: Array = np.broadcast_to(self._V[-1].T[:, None, :], (r, N, len(self._V[-1])))
        for V, s in zip(self._V[-2::-1], reversed(self._s), strict=True):
            h = g * s
            self._g.insert(0, g)
            self._h.insert(0, h)
            g = (_flat(h) @ V.T).reshape(r, N, -1)
        return g

    def pulled_back(self, slopes: Array) -> Array:
        """dL/dtheta from the derivatives of L with respect to `gradients`, (r, N, inputs). Call `gradients` before."""
        by_V, by_s, up = [], [], slopes
        for V, s, g, h in zip(self._V, self._s, self._g, self._h, strict=False):
            by_V.append(_flat(up).T @ _flat(h))
            up = (_flat(up) @ V).reshape(g.shape)  # by h
            by_s.append(np.einsum("rsw,rsw->sw", up, g))
            up *= s
        by_V.append(up.sum(axis=1).T)
        by_b = [np.zeros_like(b) for b in self._b]
        by_a = np.zeros_like(self._a[-1])
        for k in reversed(range(len(self._s))):
            by_z = (by_a - 2 * self._a[k + 1] * by_s[k]) * self._s[k]
            by_V[k] += self._a[k].T @ by_z
            by_b[k] = by_z.sum(axis=0)
            if k:
                by_a = by_z @ self._V[k].T
        return np.concatenate([part.ravel() for pair in zip(by_V, by_b, strict=True) for part in pair])


def _flat(stack: Array) -> Array:
    """(r, N, width) as (r N, width)."""
    return stack.reshape(-1, stack.shape[2])


def _layers(theta: Array, widths: Sequence[int]) -> tuple[list[Array], list[Array]]:
    """V and b of every layer, as views."""
    V, b, start = [], [], 0
    for width, out in pairwise(widths):
        end = start + width * out
        V.append(theta[start:end].reshape(width, out))
        b.append(theta[end : end + out])
        start = end + out
    return V, b
