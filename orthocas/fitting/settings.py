"""The settings of one fit, checked once."""

from dataclasses import dataclass, replace
from typing import Literal, Self

import numpy as np

from orthocas.bases.family import GradedParametrisation, Parametrisation, require_parametrisation
from orthocas.bases.products import Polynomial
from orthocas.errors import InvalidValueError
from orthocas.fitting.like import RULES as LIKE_RULES
from orthocas.fitting.like import Like, Likeness, LikeTerm
from orthocas.fitting.terms import WeightNumbers, Weights, register_loss_term
from orthocas.solvers.casadi_solvers import Ipopt
from orthocas.solvers.minimisers import LBFGS, GaussNewton, QuasiNewton
from orthocas.solvers.protocol import Solver
from orthocas.tasks.problem import Problem
from orthocas.tools.checks import as_number, require_count, require_kind, require_known

Precision = Literal["double", "single"]
PRECISIONS: tuple[Precision, ...] = ("double", "single")  #: of the large products of a fit


@dataclass(frozen=True, slots=True)
class FitRules:
    """Numbers of fits. Chosen on the planar arms and the iiwa, held on the arms of docs/which_tool.md."""

    default_degree: int = 5
    degree_with_bound: int = 4  #: with a bound on mutual angles
    lower_degrees: tuple[tuple[int, int], ...] = ((8, 4), (9, 3), (12, 2))  #: joints, and the degree from there on
    many_joints: int = 8  #: with more, coordinates are many as well, and the matrix grows with their square
    many_terms: int = 300  #: where a Gauss-Newton matrix takes longer than ten gradients: degree 4 for seven joints
    least_bound_deg: float = 1e-6  #: on mutual angles; rounding hides smaller ones

    least_samples: int = 1000  #: of bases
    residuals: int = 140  #: per coefficient, for which samples are drawn beyond these
    residuals_in_metric: int = 70  #: the same in another metric than the identity: leaks are of the same size
    renewal_in_metric: float = 0.95  #: of the matrix of QuasiNewton there, where losses fall along long valleys
    tolerance_of_many: float = 1e-3  #: of the solver for many joints: half the time, and leaks are 2 % larger
    residuals_of_many: int = 100  #: the same for coordinates of many joints, and nothing beyond them
    network_samples: int = 2000  #: of families that are not linear in their parameters
    first: int = 200  #: samples that scale coordinates
    first_tag: int = 1000  #: their seed tag; stages use other tags
    fresh_tag: int = 2000  #: seed tag of samples drawn while a solver runs
    start_seed: int = 0  #: of the samples of spectral starts, the same for all fits
    trial_degree: int = 3  #: of the trial that chooses among symmetric coordinates

    searched: int = 3  #: degree from which worst points are searched: those of lower degrees differ from the last ones
    rounds: int = 4  #: of the last degree, with the worst points
    least_gain: float = 0.01  #: of the conditioning in a round
    collected: float = 1.5 * 0.2  #: conditioning below which points are collected, before they become worse
    digits: int = 6  #: of gradients at the centre that count for the order: fits end with about as many

    bound_step: float = 0.05  #: of the bounds on the relative singular value that are offered
    failed: float = 0.05  #: conditioning below which a chart is of no use; folds have less than 0
    failed_fraction: float = 0.9  #: of such points that a bound should leave out
    largest_bound: float = 0.25  #: charts that fail at larger singular values have other reasons
    any_bound: float = 1e-12  #: of a ClearBox that only measures


RULES = FitRules()


@dataclass(frozen=True)
class FitSettings:
    """All settings that determine the result of a fit."""

    parametrisation: Parametrisation
    solver: Solver
    weights: Weights
    samples: int | None
    seed: int
    max_mutual_deg: float | None
    split_idle: bool = True
    precision: Precision = "double"
    like: Like | None = None

    @classmethod
    def check(
        cls,
        problem: Problem,
        parametrisation: Parametrisation | None,
        solver: Solver | None,
        weights: Weights | WeightNumbers,
        samples: int | None,
        seed: int,
        max_mutual_deg: float | None,
        split_idle: bool = True,
        precision: Precision = "double",
        like: Likeness | None = None,
    ) -> "FitSettings":
        """Check the settings, and fill in the default parametrisation, solver and angles.

        Raises:
            InvalidValueError, ShapeError: if a setting is invalid, or contradicts another one.
        """
        # the family, for this problem
        require_kind("problem", problem, Problem)
        if parametrisation is None:
            parametrisation = choose_parametrisation(problem, bounded=max_mutual_deg is not None)
        require_parametrisation(parametrisation)
        bound = parametrisation.for_problem(problem)
        if max_mutual_deg is not None:
            max_mutual_deg = _check_bound(bound, max_mutual_deg)
        # the solver; only Ipopt knows bounds
        if solver is None:
            solver = choose_solver(bound, problem) if max_mutual_deg is None else Ipopt()
        if not isinstance(solver, Solver) or isinstance(solver, type):
            raise InvalidValueError("solver", repr(solver), "an object such as GaussNewton()")
        if max_mutual_deg is not None and not isinstance(solver, Ipopt):
            raise InvalidValueError("solver", solver.name, "ipopt, the only solver that supports max_mutual_deg")
        count = None if samples is None else require_count("samples", samples, least=2)
        loss = Weights.of(weights).for_problem(problem)
        require_kind("split_idle", split_idle, bool)
        require_known("precision", precision, PRECISIONS)
        if precision == "single" and max_mutual_deg is not None:
            raise InvalidValueError("precision", "'single' with max_mutual_deg", "double: Ipopt needs its digits")
        tag = require_count("seed", seed, least=0)
        if like is not None and (max_mutual_deg is not None or bound.closed_form is not None):
            other = bound.label if max_mutual_deg is None else "max_mutual_deg"
            raise InvalidValueError("like", f"given with {other}", "a fit of the weighted loss")
        quantities = None if like is None else Like.of(problem, like)
        return cls(bound, solver, loss, count, tag, max_mutual_deg, split_idle, precision, quantities)

    def add_term(self, term: LikeTerm) -> Self:
        """The settings with the term that holds coordinates to quantities among the weights."""
        register_loss_term(term)
        return replace(self, weights=replace(self.weights, extra={**self.weights.extra, term.name: LIKE_RULES.weight}))

    @property
    def single(self) -> bool:
        """Whether large products are computed in single precision."""
        return self.precision == "single"

    @property
    def max_mutual(self) -> float | None:
        """Bound on the root mean square mutual angle's deviation from a right angle [rad]."""
        return None if self.max_mutual_deg is None else float(np.radians(self.max_mutual_deg))

    def fold_weight(self, problem: Problem) -> float:
        """Weight of the fold term; 0 on a torus, where every coordinate has critical points, and with a bound."""
        free = not problem.domain.full_turns and self.max_mutual_deg is None
        return self.weights.folds if free else 0.0


def choose_parametrisation(problem: Problem, bounded: bool) -> Polynomial:
    """Polynomials of degree 5; of 4 with a bound or 8 joints, of 3 with more, of 2 from 12: terms grow too many."""
    fewer = [degree for joints, degree in RULES.lower_degrees if problem.n >= joints]
    return Polynomial(
        degree=min(RULES.degree_with_bound if bounded else RULES.default_degree, *fewer, RULES.default_degree)
    )


def choose_solver(parametrisation: Parametrisation, problem: Problem) -> Solver:
    """Gauss-Newton for families linear in their parameters, with fewer matrices if these are large; else L-BFGS."""
    if not parametrisation.linear:
        return LBFGS()
    terms = parametrisation.term_count(problem.n) if isinstance(parametrisation, GradedParametrisation) else 0
    if terms and problem.n > RULES.many_joints:
        return QuasiNewton(tolerance=RULES.tolerance_of_many)
    if terms <= RULES.many_terms:
        return GaussNewton()
    return QuasiNewton() if problem.metric.is_identity else QuasiNewton(renewal=RULES.renewal_in_metric)


def _check_bound(parametrisation: Parametrisation, max_mutual_deg: float) -> float:
    if parametrisation.closed_form is not None:
        raise InvalidValueError("max_mutual_deg", f"given with {parametrisation.label}", "a parametrisation to fit")
    bound = as_number("max_mutual_deg", max_mutual_deg)
    if not RULES.least_bound_deg <= bound < 90:
        expected = f"an angle from {RULES.least_bound_deg:g} to below 90 degrees"
        raise InvalidValueError("max_mutual_deg", max_mutual_deg, expected)
    return bound
