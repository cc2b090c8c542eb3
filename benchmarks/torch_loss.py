"""Loss and gradient in PyTorch with the same mathematics as ours: the peer of `benchmarks/gradients.py`.

J_xi of a network comes from forward tangents, one per joint, or from reverse gradients, one per coordinate (as in our
code). Bases that are linear in their parameters use the same sampled basis gradients as our code.
"""

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import torch

from orthocas.tools.checks import Array

Step = Callable[[], tuple[float, Array]]
WEIGHTS = (1000.0, 30.0)


def network_step(
    hidden: tuple[int, ...], theta: Array, q: Array, g: Array, r: int, dtype: torch.dtype, mode: str
) -> Step:
    """Loss and gradient of a network with two hidden layers; `mode` is 'forward' or 'reverse'."""
    n = q.shape[1]
    layers = _layers(theta, [2 * n, *hidden, r], dtype)
    points, gradients = torch.tensor(q, dtype=dtype), torch.tensor(g, dtype=dtype)
    jacobian = {"forward": _by_forward, "reverse": _by_reverse}[mode]
    parameters = [p for layer in layers for p in layer]

    def step() -> tuple[float, Array]:
        for p in parameters:
            p.grad = None
        loss = _loss(jacobian(layers, points), gradients)
        loss.backward()
        slopes = [
            torch.zeros_like(p) if p.grad is None else p.grad for p in parameters
        ]  # the last bias has no gradient
        flat = [slope.T.ravel() if slope.ndim == 2 else slope for slope in slopes]
        return loss.item(), torch.cat(flat).numpy().astype(float)

    return step


def basis_step(C: Array, G: Array, g: Array, dtype: torch.dtype) -> Step:
    """Loss and gradient of J_xi = C G^T with sampled basis gradients G (N, n, K)."""
    basis, gradients = torch.tensor(G, dtype=dtype), torch.tensor(g, dtype=dtype)
    coefficients = torch.tensor(C, dtype=dtype, requires_grad=True)

    def step() -> tuple[float, Array]:
        coefficients.grad = None
        loss = _loss((basis @ coefficients.T).transpose(1, 2), gradients)
        loss.backward()
        assert coefficients.grad is not None
        return loss.item(), coefficients.grad.numpy().ravel().astype(float)

    return step


def _layers(theta: Array, widths: list[int], dtype: torch.dtype) -> list[tuple[torch.Tensor, torch.Tensor]]:
    """Weights and biases in the order of our theta, with matrices column by column."""
    layers, start = [], 0
    for width, out in pairwise(widths):
        W = theta[start : start + out * width].reshape(width, out).T
        b = theta[start + out * width : start + out * (width + 1)]
        start += out * (width + 1)
        layers.append(
            tuple(torch.tensor(np.ascontiguousarray(part), dtype=dtype, requires_grad=True) for part in (W, b))
        )
    return layers  # type: ignore[return-value]


def _forward(
    layers: list[tuple[torch.Tensor, torch.Tensor]], q: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    (W1, b1), (W2, b2), _ = layers
    s, c = torch.sin(q), torch.cos(q)
    h1 = torch.tanh(torch.cat([s, c], dim=1) @ W1.T + b1)
    return s, c, h1, torch.tanh(h1 @ W2.T + b2)


def _by_forward(layers: list[tuple[torch.Tensor, torch.Tensor]], q: torch.Tensor) -> torch.Tensor:
    (W1, _), (W2, _), (W3, _) = layers
    n = q.shape[1]
    s, c, h1, h2 = _forward(layers, q)
    d1 = (c[:, :, None] * W1[:, :n].T - s[:, :, None] * W1[:, n:].T) * (1 - h1**2)[:, None, :]
    d2 = (d1 @ W2.T) * (1 - h2**2)[:, None, :]
    return (d2 @ W3.T).transpose(1, 2)


def _by_reverse(layers: list[tuple[torch.Tensor, torch.Tensor]], q: torch.Tensor) -> torch.Tensor:
    (W1, _), (W2, _), (W3, _) = layers
    n = q.shape[1]
    s, c, h1, h2 = _forward(layers, q)
    u = ((W3[None] * (1 - h2**2)[:, None, :]) @ W2 * (1 - h1**2)[:, None, :]) @ W1
    return u[:, :, :n] * c[:, None, :] - u[:, :, n:] * s[:, None, :]


def _loss(J: torch.Tensor, g: torch.Tensor) -> torch.Tensor:
    """Mean of [AS2023] eq. (24), A = I."""
    r, m = J.shape[1], g.shape[1]
    unit = J / J.norm(dim=2, keepdim=True)
    task = g @ unit.transpose(1, 2)
    rows, columns = torch.tril_indices(r, r, -1)
    mutual = (unit @ unit.transpose(1, 2))[:, rows, columns]
    task_term = WEIGHTS[0] / (2 * m * r) * (task**2).sum(dim=(1, 2)).mean()
    return task_term + WEIGHTS[1] / (2 * len(rows)) * (mutual**2).sum(dim=1).mean()
