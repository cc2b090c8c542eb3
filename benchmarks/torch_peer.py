"""The strongest peer we know for fitting: a PyTorch MLP trained with Adam, on the same problem and loss.

It uses float32, fresh uniform samples in every step, a cosine learning rate and all cores. It has the same advantages
as our own fit: the idle joint (which does not move the task) is split off, so it fits three coordinates of six joints.
Its samples and task gradients are computed before its clock starts; our fit computes them while the clock runs.
"""

import math
import time
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch

from orthocas.domains import sample_uniform
from orthocas.problem import Problem, task_jacobians


@dataclass(frozen=True)
class PeerSettings:
    """One training schedule."""

    hidden: int = 128
    steps: int = 2000
    batch: int = 500
    learning_rate: float = 5e-3
    weights: tuple[float, float] = (1000.0, 30.0)


@dataclass(frozen=True)
class PeerResult:
    """Standard deviations over all angles, including the exact coordinate as in the paper, and training seconds."""

    task_std_deg: float
    mutual_std_deg: float
    seconds: float


def train(problem: Problem, settings: PeerSettings, seed: int = 0, held_out: int = 20_000) -> PeerResult:
    """Train once, and evaluate on held-out samples."""
    torch.manual_seed(seed)
    joints, r = list(range(problem.n - 1)), problem.r - 1
    widths = [2 * len(joints), settings.hidden, settings.hidden, r]
    layers = [torch.nn.Linear(a, b) for a, b in pairwise(widths)]
    parameters = [p for layer in layers for p in layer.parameters()]
    optimiser = torch.optim.Adam(parameters, lr=settings.learning_rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, settings.steps)
    all_q, all_g = _samples(problem, joints, settings.steps * settings.batch, seed)
    start = time.perf_counter()
    for q, g in zip(all_q.split(settings.batch), all_g.split(settings.batch), strict=True):
        task, mutual = _cosines(layers, q, g)
        pairs = mutual.shape[1]
        loss = settings.weights[0] / (2 * 3 * r) * (task**2).sum(dim=(1, 2)).mean()
        loss = loss + settings.weights[1] / (2 * pairs) * (mutual**2).sum(dim=1).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
    seconds = time.perf_counter() - start
    with torch.no_grad():
        task, mutual = _cosines(layers, *_samples(problem, joints, held_out, 2**31 + seed))
    return PeerResult(
        _std_with_idle(task, problem.m * problem.r), _std_with_idle(mutual, problem.r * (problem.r - 1) // 2), seconds
    )


def _samples(problem: Problem, joints: list[int], count: int, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Joint angles (N, n) and unit task gradients (N, m, n) of the active joints."""
    points = sample_uniform(problem.domain, count, seed)
    J = task_jacobians(problem, points)[:, :, joints]
    J = J / np.linalg.norm(J, axis=2, keepdims=True)
    return torch.tensor(points[:, joints], dtype=torch.float32), torch.tensor(J, dtype=torch.float32)


def _cosines(layers: list[torch.nn.Linear], q: torch.Tensor, g: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Task cosines (N, m, r) and mutual cosines (N, pairs); J_xi by forward tangents, one per joint."""
    n = q.shape[1]
    first, second, out = layers
    h1 = torch.tanh(first(torch.cat([torch.sin(q), torch.cos(q)], dim=1)))
    by_sin, by_cos = first.weight[:, :n].T, first.weight[:, n:].T  # (n, H)
    d1 = (torch.cos(q)[:, :, None] * by_sin - torch.sin(q)[:, :, None] * by_cos) * (1 - h1**2)[:, None, :]
    h2 = torch.tanh(second(h1))
    d2 = (d1 @ second.weight.T) * (1 - h2**2)[:, None, :]
    J = (d2 @ out.weight.T).transpose(1, 2)  # (N, r, n)
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
