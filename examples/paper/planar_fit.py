"""Coordinates of the planar arm with two joints, fitted on the whole torus, for Figs. 17 and 18 of [AS2023].

As in the paper, a network starts from random parameters. The loss has many minima on the torus, so another seed may end
in another one. A minimum as the paper describes it, where every value occurs twice on a leaf, is also reached from the
cosine of the grown coordinate, which itself has every value twice (ours).
"""

from dataclasses import replace
from functools import lru_cache, partial

import casadi as ca
import numpy as np

from orthocas.bases import MLP, Fourier, JointSpace, LinearFamily, Parametrisation
from orthocas.charts.chart import Chart
from orthocas.charts.coordinates import Coordinates
from orthocas.fitting.basis_objective import BasisObjective
from orthocas.fitting.terms import Weights
from orthocas.solvers import GaussNewton
from orthocas.tasks.problem import Problem
from orthocas.tasks.samples import evaluate_samples, sample_evenly, sample_problem
from orthocas.tools.batch import Batched, dense_function
from orthocas.tools.checks import Array

from .chosen_fit import ChosenFit
from .planar_flow import grown_chart, planar_problem

_WEIGHTS = Weights(1000.0, 0.0, 0.0, angles="paper")  # one coordinate has no mutual angles


def network(quick: bool) -> Parametrisation:
    """The parametrisation of both figures by itself."""
    return MLP((12, 12) if quick else (32, 32))


@lru_cache(maxsize=16)
def freely_fitted(metric: str, quick: bool, chosen: ChosenFit) -> Chart:
    """The chart that `oc.fit` finds from a random start (networks) or its spectral one (bases)."""
    count = _sample_count(quick) if chosen.parametrisation is not None else None
    return chosen.chart(planar_problem(metric), network(quick), quick, count, _WEIGHTS)


def untrained(quick: bool, chosen: ChosenFit) -> Chart:
    """The chart at the start of `freely_fitted`, for A = I."""
    problem, parametrisation = planar_problem("euclidean"), chosen.parametrisation or network(quick)
    space = JointSpace.of(problem)
    theta = parametrisation.family(space, 1).initial(chosen.seed)
    return Chart(problem, Coordinates(parametrisation, space, (), theta, np.zeros(1), np.ones(1)))


def with_other_seed(chosen: ChosenFit, k: int) -> ChosenFit:
    """The same choice with the k-th seed after its own."""
    return replace(chosen, seed=chosen.seed + k)


def fitted_from_grown(problem: Problem, quick: bool) -> Chart:
    """The chart of Fourier terms at the minimum of the loss (25) that is reached from the cosine of the grown one."""
    space, series = JointSpace.of(problem), Fourier(5 if quick else 12)
    family = series.family(space, 1)
    points = sample_evenly(problem.domain, _sample_count(quick), 0)
    start = _cosine_of_grown(problem, family, points)

    objective = BasisObjective(
        family, evaluate_samples(problem, points), _WEIGHTS, start, partial(sample_problem, problem)
    )
    theta = GaussNewton().minimise(objective, start).require_finished().theta
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


def _sample_count(quick: bool) -> int:
    return 1500 if quick else 8000
