"""Fits without folds: the worst points of each stage join the loss of the next one."""

from collections.abc import Iterator

import numpy as np

from orthocas.bases.family import JointSpace, Parametrisation
from orthocas.charts.coordinates import Coordinates
from orthocas.charts.worst_points import WorstPoints, worst_points
from orthocas.fitting.array_objective import ArrayObjective
from orthocas.fitting.basis_objective import BasisObjective
from orthocas.fitting.checkpoint import Stage
from orthocas.fitting.graph_objective import GraphObjective
from orthocas.fitting.terms import FOLD_TERM, LEAST_CONDITIONING
from orthocas.solvers.protocol import (
    EstimatedObjective,
    LeastSquaresObjective,
    Objective,
    SampledObjective,
    SmoothObjective,
)
from orthocas.tasks.problem import Problem
from orthocas.tasks.samples import samples_at
from orthocas.tools.checks import Array
from orthocas.tools.progress import Monitor, Progress

_COLLECTED = 1.5 * LEAST_CONDITIONING  # points below it are collected, before they become worse


class FoldSearch:
    """The worst points that were found so far.

    Args:
        problem: problem of the fit.
        active: joints that are not coordinates themselves.
        weight: weight of the fold term; with 0 nothing is searched.
    """

    def __init__(self, problem: Problem, active: list[int], weight: float) -> None:
        self._problem, self._active, self._weight = problem, active, weight
        self._points = np.zeros((0, problem.n))
        self.found: WorstPoints | None = None  #: of the last search

    @property
    def least(self) -> float:
        """Least conditioning of the last search; 1, the largest there is, without a search."""
        return 1.0 if self.found is None else self.found.least

    def give_up(self) -> None:
        """Forget all points."""
        self._points = self._points[:0]

    def search(self, stage: Stage, parametrisation: Parametrisation, seed: int, monitor: Monitor) -> None:
        """Find and collect the worst points of a stage."""
        if not self._weight:
            return
        monitor(Progress(stage.label, 1.0, "searching for folds"))
        problem = self._problem
        idle = tuple(i for i in range(problem.n) if i not in self._active)
        fitted = problem.r - len(idle)
        space = JointSpace.of(problem)
        coordinates = Coordinates(parametrisation, space, idle, stage.result.theta, np.zeros(fitted), np.ones(fitted))
        self.found = worst_points(problem, coordinates, seed)
        self._points = np.concatenate([self._points, self.found.below(_COLLECTED)])

    def added_to(self, objective: BasisObjective | ArrayObjective | GraphObjective) -> Objective:
        """The objective plus the fold term at all points collected."""
        if not len(self._points):
            return objective
        samples = samples_at(self._problem, self._points).restricted_to(self._active)
        penalty = objective.elsewhere(samples, {FOLD_TERM.name: self._weight})
        return _LinearSum(objective, penalty) if isinstance(objective, BasisObjective) else _Sum(objective, penalty)


class _Sum:
    """A loss on samples of the domain plus a penalty on fixed points."""

    def __init__(self, loss: Objective, penalty: Objective) -> None:
        self._loss, self._penalty = loss, penalty

    def value(self, theta: Array) -> float:
        """Loss plus the penalty of points that fold, at theta (p,)."""
        return self._loss.value(theta) + self._penalty.value(theta)

    def value_and_gradient(self, theta: Array) -> tuple[float, Array]:
        """Loss and penalty, and their gradient."""
        (value, gradient), (more, slope) = (part.value_and_gradient(theta) for part in (self._loss, self._penalty))
        return value + more, gradient + slope

    def batches(self, size: int, count: int, seed: tuple[int, ...]) -> Iterator["_Sum"]:
        """The loss on fresh samples, each time with the same penalty."""
        assert isinstance(self._loss, SampledObjective)
        for loss in self._loss.batches(size, count, seed):
            yield type(self)(loss, self._penalty)


class _LinearSum(_Sum):
    """The same for families linear in theta, with second derivatives."""

    def normal_equations(self, theta: Array) -> tuple[float, Array, Array]:
        """Loss and penalty, their gradient and their Gauss-Newton matrix."""
        assert isinstance(self._loss, LeastSquaresObjective)
        assert isinstance(self._penalty, LeastSquaresObjective)
        value, gradient, H = self._loss.normal_equations(theta)
        more, slope, curvature = self._penalty.normal_equations(theta)
        return value + more, gradient + slope, H + curvature

    def curvature_estimate(self, theta: Array) -> Array:
        """A rough Gauss-Newton matrix of loss and penalty."""
        assert isinstance(self._loss, EstimatedObjective)
        assert isinstance(self._penalty, EstimatedObjective)
        return self._loss.curvature_estimate(theta) + self._penalty.curvature_estimate(theta)

    def hessian(self, theta: Array) -> Array:
        """Hessian of loss and penalty."""
        assert isinstance(self._loss, SmoothObjective)
        assert isinstance(self._penalty, SmoothObjective)
        return self._loss.hessian(theta) + self._penalty.hessian(theta)
