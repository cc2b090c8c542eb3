"""Objectives made of others: weighted sums, losses on part of the samples, and a bound on mutual angles."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import reduce
from typing import Self

import numpy as np
from numpy.typing import NDArray

from orthocas.charts.point_quality import pairs
from orthocas.errors import InfeasibleError, InvalidValueError, SolveError
from orthocas.fitting.basis_objective import BasisObjective
from orthocas.fitting.network_objective import ArrayObjective, GraphObjective
from orthocas.fitting.terms import DEFAULT_WEIGHTS, Weights
from orthocas.solvers.minimisers import GaussNewton
from orthocas.solvers.protocol import Objective, SampledObjective, SolveResult, Status
from orthocas.tools.checks import Array


class WeightedSum:
    """A sum of losses of the same parameters on several sets of samples, each times a weight.

    The first is the loss on the domain, which may draw fresh samples; others are such as a penalty on its worst points.
    """

    def __init__(self, parts: Sequence[tuple[float, Objective]]) -> None:
        self.parts = parts

    def value(self, theta: Array) -> float:
        """The sum at theta (size,)."""
        return sum(weight * part.value(theta) for weight, part in self.parts)

    def value_and_gradient(self, theta: Array) -> tuple[float, Array]:
        """The sum and its gradient, (size,)."""
        results = [(weight, *part.value_and_gradient(theta)) for weight, part in self.parts]
        return sum(weight * value for weight, value, _ in results), _add((weight, g) for weight, _, g in results)

    def batches(self, size: int, count: int, seed: tuple[int, ...]) -> Iterator[Self]:
        """Sums with the first loss on fresh samples, and the others on their own samples."""
        (weight, first), *others = self.parts
        assert isinstance(first, SampledObjective)
        for loss in first.batches(size, count, seed):
            yield type(self)([(weight, loss), *others])


class LinearSum(WeightedSum):
    """A weighted sum for families linear in theta, with second derivatives."""

    parts: Sequence[tuple[float, BasisObjective]]

    def normal_equations(self, theta: Array) -> tuple[float, Array, Array]:
        """The sum, its gradient and its Gauss-Newton matrix."""
        results = [(weight, *part.normal_equations(theta)) for weight, part in self.parts]
        value, slopes = sum(w * value for w, value, *_ in results), _add((w, slope) for w, _, slope, _ in results)
        return value, slopes, _add((w, H) for w, *_, H in results)

    def curvature_estimate(self, theta: Array) -> list[Array]:
        """A rough Gauss-Newton matrix of the sum, in blocks."""
        estimates = [[(weight, block) for block in part.curvature_estimate(theta)] for weight, part in self.parts]
        return [_add(blocks) for blocks in zip(*estimates, strict=True)]

    def hessian(self, theta: Array) -> Array:
        """The Hessian of the sum."""
        return _add((weight, part.hessian(theta)) for weight, part in self.parts)


def _add(parts: Iterable[tuple[float, Array]]) -> Array:
    return np.asarray(reduce(np.add, [weight * array for weight, array in parts]))


class Resampled:
    """A loss of networks whose value is taken on some of its samples, and whose steps draw batches from all of them.

    Args:
        whole: the loss on all samples.
        watched: indices of the samples for value and gradient.
        count: number of all samples.
    """

    def __init__(self, whole: ArrayObjective | GraphObjective, watched: NDArray[np.int_], count: int) -> None:
        self._whole, self._count = whole, count
        self._watched = whole.part(watched)

    def value(self, theta: Array) -> float:
        """The mean loss over the watched samples."""
        return self._watched.value(theta)

    def value_and_gradient(self, theta: Array) -> tuple[float, Array]:
        """The mean loss over the watched samples, and its gradient."""
        return self._watched.value_and_gradient(theta)

    def batches(self, size: int, count: int, seed: tuple[int, ...]) -> Iterator[Objective]:
        """`count` losses, each the mean over `size` samples drawn from all."""
        rng, size = np.random.default_rng(seed), min(size, self._count)
        while count > 0:
            # Copy the samples once in a random order, so that batches are slices without copies
            shuffled = self._whole.part(rng.permutation(self._count)[: count * size])
            for start in range(0, min(count * size, self._count - size + 1), size):
                yield shuffled.part(slice(start, start + size))
                count -= 1


def bound_mutual_angles(
    objective: BasisObjective, theta: Array, bound: float, r: int, fresh: bool
) -> tuple[BoundedMutual, Array]:
    """The objective with a bound on the mutual angles, and its start.

    Args:
        objective: the weighted loss.
        theta: start of the weighted loss, (size,).
        bound: on the root mean square deviation of mutual angles from a right angle [rad].
        r: number of all coordinates, with those of idle joints.
        fresh: whether no stage has been solved before.
    """
    fitted = len(pairs(objective.r))
    if not fitted:
        raise InvalidValueError("max_mutual_deg", "given", "a problem with two or more coordinates to fit")
    # The mean is over all pairs. Those with an idle joint are exactly orthogonal, so the others may deviate more
    bounded = BoundedMutual(objective, bound * (len(pairs(r)) / fitted) ** 0.5)
    # Start from the minimum of the weighted loss: bounded minima far from it are worse
    if fresh:
        weighted = replace(objective.weights, mutual=DEFAULT_WEIGHTS.mutual)
        theta = GaussNewton().minimise(objective.reweigh(weighted), theta).require_finished().theta
    return bounded, bounded.normalise_gradients(theta)


class BoundedMutual:
    """Minimise the task term of (24) subject to a bound on the mutual term, and to a gauge condition.

    min  E[sum of task cosines^2] lambda1 / (2 m r)  (plus the regularity term, if there is one)
    s.t. E[mean of mutual cosines^2] <= bound^2  and  E|grad xi_j|^2 = 1 for every coordinate j.

    The scales of the coordinates change neither term. The gauge condition fixes them, so that the solution is an
    isolated point. Up to terms of third order, sqrt(E cos^2) is the root mean square deviation of mutual angles from
    a right angle [rad].

    Args:
        objective: the weighted loss on its samples. Its lambda2 is not used.
        bound: upper bound on the root mean square mutual cosine, > 0.

    Source:
        ours, docs/explanation/derivations_meaning.md#constrained-form.
    """

    def __init__(self, objective: BasisObjective, bound: float) -> None:
        # Both objectives share the samples of the basis
        weights, self._gram = objective.weights, objective.gram
        self._task = objective.reweigh(Weights(weights.task, 0.0, weights.regularity, angles=weights.angles))
        # The weight 2 cancels the factor 1/2 of the loss
        only_mutual = Weights(0.0, 2.0, 0.0, angles=weights.angles)
        self._mutual = objective.reweigh(only_mutual)
        self._r, self._K, self._bound = objective.r, objective.K, bound

    def value(self, theta: Array) -> float:
        """Task term, plus the regularity term if it has a weight."""
        return self._task.value(theta)

    def value_and_gradient(self, theta: Array) -> tuple[float, Array]:
        """Task term, plus the regularity term if it has a weight, and the gradient, (size,)."""
        return self._task.value_and_gradient(theta)

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds of `constraints`, (1 + r,) each."""
        ones = np.ones(self._r)
        return np.concatenate([[-np.inf], ones]), np.concatenate([[1.0], ones])

    def constraints(self, theta: Array) -> tuple[Array, Array]:
        """Mutual term over its bound, then E|grad xi_j|^2 of every coordinate, (1 + r,), and their Jacobian."""
        value, gradient = self._mutual.value_and_gradient(theta)
        C = theta.reshape(self._r, self._K)
        raised = C @ self._gram
        gauge = np.zeros((self._r, self._r, self._K))
        gauge[np.arange(self._r), np.arange(self._r)] = 2 * raised
        values = np.concatenate([[value / self._bound**2], (raised * C).sum(axis=1)])
        return values, np.vstack([gradient / self._bound**2, gauge.reshape(self._r, -1)])

    def lagrangian_hessian(self, theta: Array, factor: float, multipliers: Array) -> Array:
        """Hessian of factor L + multipliers . constraints, (size, size)."""
        H: Array = factor * self._task.hessian(theta) + multipliers[0] / self._bound**2 * self._mutual.hessian(theta)
        for j, multiplier in enumerate(multipliers[1:]):
            block = slice(j * self._K, (j + 1) * self._K)
            H[block, block] += 2 * multiplier * self._gram
        return H

    def normalise_gradients(self, theta: Array) -> Array:
        """The same coordinates with E|grad xi_j|^2 = 1."""
        C = theta.reshape(self._r, self._K)
        scaled: Array = C / np.sqrt(((C @ self._gram) * C).sum(axis=1))[:, None]
        return scaled.ravel()

    def explain_missed_bound(self, label: str, bound: float, result: SolveResult) -> SolveError:
        """The error of a missed bound on mutual angles [rad]: by how much it was missed, and why."""
        target = np.degrees(bound)
        reached = target * self.constraints(result.theta)[0][0] ** 0.5
        missing = f"{label} coordinates with mutual angles within {target:.4g} deg"
        if result.status is Status.INFEASIBLE:
            return InfeasibleError(
                f"there are no {missing} nearby, the closest have {reached:.4g} deg: raise max_mutual_deg or the degree"
            )
        return SolveError(
            f"no {missing} found in {result.iterations} iterations, the closest have {reached:.4g} deg: "
            "raise max_mutual_deg, the degree, or the number of iterations"
        )
