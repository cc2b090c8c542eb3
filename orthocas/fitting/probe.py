"""Quick fits on trial boxes: the leak and the conditioning that a chart would have there."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from orthocas.bases.family import JointSpace
from orthocas.bases.products import Polynomial, ProductFamily
from orthocas.charts.chart import Chart
from orthocas.charts.coordinates import Coordinates
from orthocas.charts.point_quality import in_the_metric, worst_points
from orthocas.fitting.basis_objective import BasisObjective, build_gradients
from orthocas.fitting.starts import find_spectral_start
from orthocas.fitting.terms import DEFAULT_WEIGHTS, Weights
from orthocas.solvers.minimisers import GaussNewton, QuasiNewton
from orthocas.solvers.protocol import Status
from orthocas.tasks.domains import Box
from orthocas.tasks.problem import (
    NEAR_HALF_A_TURN,
    NEAR_SINGULAR,
    Problem,
    measure_half_turn_distance,
    relative_singular_values,
)
from orthocas.tasks.samples import Samples, evaluate_samples, sample_boundary_weighted, sample_evenly
from orthocas.tools.batch import one_blas_thread
from orthocas.tools.checks import Array
from orthocas.tools.interrupts import deferred


@dataclass(frozen=True, slots=True)
class SuggestRules:
    """Numbers of the search for a domain, and of the trial charts that it evaluates."""

    leak_deg: float = 8.0  #: default bound of the leak [deg]
    conditioning: float = 0.2  #: default bound of the conditioning
    margin: float = 1.25  #: factor of that bound for trial charts, because a fit is evaluated at more points

    degree: int = 2  #: of trial charts: they have the conditioning of degree 4, and leaks about a fifth larger
    training: int = 700  #: even samples of a trial chart
    near_faces: int = 300  #: further samples near faces and corners
    held_out: int = 3000  #: samples that evaluate a trial chart
    many: int = 6  #: coordinates from which fits and their matrices take seconds
    other: float = 2.0  #: factor of a half-width beyond which the Gauss-Newton matrix of another box is not reused
    seed: int = 0
    tiny: float = 1e-4  #: conditioning or singular value that counts as zero

    start: float = 0.5  #: first scale of the box
    step: float = 1.6  #: factor to the next scale while the boundary is unknown
    close: float = 1.06  #: the boundary is found within this factor
    smallest: float = 1e-3  #: scale of a box that is too small to be of use
    exchanged: int = 28  #: about this many joints are tried in all rounds of exchange: five rounds with five joints
    least_step: float = 0.25  #: of an exchange; after one without gain, the next has half its step
    wider: float = 1.2  #: factor by which one joint alone is widened
    largest_exchange: float = float(np.log(1.5))
    farthest: float = float(np.pi)  #: largest half-width of a revolute joint [rad]: a full turn
    longest: float = 1.0  #: largest half-width of a prismatic joint without limits [m]

    checked: int = 200  #: samples for whether the task can be regular at all, and which joints are idle
    confirmed: int = 30_000  #: samples that evaluate the fit
    shrink: float = 0.92  #: factor of the half-widths after a fit that misses a bound
    tries: int = 12
    descent: float = 0.5  #: fraction of the bound on the conditioning that must hold even at the points of descents

    first_time: int = 24  #: time for the first scale, in trials without a fit
    next_time: int = 14  #: time for a later one
    growth_time: int = 5  #: time for the growth of a joint
    trials: int = 6  #: trials for a scale, about


RULES = SuggestRules()
Miss = Literal["leak", "conditioning", "singularity", "half a turn"]  #: bounds that a box may miss


@dataclass(frozen=True)
class Bounds:
    """Bounds that coordinates must keep on a box."""

    leak_deg: float  #: largest leak [deg]
    conditioning: float  #: smallest conditioning


@dataclass(frozen=True, eq=False)
class Quality:
    """Quality of coordinates on a box."""

    leak_deg: float  #: root mean square over uniform samples and coordinates [deg]
    conditioning: float  #: the smallest at any sample; negative if det J changes its sign, because the chart folds over
    worst_point: Array  #: where the conditioning is smallest, (n,)
    task_value: float  #: smallest relative singular value of the task, see `orthocas.ClearBox`
    turn_value: float  #: cos(angle / 2) of the tool's largest turn from the reference; 1 for tasks without one

    def excess(self, bounds: Bounds) -> dict[Miss, float]:
        """Ratio of each value to its bound, the largest first; a ratio of at most 1 keeps the bound.

        "singularity" and "half a turn" are the bounds `NEAR_SINGULAR` and `NEAR_HALF_A_TURN` on the task itself, which
        does not enter the conditioning.
        """
        ratios: dict[Miss, float] = {
            "leak": self.leak_deg / bounds.leak_deg,
            "conditioning": bounds.conditioning / max(self.conditioning, RULES.tiny),
            "singularity": NEAR_SINGULAR / max(self.task_value, RULES.tiny),
            "half a turn": NEAR_HALF_A_TURN / max(self.turn_value, RULES.tiny),
        }
        return dict(sorted(ratios.items(), key=lambda pair: -pair[1]))

    def keeps(self, bounds: Bounds | None) -> bool:
        """Whether all bounds are met; False without bounds."""
        return bounds is not None and max(self.excess(bounds).values()) <= 1

    def explained(self, miss: Miss, bounds: Bounds) -> str:
        """The value that misses a bound, and the bound, in words."""
        trial, most, least = "a trial chart", bounds.leak_deg, f"a conditioning of at least {bounds.conditioning:.3g}"
        words: dict[Miss, str] = {
            "leak": f"{trial} has a leak of {self.leak_deg:.3g} deg, expected at most {most:.3g}",
            "conditioning": f"{trial} {describe_conditioning(self.conditioning)}, expected {least}",
            "singularity": f"the task's relative singular value is {self.task_value:.3g}, expected {NEAR_SINGULAR:g}",
            "half a turn": "the tool turns by half a turn from the reference, expected less",
        }
        return words[miss]


def describe_conditioning(signed: float) -> str:
    """Describe the least conditioning of a chart, which is negative if det J changes its sign."""
    return f"has a conditioning of {signed:.3g}" if signed >= 0 else "folds over (det J changes its sign)"


@dataclass(frozen=True, eq=False)
class _Steered:
    """A loss with the Gauss-Newton matrix of another box, which is nearly the same in scaled joint positions."""

    loss: BasisObjective
    half_width: Array  #: of the box of the matrix, (n,)
    matrix: list[Array]  #: blocks of the matrix

    def value(self, theta: Array) -> float:
        """L(theta)."""
        return self.loss.value(theta)

    def value_and_gradient(self, theta: Array) -> tuple[float, Array]:
        """L(theta) and dL/dtheta."""
        return self.loss.value_and_gradient(theta)

    def curvature_estimate(self, theta: Array) -> list[Array]:
        """The matrix of the other box, in blocks."""
        return self.matrix


@dataclass(frozen=True, eq=False)
class _Start:
    """Coordinates without folds on a box."""

    half_width: Array  #: of the family's joints, (n,)
    theta: Array  #: (size,)

    def on(self, family: ProductFamily) -> Array:
        """The same quadratic coordinates as functions of the joints of another box, up to constants, (size,)."""
        growth = family.space.half_width / self.half_width
        factors = np.prod(growth ** np.array(family.terms), axis=1)
        moved: Array = self.theta.reshape(-1, family.width) * factors
        return moved.ravel()


@dataclass(eq=False)
class Prober:
    """Fits quadratic coordinates of the active joints on trial boxes.

    Fits start from the coordinates of an earlier box, which are nearly optimal already. With a spectral start for each
    box, fits on boxes that differ by a few percent could end in different minima.
    """

    problem: Problem  #: robot, task and metric; trial boxes replace its domain
    active: list[int]  #: joints that are not coordinates themselves
    cyclic: tuple[str, ...] = ()  #: joints that enter linearly
    weights: Weights = DEFAULT_WEIGHTS  #: of the fit that confirms the box; trials leave out lengths and extra terms
    _objective: BasisObjective | None = None  #: of the last box; the next box moves it
    _start: _Start | None = None  #: coordinates of the last box without folds; None for a spectral start
    _kept: _Start | None = None  #: the last coordinates that kept the bounds
    _steered: _Steered | None = None  #: of the last box whose matrix was computed

    @property
    def outputs(self) -> int:
        """Number of coordinates to fit."""
        return len(self.active) - self.problem.m

    def evaluate(self, box: Box, enough: Bounds | None = None, leap: bool = False) -> Quality:
        """Fit coordinates on a box, and evaluate them.

        Args:
            box: the box.
            enough: if the coordinates of an earlier box keep these bounds, they are evaluated without a fit.
            leap: whether to evaluate the coordinates of an earlier box without a fit in any case, if there are some.

        Raises:
            KeyboardInterrupt: after Ctrl-C.
        """
        problem = Problem(self.problem.robot, self.problem.task, self.problem.metric, box)
        if self.outputs == 0:
            return self._evaluate(problem, lambda points: np.zeros((len(points), 0, len(self.active))))
        space = JointSpace.of(problem).restricted_to(self.active)
        family = Polynomial(RULES.degree, self.cyclic).family(space, self.outputs)
        # The coordinates of an earlier box may be good enough; otherwise they are the start of a fit
        with one_blas_thread():
            if self._start is not None and (enough is not None or leap):
                quality = self._evaluate(problem, self._gradients(family, self._start.on(family)))
                if leap or quality.keeps(enough):
                    self._kept = self._start if quality.keeps(enough) else self._kept
                    return quality
            # Even samples for the start, and more near faces and corners, where charts fail first
            even = sample_evenly(problem.domain, RULES.training, RULES.seed)
            heavy = sample_boundary_weighted(problem.domain, RULES.near_faces, RULES.seed + 1)
            samples = evaluate_samples(problem, np.vstack([even, heavy])).restricted_to(self.active)
            with deferred():
                known = self._start
                start = find_spectral_start(family, samples[: len(even)]) if known is None else known.on(family)
                # The loss is that of the fit that confirms the box, without lengths and extra terms
                if self._objective is None:
                    weights = replace(self.weights.for_problem(problem), length=0.0, extra={})
                    objective = BasisObjective(family, samples, weights, start, lambda count, seed: samples)
                else:
                    objective = self._objective.move_to(build_gradients(family, len(self.active)), samples, start)
                self._objective = objective
            if self.outputs < RULES.many:
                result = GaussNewton().coarser().minimise(objective, start)
            elif known is None:
                result = QuasiNewton().coarser().minimise(objective, start)
            else:
                # Reuse the matrix of the last such box, unless a half-width differs by more than a factor of two
                width, steered = family.space.half_width, self._steered
                if steered is None or np.abs(np.log(width / steered.half_width)).max() > np.log(RULES.other):
                    self._steered = _Steered(objective, width, objective.curvature_estimate(start))
                else:
                    self._steered = replace(steered, loss=objective)
                result = QuasiNewton().coarser().minimise(self._steered, start)
            if result.status is Status.INTERRUPTED:
                raise KeyboardInterrupt
            theta: Array = result.theta
            quality = self._evaluate(problem, self._gradients(family, theta))
        if quality.conditioning > 0:
            self._start = _Start(space.half_width, theta)
            self._kept = self._start if quality.keeps(enough) else self._kept
        return quality

    def go_back(self) -> None:
        """Start the next fit from the last coordinates that kept the bounds, if there are any."""
        self._start = self._start if self._kept is None else self._kept

    def start_on(self, family: ProductFamily) -> Array | None:
        """Coefficients (size,) of the last coordinates without folds, in a family of another degree and box.

        None without such coordinates, or if the family is linear.
        """
        if self._start is None:
            return None
        quadratic = Polynomial(RULES.degree, self.cyclic).family(family.space, self.outputs)
        # A linear family cannot represent quadratic coordinates
        if not set(quadratic.terms) <= set(family.terms):
            return None
        return family.embed(self._start.on(quadratic), quadratic)

    def least(self, problem: Problem, seed: int) -> float:
        """Least conditioning of the last coordinates on another domain, by descent.

        1 for fewer than six coordinates, whose fit takes no longer than this search.
        """
        if self._start is None or self.outputs < RULES.many:
            return 1.0
        # Build the coordinates of the last trial for the chart's joints
        parametrisation = Polynomial(RULES.degree, self.cyclic)
        family = parametrisation.family(JointSpace.of(problem).restricted_to(self.active), self.outputs)
        idle = tuple(k for k in range(problem.n) if k not in self.active)
        zeros, ones = np.zeros(self.outputs), np.ones(self.outputs)
        theta = self._start.on(family)
        coordinates = Coordinates(parametrisation, JointSpace.of(problem), idle, theta, zeros, ones)
        return worst_points(problem, coordinates, seed).least

    def _evaluate(self, problem: Problem, jacobian: Callable[[Array], Array]) -> Quality:
        points = sample_boundary_weighted(problem.domain, RULES.held_out, RULES.seed)
        return evaluate_at(problem, points, jacobian, self.active)

    def _gradients(self, family: ProductFamily, theta: Array) -> Callable[[Array], Array]:
        """A function of points (N, n) that returns gradients in the active joints, (N, r, active)."""
        C = theta.reshape(self.outputs, family.width)

        def jacobian(points: Array) -> Array:
            basis = build_gradients(family, len(self.active))
            G = basis.expand(basis.at(points[:, self.active]), len(points))
            J: Array = (G @ C.T).transpose(0, 2, 1)
            return J

        return jacobian


def evaluate_chart(chart: Chart, samples: int, seed: int) -> Quality:
    """Quality of a fitted chart, without its idle joints, on samples of its domain, two thirds near its boundary."""
    coordinates = chart.coordinates
    assert isinstance(coordinates, Coordinates)
    # Take the fitted coordinates, in the joints that they depend on
    fitted, active = len(coordinates.offset), coordinates.active

    def jacobian(points: Array) -> Array:
        J: Array = coordinates.jacobian(points)[:, :fitted, active]
        return J

    return evaluate_at(chart.problem, sample_boundary_weighted(chart.problem.domain, samples, seed), jacobian, active)


def evaluate_at(problem: Problem, points: Array, jacobian: Callable[[Array], Array], active: list[int]) -> Quality:
    """Quality at samples of `sample_boundary_weighted`.

    If all coordinates are idle joints, the leak is 0 and the conditioning 1. If det J then changes its sign, a singular
    posture of the task lies between the samples, and the task value is 0.

    Args:
        problem: robot, task and metric.
        points: all samples (N, n).
        jacobian: gradients of the fitted coordinates in the active joints, (N, r, n), at points of all joints.
        active: the active joints.
    """
    samples = evaluate_samples(problem, points)
    # Leaks are taken at the uniform samples, which come first, and the conditioning at all samples
    J, own = jacobian(samples.points), samples.restricted_to(active)
    uniform = len(samples) - 2 * (len(samples) // 3)
    leaks, conditioning = compute_leak_and_conditioning(own, J)
    worst = int(np.argmin(conditioning))
    task_value = float(relative_singular_values(problem, points).min())
    turn_value = float(measure_half_turn_distance(problem, points).min())
    if J.shape[1] == 0:
        return Quality(0.0, 1.0, samples.points[worst], task_value if conditioning[worst] > 0 else 0.0, turn_value)
    leak = float(np.degrees(np.sqrt(np.mean(leaks[:uniform] ** 2))))
    return Quality(leak, float(conditioning[worst]), samples.points[worst], task_value, turn_value)


def compute_leak_and_conditioning(samples: Samples, J: Array) -> tuple[Array, Array]:
    """Leaks (N, r) [rad] and signed conditioning (N,) of coordinates with gradients J (N, r, n).

    The leak of a coordinate is the angle, in the metric, between its gradient and the space orthogonal to the task. The
    conditioning is the smallest singular value of [A-orthonormal task basis; unit coordinate gradients]. It is negative
    where the sign of det J is opposite to that at most samples.
    """
    sines, conditioning, signs = in_the_metric(samples, J)
    usual = 1.0 if signs.sum() >= 0 else -1.0
    return np.arcsin(np.minimum(sines, 1.0)), conditioning * np.where(signs == -usual, -1.0, 1.0)
