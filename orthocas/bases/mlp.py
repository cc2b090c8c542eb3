"""Multilayer perceptron of sines and cosines of the joints, or of the joints themselves ([AS2023] Sec. 6, Fig. 16)."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from orthocas.bases.family import ArrayMemory, Expression, JointSpace, Pulled
from orthocas.errors import InvalidValueError
from orthocas.tools.checks import Array, require_count, require_kind

if TYPE_CHECKING:
    from orthocas.tasks.problem import Problem


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

        # Values of the layers lie in the last place of `up`, slopes 1 - a^2 beside them.
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
        # From the last layer to the inputs.
        *hidden, last = self._V
        np.multiply(last.T[:, None, :], self._s[-1], out=self._below[-1][:-1])
        for k in reversed(range(len(hidden))):
            np.matmul(_flatten(self._below[k + 1][:-1]), hidden[k].T, out=_flatten(self._below[k][:-1]))
            if k:
                self._below[k][:-1] *= self._s[k]
        return self._below[0][:-1]

    def pull_back(self, slopes: Array, result: Array) -> Array:
        """dL/dtheta from the derivatives of L with respect to `gradients`, (r, N, inputs). Call `gradients` before.

        Args:
            slopes: the derivatives.
            result: takes dL/dtheta, (size,), and is returned.
        """
        by_V, by_b = _layers(result, self._widths)
        self._up[0][:-1] = slopes
        for k, V in enumerate(self._V[:-1], start=1):
            up, h = self._up[k][:-1], self._below[k][:-1]
            # By h, then by s, times s.
            np.matmul(_flatten(self._up[k - 1][:-1]), V, out=_flatten(up))
            np.einsum("rsw,rsw->sw", up, h, out=self._work[k])
            up *= self._s[k]
        np.sum(self._up[-1][:-1], axis=1, out=by_V[-1].T)
        by_b[-1][...] = 0
        for k in reversed(range(1, len(self._V))):
            by_z, rest = self._below[k][-1], self._work[k]
            rest *= self._a[k]
            rest *= -2
            # By a, then through tanh, and what s adds.
            if k < len(self._V) - 1:
                np.matmul(self._below[k + 1][-1], self._V[k].T, out=by_z)
                by_z *= self._s[k]
                by_z += rest
            else:
                by_z[...] = rest
            np.matmul(_flatten(self._up[k - 1]).T, _flatten(self._below[k]), out=by_V[k - 1])
            np.sum(by_z, axis=0, out=by_b[k - 1])
        return result


def _flatten(stack: Array) -> Array:
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


@dataclass(frozen=True)
class MLP:
    """xi = W_out tanh(W_2 tanh(W_1 [sin q; cos q] + b_1) + b_2) + b_out. Prismatic joints enter as q itself.

    Args:
        hidden: widths of the hidden layers, each >= 1.
        raw: whether revolute joints enter as q itself, too. Coordinates are then not periodic. The number of parameters
            that the paper states for its network in Sec. 9 is that of raw inputs.

    Example:
        >>> import orthocas as oc
        >>> from orthocas import problems, solvers
        >>> network = oc.MLP(hidden=(6, 6))
        >>> solver = solvers.LBFGS(max_iterations=5)
        >>> chart = oc.fit(problems.get("planar_3r_xy"), network, solver, samples=100).chart
        >>> chart.coordinates.label, chart.coordinates.size
        ('mlp:6x6', 91)
        >>> oc.MLP(hidden=(1024, 512), raw=True).label
        'mlp:1024x512:raw'
    """

    hidden: tuple[int, ...] = (64, 64)
    raw: bool = False
    linear = False
    closed_form = None

    def __post_init__(self) -> None:
        if not isinstance(self.hidden, tuple | list) or not self.hidden:
            raise InvalidValueError("hidden", self.hidden, "the widths of at least one hidden layer, such as (64, 64)")
        object.__setattr__(self, "hidden", tuple(require_count("hidden", width) for width in self.hidden))
        require_kind("raw", self.raw, bool)

    @property
    def label(self) -> str:
        """'mlp:WIDTHxWIDTH', and ':raw' for raw inputs."""
        return "mlp:" + "x".join(map(str, self.hidden)) + (":raw" if self.raw else "")

    def for_problem(self, problem: "Problem") -> "MLP":
        """The object itself: it does not depend on the problem."""
        return self

    def family(self, space: JointSpace, outputs: int) -> "MLPFamily":
        """The network on the given joints."""
        return MLPFamily(space, outputs, self.hidden, self.raw)


@dataclass(frozen=True, eq=False)
class MLPFamily:
    """The network on given joints. theta holds W_1, b_1, ..., W_out, b_out, with matrices column by column."""

    space: JointSpace
    outputs: int
    hidden: tuple[int, ...]
    raw: bool = False
    as_matrices: bool = True

    @property
    def direct(self) -> tuple[bool, ...]:
        """Which joints enter as q itself."""
        return (True,) * self.space.n if self.raw else self.space.prismatic

    @property
    def widths(self) -> tuple[int, ...]:
        """Widths of all layers, from the inputs to the outputs."""
        return (2 * self.space.n - sum(self.direct), *self.hidden, self.outputs)

    @property
    def size(self) -> int:
        """Number of weights and biases."""
        return sum(out * (width + 1) for width, out in pairwise(self.widths))

    @property
    def width(self) -> int:
        """Width of the widest layer."""
        return max(self.widths)

    def expression(self, q: Expression, theta: Expression) -> Expression:
        """xi_theta(q), (r, N), for q (n, N)."""
        return self._forward(q, self._layers(theta))[0]

    def jacobian(self, q: Expression, theta: Expression) -> list[Expression]:
        """Gradients of the components, r matrices (n, N), by the chain rule from the outputs to the inputs.

        The gradients of all components pass through the layers side by side, as one matrix (width, r N), because BLAS
        is fast at large products.
        """
        layers = self._layers(theta)
        slopes = self._forward(q, layers)[1]
        N = q.shape[1]
        W_out = layers[-1][0]
        gradients = ca.horzcat(*(ca.repmat(W_out[j, :].T, 1, N) for j in range(self.outputs)))
        for (W, _), slope in zip(layers[-2::-1], reversed(slopes), strict=True):
            gradients *= ca.repmat(slope, 1, self.outputs)
            # One sample as rows: then generated C needs no transposed copy of the weights.
            gradients = (gradients.T @ W).T if N == 1 else W.T @ gradients
        t = len(self._turning)
        by_angle = gradients[:t, :] * ca.repmat(ca.cos(q[self._turning, :]), 1, self.outputs)
        by_angle -= gradients[t : 2 * t, :] * ca.repmat(ca.sin(q[self._turning, :]), 1, self.outputs)
        # Back to the order of the joints.
        rows = np.argsort([*self._turning, *self._direct_joints]).tolist()
        stacked = ca.vertcat(by_angle, gradients[2 * t :, :])[rows, :]
        return [stacked[:, j * N : (j + 1) * N] for j in range(self.outputs)]

    def split_layers(self, theta: Array) -> list[tuple[Array, Array]]:
        """Weights (out, width) and biases (out,) of every layer."""
        return [(W.T.copy(), b) for W, b in zip(*_layers(theta, self.widths), strict=True)]

    def pullback(self, points: Array, theta: Array, memory: ArrayMemory | None = None) -> tuple[Array, Pulled]:
        """J_xi at points (N, n), (N, r, n), and the map from dL/dJ_xi to dL/dtheta; see `ArrayFamily`."""
        angles, t = points[:, self._turning], len(self._turning)
        sin, cos = np.sin(angles).astype(theta.dtype), np.cos(angles).astype(theta.dtype)
        inputs = np.concatenate([sin, cos, points[:, self._direct_joints].astype(theta.dtype)], axis=1)
        network = NetworkArrays(theta, self.widths, inputs, memory or ArrayMemory())
        # From the inputs, (N, r, inputs), to the joints.
        g = network.gradients().transpose(1, 0, 2)
        J = np.empty((len(points), self.outputs, self.space.n))
        J[:, :, self._turning] = g[:, :, :t] * cos[:, None] - g[:, :, t : 2 * t] * sin[:, None]
        J[:, :, self._direct_joints] = g[:, :, 2 * t :]

        def back(slopes: Array, result: Array) -> Array:
            by_angle, direct = slopes[:, :, self._turning].astype(theta.dtype), slopes[:, :, self._direct_joints]
            parts = [by_angle * cos[:, None], -by_angle * sin[:, None], direct.astype(theta.dtype)]
            return network.pull_back(np.concatenate(parts, axis=2).transpose(1, 0, 2), result)

        return J, back

    @property
    def _turning(self) -> list[int]:
        return [i for i, direct in enumerate(self.direct) if not direct]

    @property
    def _direct_joints(self) -> list[int]:
        return [i for i, direct in enumerate(self.direct) if direct]

    def _layers(self, theta: Expression) -> list[tuple[Expression, Expression]]:
        """Weights and biases of every layer."""
        layers, start = [], 0
        for width, out in pairwise(self.widths):
            W = ca.reshape(theta[start : start + out * width], out, width)
            layers.append((W, theta[start + out * width : start + out * (width + 1)]))
            start += out * (width + 1)
        return layers

    def _forward(
        self, q: Expression, layers: list[tuple[Expression, Expression]]
    ) -> tuple[Expression, list[Expression]]:
        """Outputs (r, N), and the derivatives 1 - tanh^2 of the hidden layers, (width, N) each."""
        angles = q[self._turning, :]
        layer = ca.vertcat(ca.sin(angles), ca.cos(angles), q[self._direct_joints, :])
        slopes = []
        for depth, (W, b) in enumerate(layers):
            layer = W @ layer + ca.repmat(b, 1, q.shape[1])
            if depth < len(self.hidden):
                layer = ca.tanh(layer)
                slopes.append(1 - layer**2)
        return layer, slopes

    def initial(self, seed: int) -> Array:
        """Glorot-uniform weights and zero biases, (size,)."""
        rng = np.random.default_rng(seed)
        parts = []
        for width, out in pairwise(self.widths):
            bound = np.sqrt(6 / (width + out))
            parts += [rng.uniform(-bound, bound, out * width), np.zeros(out)]
        return np.concatenate(parts)

    def reordered(self, theta: Array, order: Sequence[int]) -> Array:
        """Parameters with the outputs in another order, (size,)."""
        # The products with 0 and 1 are exact.
        return self.combined(theta, np.eye(self.outputs)[list(order)])

    def combined(self, theta: Array, B: Array) -> Array:
        """Parameters of B xi, (size,), for a matrix B (r, r)."""
        # W_out column by column, then b_out.
        last = self.outputs * (self.widths[-2] + 1)
        columns = theta[-last:].reshape(-1, self.outputs) @ B.T
        return np.concatenate([theta[:-last], columns.ravel()])
