"""Coordinates of the planar arm with two joints, fitted on the whole torus, for Figs. 17 and 18 of [AS2023].

The paper fits a network; here Fourier terms of degree 12 take some seconds. The loss has many minima on the torus. For
A = M, `oc.fit` finds one where every value occurs twice on a leaf, as in the paper. For A = I, it finds one whose
values occur more often. The minimum of the paper is reached from the cosine of the grown coordinate, which itself has
every value twice.
"""

from functools import partial

import casadi as ca
import numpy as np

from orthocas.casadi_tools.batch import Batched, dense_function
from orthocas.chart import Chart
from orthocas.checks import Array
from orthocas.coordinates.fitted import Coordinates
from orthocas.domains import sample_evenly
from orthocas.fitting.basis_objective import BasisObjective
from orthocas.fitting.fit import fit
from orthocas.fitting.loss import Weights
from orthocas.parametrisations import Fourier, JointSpace, LinearFamily
from orthocas.problem import Problem
from orthocas.reproduce.planar_flow import grown_chart
from orthocas.samples import sample_problem, samples_at
from orthocas.solvers import GaussNewton

_WEIGHTS = Weights(1000.0, 0.0, 0.0, angles="paper")  # one coordinate has no mutual angles


def freely_fitted(problem: Problem, quick: bool) -> Chart:
    """The chart that `oc.fit` finds without a given start."""
    return fit(problem, _series(quick), weights=_WEIGHTS, samples=_sample_count(quick)).chart


def fitted_from_grown(problem: Problem, quick: bool) -> Chart:
    """The chart at the minimum of the loss (25) that is reached from the cosine of the grown coordinate."""
    space, series = JointSpace.of(problem), _series(quick)
    family = series.family(space, 1)
    points = sample_evenly(problem.domain, _sample_count(quick), 0)
    start = _cosine_of_grown(problem, family, points)

    objective = BasisObjective(family, samples_at(problem, points), _WEIGHTS, start, partial(sample_problem, problem))
    theta = GaussNewton().minimise(objective, start).finished().theta
    return Chart(problem, Coordinates(series, space, (), theta, np.zeros(1), np.ones(1)))


def _cosine_of_grown(problem: Problem, family: LinearFamily, points: Array) -> Array:
    """Coefficients of the best fit to cos(xi_grown), (size,)."""
    q = ca.SX.sym("q", problem.n)
    basis = Batched(dense_function("basis", [q], [family.basis(q)]))(points)[0]
    wanted = np.cos(grown_chart(problem).xi(points)[:, 0])
    known = np.isfinite(wanted)
    columns = np.column_stack([basis, np.ones(len(basis))])[known]
    solution: Array = np.asarray(np.linalg.lstsq(columns, wanted[known], rcond=None)[0][:-1], dtype=float)
    return solution


def _series(quick: bool) -> Fourier:
    return Fourier(5 if quick else 12)


def _sample_count(quick: bool) -> int:
    return 1500 if quick else 8000
