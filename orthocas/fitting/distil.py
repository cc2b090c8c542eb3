"""Closed expressions for grown coordinates, so that controllers and generated C can use them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from orthocas.bases.composed import CircleFamily
from orthocas.bases.family import Family, JointSpace, LinearFamily, Parametrisation
from orthocas.bases.products import Polynomial
from orthocas.charts.chart import Chart
from orthocas.charts.coordinates import Coordinates
from orthocas.charts.quality import Report, evaluate
from orthocas.errors import GrowError, InvalidValueError
from orthocas.exact.flow import GrownCoordinates
from orthocas.solvers.minimisers import LBFGS
from orthocas.solvers.protocol import Solver
from orthocas.tasks.samples import sample_evenly, sample_uniform
from orthocas.tools.batch import Batched, dense_function
from orthocas.tools.blas_graph import NumpyGraph
from orthocas.tools.checks import Array, require_count, require_kind, require_memory
from orthocas.tools.display import Shown, number_list, percent
from orthocas.tools.expressions import wrap_shortest
from orthocas.tools.progress import Monitor, Progress, Watch, silent


@dataclass(frozen=True, slots=True)
class DistilRules:
    """Numbers of closed expressions for grown coordinates."""

    degree: int = 6  #: of the default polynomial
    per_parameter: int = 4  #: samples per parameter of a coordinate
    least_samples: int = 2000
    most_samples: int = 20_000
    chunk: int = 500  #: samples whose basis is in memory at once
    held_out: int = 5000  #: samples for errors, at most
    held_out_seed: int = 1


RULES = DistilRules()


def distil(
    chart: Chart,
    parametrisation: Parametrisation | None = None,
    solver: Solver | None = None,
    samples: int | None = None,
    seed: int = 0,
    monitor: Monitor = silent,
) -> Distilled:
    """Fit a closed expression to the values and gradients of a grown chart, for controllers and generated C.

    Minimises the mean of |xi - xi_grown|^2 + w^2 |J_xi - J_grown|^2 over samples of the domain, where w is the mean
    half-width of the domain. Families that are linear in their parameters are fitted by least squares, networks by a
    minimiser. With `Circle` pairs, it fits cos xi and sin xi, for coordinates that are angles along closed curves:
    these functions are smooth where the angle jumps.

    Args:
        chart: a grown chart.
        parametrisation: form of the closed expression; default Polynomial(degree=6).
        solver: minimiser for networks; default LBFGS.
        samples: number of samples; default four per parameter of a coordinate, between 2000 and 20,000.
        seed: seed of samples and random starts.
        monitor: called with progress.

    Returns:
        The chart, its errors in values and gradients, and the quality before and after.

    Raises:
        InvalidValueError: if the chart is not grown, or the parametrisation cannot be fitted.
        GrowError: if the grown chart has no values on its domain.
        KeyboardInterrupt: after Ctrl-C, also within the minimiser.

    Example:
        >>> import orthocas as oc
        >>> robot = oc.Robot.planar(lengths=[1.0, 1.0], masses=[3.0, 3.0])
        >>> problem = oc.Problem(robot, oc.Task.position(robot, "x"), "inertia", oc.Box([0.6, 0.8], 0.2))
        >>> result = oc.distil(oc.grow(problem), oc.Polynomial(degree=3), samples=300)
        >>> result.distilled.task_angle.std < 1.0  # [deg]; 0 before
        True
        >>> result.chart.function("xi").name()
        'xi'
    """
    parametrisation = Polynomial(RULES.degree) if parametrisation is None else parametrisation
    if not isinstance(parametrisation, Parametrisation) or parametrisation.closed_form is not None:
        raise InvalidValueError(
            "parametrisation", repr(parametrisation), "a family with parameters to fit, such as Polynomial(6)"
        )
    # Circle-valued coordinates are fitted by the family of their cosines and sines
    require_kind("chart", chart, Chart)
    watch = Watch(monitor, f"distil {parametrisation.label}")
    if not isinstance(chart.coordinates, GrownCoordinates):
        raise InvalidValueError("chart", f"a chart of kind {chart.coordinates.label}", "a grown chart")
    space = JointSpace.of(chart.problem)
    whole = parametrisation.family(space, chart.r)
    circle = whole if isinstance(whole, CircleFamily) else None
    if circle is not None and not chart.parts.turns.any():
        raise InvalidValueError(
            "parametrisation", parametrisation.label, "another one, because no coordinate of the chart is an angle"
        )
    family = whole if circle is None else circle.pairs
    if isinstance(family, LinearFamily):
        if solver is not None:
            raise InvalidValueError("solver", repr(solver), "no solver, because bases are fitted by least squares")
        needed = 8.0 * family.width * (3 * family.width + (chart.n + 1) * RULES.chunk)
        require_memory(f"least squares with {family.width} terms", needed)
    default = int(np.clip(RULES.per_parameter * family.size // chart.r, RULES.least_samples, RULES.most_samples))
    count = default if samples is None else require_count("samples", samples)
    if count * (1 + chart.n) <= family.size / chart.r:
        enough = f"more, for the {family.size // chart.r} parameters of a coordinate"
        raise InvalidValueError("samples", count, enough)
    require_memory(f"distilling with {count} samples", 8.0 * count * chart.n * (chart.n + 4))
    # Take values and gradients of the grown chart at the samples where it has them
    points = sample_evenly(chart.problem.domain, count, require_count("seed", seed, least=0))
    targets = _sample_targets(chart, points)
    own_targets = targets
    if circle is not None:
        # The targets are the cosines, then the sines of the angles, and their gradients
        c, s, g = np.cos(targets.xi), np.sin(targets.xi), targets.gradients
        gradients = np.concatenate([-s[:, :, None] * g, c[:, :, None] * g], axis=1)
        own_targets = replace(targets, xi=np.concatenate([c, s], axis=1), gradients=gradients)
    # Fit bases by least squares, and networks by a minimiser
    if isinstance(family, LinearFamily):
        theta, offset = _solve_least_squares(family, own_targets, watch)
    else:
        minimiser = LBFGS(max_iterations=500, tolerance=1e-9) if solver is None else solver
        result = minimiser.minimise(_Distance(family, own_targets), family.initial(seed), watch).require_finished()
        # The output bias of a network serves as the offset
        theta, offset = result.theta, np.zeros(family.outputs)
    if circle is not None:
        theta, offset = np.concatenate([theta, -offset[: circle.constants]]), np.zeros(chart.r)
    coordinates = Coordinates(parametrisation, space, (), theta, offset, np.ones(chart.r))
    return _evaluate(
        chart, Chart(chart.problem, coordinates, {"distilled from": chart.coordinates.label}), targets, count
    )


@dataclass(frozen=True, eq=False, repr=False)
class Distilled(Shown):
    """A fitted chart that replaces a grown one, and its errors."""

    chart: Chart
    value_rms: Array  #: root mean square of xi - xi_grown over held-out samples, (r,)
    gradient_rms: Array  #: root mean square of |dxi - dxi_grown| / |dxi_grown|, (r,)
    grown: Report  #: quality of the grown chart
    distilled: Report  #: quality of the fitted chart; the task angle of the grown chart is exactly 90 degrees
    left_out: float  #: share of training samples where the grown chart has no value

    def facts(self) -> dict[str, str]:
        """The fitted parametrisation, and its errors in values and gradients on held-out samples."""
        before, after = self.grown.task_angle, self.distilled.task_angle
        return {
            "distilled": f"{self.chart.coordinates.label} for {self.chart.notes['distilled from']} coordinates",
            "problem": self.chart.problem.heading,
            "error of xi": f"{number_list(self.value_rms)} (root mean square)",
            "error of gradients": f"{number_list(self.gradient_rms)} (relative)",
            "task angle": f"std {after.std:.3g} deg, before {before.std:.3g} deg",
            "left out": f"{percent(self.left_out, 3, fault=True)} of the samples",
        }


@dataclass(frozen=True, eq=False)
class _Targets:
    """Values and gradients of the grown chart."""

    points: Array  #: (N, n)
    xi: Array  #: (N, r)
    gradients: Array  #: (N, r, n), multiplied by `weight`
    weight: float  #: length scale that makes gradients comparable to values


def _sample_targets(chart: Chart, points: Array) -> _Targets:
    """Grown values and gradients at the points that have them."""
    xi, gradients = chart.coordinates.xi(points), chart.coordinates.jacobian(points)
    finite = np.isfinite(xi).all(axis=1) & np.isfinite(gradients).all(axis=(1, 2))
    if not finite.any():
        raise GrowError(f"the grown chart has no value at any of {len(points)} samples of the domain")
    weight = float(chart.problem.domain.half_width.mean())
    return _Targets(points[finite], xi[finite], gradients[finite] * weight, weight)


def _evaluate(chart: Chart, distilled: Chart, targets: _Targets, count: int) -> Distilled:
    # Measure errors on samples that the fit has not seen
    held_out = sample_uniform(chart.problem.domain, min(count, RULES.held_out), RULES.held_out_seed)
    held_out_targets = _sample_targets(chart, held_out)
    errors = wrap_shortest(
        distilled.coordinates.xi(held_out_targets.points) - held_out_targets.xi, distilled.parts.turns[chart.m :]
    )
    # Relative errors of the gradients
    gradients = held_out_targets.gradients / held_out_targets.weight
    turned = np.linalg.norm(distilled.coordinates.jacobian(held_out_targets.points) - gradients, axis=2)
    relative = turned / np.linalg.norm(gradients, axis=2)
    return Distilled(
        chart=distilled,
        value_rms=np.sqrt((errors**2).mean(axis=0)),
        gradient_rms=np.sqrt((relative**2).mean(axis=0)),
        grown=evaluate(chart, len(held_out), RULES.held_out_seed),
        distilled=evaluate(distilled, len(held_out), RULES.held_out_seed),
        left_out=1 - len(targets.points) / count,
    )


def _solve_least_squares(family: LinearFamily, targets: _Targets, watch: Watch) -> tuple[Array, Array]:
    """Coefficients and offset of the best linear combination, by normal equations over chunks of samples."""
    # A function for values and gradients of the basis
    n, K = targets.points.shape[1], family.width
    q = ca.SX.sym("q", n)
    basis = family.basis(q)
    both = Batched(dense_function("basis", [q], [basis, ca.jacobian(basis, q)]))
    # Sum up the normal equations over parts of the samples, to limit the memory. The last column is the offset
    normal, right = np.zeros((K + 1, K + 1)), np.zeros((K + 1, family.outputs))
    for start in range(0, len(targets.points), RULES.chunk):
        part = slice(start, start + RULES.chunk)
        watch.monitor(Progress(watch.stage, start / len(targets.points), f"{start} samples"))
        values, slopes = both(targets.points[part])
        slopes = slopes.reshape(len(values), K, n).transpose(0, 2, 1).reshape(-1, K) * targets.weight
        constant = np.r_[np.ones(len(values)), np.zeros(len(slopes))]
        rows = np.column_stack([np.vstack([values, slopes]), constant])
        sides = np.vstack([targets.xi[part], targets.gradients[part].transpose(0, 2, 1).reshape(-1, family.outputs)])
        normal += rows.T @ rows
        right += rows.T @ sides
    solution: Array = np.asarray(np.linalg.lstsq(normal, right, rcond=1e-14)[0], dtype=float)
    return solution[:-1].T.ravel(), -solution[-1]


class _Distance:
    """Mean squared distance of values and weighted gradients from the targets, with samples as columns."""

    def __init__(self, family: Family, targets: _Targets) -> None:
        N, n = targets.points.shape
        r = family.outputs
        # The distance as a graph of theta, and its gradient with respect to theta
        theta, q = ca.MX.sym("theta", family.size), ca.MX.sym("q", n, N)
        values, slopes = ca.MX.sym("values", r, N), ca.MX.sym("slopes", r * n, N)
        gradients = ca.vertcat(*family.jacobian(q, theta)) * targets.weight
        distance = (ca.sumsqr(family.expression(q, theta) - values) + ca.sumsqr(gradients - slopes)) / N
        inputs: list[Any] = [theta, q, values, slopes]
        gradient = ca.jtimes(distance, theta, ca.MX(1), True)
        self._value = NumpyGraph("distance", inputs, [distance])
        self._both = NumpyGraph("distance_and_gradient", inputs, [distance, ca.densify(gradient)])
        # The data of the samples, with one sample in a row
        self._data = [np.ascontiguousarray(part) for part in (targets.points, targets.xi, targets.gradients)]
        self._data[2] = self._data[2].reshape(N, r * n)

    def value(self, theta: Array) -> float:
        """The distance to the grown coordinates for parameters theta."""
        return float(self._run(self._value, theta)[0][0, 0])

    def value_and_gradient(self, theta: Array) -> tuple[float, Array]:
        """The distance and its gradient, (size,)."""
        value, gradient = self._run(self._both, theta)
        return float(value[0, 0]), gradient[0]

    def _run(self, graph: Callable[..., list[Array]], theta: Array) -> list[Array]:
        return graph(np.ascontiguousarray(theta), *self._data)
