"""Coordinate gradients of a network on NumPy arrays, in any precision, with their derivative by hand (ours)."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from orthocas.checks import Array
from orthocas.parametrisations.array_memory import ArrayMemory


class NetworkArrays:
    """The gradients of a network with tanh layers at samples, and the derivative of a loss of these gradients.

    With a_l = tanh(V_l^T a_(l-1) + b_l) and s_l = 1 - a_l^2, the gradient of an output passes from the last layer to
    the inputs as g_(l-1) = V_l h_l, h_l = s_l g_l. The derivative of a loss goes back: first from the inputs to the
    outputs along the h_l, then from the outputs to the inputs along the a_l. Both parts of dL/dV_l are one product,
    [dL/dg_(l-1), a_(l-1)]^T [h_l, dL/dz_l] with z_l = V_l^T a_(l-1) + b_l. So these arrays (r + 1, N, width) have one
    place more than there are outputs.

    Args:
        theta: V_1, b_1, ..., V_out, b_out, with V_l (width, next width) row by row. All products have its type.
        widths: widths of all layers, from the inputs to the outputs.
        inputs: a_0, (N, inputs).
        memory: the arrays of earlier networks.
    """

    def __init__(self, theta: Array, widths: Sequence[int], inputs: Array, memory: ArrayMemory) -> None:
        N, self._widths = len(inputs), widths
        self._V, self._b = _layers(theta, widths)

        def arrays(name: str, *before: int) -> list[Array]:
            return [memory.array(f"{name}{k}", (*before, N, w), theta.dtype) for k, w in enumerate(widths[:-1])]

        self._up, self._below = arrays("up", widths[-1] + 1), arrays("below", widths[-1] + 1)
        self._s, self._work = arrays("slope"), arrays("work")
        self._a = [array[-1] for array in self._up]
        self._a[0][...] = inputs
        for V, b, before, a, s in zip(self._V, self._b, self._a, self._a[1:], self._s[1:], strict=False):
            np.add(np.matmul(before, V, out=a), b, out=a)
            np.tanh(a, out=a)
            np.multiply(a, a, out=s)
            np.subtract(1, s, out=s)

    def gradients(self) -> Array:
        """Gradients of the outputs with respect to the inputs, (r, N, inputs)."""
        *hidden, last = self._V
        np.multiply(last.T[:, None, :], self._s[-1], out=self._below[-1][:-1])
        for k in reversed(range(len(hidden))):
            np.matmul(_flat(self._below[k + 1][:-1]), hidden[k].T, out=_flat(self._below[k][:-1]))
            if k:
                self._below[k][:-1] *= self._s[k]
        return self._below[0][:-1]

    def pulled_back(self, slopes: Array, result: Array) -> Array:
        """dL/dtheta from the derivatives of L with respect to `gradients`, (r, N, inputs). Call `gradients` before.

        Args:
            slopes: the derivatives.
            result: takes dL/dtheta, (size,), and is returned.
        """
        by_V, by_b = _layers(result, self._widths)
        self._up[0][:-1] = slopes
        for k, V in enumerate(self._V[:-1], start=1):
            up, h = self._up[k][:-1], self._below[k][:-1]
            np.matmul(_flat(self._up[k - 1][:-1]), V, out=_flat(up))  # by h
            np.einsum("rsw,rsw->sw", up, h, out=self._work[k])  # by s, times s
            up *= self._s[k]
        np.sum(self._up[-1][:-1], axis=1, out=by_V[-1].T)
        by_b[-1][...] = 0
        for k in reversed(range(1, len(self._V))):
            by_z, rest = self._below[k][-1], self._work[k]
            rest *= self._a[k]
            rest *= -2
            if k < len(self._V) - 1:
                np.matmul(self._below[k + 1][-1], self._V[k].T, out=by_z)  # by a
                by_z *= self._s[k]
                by_z += rest
            else:
                by_z[...] = rest
            np.matmul(_flat(self._up[k - 1]).T, _flat(self._below[k]), out=by_V[k - 1])
            np.sum(by_z, axis=0, out=by_b[k - 1])
        return result


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
