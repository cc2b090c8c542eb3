"""The strongest peer we know for fitting: an MLP in PyTorch, trained with Adam on the same problem and loss.

It uses float32, fresh uniform samples in every step and a cosine learning rate. It has the same advantages as our own
fit: the idle joint (which does not move the task) is split off, so it fits three coordinates of six joints. J_xi comes
from reverse gradients, one per coordinate, which is faster than forward tangents of six joints. Its samples and task
gradients are computed before its clock starts, and so is the code that `torch.compile` makes; our fit computes samples
while the clock runs.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch

from orthocas.tasks.problem import Problem
from orthocas.tasks.samples import sample_uniform
from orthocas.tools.checks import Array


@dataclass(frozen=True)
class PeerSettings:
    """One training schedule."""

    hidden: int = 128
    steps: int = 2000
    batch: int = 500
    learning_rate: float = 5e-3
    weights: tuple[float, float] = (1000.0, 30.0)

    def rate(self, k: int) -> float:
        """Learning rate of step k = 0, 1, ..., which falls to zero along half a cosine."""
        return self.learning_rate * 0.5 * (1 + math.cos(math.pi * k / self.steps))


class PeerResult(NamedTuple):
    """Standard deviations over all angles, including the exact coordinate as in the paper, and training seconds."""

    task_std_deg: float
    mutual_std_deg: float
    seconds: float


Layers = list[tuple[torch.Tensor, torch.Tensor]]  # weights (out, in) and biases


def train(
    problem: Problem,
    settings: PeerSettings,
    seed: int = 0,
    compiled: bool = False,
    clock: Callable[[], float] = time.perf_counter,
) -> PeerResult:
    """Train once, eagerly or with `torch.compile`, and evaluate on held-out samples."""
    layers = _initial(problem, settings.hidden, seed)
    optimiser = torch.optim.Adam([p for layer in layers for p in layer], lr=settings.learning_rate, fused=True)
    loss = _compiled_loss if compiled else _loss
    points, task = samples(problem, settings.steps * settings.batch, seed)
    q, g = (torch.tensor(array).split(settings.batch) for array in (points, task))
    loss(layers, q[0], g[0], settings.weights).backward()  # compiles
    start = clock()
    for k in range(settings.steps):
        for group in optimiser.param_groups:
            group["lr"] = settings.rate(k)
        optimiser.zero_grad()
        loss(layers, q[k], g[k], settings.weights).backward()
        optimiser.step()
    seconds = clock() - start
    return judged(problem, [(W.detach().numpy(), b.detach().numpy()) for W, b in layers], seconds)


def samples(problem: Problem, count: int, seed: int) -> tuple[Array, Array]:
    """Joint angles (N, n) and unit task gradients (N, m, n) of the joints before the idle one, in single precision."""
    points = sample_uniform(problem.domain, count, seed)
    J = problem.task.evaluate_jacobian(points)[:, :, :-1]
    J = J / np.linalg.norm(J, axis=2, keepdims=True)
    return points[:, :-1].astype(np.float32), J.astype(np.float32)


def judged(problem: Problem, layers: list[tuple[Array, Array]], seconds: float, held_out: int = 50_000) -> PeerResult:
    """Angles of a network with weights (out, in) and biases on held-out samples."""
    q, g = (torch.tensor(array) for array in samples(problem, held_out, 2**31))
    with torch.no_grad():
        task, mutual = _cosines([(torch.tensor(W), torch.tensor(b)) for W, b in layers], q, g)
    r = problem.r
    return PeerResult(_std_with_idle(task, problem.m * r), _std_with_idle(mutual, r * (r - 1) // 2), seconds)


def _initial(problem: Problem, hidden: int, seed: int) -> Layers:
    """Weights and biases as PyTorch draws them."""
    torch.manual_seed(seed)
    modules = [torch.nn.Linear(a, b) for a, b in pairwise([2 * (problem.n - 1), hidden, hidden, problem.r - 1])]
    return [(module.weight, module.bias) for module in modules]


def _loss(layers: Layers, q: torch.Tensor, g: torch.Tensor, weights: tuple[float, float]) -> torch.Tensor:
    """Mean of [AS2023] eq. (24), A = I."""
    task, mutual = _cosines(layers, q, g)
    loss = weights[0] / (2 * task.shape[1] * task.shape[2]) * (task**2).sum(dim=(1, 2)).mean()
    return loss + weights[1] / (2 * mutual.shape[1]) * (mutual**2).sum(dim=1).mean()


_compiled_loss = torch.compile(_loss, dynamic=False)


def _cosines(layers: Layers, q: torch.Tensor, g: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Task cosines (N, m, r) and mutual cosines (N, pairs)."""
    n = q.shape[1]
    (W1, b1), (W2, b2), (W3, _) = layers
    s, c = torch.sin(q), torch.cos(q)
    h1 = torch.tanh(torch.cat([s, c], dim=1) @ W1.T + b1)
    h2 = torch.tanh(h1 @ W2.T + b2)
    by_h1 = (W3[None] * (1 - h2**2)[:, None, :]) @ W2  # (N, r, H)
    by_input = (by_h1 * (1 - h1**2)[:, None, :]) @ W1
    J = by_input[:, :, :n] * c[:, None, :] - by_input[:, :, n:] * s[:, None, :]
    unit = J / J.norm(dim=2, keepdim=True)
    gram = unit @ unit.transpose(1, 2)
    rows, columns = torch.tril_indices(gram.shape[1], gram.shape[1], -1)
    return g @ unit.transpose(1, 2), gram[:, rows, columns]


def _std_with_idle(cosines: torch.Tensor, angles_per_sample: int) -> float:
    """Standard deviation of the angles, with the right angles of the exact coordinate counted too."""
    deviation = torch.rad2deg(torch.arccos(cosines.clamp(-1, 1))) - 90
    padded = deviation.reshape(len(deviation), -1)
    missing = angles_per_sample - padded.shape[1]
    total = padded.numel() + missing * len(padded)
    mean = padded.sum().item() / total
    return math.sqrt((padded**2).sum().item() / total - mean**2)
