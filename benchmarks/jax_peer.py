"""Two peers in JAX for the same problem and loss as `torch_peer`: Adam in one compiled loop, and SciPy's L-BFGS.

Adam trains the same network with the same schedules as in PyTorch. All its steps are one compiled program, so nothing
of Python is left in it. L-BFGS-B of SciPy minimises the loss on fixed samples, with values and gradients from JAX.
Samples, task gradients and compilation come before the clock starts.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from scipy.optimize import minimize
from torch_peer import PeerResult, PeerSettings, judged, samples

from orthocas.tasks.problem import Problem
from orthocas.tools.checks import Array

Layers = list[tuple[Any, Any]]  # weights (out, in) and biases
_MOMENT, _SQUARE, _SMALL = 0.9, 0.999, 1e-8


@dataclass(frozen=True)
class DescentSettings:
    """A minimisation with L-BFGS."""

    hidden: int = 32
    samples: int = 2000
    iterations: int = 300
    weights: tuple[float, float] = (1000.0, 30.0)


def train(
    problem: Problem, settings: PeerSettings, seed: int = 0, clock: Callable[[], float] = time.perf_counter
) -> PeerResult:
    """Train once with Adam, and evaluate on held-out samples."""
    layers = _initial(problem, settings.hidden, seed)
    shape = (settings.steps, settings.batch)
    q, g = (jnp.asarray(a.reshape(*shape, *a.shape[1:])) for a in samples(problem, int(np.prod(shape)), seed))
    rates = jnp.asarray([settings.rate(k) for k in range(settings.steps)], dtype=jnp.float32)
    program = _training.lower(layers, q, g, rates, settings.weights).compile()
    start = clock()
    trained = jax.block_until_ready(program(layers, q, g, rates))
    return judged(problem, [(np.array(W), np.array(b)) for W, b in trained], clock() - start)


def descend(
    problem: Problem, settings: DescentSettings, seed: int = 0, clock: Callable[[], float] = time.perf_counter
) -> PeerResult:
    """Minimise once with SciPy's L-BFGS-B, and evaluate on held-out samples."""
    theta, unflat = ravel_pytree(_initial(problem, settings.hidden, seed))
    q, g = (jnp.asarray(array) for array in samples(problem, settings.samples, seed))
    program = jax.jit(jax.value_and_grad(lambda theta: _loss(unflat(theta), q, g, settings.weights)))

    def value_and_gradient(theta: Array) -> tuple[float, Array]:
        value, gradient = program(theta.astype(np.float32))
        return float(value), np.asarray(gradient, dtype=float)

    value_and_gradient(np.asarray(theta, dtype=float))  # compiles
    start = clock()
    options = {"maxiter": settings.iterations, "maxfun": 2 * settings.iterations, "maxcor": 20}
    found = minimize(value_and_gradient, np.asarray(theta, float), jac=True, method="L-BFGS-B", options=options)
    seconds = clock() - start
    return judged(problem, [(np.array(W), np.array(b)) for W, b in unflat(found.x.astype(np.float32))], seconds)


def _initial(problem: Problem, hidden: int, seed: int) -> Layers:
    """Weights and biases as PyTorch draws them: uniform within 1 / sqrt(inputs)."""
    rng = np.random.default_rng(seed)
    layers = []
    for width, out in pairwise([2 * (problem.n - 1), hidden, hidden, problem.r - 1]):
        bound = 1 / np.sqrt(width)
        drawn = (rng.uniform(-bound, bound, size) for size in ((out, width), out))
        layers.append(tuple(jnp.asarray(part, dtype=jnp.float32) for part in drawn))
    return layers  # type: ignore[return-value]


@partial(jax.jit, static_argnames="weights")
def _training(layers: Layers, q: Any, g: Any, rates: Any, weights: tuple[float, float]) -> Layers:
    """The layers after all steps of Adam."""

    def step(state: Any, batch: Any) -> tuple[Any, None]:
        theta, mean, square, k = state
        points, task, rate = batch
        slopes = jax.grad(_loss)(theta, points, task, weights)
        mean = jax.tree.map(lambda m, s: _MOMENT * m + (1 - _MOMENT) * s, mean, slopes)
        square = jax.tree.map(lambda v, s: _SQUARE * v + (1 - _SQUARE) * s * s, square, slopes)
        by_mean, by_square = 1 - _MOMENT**k, 1 - _SQUARE**k
        theta = jax.tree.map(
            lambda t, m, v: t - rate * (m / by_mean) / (jnp.sqrt(v / by_square) + _SMALL), theta, mean, square
        )
        return (theta, mean, square, k + 1), None

    zeros = jax.tree.map(jnp.zeros_like, layers)
    state, _ = jax.lax.scan(step, (layers, zeros, zeros, jnp.float32(1)), (q, g, rates))
    return state[0]  # type: ignore[no-any-return]


def _loss(layers: Layers, q: Any, g: Any, weights: tuple[float, float]) -> Any:
    """Mean of [AS2023] eq. (24), A = I."""
    (W1, b1), (W2, b2), (W3, _) = layers
    n = q.shape[1]
    s, c = jnp.sin(q), jnp.cos(q)
    h1 = jnp.tanh(jnp.concatenate([s, c], axis=1) @ W1.T + b1)
    h2 = jnp.tanh(h1 @ W2.T + b2)
    N, r = len(q), len(W3)
    by_h1 = (W3[None] * (1 - h2**2)[:, None, :]).reshape(N * r, -1) @ W2
    by_input = ((by_h1.reshape(N, r, -1) * (1 - h1**2)[:, None, :]).reshape(N * r, -1) @ W1).reshape(N, r, -1)
    J = by_input[:, :, :n] * c[:, None, :] - by_input[:, :, n:] * s[:, None, :]
    unit = J / jnp.linalg.norm(J, axis=2, keepdims=True)
    task = jnp.sum(jnp.einsum("smn,srn->smr", g, unit) ** 2, axis=(1, 2)).mean()
    rows, columns = np.tril_indices(r, -1)
    mutual = sum(jnp.sum(unit[:, i] * unit[:, j], axis=1) ** 2 for i, j in zip(rows, columns, strict=True)).mean()
    return weights[0] / (2 * g.shape[1] * r) * task + weights[1] / (2 * len(rows)) * mutual
