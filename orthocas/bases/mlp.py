"""Multilayer perceptron of sines and cosines of the joints, or of the joints themselves ([AS2023] Sec. 6, Fig. 16)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from orthocas.bases.cyclic import resolved
from orthocas.bases.family import (
    ArrayMemory,
    Cyclic,
    Expression,
    JointSpace,
    Pulled,
    check_joint_names,
    indices,
    suffix,
)
from orthocas.errors import InvalidValueError
from orthocas.tools.checks import Array, require_count, require_kind, require_known

if TYPE_CHECKING:
    from orthocas.tasks.problem import Problem


#: activation a(z) of a hidden layer: tanh z, or the inverse square root unit z / sqrt(1 + z^2)
ACTIVATIONS = ("tanh", "isru")


def activate(name: str, z: Expression) -> tuple[Expression, Expression]:
    """The value a(z) of an activation and its slope da/dz: 1 - tanh^2 z, or (1 + z^2)^(-3/2)."""
    if name == "tanh":
        value = ca.tanh(z)
        return value, 1 - value**2
    root = 1 / ca.sqrt(1 + z**2)
    return z * root, root * root**2


def _activate_in_place(name: str, z: Array, slope: Array, bend: Array) -> None:
    """Overwrite z with a(z), and compute the slope and the bend d log(da/dz)/dz, which is -2 a or -3 z / (1 + z^2)."""
    if name == "tanh":
        np.tanh(z, out=z)
        np.multiply(z, z, out=slope)
        np.subtract(1, slope, out=slope)
        np.multiply(z, -2, out=bend)
        return
    np.multiply(z, z, out=bend)
    bend += 1
    np.reciprocal(bend, out=bend)
    np.sqrt(bend, out=slope)
    # At this point bend = 1 / (1 + z^2), and slope is its square root.
    z *= slope
    slope *= bend
    np.sqrt(bend, out=bend)
    bend *= z
    bend *= -3


class NetworkArrays:
    """Computes the gradients of a network at samples, and the derivative of a loss of these gradients.

    With a_l = a(V_l^T a_(l-1) + b_l) and slopes s_l, the gradient of an output passes from the last layer to the inputs
    as g_(l-1) = V_l h_l, h_l = s_l g_l. The derivative of a loss passes back: first from the inputs to the outputs
    along the h_l, then from the outputs to the inputs along the a_l. One product gives both parts of dL/dV_l,
    [dL/dg_(l-1), a_(l-1)]^T [h_l, dL/dz_l] with z_l = V_l^T a_(l-1) + b_l. Therefore the arrays (r + 1, N, width) have
    one more entry than there are outputs.

    Args:
        theta: V_1, b_1, ..., V_out, b_out, with V_l (width, next width) row by row. All products have its type.
        family: the network, for its layers and activation.
        inputs: a_0, (N, inputs).
        memory: reused arrays.
    """

    def __init__(self, theta: Array, family: MLPFamily, inputs: Array, memory: ArrayMemory) -> None:
        N, widths = len(inputs), family.widths
        self._widths = widths
        self._V, self._b = split_layers(theta, widths)

        def arrays(name: str, *before: int) -> list[Array]:
            return [memory.array(f"{name}{k}", (*before, N, w), theta.dtype) for k, w in enumerate(widths[:-1])]

        # The last entry of `up` holds the values a_l of the layers.
        self._up, self._below = arrays("up", widths[-1] + 1), arrays("below", widths[-1] + 1)
        self._s, self._bend, self._work = arrays("slope"), arrays("bend"), arrays("work")
        self._a = [array[-1] for array in self._up]
        self._a[0][...] = inputs
        for k, (V, b) in enumerate(zip(self._V[:-1], self._b[:-1], strict=True)):
            a = self._a[k + 1]
            np.add(np.matmul(self._a[k], V, out=a), b, out=a)
            _activate_in_place(family.activation, a, self._s[k + 1], self._bend[k + 1])

    def gradients(self) -> Array:
        """Gradients of the outputs with respect to the inputs, (r, N, inputs)."""
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
        by_V, by_b = split_layers(result, self._widths)
        self._up[0][:-1] = slopes
        for k, V in enumerate(self._V[:-1], start=1):
            up, h = self._up[k][:-1], self._below[k][:-1]
            # dL/dg_k from dL/dh_k; its product with h sums the derivatives by the slopes.
            np.matmul(_flatten(self._up[k - 1][:-1]), V, out=_flatten(up))
            np.einsum("rsw,rsw->sw", up, h, out=self._work[k])
            up *= self._s[k]
        np.sum(self._up[-1][:-1], axis=1, out=by_V[-1].T)
        by_b[-1][...] = 0
        for k in reversed(range(1, len(self._V))):
            by_z, rest = self._below[k][-1], self._work[k]
            rest *= self._bend[k]
            # dL/dz_k: through the next layer and the activation, plus the part through the slopes.
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
    """Reshape (r, N, width) to (r N, width)."""
    return stack.reshape(-1, stack.shape[2])


def split_layers(theta: Array, widths: Sequence[int]) -> tuple[list[Array], list[Array]]:
    """V (width, next width) and b (next width,) of every layer, as views."""
    V, b, start = [], [], 0
    for width, out in pairwise(widths):
        end = start + width * out
        V.append(theta[start:end].reshape(width, out))
        b.append(theta[end : end + out])
        start = end + out
    return V, b


@dataclass(frozen=True)
class MLP:
    """xi = W_out a(W_2 a(W_1 [sin q; cos q] + b_1) + b_2) + b_out, a = tanh. Prismatic joints enter as q itself.

    Args:
        hidden: widths of the hidden layers, each >= 1.
        raw: whether revolute joints enter as q itself too, so that coordinates are not periodic. The paper's number of
            parameters in Sec. 9 is that of raw inputs.
        cyclic: names of joints with one linear term each instead of an input, or "auto" for all cyclic joints of the
            problem; see `Polynomial`.
        without: names of joints that coordinates do not depend on; see `Polynomial`.
        activation: a, "tanh" as in the paper, or "isru", a(z) = z / sqrt(1 + z^2), the inverse square root unit
            (Carlile et al., arXiv:1710.09967). "isru" fits wide charts equally well, and is faster in C.

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
        >>> oc.MLP((24, 24), raw=True, cyclic=["A1"], without=["A7"]).label
        'mlp:24x24:raw:cyclic=A1:without=A7'
        >>> oc.MLP((24, 24), raw=True, activation="isru").label
        'mlp:24x24:raw:isru'
    """

    hidden: tuple[int, ...] = (64, 64)
    raw: bool = False
    # Charts without these settings keep their fingerprints.
    cyclic: Cyclic = field(default=(), metadata={"stored": "if given"})
    without: tuple[str, ...] = field(default=(), metadata={"stored": "if given"})
    activation: str = field(default="tanh", metadata={"stored": "if given"})
    linear = False
    closed_form = None

    def __post_init__(self) -> None:
        if not isinstance(self.hidden, tuple | list) or not self.hidden:
            raise InvalidValueError("hidden", self.hidden, "the widths of at least one hidden layer, such as (64, 64)")
        object.__setattr__(self, "hidden", tuple(require_count("hidden", width) for width in self.hidden))
        require_kind("raw", self.raw, bool)
        cyclic, without = check_joint_names(self.cyclic, self.without)
        object.__setattr__(self, "cyclic", cyclic)
        object.__setattr__(self, "without", without)
        require_known("activation", self.activation, ACTIVATIONS)

    @property
    def label(self) -> str:
        """'mlp:WIDTHxWIDTH', then ':raw', ':isru', and the cyclic and excluded joints, if any."""
        widths = "x".join(map(str, self.hidden)) + (":raw" if self.raw else "")
        widths += "" if self.activation == "tanh" else f":{self.activation}"
        return f"mlp:{widths}{suffix(self.cyclic, self.without)}"

    def for_problem(self, problem: Problem) -> MLP:
        """The parametrisation with `cyclic="auto"` replaced by the names of the problem's cyclic joints."""
        return replace(self, cyclic=resolved(self.cyclic, problem)) if self.cyclic else self

    def family(self, space: JointSpace, outputs: int) -> MLPFamily:
        """The network on the given joints.

        Raises:
            InvalidValueError: if no joint enters the network.
        """
        linear = tuple(indices(self.cyclic, space))
        without = indices(self.without, space)
        inputs = tuple(i for i in range(space.n) if i not in (*linear, *without))
        if not inputs:
            raise InvalidValueError(
                "parametrisation",
                self.label,
                "at least one joint neither in cyclic nor in without, as an input of the network",
            )
        return MLPFamily(space, outputs, self.hidden, self.raw, inputs, linear, self.activation)


@dataclass(frozen=True, eq=False)
class MLPFamily:
    """The network on given joints. theta holds W_1, b_1, ..., W_out, b_out, then A, with matrices column by column."""

    space: JointSpace
    outputs: int
    hidden: tuple[int, ...]
    raw: bool
    inputs: tuple[int, ...]  #: joints that enter the network
    linear: tuple[int, ...]  #: joints q_l that add A q_l
    activation: str = "tanh"
    as_matrices: bool = True

    @property
    def turning(self) -> list[int]:
        """Joints that enter the network as sine and cosine."""
        return [i for i in self.inputs if not (self.raw or self.space.prismatic[i])]

    @property
    def direct(self) -> list[int]:
        """Joints that enter the network as q itself."""
        return [i for i in self.inputs if self.raw or self.space.prismatic[i]]

    @property
    def widths(self) -> tuple[int, ...]:
        """Widths of all layers, from the inputs to the outputs."""
        return (2 * len(self.turning) + len(self.direct), *self.hidden, self.outputs)

    @property
    def size(self) -> int:
        """Number of weights and biases, and of entries of A."""
        return self._network_size + self.outputs * len(self.linear)

    @property
    def _network_size(self) -> int:
        return sum(out * (width + 1) for width, out in pairwise(self.widths))

    @property
    def width(self) -> int:
        """Width of the widest layer."""
        return max(self.widths)

    def _split(self, theta: Expression) -> list[tuple[Expression, Expression]]:
        """Weights (out, width) and biases (out, 1) of every layer."""
        layers, start = [], 0
        for width, out in pairwise(self.widths):
            W = ca.reshape(theta[start : start + out * width], out, width)
            layers.append((W, theta[start + out * width : start + out * (width + 1)]))
            start += out * (width + 1)
        return layers

    def split_slopes(self, theta: Array) -> Array:
        """A, (r, linear)."""
        return theta[self._network_size :].reshape(len(self.linear), self.outputs).T

    def expression(self, q: Expression, theta: Expression) -> Expression:
        """xi_theta(q), (r, N), for q (n, N)."""
        xi = self._forward(q, self._split(theta))[0]
        if self.linear:
            xi += ca.reshape(theta[self._network_size :], self.outputs, len(self.linear)) @ q[list(self.linear), :]
        return xi

    def jacobian(self, q: Expression, theta: Expression) -> list[Expression]:
        """Gradients of the components, r matrices (n, N), by the chain rule from outputs to inputs.

        The gradients of all components pass through the layers in one matrix (width, r N), because BLAS is efficient on
        large products.
        """
        layers = self._split(theta)
        slopes = self._forward(q, layers)[1]
        N, r = q.shape[1], self.outputs
        W_out = layers[-1][0]
        gradients = ca.horzcat(*(ca.repmat(W_out[j, :].T, 1, N) for j in range(r)))
        for (W, _), slope in zip(layers[-2::-1], reversed(slopes), strict=True):
            gradients *= ca.repmat(slope, 1, r)
            # A single sample is a row, so that generated C needs no transposed copy of the weights.
            gradients = (gradients.T @ W).T if N == 1 else W.T @ gradients
        turning: list[int] = self.turning
        t = len(turning)
        by_angle = gradients[:t, :] * ca.repmat(ca.cos(q[turning, :]), 1, r)
        by_angle -= gradients[t : 2 * t, :] * ca.repmat(ca.sin(q[turning, :]), 1, r)
        # Rows of network joints, of linear joints, and of excluded joints.
        parts = [by_angle, gradients[2 * t :, :]]
        if self.linear:
            A = ca.reshape(theta[self._network_size :], r, len(self.linear))
            parts.append(ca.horzcat(*(ca.repmat(A[j, :].T, 1, N) for j in range(r))))
        entered: list[int] = [*turning, *self.direct, *self.linear]
        without: list[int] = [i for i in range(self.space.n) if i not in entered]
        if without:
            parts.append(type(q).zeros(len(without), r * N))
        # Restore the order of the joints.
        stacked = ca.vertcat(*parts)[np.argsort([*entered, *without]).tolist(), :]
        return [stacked[:, j * N : (j + 1) * N] for j in range(r)]

    def pullback(self, points: Array, theta: Array, memory: ArrayMemory | None = None) -> tuple[Array, Pulled]:
        """J_xi at points (N, n), (N, r, n), and the map from dL/dJ_xi to dL/dtheta; see `ArrayFamily`."""
        turning, direct, linear, size = self.turning, self.direct, list(self.linear), self._network_size
        # Sines and cosines of turning joints, and the other joints unchanged.
        angles, t = points[:, turning], len(turning)
        sin, cos = np.sin(angles).astype(theta.dtype), np.cos(angles).astype(theta.dtype)
        inputs = np.concatenate([sin, cos, points[:, direct].astype(theta.dtype)], axis=1)
        network = NetworkArrays(theta[:size], self, inputs, memory or ArrayMemory())
        # Chain rule from the network's inputs, (N, r, inputs), to the joints.
        g = network.gradients().transpose(1, 0, 2)
        J = np.zeros((len(points), self.outputs, self.space.n))
        J[:, :, turning] = g[:, :, :t] * cos[:, None] - g[:, :, t : 2 * t] * sin[:, None]
        J[:, :, direct] = g[:, :, 2 * t :]
        J[:, :, linear] = self.split_slopes(theta)

        # The same chain rule, backwards.
        def back(slopes: Array, result: Array) -> Array:
            by_angle, by_direct = slopes[:, :, turning].astype(theta.dtype), slopes[:, :, direct].astype(theta.dtype)
            parts = [by_angle * cos[:, None], -by_angle * sin[:, None], by_direct]
            network.pull_back(np.concatenate(parts, axis=2).transpose(1, 0, 2), result[:size])
            result[size:] = slopes[:, :, linear].sum(axis=0).T.ravel()
            return result

        return J, back

    def _forward(
        self, q: Expression, layers: list[tuple[Expression, Expression]]
    ) -> tuple[Expression, list[Expression]]:
        """Outputs of the network (r, N), and the slopes of the hidden layers, (width, N) each."""
        # Inputs: sines and cosines of turning joints, and the other joints unchanged.
        angles = q[self.turning, :]
        layer = ca.vertcat(ca.sin(angles), ca.cos(angles), q[self.direct, :])
        slopes = []
        for depth, (W, b) in enumerate(layers):
            layer = W @ layer + ca.repmat(b, 1, q.shape[1])
            if depth < len(self.hidden):
                layer, slope = activate(self.activation, layer)
                slopes.append(slope)
        return layer, slopes

    def initial(self, seed: int) -> Array:
        """Glorot-uniform weights, zero biases and no linear terms, (size,)."""
        rng = np.random.default_rng(seed)
        parts = []
        for width, out in pairwise(self.widths):
            bound = np.sqrt(6 / (width + out))
            parts += [rng.uniform(-bound, bound, out * width), np.zeros(out)]
        return np.concatenate([*parts, np.zeros(self.outputs * len(self.linear))])

    def reordered(self, theta: Array, order: Sequence[int]) -> Array:
        """Parameters with the outputs in another order, (size,)."""
        # Multiplications by 0 and 1 are exact.
        return self.combined(theta, np.eye(self.outputs)[list(order)])

    def combined(self, theta: Array, B: Array) -> Array:
        """Parameters of B xi, (size,), for a matrix B (r, r)."""
        # The last parameters are W_out column by column, b_out, and A.
        last = self.outputs * (self.widths[-2] + 1 + len(self.linear))
        columns = theta[-last:].reshape(-1, self.outputs) @ B.T
        return np.concatenate([theta[:-last], columns.ravel()])
