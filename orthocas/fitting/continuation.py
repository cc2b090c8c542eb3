"""The stages of a fit in their order: rising degrees, then rounds until no fold is left (ours)."""

from collections.abc import Sequence
from dataclasses import dataclass

from orthocas.checks import Array
from orthocas.fitting.checkpoint import Stage
from orthocas.fitting.loss import LEAST_CONDITIONING
from orthocas.fitting.stages import Plan, StageRunner
from orthocas.minimising.solver import Status
from orthocas.parametrisations import GradedFamily, GradedParametrisation, Parametrisation
from orthocas.parametrisations.family import Family
from orthocas.worst_points import WorstPoints

_SEARCHED = 3  # degree from which worst points are searched: those of lower degrees differ from the last ones
_ROUNDS = 4  # of the last degree
_LEAST_GAIN = 0.01  # of the conditioning in a round


@dataclass(frozen=True, eq=False)
class Solved:
    """Finished minimisations, the parametrisation that they reached, and its worst points if a search was made."""

    stages: tuple[Stage, ...]
    parametrisation: Parametrisation
    worst: WorstPoints | None

    @property
    def theta(self) -> Array:
        """Parameters found by the last minimisation."""
        return self.stages[-1].result.theta


class Continuation:
    """Solves a low degree from a spectral start, embeds the result, and solves the next degree.

    The worst points of each degree join the loss of the next one. The last degree is solved again until its least
    conditioning is large enough or, without a fold, no longer grows. If folds remain after some rounds, the domain
    forces them: then the last stage leaves the fold term out.

    Args:
        runner: runs single stages.
        r: number of coordinates of the active joints.
    """

    def __init__(self, runner: StageRunner, r: int) -> None:
        self._runner, self._r = runner, r
        self._stages: list[Stage] = []
        self._reached: tuple[Parametrisation, Family] | None = None

    def run(self) -> Solved:
        """Run all stages. After Ctrl-C, the last one is marked as interrupted."""
        steps = self._steps(self._runner.settings.parametrisation)
        try:
            for step in steps:
                self._solve(step, step.label, final=step is steps[-1])
            self._unfold(steps[-1])
        except KeyboardInterrupt:  # also between minimisations
            if self._reached is None:
                raise
            self._stages[-1] = self._stages[-1].interrupted()
        assert self._reached is not None
        return Solved(tuple(self._stages), self._reached[0], self._runner.folds.found)

    def _steps(self, target: Parametrisation) -> Sequence[Parametrisation]:
        if not isinstance(target, GradedParametrisation):
            return [target]
        self._runner.require_memory(target, self._r)
        return [target.of_degree(degree) for degree in range(min(target.degree, 2), target.degree + 1)]

    def _solve(self, step: Parametrisation, label: str, final: bool) -> None:
        """Run a stage, and search the worst points of its result."""
        runner, degree = self._runner, step.degree if isinstance(step, GradedParametrisation) else 0
        family = runner.family(step, self._r)
        solver = runner.settings.solver if final else runner.settings.solver.coarser()
        stage = runner.run(Plan(label, family, self._start(family), solver, degree, final))
        self._stages.append(stage)
        self._reached = step, family
        if stage.result.status is Status.INTERRUPTED:
            raise KeyboardInterrupt
        if final or degree >= _SEARCHED:
            runner.folds.search(stage, step, len(self._stages), runner.monitor)

    def _start(self, family: Family) -> Array | None:
        """The last result, embedded."""
        if self._reached is None:
            return None
        theta, before = self._stages[-1].result.theta, self._reached[1]
        if theta.size == family.size:
            return theta
        assert isinstance(family, GradedFamily)
        assert isinstance(before, GradedFamily)
        return family.embed(theta, before)

    def _unfold(self, step: Parametrisation) -> None:
        """Solve the last step again until there is no point of small conditioning."""
        folds, before = self._runner.folds, 0.0
        for k in range(2, 2 + _ROUNDS):
            if folds.least >= LEAST_CONDITIONING or 0 <= folds.least < before + _LEAST_GAIN:
                break
            before = folds.least
            self._solve(step, f"{step.label}, round {k}", final=True)
        if folds.least < 0:
            folds.give_up()
            self._solve(step, f"{step.label}, with folds", final=True)
