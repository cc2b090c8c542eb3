"""Adam on fresh samples, the method that trains the paper's network ([AS2023] Sec. 6)."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import repeat

import numpy as np

from orthocas.solvers.protocol import RULES, BestPoint, Objective, SampledObjective, SolveResult, Status
from orthocas.tools.checks import Array, require_at_least, require_count
from orthocas.tools.progress import UNWATCHED, Watch


@dataclass(frozen=True)
class Adam:
    """Adam [KB2015]: steps along the mean gradient divided by the root of its mean square, with new samples each time.

    After every epoch, the loss on the fixed samples is evaluated and the best point so far is kept. The learning rate
    falls to zero along half a cosine, which makes the last epochs the best ones. Objectives without samples are used as
    a whole.

    Args:
        epochs: number of epochs; 200 in the paper.
        steps: steps per epoch; 50 in the paper.
        batch: fresh samples per step; 200 in the paper.
        learning_rate: learning rate of the first step (the paper does not state it).
    """

    epochs: int = 200
    steps: int = 50
    batch: int = 200
    learning_rate: float = 1e-3
    name: str = "adam"

    def __post_init__(self) -> None:
        for name in ("epochs", "steps", "batch"):
            require_count(name, getattr(self, name))
        require_at_least("learning_rate", self.learning_rate, 1e-300)

    def coarser(self) -> "Adam":
        """The same solver with a quarter of the epochs."""
        return replace(self, epochs=max(1, self.epochs // 4))

    def minimise(self, objective: Objective, theta0: Array, watch: Watch = UNWATCHED) -> SolveResult:
        """Minimise from theta0. A run of all planned epochs has the status ITERATION_LIMIT."""
        run = _Run(self, objective, theta0, watch)
        return run.best.run(run.iterate)


class _Run:
    """State of one minimisation."""

    def __init__(self, settings: Adam, objective: Objective, theta0: Array, watch: Watch) -> None:
        self.settings, self.objective = settings, objective
        self.best = BestPoint(objective, theta0, watch)
        self.theta = np.array(theta0, dtype=float)
        self.mean, self.square = np.zeros_like(self.theta), np.zeros_like(self.theta)

    def iterate(self) -> Status:
        best, epochs = self.best, self.settings.epochs
        if not self._evaluate():
            return Status.FAILED
        while best.iterations < epochs:
            # The steps of an epoch: on batches of samples in turn, or on the whole objective.
            parts: Iterable[Objective] = repeat(self.objective, self.settings.steps)
            if isinstance(self.objective, SampledObjective):
                parts = self.objective.batches(self.settings.batch, self.settings.steps, (best.iterations,))
            for k, part in enumerate(parts):
                # a step for each part, and then the value on all samples
                gradient = part.value_and_gradient(self.theta)[1]
                best.evaluations += 1
                if not np.isfinite(gradient).all():
                    return Status.STALLED
                self._step(gradient, best.iterations * self.settings.steps + k)
            self._evaluate()
            best.next_iteration(epochs)
        return Status.ITERATION_LIMIT

    def _step(self, gradient: Array, k: int) -> None:
        """Take step k = 0, 1, ..., counted over all epochs."""
        total = self.settings.epochs * self.settings.steps
        rate = self.settings.learning_rate * 0.5 * (1 + np.cos(np.pi * k / total))
        for start in range(0, len(gradient), RULES.part):
            theta, mean, square, slope = (
                array[start : start + RULES.part] for array in (self.theta, self.mean, self.square, gradient)
            )
            mean += (1 - RULES.moment) * (slope - mean)
            square += (1 - RULES.square) * (slope**2 - square)
            unbiased = np.sqrt(square / (1 - RULES.square ** (k + 1))) + RULES.small
            theta -= rate / (1 - RULES.moment ** (k + 1)) * mean / unbiased

    def _evaluate(self) -> bool:
        """Evaluate the loss on the fixed samples, and return whether it is finite."""
        value = self.objective.value(self.theta)
        self.best.evaluations += 1
        self.best.offer(self.theta, value)
        return bool(np.isfinite(value))
